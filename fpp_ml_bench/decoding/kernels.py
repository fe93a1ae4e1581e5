"""Compiled kernels of the triangulation and of the orders from two phases.
`fpp_ml_bench.coding.kernels` says how they work, and that they are imported where they are called.

``rays`` are the pixels' normalised (x, y), (n,) each; ``geometry`` is R, t and the projector's (fx,
fy) and (cx, cy); results are filled in.
"""

import math

import numpy as np

from fpp_ml_bench.coding.kernels import TILE
from fpp_ml_bench.machine import njit

_TAU = 2 * math.pi
GAUSS_NEWTON_STEPS = 3
"""The algebraic start is exact for a projector beside the camera (t_2 = 0), close otherwise, and
each step squares its error; after three steps it is below float64's resolution."""
LEAST_PARALLAX = 2.0**-49
"""Least ``|a_0 - x_p a_2|``, relative to the magnitudes of its terms and of the coordinate, of
which its round-off is up to 8 x 2^-53. Below it ray and plane count as parallel: up to half of the
depth would be round-off."""


@njit
def _rotated(rotation, axis, x, y):  # type: ignore[no-untyped-def]
    return rotation[axis, 0] * x + rotation[axis, 1] * y + rotation[axis, 2]


@njit
def _depth(z, forward, tz):  # type: ignore[no-untyped-def]
    """Depth in mm where ``z`` (m) is finite and in front of both devices, else NaN."""
    return z * 1000.0 if (z > 0.0) & (z < np.inf) & (forward * z + tz > 0.0) else np.nan


@njit
def depth_from_coordinate(rays, straight, pixels, axis, geometry, depth_mm):  # type: ignore[no-untyped-def]
    """`triangulation.depth_from_coordinate`: coordinates ``straight``, without the lens's
    distortion, in ``pixels``: their size, the place of the principal point, and what their
    round-off is more than theirs; all arrays (n,)."""
    (x, y), (size, origin, more), (rotation, translation, _, _) = rays, pixels, geometry
    t, tz = translation[axis], translation[2]
    for i in range(len(x)):
        ideal = (straight[i] - origin) / size
        forward = _rotated(rotation, 2, x[i], y[i])
        along, across = _rotated(rotation, axis, x[i], y[i]), ideal * forward
        depth = _depth((ideal * tz - t) / (along - across), forward, tz)
        least = LEAST_PARALLAX * (
            abs(along) + ((abs(straight[i]) + abs(origin)) / size + more) * abs(forward)
        )
        depth_mm[i] = depth if abs(along - across) > least else np.nan


@njit
def _residual_and_slope(c, d, q, tz, w):  # type: ignore[no-untyped-def]
    r = (c - d * w) / q
    return r, (d + r * tz) / q


@njit
def depth_from_both(rays, straight, pixels, weights, geometry, results):  # type: ignore[no-untyped-def]
    """`triangulation.depth_from_both`: ``straight`` coordinates and ``pixels`` as in
    `depth_from_coordinate`, of both directions; ``results`` = depth in mm, disagreement in px. The
    residual in px is ``f (c - d w) / (forward + t_2 w)`` at inverse depth w; c and d, with f in
    them, are fixed by the measurement."""
    (x, y), (u, v), ((su, ou), (sv, ov)), (weight_u, weight_v) = rays, straight, pixels, weights
    rotation, translation, (fx, fy), _ = geometry
    depth_mm, disagreement = results
    tx, ty, tz = translation[0], translation[1], translation[2]
    cu, du, cv, dv = np.empty(TILE), np.empty(TILE), np.empty(TILE), np.empty(TILE)
    forward, inverse = np.empty(TILE), np.empty(TILE)
    for start in range(0, len(x), TILE):
        n = min(TILE, len(x) - start)
        for i in range(n):
            j = start + i
            # By hand, because here, with the many arrays of this loop, three calls of `_rotated`
            # cost 4% of the time.
            a0 = rotation[0, 0] * x[j] + rotation[0, 1] * y[j] + rotation[0, 2]
            a1 = rotation[1, 0] * x[j] + rotation[1, 1] * y[j] + rotation[1, 2]
            forward[i] = rotation[2, 0] * x[j] + rotation[2, 1] * y[j] + rotation[2, 2]
            wu, wv = weight_u[j], weight_v[j]
            px, py = (u[j] - ou) / su, (v[j] - ov) / sv
            cu[i], du[i] = fx * (a0 - px * forward[i]), fx * (px * tz - tx)
            cv[i], dv[i] = fy * (a1 - py * forward[i]), fy * (py * tz - ty)
            inverse[i] = (wu * cu[i] * du[i] + wv * cv[i] * dv[i]) / (
                wu * du[i] * du[i] + wv * dv[i] * dv[i]
            )
        if tz != 0.0:
            for _ in range(GAUSS_NEWTON_STEPS):
                for i in range(n):
                    wu, wv = weight_u[start + i], weight_v[start + i]
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
    """`blocks.within_reach`: ``depths`` = near, far (m); ``allowance`` = disagreement, slack
    (px)."""
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
        outside = (coordinate[i] < min(begin, end) - margin) | (
            coordinate[i] > max(begin, end) + margin
        )
        reached[i] = not (outside & (first > 0.0) & (last > 0.0))


@njit
def joint_orders(rays, phases, axis, geometry, depths, pitches, search, results):  # type: ignore[no-untyped-def]
    """`fewest.nearest_pair`: ``results`` = both orders and the pair's distance (px), float64 (n,).
    ``phases`` and ``pitches`` (px) of ``axis`` and of the other axis; ``depths`` in m; ``search`` =
    tolerance (px), orders to try."""
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
            predicted = (
                offset + (position - a_near) * slope
            )  # position from the second direction's order 0, px
            second_order = math.floor(predicted * inverse_b + 0.5)
            distance = abs(second_order * pb - predicted) * share
            if (distance < nearest[i]) & (position <= high):
                nearest[i], order_first[i], order_second[i] = distance, start + step, second_order
            position += pa
