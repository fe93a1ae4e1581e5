"""Compiled kernels of the codes: phase, cell and order of a block of pixels, fused.

They are imported where they are called, since numba takes longer to import than most commands take.
Pixels are processed in tiles that stay in the first-level cache, frame by frame and without
branches, so that the compiler can use vector instructions.
"""

import math

import numpy as np

from fpp_ml_bench.machine import njit

TILE = 1024
"""Pixels that are decoded at once: their intermediate values, 56 bytes each, stay in the cache."""
_TAU = 2 * math.pi
TOP = (
    -6.485021904942025371773e1,
    -1.228866684490136173410e2,
    -7.500855792314704667340e1,
    -1.615753718733365076637e1,
    -8.750608600031904122785e-1,
)
BOTTOM = (
    1.945506571482613964425e2,
    4.853903996359136964868e2,
    4.328810604912902668951e2,
    1.650270098316988542046e2,
    2.485846490142306297962e1,
    1.0,
)
"""Cephes (Moshier 1989): atan(t) = t + t z P(z) / Q(z) with z = t^2 on [0, tan(pi/8)], lowest
coefficient first."""
TAN_EIGHTH = math.sqrt(2.0) - 1.0


@njit
def _minus_atan2(y, x):  # type: ignore[no-untyped-def]
    """-atan2(y, x) in [-pi, pi) to 2 ulp, with the same bits on every processor; without calls,
    which would stop vectorisation."""
    ax, ay = abs(x), abs(y)
    small, large = min(ax, ay), max(ax, ay)
    upper = small > TAN_EIGHTH * large
    top = small - large if upper else small
    bottom = small + large if upper else large
    bottom = bottom if bottom > 0.0 else 1.0
    t = top / bottom
    z = t * t
    p = (((TOP[4] * z + TOP[3]) * z + TOP[2]) * z + TOP[1]) * z + TOP[0]
    q = ((((z + BOTTOM[4]) * z + BOTTOM[3]) * z + BOTTOM[2]) * z + BOTTOM[1]) * z + BOTTOM[0]
    angle = t + t * z * (p / q)
    angle = angle + math.pi / 4 if upper else angle
    angle = math.pi / 2 - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    angle = angle if y < 0.0 else -angle
    return -math.pi if angle >= math.pi else angle


@njit
def minus_atan2_all(sine, cosine, phase):  # type: ignore[no-untyped-def]
    """`phase.minus_atan2`: fills ``phase``; all flat float64 of one length."""
    for i in range(phase.size):
        phase[i] = _minus_atan2(sine[i], cosine[i])


@njit
def decode_block(frames, weights, code, limits, codes, results):  # type: ignore[no-untyped-def]
    """A direction of a block of n pixels: phase, cell, order and projector coordinate.

    ``frames`` uint8 (N + bits, n): sinusoids, then Gray bits; ``weights`` (3, N); ``code`` = number
    of Gray bits, cell centres in rad, pitch and length in px; ``limits`` = least modulation, most
    clipped steps, ambiguous fraction, inconsistent rad; ``codes`` = low modulation, saturated,
    inconsistent, outside; ``results`` = coordinate px, modulation and phase (float64) and reason
    (uint8, 0 = decoded), each (n,)."""
    bits, centres, pitch, length = code
    coordinate, modulation, phase, reason = results
    steps, total = weights.shape[1], frames.shape[1]
    mean, cosine, sine = np.empty(TILE), np.empty(TILE), np.empty(TILE)
    clipped, centre, faulty = np.empty(TILE, np.int32), np.empty(TILE), np.empty(TILE)
    dark, bright, threshold = (
        np.empty(TILE, np.int16),
        np.empty(TILE, np.int16),
        np.empty(TILE, np.int16),
    )
    cell, doubt, previous = (
        np.empty(TILE, np.int16),
        np.empty(TILE, np.int16),
        np.empty(TILE, np.int16),
    )
    cells = len(centres)
    for start in range(0, total, TILE):
        n = min(TILE, total - start)
        for i in range(n):
            mean[i], cosine[i], sine[i], clipped[i] = 0.0, 0.0, 0.0, 0
            cell[i], doubt[i], previous[i] = 0, 0, 0
        for f in range(steps):
            row = frames[f, start : start + n]
            a, c, s = weights[0, f], weights[1, f], weights[2, f]
            for i in range(n):
                grey = np.float64(row[i])
                mean[i] += a * grey
                cosine[i] += c * grey
                sine[i] += s * grey
            for i in range(n):
                clipped[i] += row[i] == 255
        for i in range(n):
            phase[start + i] = _minus_atan2(sine[i], cosine[i])
        for i in range(n):
            b = math.sqrt(cosine[i] * cosine[i] + sine[i] * sine[i])
            modulation[start + i] = b
            margin = limits[2] * b
            # Grey levels are whole numbers, so the float comparisons become exact integer
            # comparisons: grey > mean is grey > floor(mean), and mean - margin < grey < mean +
            # margin is dark < grey < bright.
            threshold[i] = np.int16(math.floor(mean[i]))
            dark[i] = np.int16(max(math.floor(mean[i] - margin), -1.0))
            bright[i] = np.int16(min(math.ceil(mean[i] + margin), 256.0))
        for bit in range(bits):
            row = frames[steps + bit, start : start + n]
            for i in range(n):
                level = np.int16(row[i])
                previous[i] ^= level > threshold[i]
                cell[i] = np.int16(cell[i] * 2 + previous[i])
                doubt[i] = np.int16(doubt[i] * 2 + ((level > dark[i]) & (level < bright[i])))
        for i in range(n):
            even = np.int16(cell[i] + (cell[i] & 1))
            trusted = (doubt[i] <= 1) | (doubt[i] == (even & -even))
            faulty[i] = 0.0 if trusted & (cell[i] < cells) else 1.0
        for i in range(n):
            centre[i] = centres[min(np.int64(cell[i]), cells - 1)]
        for i in range(n):
            phi = phase[start + i]
            absolute = phi + _TAU * math.floor((centre[i] - phi) / _TAU + 0.5)
            coordinate[start + i] = absolute * (pitch / _TAU)
            faulty[i] += 1.0 if abs(absolute - centre[i]) > limits[3] else 0.0
        for i in range(n):
            w = coordinate[start + i]
            fault = codes[3] if (w < -0.5) | (w > length - 0.5) else 0.0
            fault = codes[2] if faulty[i] > 0.0 else fault
            fault = codes[1] if clipped[i] > limits[1] else fault
            fault = fault if modulation[start + i] >= limits[0] else codes[0]
            reason[start + i] = np.uint8(np.int32(fault))
