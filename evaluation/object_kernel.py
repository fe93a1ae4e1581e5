"""The compiled first pass over a sample: one walk over both images, no temporary arrays. Imports numba.

Sums run in `LANES` independent lanes a block: one alone would wait for its last addition, and the compiler may not
reorder a sum by itself. Each lane adds a few hundred values, so a sum is as accurate as its block's.
"""

import numpy as np

from fpp_ml_bench.acceleration import njit

LANES = 32


@njit
def object_pass(prediction, target, block, pixels, errors, missing, absolute, squares):  # type: ignore[no-untyped-def]
    """Fill ``pixels``, ``errors``, ``missing`` with the object's and the blocks' background sums; the object's number.

    Flat float32 or float64 images of one size; sums float64, one of |e| and one of e^2 a block.
    """
    found = 0
    size = prediction.size
    lanes, lanes_squared = np.zeros(LANES), np.zeros(LANES)
    for number in range(absolute.size):
        stop = min((number + 1) * block, size)
        lanes[:] = 0
        lanes_squared[:] = 0
        for start in range(number * block, stop, LANES):
            width = min(LANES, stop - start)
            p, t = prediction[start : start + width], target[start : start + width]
            inside = 0
            for k in range(width):
                inside += t[k] > 0
            if inside == 0:
                for k in range(width):
                    error = np.float64(p[k]) - np.float64(t[k])
                    lanes[k] += abs(error)
                    lanes_squared[k] += error * error
                continue
            for k in range(width):
                error = np.float64(p[k]) - np.float64(t[k])
                if t[k] > 0:
                    pixels[found] = start + k
                    errors[found] = error
                    missing[found] = p[k] <= 0
                    found += 1
                else:
                    lanes[k] += abs(error)
                    lanes_squared[k] += error * error
        absolute[number], squares[number] = lanes.sum(), lanes_squared.sum()
    return found


@njit
def headline_pass(prediction, target, block, sums):  # type: ignore[no-untyped-def]
    """Fill ``sums`` (blocks, 4): object |e| and e^2, background |e| and e^2 of each block; the object's pixels.

    Flat float32 or float64 images of one size; sums float64.
    """
    found = 0
    size = prediction.size
    lanes, lanes_squared = np.zeros(LANES), np.zeros(LANES)
    for number in range(sums.shape[0]):
        stop = min((number + 1) * block, size)
        lanes[:] = 0
        lanes_squared[:] = 0
        absolute, squares = 0.0, 0.0
        for start in range(number * block, stop, LANES):
            width = min(LANES, stop - start)
            p, t = prediction[start : start + width], target[start : start + width]
            inside = 0
            for k in range(width):
                inside += t[k] > 0
            found += inside
            if inside == 0:
                for k in range(width):
                    error = np.float64(p[k]) - np.float64(t[k])
                    lanes[k] += abs(error)
                    lanes_squared[k] += error * error
                continue
            for k in range(width):
                error = np.float64(p[k]) - np.float64(t[k])
                if t[k] > 0:
                    absolute += abs(error)
                    squares += error * error
                else:
                    lanes[k] += abs(error)
                    lanes_squared[k] += error * error
        sums[number, 0], sums[number, 1] = absolute, squares
        sums[number, 2], sums[number, 3] = lanes.sum(), lanes_squared.sum()
    return found
