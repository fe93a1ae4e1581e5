"""The projector as a projection matrix in periods: linear start, decomposition, and what can't be a projector.

Absolute phase / 2 pi = w / P, so points X in metres and phases in periods give M (3 x 4) with ``(w_u / P_u, w_v / P_v,
1) ~ M (X, 1)``, and M = K [R | t] with K in periods: focal length / pitch and principal point / pitch of each
direction. The linear solution is Abdel-Aziz and Karara's DLT, normalised as by Hartley and Zisserman, *Multiple View
Geometry*, 2nd ed., algorithm 7.1; the decomposition is theirs too (6.2.4).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import CalibrationError

LEAST_THICKNESS = 0.01
"""Of the surface across its mean plane, as a part of its extent along it (RMS): below, the surface is taken as flat."""
LEAST_GAP = 5.0
"""Between the two smallest singular values of the linear system: less, and the solution is not the only one."""
LEAST_SINGULAR = 1e-5
MOST_SKEW = 0.05
"""Of K, as a part of the focal length: a projector's axes are square to each other to far better than 3 degrees."""
_MOST_TRIMMINGS = 30
_KEPT_MEDIANS = 5.0
_SMALLEST_PERIODS = 1e-9


class Projection(NamedTuple):
    """R (3, 3), t (3,) in m, and in periods: focal lengths (2,) and principal point (2,), along u and v; ``kept`` bool
    (n,): the points it was found from."""

    R: NDArray[np.float64]
    t: NDArray[np.float64]
    focal: NDArray[np.float64]
    centre: NDArray[np.float64]
    kept: NDArray[np.bool_]


def projection_from(points_m: NDArray[np.float64], periods: NDArray[np.float64]) -> Projection:
    """The projection of points (n, 3) in the camera's frame, m, to ``periods`` (n, 2), from those that agree with the
    rest. Raises `CalibrationError` where the points are flat, fit no projection, or only a mirrored or oblique one."""
    kept = np.ones(len(points_m), dtype=bool)
    for _ in range(_MOST_TRIMMINGS):
        matrix, singular = _dlt(points_m[kept], periods[kept])
        projected = points_m @ matrix[:, :3].T + matrix[:, 3]
        with np.errstate(all="ignore"):
            distance = np.linalg.norm(projected[:, :2] / projected[:, 2:] - periods, axis=1)
        before, kept = kept, distance <= _KEPT_MEDIANS * np.median(distance) + _SMALLEST_PERIODS
        if np.array_equal(before, kept):
            break
    extents = np.linalg.svd(points_m[kept] - points_m[kept].mean(axis=0), compute_uv=False)
    if extents[2] < LEAST_THICKNESS * extents[0]:
        raise CalibrationError(
            "the surface is flat, or nearly so, and lies at one place in all views; a projector is not determined by a "
            "plane. Give views of an object with relief, or of several distances"
        )
    if singular[-2] < LEAST_SINGULAR * singular[0] or singular[-2] < LEAST_GAP * singular[-1]:
        raise CalibrationError(
            "no projector explains phase and depth together, or the surface has too little relief for their noise: "
            "expected phases of the frames that this depth was measured from. Check the frame order, the depth's unit "
            "and the camera, or give more views"
        )
    if np.median(projected[:, 2]) < 0:
        matrix = -matrix
    return _decomposed(matrix, kept)


def _dlt(points: NDArray[np.float64], periods: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The projection matrix (3, 4) up to its sign, and the singular values (12,) of the normalised system."""
    normalised = []
    for values in (points, periods):
        centre = values.mean(axis=0)
        scale = max(float(np.sqrt(((values - centre) ** 2).mean())), np.finfo(float).tiny)
        normalised.append(((values - centre) / scale, centre, scale))
    (x, x_centre, x_scale), (w, w_centre, w_scale) = normalised
    x = np.column_stack([x, np.ones(len(x))])
    none = np.zeros_like(x)
    system = [np.hstack([x, none, -w[:, :1] * x]), np.hstack([none, x, -w[:, 1:] * x])]
    _, singular, right = np.linalg.svd(np.linalg.qr(np.vstack(system), mode="r"))
    into = np.diag([1 / x_scale] * 3 + [1.0])
    into[:3, 3] = -x_centre / x_scale
    out = np.diag([w_scale, w_scale, 1.0])
    out[:2, 2] = w_centre
    return out @ right[-1].reshape(3, 4) @ into, singular


def _decomposed(matrix: NDArray[np.float64], kept: NDArray[np.bool_]) -> Projection:
    from scipy.linalg import rq

    if np.linalg.det(matrix[:, :3]) < 0:
        raise CalibrationError(
            "the projector's coordinates are mirrored: u, v and depth make a left-handed frame. One direction's "
            "fringes run backwards (check the frame order), or the images are flipped"
        )
    upper, turned = rq(matrix[:, :3])
    signs = np.sign(np.diag(upper))
    upper, rotation = upper * signs, turned * signs[:, None]
    translation = np.linalg.solve(upper, matrix[:, 3])
    upper = upper / upper[2, 2]
    if abs(upper[0, 1]) > MOST_SKEW * upper[0, 0]:
        raise CalibrationError(
            f"the best projector has oblique axes (skew {upper[0, 1] / upper[0, 0]:.3f} of its focal length, expected "
            f"under {MOST_SKEW}); check the camera, the frame order, and that the depth belongs to these frames"
        )
    return Projection(rotation, translation, np.diag(upper)[:2].copy(), upper[:2, 2].copy(), kept)
