"""The projector from views whose depth is known: pose, intrinsics and fringe pitch, with the camera
given.

Phase and depth alone determine the projector in periods (`projection`): all but the size of its
pixels. The pitch in px then follows from one more fact: the pitch itself, the focal length in px,
or (by default) the pattern's size, with square pixels and the principal point in the pattern's
middle, (W - 1) / 2 px. A pitch that is within its uncertainty a whole number of px, or fits the
pattern a whole number of times, is taken as that; also one that is a little farther off
(`_PITCH_SHARE`), unless the fit gets worse by it.

The phase's origin is the centre of pixel 0, as in the patterns; another origin would shift the
principal point.
"""

import math
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.projection import (
    CENTRE,
    MOST_PX,
    NAMES,
    PITCH,
    POSE,
    DepthView,
    Projection,
    Projector,
    measured_in,
    projection_from,
    refined,
)
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.decoding.triangulation import depth_from_both
from fpp_ml_bench.errors import CalibrationError, RigError
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import AXES

LEAST_PX = 200
"""Fewest pixels with depth and both phases that a projector is fitted to: many times its twelve or
so unknowns."""
MOST_SIGMA_PX = 1.5
"""Robust standard deviation above which the frames are not those of the depth: the decoder's limit
for a pixel."""
MOST_RELATIVE_ERROR = 0.02
"""Of the pitch and the focal length: above it, the views don't determine them."""
MOST_OFF_SQUARE = 0.01
"""How far the projector's aspect may be from 1, beyond its uncertainty, before the calibration is
refused."""
_SIGMAS = 3.0
"""Standard errors within which a measured number may be a rounder one: three hold 99.7% of
chance."""
_PITCH_SHARE = 0.005
"""A pitch this near to a whole one, as a share, may be it, whatever its standard error: the part
that noise does not explain."""
_PITCH_PX = 0.25
"""Largest such distance in px: at 0.25, half of all pitches would be near to a whole one."""
_MOST_APART_PX = 0.5
"""Uncertainty of a pitch, in px, from which on no whole one is taken: half of their distance, so
that any pitch would be near to one."""
_MOST_WORSE = 1.05
"""Factor by which a fit with a rounder pitch may be worse than that without, where the pitch is not
certain."""
_WORSE_PX = 1e-3
"""Also allowed in px, so that fits of exact depth, whose residuals are almost 0, may round too."""
_SMALLEST_PX = 1e-4
"""Added to a pitch's uncertainty in px: what rounding leaves where depth has no noise."""
_LEVELS = 99.9, 0.1
"""Percentiles of the depths between which the range is set, so that a stray pixel does not widen
it."""
_STEP_MM = 10
"""The ends of the range are whole multiples of this, at least one step beyond the depths."""
_BEHIND_M = 0.1
"""Least distance of the background plane behind the range, in m."""

Pair = tuple[float, float]


class Residual(NamedTuple):
    """Depth of the fitted rig from the phases minus the depth given, of ``pixels``: median, robust
    standard deviation (1.4826 MAD) and RMS in mm, and the RMS distance of projected from measured
    coordinates in projector px. At ``missing`` further pixels the rig gives no depth. NaN where
    there is no pixel."""

    name: str
    pixels: int
    missing: int
    median_mm: float
    sigma_mm: float
    rms_mm: float
    rms_px: float


@dataclass(frozen=True)
class DepthFit:
    """What a fit found: residuals by view and of all views together; the pitch as measured before
    it was rounded, and its standard error, (vertical, horizontal) in px; and what the pitch was
    taken from, a sentence."""

    views: tuple[Residual, ...]
    total: Residual
    pitch_px: Pair
    pitch_error_px: Pair
    pitch_from: str


def fit_projector(
    views: Iterable[DepthView],
    rig: Rig,
    size: tuple[int, int] | None = None,
    *,
    pitch_px: Pair | None = None,
    focal_px: float | None = None,
    lens: bool = False,
    most_px: int = MOST_PX,
) -> tuple[Rig, DepthFit]:
    """The rig whose projector gives the views' depth from their phases, by robust least squares
    over all of them.

    Of ``rig`` the camera, the sequence and the distances are kept; the working range is widened to
    hold the depths. ``size``: the projector's (width, height) in px, by default that of ``rig``.
    ``pitch_px``, (vertical, horizontal), or ``focal_px``: what is known of the projector; the
    principal point is then fitted. ``lens``: fit the projector's first radial term too. Raises
    `CalibrationError` where the views don't determine a projector or no projector explains them."""
    if pitch_px is not None and focal_px is not None:
        raise CalibrationError(
            "pitch_px and focal_px: expected one of them, got both; each follows from the other"
        )
    views = list(views)
    count = sum(len(view.depth_mm) for view in views)
    if count < LEAST_PX:
        raise CalibrationError(
            f"expected at least {LEAST_PX} pixels with depth and with both phases, got {count} in "
            f"{len(views)} views; "
            "the Gray code must count half periods, and the depth must be that of the frames"
        )
    width, height = size or (rig.projector.width, rig.projector.height)
    measured = measured_in(views, most_px)
    start = projection_from(measured.points_m, measured.periods)
    kept, always = measured.only(start.kept), POSE | ({"k1"} if lens else set())

    def fit(values: dict[str, float], *free: Set[str]) -> Projector:
        return refined(kept, values, always.union(*free))

    if pitch_px is not None:
        fitted = first = fit(_values(start, pitch_px), {"focal", "aspect"}, CENTRE)
        pitch_from = "given"
    elif focal_px is not None:
        first = fit(_values(start, focal_px / start.focal), CENTRE, PITCH)
        fitted, rounded = _rounded(fit, first, (width, height), CENTRE)
        pitch_from = f"focal length given{rounded}"
    else:
        first = _with_middle(fit, start, (width, height))
        fitted, rounded = _rounded(fit, first, (width, height))
        pitch_from = f"square pixels, principal point in the pattern's middle{rounded}"
    _check_fit(fitted, first)
    result = _rig_of(fitted, rig, (width, height), measured.points_m[2] * MM_PER_M)
    differences = [_differences(view, result) for view in views]
    residuals = tuple(
        _residual(view.name, values) for view, values in zip(views, differences, strict=True)
    )
    total = _residual("all", np.concatenate(differences, axis=1))
    errors = first.errors.get("pitch_u", 0.0), first.errors.get("pitch_v", 0.0)
    return result, DepthFit(residuals, total, first.pair("pitch_u", "pitch_v"), errors, pitch_from)


def _with_middle(
    fit: Callable[..., Projector], start: Projection, size: tuple[int, int]
) -> Projector:
    """The fit with square pixels and the principal point in the middle of a pattern of ``size`` px
    (W, H)."""
    middle = (np.array(size) - 1) / 2
    if not (start.centre > 0).all():
        raise CalibrationError(
            f"the principal point lies outside the pattern (at {start.centre[0]:.3g} and "
            f"{start.centre[1]:.3g} "
            "periods), so the pitch can't be taken from the pattern's middle; give the pitch or "
            "the focal length"
        )
    free = fit(_values(start, middle / start.centre), {"focal", "aspect"}, PITCH)
    aspect, error = free.values["aspect"], free.errors["aspect"]
    if abs(aspect - 1) > max(MOST_OFF_SQUARE, _SIGMAS * error):
        raise CalibrationError(
            f"with the principal point in the middle of {size[0]} x {size[1]} px, the pixels would "
            f"not be square "
            f"(aspect {aspect:.4f} +- {error:.4f}). Give the projector's size, its pitch or its "
            f"focal length"
        )
    return fit(free.values | {"aspect": 1.0}, {"focal"}, PITCH)


def _rounded(
    fit: Callable[..., Projector],
    projector: Projector,
    size: tuple[int, int],
    centre: Set[str] = frozenset(),
) -> tuple[Projector, str]:
    """The fit with a whole pitch where the found one may be it, else the found one; and words that
    say so."""
    pitches, words, certain = {}, [], True
    for name, length in zip(("pitch_u", "pitch_v"), size, strict=True):
        if whole := _whole_pitch(projector.values[name], projector.errors[name], length):
            pitches[name], title = whole
            words.append(title)
            certain &= (
                abs(pitches[name] - projector.values[name]) <= _SIGMAS * projector.errors[name]
            )
    if not pitches:
        return projector, ""
    fitted = fit(projector.values | pitches, {"focal"}, centre, PITCH - pitches.keys())
    if not certain and fitted.sigma_px > _MOST_WORSE * projector.sigma_px + _WORSE_PX:
        return projector, ""
    return fitted, "; rounded to " + " and ".join(dict.fromkeys(words))


def _whole_pitch(pitch_px: float, error_px: float, length_px: int) -> tuple[float, str] | None:
    """The whole number of px, or the whole part of the pattern's length, that a measured pitch may
    be, and its name."""
    noise_px = _SIGMAS * error_px + _SMALLEST_PX
    whole, part = float(round(pitch_px)), length_px / round(length_px / pitch_px)
    if noise_px < _MOST_APART_PX and abs(whole - pitch_px) <= max(
        noise_px, min(_PITCH_SHARE * pitch_px, _PITCH_PX)
    ):
        return whole, "whole px"
    # Parts of the pattern lie closer together, so that one of them is near any pitch.
    next_part = length_px / (length_px / part + 1)
    if noise_px < (part - next_part) / 4 and abs(part - pitch_px) <= noise_px:
        return part, f"{length_px} px / {length_px / part:.0f}"
    return None


def _values(start: Projection, pitch_px: Pair | NDArray[np.float64]) -> dict[str, float]:
    """The projector's numbers, given the pitch that the projection is in."""
    focal, centre = start.focal * pitch_px, start.centre * pitch_px
    numbers = np.concatenate(
        [start.turn, start.t, [focal[0], focal[1] / focal[0]], centre, pitch_px, [0.0]]
    )
    return dict(zip(NAMES, numbers.tolist(), strict=True))


def _check_fit(projector: Projector, first: Projector) -> None:
    for name in ("pitch_u", "pitch_v", "focal"):
        value, error = first.values[name], first.errors.get(name, 0.0)
        if not error <= MOST_RELATIVE_ERROR * abs(value):
            raise CalibrationError(
                f"the views determine the projector's {name.replace('_', ' of ')} only to "
                f"{value:.2f} +- {error:.2g} "
                "px; give views at more places and distances, or the pitch"
            )
    if not projector.sigma_px <= MOST_SIGMA_PX:
        raise CalibrationError(
            f"the best projector misses the phases by {projector.sigma_px:.2f} px (robust standard "
            f"deviation), expected at "
            f"most {MOST_SIGMA_PX} px: the depth is not that of these frames, or not by this "
            f"camera; check both, and "
            "the frame order"
        )


def _rig_of(
    projector: Projector, rig: Rig, size: tuple[int, int], depths_mm: NDArray[np.float64]
) -> Rig:
    """``rig`` with the projector found, its distances widened to hold ``depths_mm``."""
    focal, aspect = projector.pair("focal", "aspect")
    c_u, c_v = projector.pair("c_u", "c_v")
    high_mm, low_mm = np.percentile(depths_mm, _LEVELS).tolist()
    near = min(rig.working_range_mm[0], _STEP_MM * math.floor(low_mm / _STEP_MM - 1))
    far = max(rig.working_range_mm[1], _STEP_MM * math.ceil(high_mm / _STEP_MM + 1))
    turn, (x, y, z) = ([projector.values[name] for name in NAMES[at : at + 3]] for at in (0, 3))
    try:
        return replace(
            rig,
            projector=Pinhole(
                *size, focal, focal * aspect, c_u, c_v, (projector.values["k1"], 0.0, 0.0, 0.0, 0.0)
            ),
            rotation=tuple(map(tuple, rotation_matrix(tuple(turn)).tolist())),
            translation_m=(x, y, z),
            pitch_vertical_px=projector.values["pitch_u"],
            pitch_horizontal_px=projector.values["pitch_v"],
            working_range_mm=(near, far),
            background_m=max(rig.background_m, far / MM_PER_M + _BEHIND_M),
        )
    except RigError as error:
        raise CalibrationError(
            f"the projector found is not one of this sequence and size: {error}"
        ) from error


def _differences(view: DepthView, rig: Rig) -> NDArray[np.float64]:
    """Depth by the rig minus the depth given in mm, and projected minus measured u and v in px, (3,
    n)."""
    pitches = np.array([[rig.pitch(direction)] for direction in AXES])
    (u_px, v_px), weights = view.periods * pitches, (view.modulation / pitches) ** 2
    x, y = view.rays
    depth_mm = depth_from_both((x, y), u_px, v_px, rig, weights[0], weights[1]).depth_mm
    projected_u, projected_v = rig.project(view.points_m.T)
    return np.stack([depth_mm - view.depth_mm, projected_u - u_px, projected_v - v_px])


def _residual(name: str, differences: NDArray[np.float64]) -> Residual:
    depth_mm, u_px, v_px = differences[:, np.isfinite(differences).all(axis=0)]
    missing = differences.shape[1] - len(depth_mm)
    if not len(depth_mm):
        return Residual(name, 0, missing, *[math.nan] * 4)
    median = float(np.median(depth_mm))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(depth_mm - median)))
    rms_mm, rms_px = (
        math.sqrt(float(np.mean(squares))) for squares in (depth_mm**2, u_px**2 + v_px**2)
    )
    return Residual(name, len(depth_mm), missing, median, sigma, rms_mm, rms_px)
