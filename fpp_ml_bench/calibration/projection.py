"""The projector from points whose depth is known: what a view says of it, its projection in
periods, and the fit.

Absolute phase is counted in periods of the fringes, w / P for a projector coordinate w and a pitch
P. The Gray code counts half periods, so that frames give it without knowing the pitch.

Absolute phase / 2 pi = w / P, so points X in metres and phases in periods give M (3 x 4) with
``(w_u / P_u, w_v / P_v, 1) ~ M (X, 1)``, and M = K [R | t] with K in periods: focal length / pitch
and principal point / pitch of each direction. The linear solution is Abdel-Aziz and Karara's DLT,
normalised as by Hartley and Zisserman, *Multiple View Geometry*, 2nd ed., algorithm 7.1; the
decomposition is theirs too (6.2.4). Robust least squares then fit the projector's thirteen numbers,
of which some are free.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction

MOST_PX = 50_000
"""Pixels that a fit uses, of all views together."""
_CODED_PX = 65536
"""Side, in px, of the imagined projector in which the code is decoded before its own size is known:
a power of 2, so that cells are whole."""
LEAST_THICKNESS = 0.01
"""Of the surface across its mean plane, as a part of its extent along it (RMS): below, the surface
is taken as flat."""
LEAST_GAP = 5.0
"""Between the two smallest singular values of the linear system: less, and the solution is not the
only one."""
LEAST_SINGULAR = 1e-5
"""Least ratio of the second smallest singular value of the linear system to the largest one: below,
the points do not tell the projection."""
MOST_SKEW = 0.05
"""Of K, as a part of the focal length: a projector's axes are square to each other to far better
than 3 degrees."""
_MOST_TRIMMINGS = 30
"""Most rounds in which outliers of the linear fit are left out; rounds end before where none
changes."""
_KEPT_MEDIANS = 5.0
"""Distance, in medians of all distances, up to which a pixel takes part in the next round: wrong
orders lie far beyond."""
_SMALLEST_PERIODS = 1e-9
"""Added to that limit, in periods, so that exact pixels, whose median is 0, all stay."""
POSE = frozenset({"turn_x", "turn_y", "turn_z", "t_x", "t_y", "t_z"})
CENTRE, PITCH = frozenset({"c_u", "c_v"}), frozenset({"pitch_u", "pitch_v"})
NAMES = (
    "turn_x",
    "turn_y",
    "turn_z",
    "t_x",
    "t_y",
    "t_z",
    "focal",
    "aspect",
    "c_u",
    "c_v",
    "pitch_u",
    "pitch_v",
    "k1",
)
"""``turn`` a rotation vector in rad, t in m, ``focal`` that of u in px, ``aspect``
that of v over it, c and pitch in px, ``k1`` the first radial term of the lens."""
MOST_CONDITION = 1e7
"""Of the Jacobian with its columns scaled to equal length; the benchmark's objects give some
thousands."""
_SMALLEST_PX = 1e-3
"""Least knee of the robust loss, in px: exact pixels would have a knee of 0."""
_BANDS = 16
"""Bands of pixels in each view that are taken as independent where uncertainties are estimated:
errors of neighbouring pixels go together."""
_MOST_EVALUATIONS = 100
"""Most evaluations of the fit, so that data that no projector explains end it."""


class DepthView(NamedTuple):
    """n pixels of a view, float64: ``rays`` (2, n) normalised x and y, ``depth_mm`` (n,), and of
    the vertical and the horizontal fringes ``periods`` (2, n), absolute phase / 2 pi, and
    ``modulation`` (2, n), of which only ratios count."""

    name: str
    rays: NDArray[np.float64]
    depth_mm: NDArray[np.float64]
    periods: NDArray[np.float64]
    modulation: NDArray[np.float64]

    @property
    def points_m(self) -> NDArray[np.float64]:
        """The surface in the camera's frame, (3, n)."""
        return np.stack([*self.rays, np.ones(len(self.depth_mm))]) * self.depth_mm / MM_PER_M


def view_from_maps(
    name: str,
    camera: Pinhole,
    periods: Mapping[Direction, NDArray],
    depth_mm: NDArray,
    modulation: Mapping[Direction, NDArray] | None = None,
    most_px: int = MOST_PX,
) -> DepthView:
    """A view from maps (H, W) of the camera's size: absolute phase / 2 pi of both directions, NaN =
    not decoded, and depth in mm, 0 = none. ``modulation`` in grey levels (default: the same at all
    pixels). At most ``most_px`` pixels are kept, spread evenly. Raises `CalibrationError` for an
    absent direction, maps of another size, or depth that is negative or not finite."""
    size = (camera.height, camera.width)
    for direction in AXES:
        if direction not in periods:
            raise CalibrationError(
                f"{name}: has no phase of the {direction} fringes; the projector is found only "
                f"from both directions"
            )
    strengths = modulation or {direction: np.ones(size) for direction in AXES}
    maps = (
        {"depth": depth_mm}
        | {f"{d} phase": periods[d] for d in AXES}
        | {f"{d} modulation": strengths[d] for d in AXES}
    )
    for title, values in maps.items():
        if np.shape(values) != size:
            raise CalibrationError(
                f"{name}: expected {title} of shape {size} like the camera, got {np.shape(values)}"
            )
    if not np.isfinite(depth_mm).all() or np.min(depth_mm) < 0:
        raise CalibrationError(
            f"{name}: depth is negative, NaN or infinite at some pixels; write 0 where there is "
            f"none"
        )
    rays, measured, strength = (
        np.stack([np.asarray(values, dtype=np.float64).reshape(-1) for values in pair])
        for pair in (camera.rays(), [periods[d] for d in AXES], [strengths[d] for d in AXES])
    )
    usable = (
        np.isfinite(rays).all(axis=0)
        & np.isfinite(measured).all(axis=0)
        & (strength > 0).all(axis=0)
    )
    pixels = np.flatnonzero(object_mask(np.asarray(depth_mm)).reshape(-1) & usable)
    pixels = pixels[:: max(1, -(-len(pixels) // most_px))]
    depth = np.asarray(depth_mm, dtype=np.float64).reshape(-1)[pixels]
    return DepthView(name, rays[:, pixels], depth, measured[:, pixels], strength[:, pixels])


def view_from_frames(
    name: str,
    frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8],
    depth_mm: NDArray,
    rig: Rig,
    most_px: int = MOST_PX,
) -> DepthView:
    """A view from all frames of ``rig.sequence``, uint8 (H, W) each, and depth in mm (H, W), 0 =
    none. Of ``rig``, only the camera and the sequence are used. Raises `DecodeError` as
    `decode_stack`, `CalibrationError` as `view_from_maps`."""
    # The decoder wants a pitch, and any gives the same periods. A long one in a pattern of as many
    # cells as the bits can tell apart puts each cell's centre where it is without knowing the
    # projector's pixels.
    middle = (_CODED_PX - 1) / 2
    pitch_px = {direction: 2.0 * (_CODED_PX >> rig.sequence.bits(direction)) for direction in AXES}
    coded = replace(
        rig,
        projector=Pinhole(_CODED_PX, _CODED_PX, _CODED_PX, _CODED_PX, middle, middle),
        pitch_horizontal_px=pitch_px["horizontal"],
        pitch_vertical_px=pitch_px["vertical"],
    )
    measured = decode_stack(frames, coded, details=True).details
    periods = {
        direction: measured[direction].coordinate_px / pitch_px[direction] for direction in AXES
    }
    modulation = {direction: measured[direction].modulation for direction in AXES}
    return view_from_maps(name, rig.camera, periods, depth_mm, modulation, most_px)


class Projection(NamedTuple):
    """Rotation vector (3,) in rad, t (3,) in m, and in periods: focal lengths (2,) and principal
    point (2,), along u and v; ``kept`` bool (n,): the points it was found from."""

    turn: NDArray[np.float64]
    t: NDArray[np.float64]
    focal: NDArray[np.float64]
    centre: NDArray[np.float64]
    kept: NDArray[np.bool_]


def projection_from(points_m: NDArray[np.float64], periods: NDArray[np.float64]) -> Projection:
    """The projection of points (3, n) in the camera's frame, m, to ``periods`` (2, n), from those
    that agree with the rest. Raises `CalibrationError` where the points are flat, fit no
    projection, or only a mirrored or oblique one."""
    points_m, periods = points_m.T, periods.T
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
            "the surface is flat, or nearly so, and lies at one place in all views; a projector is "
            "not determined by a "
            "plane. Give views of an object with relief, or of several distances"
        )
    if singular[-2] < LEAST_SINGULAR * singular[0] or singular[-2] < LEAST_GAP * singular[-1]:
        raise CalibrationError(
            "no projector explains phase and depth together, or the surface has too little relief "
            "for their noise: "
            "expected phases of the frames that this depth was measured from. Check the frame "
            "order, the depth's unit "
            "and the camera, or give more views"
        )
    if np.median(projected[:, 2]) < 0:
        matrix = -matrix
    return _decomposed(matrix, kept)


def _dlt(
    points: NDArray[np.float64], periods: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The projection matrix (3, 4) up to its sign, and the singular values (12,) of the normalised
    system."""
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
    if np.linalg.det(matrix[:, :3]) < 0:
        raise CalibrationError(
            "the projector's coordinates are mirrored: u, v and depth make a left-handed frame. "
            "One direction's "
            "fringes run backwards (check the frame order), or the images are flipped"
        )
    upper, rotation, place = cv2.decomposeProjectionMatrix(matrix)[:3]
    upper = upper / upper[2, 2]
    if abs(upper[0, 1]) > MOST_SKEW * upper[0, 0]:
        raise CalibrationError(
            f"the best projector has oblique axes (skew {upper[0, 1] / upper[0, 0]:.3f} of its "
            f"focal length, expected "
            f"under {MOST_SKEW}); check the camera, the frame order, and that the depth belongs to "
            f"these frames"
        )
    translation = -rotation @ (place[:3] / place[3])
    return Projection(
        cv2.Rodrigues(rotation)[0][:, 0].astype(np.float64),
        translation[:, 0],
        np.diag(upper)[:2],
        upper[:2, 2],
        kept,
    )


class Measured(NamedTuple):
    """The pixels of all views: points (3, n) in m, periods and weights (2, n), and a number for
    each band of rows of each view (n,). Errors of neighbouring pixels go together; those of bands
    are taken as independent."""

    points_m: NDArray[np.float64]
    periods: NDArray[np.float64]
    weights: NDArray[np.float64]
    bands: NDArray[np.intp]

    def only(self, kept: NDArray[np.bool_]) -> "Measured":
        return Measured(
            self.points_m[:, kept], self.periods[:, kept], self.weights[:, kept], self.bands[kept]
        )


def measured_in(views: list[DepthView], most_px: int) -> Measured:
    """What ``views`` measure, thinned evenly to about ``most_px`` pixels."""
    step = max(1, -(-sum(len(view.depth_mm) for view in views) // most_px))
    counts = [len(view.depth_mm[::step]) for view in views]
    bands = [
        number * _BANDS + np.arange(count) * _BANDS // max(count, 1)
        for number, count in enumerate(counts)
    ]
    points, periods, weights = (
        np.concatenate([getattr(view, name)[:, ::step] for view in views], axis=1)
        for name in ("points_m", "periods", "modulation")
    )
    weights = weights / np.median(
        weights, axis=1, keepdims=True
    )  # the noise of a phase goes as 1 / modulation
    return Measured(points, periods, weights, np.concatenate(bands))


class Projector(NamedTuple):
    """``values`` of `NAMES` and the standard ``errors`` of those that were fitted, and the robust
    standard deviation of the residuals in px, weighted."""

    values: dict[str, float]
    errors: dict[str, float]
    sigma_px: float

    def pair(self, first: str, second: str) -> tuple[float, float]:
        return self.values[first], self.values[second]


def projected(points_m: NDArray[np.float64], values: Mapping[str, float]) -> NDArray[np.float64]:
    """Absolute phase / 2 pi of points (3, n) in the camera's frame, (2, n), by a projector's
    `NAMES`."""
    place, (focal, aspect, c_u, c_v, *pitches, k1) = np.split(
        np.array([values[name] for name in NAMES]), [6]
    )
    lens = np.array([[focal, 0, c_u], [0, focal * aspect, c_v], [0, 0, 1]]), np.array([k1, 0, 0, 0])
    pixels = cv2.projectPoints(np.ascontiguousarray(points_m.T), place[:3], place[3:], *lens)[0]
    return pixels.reshape(-1, 2).T / np.array(pitches)[:, None]


def refined(measured: Measured, start: Mapping[str, float], free: Set[str]) -> Projector:
    """The projector whose ``free`` numbers, from those of ``start`` on, fit the phases best (soft
    L1 loss beyond three robust standard deviations of the start), with standard errors that allow
    for errors shared within a band. Raises `CalibrationError` where the numbers can't be told
    apart."""
    names = [name for name in NAMES if name in free]
    # One unit for both directions: noise is the same in periods, whatever their pitches.
    scale_px = measured.weights * (start["pitch_u"] + start["pitch_v"]) / 2

    def with_numbers(numbers: NDArray[np.float64]) -> dict[str, float]:
        return {**start, **dict(zip(names, numbers.tolist(), strict=True))}

    def residuals_px(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        difference = (
            projected(measured.points_m, with_numbers(numbers)) - measured.periods
        ) * scale_px
        # A step of the search that turns a point behind the projector is refused by its cost.
        return np.nan_to_num(difference, nan=1e6, posinf=1e6, neginf=-1e6).ravel()

    begin = np.array([start[name] for name in names])
    knee_px = max(3 * _sigma(residuals_px(begin)), _SMALLEST_PX)
    solution = least_squares(
        residuals_px,
        begin,
        jac="3-point",
        loss="soft_l1",
        f_scale=knee_px,
        x_scale="jac",
        max_nfev=_MOST_EVALUATIONS,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    lengths = np.linalg.norm(solution.jac, axis=0)
    with np.errstate(all="ignore"):
        unit = solution.jac / lengths
    condition = (
        float(np.linalg.cond(np.linalg.qr(unit, mode="r"))) if (lengths > 0).all() else np.inf
    )
    if condition > MOST_CONDITION:
        raise CalibrationError(
            f"the views don't tell {', '.join(names)} apart (condition {condition:.1g}); give "
            f"views at more places and "
            "distances, or the pitch"
        )
    # least_squares scales the Jacobian for its loss; with these residuals, their products are the
    # gradient's terms.
    bent = solution.fun * (1 + (solution.fun / knee_px) ** 2) ** 0.25
    terms = (unit * bent[:, None]).reshape(2, -1, len(names)).sum(axis=0)
    by_band = np.stack([np.bincount(measured.bands, weights=column) for column in terms.T])
    inverse = np.linalg.inv(unit.T @ unit)
    errors = np.linalg.norm(inverse @ by_band, axis=1) / lengths
    fitted = with_numbers(solution.x)
    return Projector(fitted, dict(zip(names, errors.tolist(), strict=True)), _sigma(solution.fun))


def _sigma(values: NDArray[np.float64]) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(values)))
