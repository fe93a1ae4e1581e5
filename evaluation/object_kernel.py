"""The compiled first pass over a sample: one walk over both images, no temporary arrays. Imports numba."""

import numpy as np

from fpp_ml_bench.acceleration import njit


@njit
def object_pass(prediction, target, block, index, errors, missing, absolute, squares):  # type: ignore[no-untyped-def]
    """Fill ``index``, ``errors``, ``missing`` with the object's pixels and the blocks' background sums; their number.

    Four independent sums a block: one alone would wait for its last addition, and no reordering by the compiler is
    allowed. Flat float32 or float64 images of one size; sums float64.
    """
    found = 0
    size = prediction.size
    for number in range(absolute.size):
        start = number * block
        stop = min(start + block, size)
        a0, a1, a2, a3 = 0.0, 0.0, 0.0, 0.0
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        i = start
        while i + 4 <= stop:
            if target[i] > 0 or target[i + 1] > 0 or target[i + 2] > 0 or target[i + 3] > 0:
                for j in range(i, i + 4):
                    error = np.float64(prediction[j]) - np.float64(target[j])
                    if target[j] > 0:
                        index[found] = j
                        errors[found] = error
                        missing[found] = prediction[j] <= 0
                        found += 1
                    else:
                        a0 += abs(error)
                        s0 += error * error
            else:
                e0 = np.float64(prediction[i]) - np.float64(target[i])
                e1 = np.float64(prediction[i + 1]) - np.float64(target[i + 1])
                e2 = np.float64(prediction[i + 2]) - np.float64(target[i + 2])
                e3 = np.float64(prediction[i + 3]) - np.float64(target[i + 3])
                a0 += abs(e0)
                a1 += abs(e1)
                a2 += abs(e2)
                a3 += abs(e3)
                s0 += e0 * e0
                s1 += e1 * e1
                s2 += e2 * e2
                s3 += e3 * e3
            i += 4
        while i < stop:
            error = np.float64(prediction[i]) - np.float64(target[i])
            if target[i] > 0:
                index[found] = i
                errors[found] = error
                missing[found] = prediction[i] <= 0
                found += 1
            else:
                a0 += abs(error)
                s0 += error * error
            i += 1
        absolute[number] = (a0 + a1) + (a2 + a3)
        squares[number] = (s0 + s1) + (s2 + s3)
    return found


@njit
def headline_pass(prediction, target, block, sums):  # type: ignore[no-untyped-def]
    """Fill ``sums`` (blocks, 4): object |e| and e^2, background |e| and e^2 of each block; the object's pixels.

    Flat float32 or float64 images of one size; sums float64, four independent ones as in `object_pass`.
    """
    found = 0
    size = prediction.size
    for number in range(sums.shape[0]):
        start = number * block
        stop = min(start + block, size)
        a0, a1, a2, a3 = 0.0, 0.0, 0.0, 0.0
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        inside, inside_squares = 0.0, 0.0
        i = start
        while i + 4 <= stop:
            e0 = np.float64(prediction[i]) - np.float64(target[i])
            e1 = np.float64(prediction[i + 1]) - np.float64(target[i + 1])
            e2 = np.float64(prediction[i + 2]) - np.float64(target[i + 2])
            e3 = np.float64(prediction[i + 3]) - np.float64(target[i + 3])
            if not (target[i] > 0 or target[i + 1] > 0 or target[i + 2] > 0 or target[i + 3] > 0):
                a0 += abs(e0)
                a1 += abs(e1)
                a2 += abs(e2)
                a3 += abs(e3)
                s0 += e0 * e0
                s1 += e1 * e1
                s2 += e2 * e2
                s3 += e3 * e3
            elif target[i] > 0 and target[i + 1] > 0 and target[i + 2] > 0 and target[i + 3] > 0:
                inside += (abs(e0) + abs(e1)) + (abs(e2) + abs(e3))
                inside_squares += (e0 * e0 + e1 * e1) + (e2 * e2 + e3 * e3)
                found += 4
            else:
                for j in range(i, i + 4):
                    error = np.float64(prediction[j]) - np.float64(target[j])
                    if target[j] > 0:
                        inside += abs(error)
                        inside_squares += error * error
                        found += 1
                    else:
                        a0 += abs(error)
                        s0 += error * error
            i += 4
        while i < stop:
            error = np.float64(prediction[i]) - np.float64(target[i])
            if target[i] > 0:
                inside += abs(error)
                inside_squares += error * error
                found += 1
            else:
                a0 += abs(error)
                s0 += error * error
            i += 1
        sums[number, 0], sums[number, 1] = inside, inside_squares
        sums[number, 2], sums[number, 3] = (a0 + a1) + (a2 + a3), (s0 + s1) + (s2 + s3)
    return found
