"""Compiled twins of `phase`, `gray_code` and `triangulation` for the decoder: same sums in the same order, fused.

Import only where `fpp_ml_bench.acceleration.numba_enabled`. Pixels are worked off in tiles that stay in the first-level
cache, frame by frame within a tile, so that the compiler can use vector instructions and each grey level is read once.
The loops carry no branches for the same reason. The NumPy functions are the reference; tests hold the two together.
"""

import math

import numpy as np

from fpp_ml_bench.acceleration import njit
from fpp_ml_bench.triangulation import GAUSS_NEWTON_STEPS

TILE = 1024
_HALF_PI = math.pi / 2
_TAU = 2 * math.pi
_TAN_EIGHTH = math.tan(math.pi / 8)


@njit
def _minus_atan2(y, x):  # type: ignore[no-untyped-def]
    """-atan2(y, x) in [-pi, pi) to 2 ulp without a call into the C library, which would stop vectorisation.

    Rational approximation of atan on [0, tan(pi/8)] from Cephes (Moshier 1989), the rest by symmetry.
    """
    ax, ay = abs(x), abs(y)
    small, large = min(ax, ay), max(ax, ay)
    upper = small > _TAN_EIGHTH * large
    top = small - large if upper else small
    bottom = small + large if upper else large
    bottom = bottom if bottom > 0.0 else 1.0
    t = top / bottom
    z = t * t
    p = (((-8.750608600031904122785e-1 * z - 1.615753718733365076637e1) * z - 7.500855792314704667340e1) * z
         - 1.228866684490136173410e2) * z - 6.485021904942025371773e1  # fmt: skip
    q = ((((z + 2.485846490142306297962e1) * z + 1.650270098316988542046e2) * z + 4.328810604912902668951e2) * z
         + 4.853903996359136964868e2) * z + 1.945506571482613964425e2  # fmt: skip
    angle = t + t * z * (p / q)
    angle = angle + math.pi / 4 if upper else angle
    angle = _HALF_PI - angle if ay > ax else angle
    angle = math.pi - angle if x < 0.0 else angle
    angle = angle if y < 0.0 else -angle
    return -math.pi if angle >= math.pi else angle


@njit
def decode_block(  # type: ignore[no-untyped-def]
    frames, weights, bits, centres, pitch, length, limits, codes, coordinate, modulation, phase, reason
):
    """One direction of a block of n pixels: phase, cell, order and projector coordinate.

    ``frames`` uint8 (N + bits, n): sinusoids, then Gray bits; ``weights`` (3, N); ``limits`` = least modulation, most
    clipped steps, ambiguous fraction, inconsistent rad; ``codes`` = low modulation, saturated, inconsistent, outside.
    Fills ``coordinate`` px, ``modulation`` and ``phase`` (float64) and ``reason`` (uint8, 0 = decoded), each (n,).
    """
    steps, total = weights.shape[1], frames.shape[1]
    mean, cosine, sine = np.empty(TILE), np.empty(TILE), np.empty(TILE)
    clipped = np.empty(TILE, np.int32)
    dark, bright, least = np.empty(TILE, np.int16), np.empty(TILE, np.int16), np.empty(TILE, np.int16)
    cell, doubt, previous = np.empty(TILE, np.int16), np.empty(TILE, np.int16), np.empty(TILE, np.int16)
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
            b = math.sqrt(cosine[i] * cosine[i] + sine[i] * sine[i])
            modulation[start + i] = b
            phase[start + i] = _minus_atan2(sine[i], cosine[i])
            margin = limits[2] * b
            # Grey levels are whole numbers, so the float comparisons become exact integer ones: grey > mean is
            # grey > floor(mean), and |grey - mean| < margin is dark < grey < bright.
            least[i] = np.int16(math.floor(mean[i]))
            dark[i] = np.int16(max(math.floor(mean[i] - margin), -1.0))
            bright[i] = np.int16(min(math.ceil(mean[i] + margin), 256.0))
        for bit in range(bits):
            row = frames[steps + bit, start : start + n]
            for i in range(n):
                grey = np.int16(row[i])
                previous[i] ^= grey > least[i]
                cell[i] = np.int16(cell[i] * 2 + previous[i])
                doubt[i] = np.int16(doubt[i] * 2 + ((grey > dark[i]) & (grey < bright[i])))
        for i in range(n):
            number = np.int32(cell[i])
            even = number + (number & 1)
            trusted = (doubt[i] <= 1) | (doubt[i] == (even & -even))
            centre = centres[min(number, cells - 1)]
            phi = phase[start + i]
            absolute = phi + _TAU * math.floor((centre - phi) / _TAU + 0.5)
            trusted = trusted & (number < cells) & (abs(absolute - centre) <= limits[3])
            w = absolute * (pitch / _TAU)
            coordinate[start + i] = w
            code = codes[3] if (w < -0.5) | (w > length - 0.5) else np.uint8(0)
            code = code if trusted else codes[2]
            code = codes[1] if clipped[i] > limits[1] else code
            reason[start + i] = code if modulation[start + i] >= limits[0] else codes[0]


@njit
def depth_one(x, y, coordinate, rotation, translation, axis, focal, centre, depth_mm):  # type: ignore[no-untyped-def]
    """`triangulation.depth_from_coordinate` for an undistorted projector; all arrays (n,), ``depth_mm`` is filled."""
    r0, r1, r2 = rotation[axis, 0], rotation[axis, 1], rotation[axis, 2]
    s0, s1, s2 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    t, tz = translation[axis], translation[2]
    for i in range(len(x)):
        ideal = (coordinate[i] - centre) / focal
        forward = s0 * x[i] + s1 * y[i] + s2
        z = (ideal * tz - t) / (r0 * x[i] + r1 * y[i] + r2 - ideal * forward)
        good = (z > 0.0) & (z < np.inf) & (forward * z + tz > 0.0)
        depth_mm[i] = z * 1000.0 if good else np.nan


@njit
def depth_both(  # type: ignore[no-untyped-def]
    x, y, u, v, weight_u, weight_v, rotation, translation, focal, centre, depth_mm, disagreement
):
    """`triangulation.depth_from_both` for an undistorted projector; ``focal`` and ``centre`` are pairs.

    ``weight_u`` and ``weight_v`` are B / P here and squared inside. Fills ``depth_mm`` and ``disagreement`` (px).
    """
    (fx, fy), (cx, cy) = focal, centre
    tx, ty, tz = translation[0], translation[1], translation[2]
    for i in range(len(x)):
        a0 = rotation[0, 0] * x[i] + rotation[0, 1] * y[i] + rotation[0, 2]
        a1 = rotation[1, 0] * x[i] + rotation[1, 1] * y[i] + rotation[1, 2]
        forward = rotation[2, 0] * x[i] + rotation[2, 1] * y[i] + rotation[2, 2]
        px, py = (u[i] - cx) / fx, (v[i] - cy) / fy
        wu, wv = weight_u[i] * weight_u[i], weight_v[i] * weight_v[i]
        cu, du = fx * (a0 - px * forward), fx * (px * tz - tx)
        cv, dv = fy * (a1 - py * forward), fy * (py * tz - ty)
        w = (wu * cu * du + wv * cv * dv) / (wu * du * du + wv * dv * dv)
        if tz != 0.0:
            for _ in range(GAUSS_NEWTON_STEPS):
                q = forward + tz * w
                ru, rv = (cu - du * w) / q, (cv - dv * w) / q
                gu, gv = (du + ru * tz) / q, (dv + rv * tz) / q
                w = w + (wu * ru * gu + wv * rv * gv) / (wu * gu * gu + wv * gv * gv)
        q = forward + tz * w
        ru, rv = (cu - du * w) / q, (cv - dv * w) / q
        gu, gv = (du + ru * tz) / q, (dv + rv * tz) / q
        disagreement[i] = abs(ru * gv - rv * gu) / math.sqrt(gu * gu + gv * gv)
        z = 1.0 / w
        good = (z > 0.0) & (z < np.inf) & (forward * z + tz > 0.0)
        depth_mm[i] = z * 1000.0 if good else np.nan
