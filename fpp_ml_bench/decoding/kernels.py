"""Compiled kernels of the decoder: the sums of `phase`, `gray_code` and `triangulation` in the same order, fused.

Import only where `fpp_ml_bench.machine.numba_enabled`. Pixels are processed in tiles that stay in the first-level
cache, frame by frame and without branches, so that the compiler can use vector instructions. The NumPy functions are
the reference. ``rays`` are the pixels' normalised (x, y), (n,) each; ``geometry`` is R, t and the projector's (fx, fy)
and (cx, cy); results are filled in.
"""

import math

import numpy as np

from fpp_ml_bench.decoding.triangulation import GAUSS_NEWTON_STEPS, LEAST_PARALLAX
from fpp_ml_bench.machine import njit
from fpp_ml_bench.portable import ATAN_BOTTOM as BOTTOM
from fpp_ml_bench.portable import ATAN_TOP as TOP
from fpp_ml_bench.portable import TAN_EIGHTH

TILE = 1024
_TAU = 2 * math.pi


@njit
def _minus_atan2(y, x):  # type: ignore[no-untyped-def]
    """-atan2(y, x) in [-pi, pi) to 2 ulp: `portable.arctangent2` without calls, which would stop vectorisation."""
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

    ``frames`` uint8 (N + bits, n): sinusoids, then Gray bits; ``weights`` (3, N); ``code`` = number of Gray bits, cell
    centres in rad, pitch and length in px; ``limits`` = least modulation, most clipped steps, ambiguous fraction,
    inconsistent rad; ``codes`` = low modulation, saturated, inconsistent, outside; ``results`` = coordinate px,
    modulation and phase (float64) and reason (uint8, 0 = decoded), each (n,)."""
    bits, centres, pitch, length = code
    coordinate, modulation, phase, reason = results
    steps, total = weights.shape[1], frames.shape[1]
    mean, cosine, sine = np.empty(TILE), np.empty(TILE), np.empty(TILE)
    clipped, centre, faulty = np.empty(TILE, np.int32), np.empty(TILE), np.empty(TILE)
    dark, bright, threshold = np.empty(TILE, np.int16), np.empty(TILE, np.int16), np.empty(TILE, np.int16)
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
            phase[start + i] = _minus_atan2(sine[i], cosine[i])
        for i in range(n):
            b = math.sqrt(cosine[i] * cosine[i] + sine[i] * sine[i])
            modulation[start + i] = b
            margin = limits[2] * b
            # Grey levels are whole numbers, so the float comparisons become exact integer comparisons: grey > mean is
            # grey > floor(mean), and mean - margin < grey < mean + margin is dark < grey < bright.
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


@njit
def _rotated(rotation, axis, x, y):  # type: ignore[no-untyped-def]
    return rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2]


@njit
def _depth(z, forward, tz):  # type: ignore[no-untyped-def]
    """Depth in mm where ``z`` (m) is finite and in front of both devices, else NaN."""
    return z * 1000.0 if (z > 0.0) & (z < np.inf) & (forward * z + tz > 0.0) else np.nan


@njit
def depth_from_coordinate(rays, coordinate, axis, geometry, depth_mm):  # type: ignore[no-untyped-def]
    """`triangulation.depth_from_coordinate` for an undistorted projector; all arrays (n,)."""
    (x, y), (rotation, translation, focals, centres) = rays, geometry
    t, tz, focal, centre = translation[axis], translation[2], focals[axis], centres[axis]
    for i in range(len(x)):
        ideal = (coordinate[i] - centre) / focal
        forward = _rotated(rotation, 2, x[i], y[i])
        along, across = _rotated(rotation, axis, x[i], y[i]), ideal * forward
        depth = _depth((ideal * tz - t) / (along - across), forward, tz)
        size = abs(along) + (abs(coordinate[i]) + abs(centre)) / focal * abs(forward)
        depth_mm[i] = depth if abs(along - across) > LEAST_PARALLAX * size else np.nan


@njit
def _residual_and_slope(c, d, q, tz, w):  # type: ignore[no-untyped-def]
    r = (c - d * w) / q
    return r, (d + r * tz) / q


@njit
def depth_from_both(rays, coordinates, weights, geometry, results):  # type: ignore[no-untyped-def]
    """`triangulation.depth_from_both` for an undistorted projector; ``results`` = depth in mm, disagreement in px;
    ``weights`` are B / P here and squared inside."""
    (x, y), (u, v), (weight_u, weight_v) = rays, coordinates, weights
    rotation, translation, (fx, fy), (cx, cy) = geometry
    depth_mm, disagreement = results
    tx, ty, tz = translation[0], translation[1], translation[2]
    cu, du, cv, dv = np.empty(TILE), np.empty(TILE), np.empty(TILE), np.empty(TILE)
    forward, inverse = np.empty(TILE), np.empty(TILE)
    for start in range(0, len(x), TILE):
        n = min(TILE, len(x) - start)
        for i in range(n):
            j = start + i
            # By hand, because here, with the many arrays of this loop, three calls of `_rotated` cost 4% of the time.
            a0 = rotation[0, 0] * x[j] + rotation[0, 1] * y[j] + rotation[0, 2]
            a1 = rotation[1, 0] * x[j] + rotation[1, 1] * y[j] + rotation[1, 2]
            forward[i] = rotation[2, 0] * x[j] + rotation[2, 1] * y[j] + rotation[2, 2]
            px, py = (u[j] - cx) / fx, (v[j] - cy) / fy
            wu, wv = weight_u[j] * weight_u[j], weight_v[j] * weight_v[j]
            cu[i], du[i] = fx * (a0 - px * forward[i]), fx * (px * tz - tx)
            cv[i], dv[i] = fy * (a1 - py * forward[i]), fy * (py * tz - ty)
            inverse[i] = (wu * cu[i] * du[i] + wv * cv[i] * dv[i]) / (wu * du[i] * du[i] + wv * dv[i] * dv[i])
        if tz != 0.0:
            for _ in range(GAUSS_NEWTON_STEPS):
                for i in range(n):
                    wu, wv = weight_u[start + i] * weight_u[start + i], weight_v[start + i] * weight_v[start + i]
                    q = forward[i] + tz * inverse[i]
                    ru, gu = _residual_and_slope(cu[i], du[i], q, tz, inverse[i])
                    rv, gv = _residual_and_slope(cv[i], dv[i], q, tz, inverse[i])
                    inverse[i] += (wu * ru * gu + wv * rv * gv) / (wu * gu * gu + wv * gv * gv)
        for i in range(n):
            q = forward[i] + tz * inverse[i]
            ru, gu = _residual_and_slope(cu[i], du[i], q, tz, inverse[i])
            rv, gv = _residual_and_slope(cv[i], dv[i], q, tz, inverse[i])
            disagreement[start + i] = abs(ru * gv - rv * gu) / math.sqrt(gu * gu + gv * gv)
            depth_mm[start + i] = _depth(1.0 / inverse[i], forward[i], tz)


@njit
def reach(rays, coordinate, axis, geometry, depths, allowance, reached):  # type: ignore[no-untyped-def]
    """`blocks.within_reach`: ``depths`` = near, far (m); ``allowance`` = disagreement, slack (px)."""
    (x, y), (near, far), (disagreement, slack) = rays, depths, allowance
    rotation, translation, focal, centre = geometry
    other = 1 - axis
    f, c, g = focal[axis], centre[axis], focal[other]
    tx, ty, tz = translation[axis], translation[other], translation[2]
    for i in range(len(x)):
        a, b = _rotated(rotation, axis, x[i], y[i]), _rotated(rotation, other, x[i], y[i])
        forward = _rotated(rotation, 2, x[i], y[i])
        first, last = near * forward + tz, far * forward + tz
        begin, end = f * (near * a + tx) / first + c, f * (far * a + tx) / last + c
        along, across = end - begin, g * (far * b + ty) / last - g * (near * b + ty) / first
        margin = disagreement * math.sqrt(along * along + across * across) / abs(across) + slack
        outside = (coordinate[i] < min(begin, end) - margin) | (coordinate[i] > max(begin, end) + margin)
        reached[i] = not (outside & (first > 0.0) & (last > 0.0))


@njit
def joint_orders(rays, phases, axis, geometry, depths, pitches, search, results):  # type: ignore[no-untyped-def]
    """`fewest.nearest_pair`: ``results`` = both orders and the pair's distance (px), float64 (n,). ``phases`` and
    ``pitches`` (px) of ``axis`` and of the other axis; ``depths`` in m; ``search`` = tolerance (px), orders to try."""
    (x, y), (first, second), (near, far), (tolerance, tries) = rays, phases, depths, search
    rotation, translation, focal, centre = geometry
    order_first, order_second, nearest = results
    other = 1 - axis
    ta, tb, tz = translation[axis], translation[other], translation[2]
    fa, fb, ca, cb = focal[axis], focal[other], centre[axis], centre[other]
    pa, pb = pitches
    inverse_a, inverse_b, per_rad_a, per_rad_b = 1.0 / pa, 1.0 / pb, pa / _TAU, pb / _TAU
    for i in range(len(x)):
        a, b = _rotated(rotation, axis, x[i], y[i]), _rotated(rotation, other, x[i], y[i])
        forward = _rotated(rotation, 2, x[i], y[i])
        q, r = near * forward + tz, far * forward + tz
        nearest[i], order_first[i], order_second[i] = np.inf, 0.0, 0.0
        if not ((q > 0.0) & (r > 0.0)):
            continue
        a_near, a_far = fa * (near * a + ta) / q + ca, fa * (far * a + ta) / r + ca
        b_near, b_far = fb * (near * b + tb) / q + cb, fb * (far * b + tb) / r + cb
        along, across = a_far - a_near, b_far - b_near
        slope, share = across / along, abs(along) / math.sqrt(along * along + across * across)
        low, high = min(a_near, a_far) - tolerance, max(a_near, a_far) + tolerance
        start = math.ceil((low - first[i] * per_rad_a) * inverse_a)
        position = first[i] * per_rad_a + start * pa
        offset = b_near - second[i] * per_rad_b
        for step in range(tries):
            predicted = offset + (position - a_near) * slope  # position from the second direction's order 0, px
            second_order = math.floor(predicted * inverse_b + 0.5)
            distance = abs(second_order * pb - predicted) * share
            if (distance < nearest[i]) & (position <= high):
                nearest[i], order_first[i], order_second[i] = distance, start + step, second_order
            position += pa
