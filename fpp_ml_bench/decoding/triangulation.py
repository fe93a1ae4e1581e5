"""Depth from projector coordinates: closed form from a single coordinate, least squares from both,
for any rig; and its standard uncertainty, from the noise of the frames.

A camera pixel's ray is ``Z (x, y, 1)``; with ``a = R (x, y, 1)`` it runs through ``Z a + t`` in the
projector's frame and projects to ``(Z a_0 + t_0) / (Z a_2 + t_2)``. A single ideal projector
coordinate x_p therefore gives

    Z = (x_p t_2 - t_0) / (a_0 - x_p a_2)            (and likewise y_p with a_1, t_1),

which for the paper's rig is ``Z = f_p b / (u_p - c_u - f_p x)``. Depth is the camera's z, not the
length of the ray.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.phase_shift import PhaseShift, phase_weights, weighted_sums
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.pinhole import Maps, distort
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, DIRECTIONS, Direction

if TYPE_CHECKING:
    from fpp_ml_bench.decoding.decode import Decoded

FIXED_POINT_STEPS = 50
"""Most steps of the iteration that removes the projector's distortion. A coordinate that is not
steady after them gets no depth."""
FIXED_POINT_TOLERANCE = 1e-13
"""Largest last change, in normalised units, of a projector coordinate after its distortion was
removed by iteration."""
ASSUMED_NOISE_GREY = 1.0
"""Where the frames don't tell: three steps fit any three grey levels."""
_SAMPLED_PX = 50_000
"""Pixels of a frame, about, from which its noise is estimated: thousands for each group of
brightness, at a small part of the time."""
_LEAST_PX = 100
"""Fewest pixels of a direction that are lit and not clipped from which its noise is estimated; with
fewer the direction is left out."""
_BRIGHTNESSES = 12
"""Groups of as many pixels each, by brightness, in which noise is estimated: noise grows with
light, and the line through them needs several."""
_LEAST_VARIANCE = 1 / 12
"""Least variance of noise in squared grey levels: that of rounding to whole grey levels."""
ROUNDING_GREY = _LEAST_VARIANCE**0.5
"""Its standard deviation: that of an even distribution of width 1."""
_HIGHEST_HARMONIC = 4
"""Highest harmonic of a fringe that is taken for the response of projector or camera (gamma):
higher ones are weak, and each takes freedom from the noise."""
_LEAST_HARMONIC = 0.01
"""Least share of the modulation that such a harmonic must have; below it the light counts as
straight, and nothing is removed."""
_MEDIAN_OF_SQUARE = (0.4549, 0.6931, 0.7887, 0.8392, 0.8703, 0.8914)
"""Median of chi^2 / n for 1 to 6 degrees of freedom; (1 - 2 / (9 n))^3 for more."""
STATED_SYSTEMATIC_RAD = 0.015
"""Error of a phase that is no noise: light of further bounces, mostly. With it 95% intervals of 18
steps hold 95% of the pixels of the validation objects in the light ``paper`` (`fpp-bench predict
classical DATASET --split validation` and `fpp-eval` with ``--split validation --target
depth_exact``), 96% in ``workshop`` and 93% in ``hard``, with the calibration's error. 68% intervals
would hold 68% with 0.005 rad, but larger errors are more frequent than in a normal distribution."""


class DepthFromBoth(NamedTuple):
    """``depth_mm`` float64, NaN = no depth; ``disagreement_px``: distance from the epipolar line in
    projector px."""

    depth_mm: NDArray[np.float64]
    disagreement_px: NDArray[np.float64]


def rotated_ray(rays: Maps, rig: Rig, axis: int) -> NDArray[np.float64]:
    """Component ``axis`` of R (x, y, 1)."""
    x, y = rays
    return rig.R[axis, 0] * x + rig.R[axis, 1] * y + rig.R[axis, 2]


def _ideal_coordinate(
    rays: Maps, coordinate_px: NDArray, rig: Rig, axis: int
) -> NDArray[np.float64]:
    """Ideal normalised projector coordinate from a distorted one in px, when the second coordinate
    is unknown. The ray supplies it: each step takes the depth from the present estimate, projects
    the point and subtracts its distortion from the measured coordinate. Coordinates that do not
    settle are NaN."""
    device = rig.projector
    measured = (coordinate_px - device.centre[axis]) / device.focal[axis]
    rotated = [rotated_ray(rays, rig, i) for i in range(3)]
    ideal, change = measured, np.full(np.shape(measured), np.inf)
    for _ in range(FIXED_POINT_STEPS):
        depth = (ideal * rig.t[2] - rig.t[axis]) / (rotated[axis] - ideal * rotated[2])
        forward = depth * rotated[2] + rig.t[2]
        point = [(depth * rotated[i] + rig.t[i]) / forward for i in range(2)]
        improved = measured - (distort(point[0], point[1], device.distortion)[axis] - point[axis])
        change, ideal = np.abs(improved - ideal), improved
        if not np.any(change > FIXED_POINT_TOLERANCE):
            break
    return np.where(change <= FIXED_POINT_TOLERANCE, ideal, np.nan)


def depth_from_coordinate(
    rays: Maps, coordinate_px: ArrayLike, rig: Rig, direction: Direction
) -> NDArray[np.float64]:
    """Depth in mm from one projector coordinate per pixel, float64; NaN where there is no depth
    (NaN input, ray parallel to the projector plane, intersection behind a device, or a distortion
    that can't be inverted). ``rays``: normalised (x, y) of the camera pixels, as `Pinhole.rays`
    gives them; ``coordinate_px``: u_p for ``direction`` "vertical", v_p for "horizontal", in px,
    same shape."""
    if direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal or vertical, got {direction!r}")
    from fpp_ml_bench.decoding import kernels

    axis, device = AXES.index(direction), rig.projector
    x, y, straight = _arrays(*rays, coordinate_px)
    focal, centre = device.focal[axis], device.centre[axis]
    pixels = focal, centre, 0.0
    if device.is_distorted:
        with np.errstate(all="ignore"):
            straight, pixels = (
                _ideal_coordinate((x, y), straight, rig, axis),
                (1.0, 0.0, 2 * abs(centre) / focal),
            )
    depth_mm = np.empty(straight.shape)
    flat = (x.ravel(), y.ravel()), straight.ravel(), pixels
    kernels.depth_from_coordinate(*flat, axis, geometry(rig), depth_mm.ravel())
    return depth_mm


def geometry(rig: Rig) -> tuple[NDArray, NDArray, tuple[float, float], tuple[float, float]]:
    """The rig as the kernels take it: R, t, and the projector's focal lengths and principal
    point."""
    return rig.R, rig.t, rig.projector.focal, rig.projector.centre


def _arrays(*values: ArrayLike) -> list[NDArray[np.float64]]:
    """The values as contiguous float64 arrays of one shape."""
    alike = (
        len({np.shape(value) for value in values}) == 1
    )  # as in the decoder, whose blocks are small
    return [
        np.asarray(array, np.float64, "C")
        for array in (values if alike else np.broadcast_arrays(*values))
    ]


def depth_from_both(
    rays: Maps,
    u_px: ArrayLike,
    v_px: ArrayLike,
    rig: Rig,
    weight_u: ArrayLike = 1.0,
    weight_v: ArrayLike = 1.0,
) -> DepthFromBoth:
    """Depth in mm from both projector coordinates by weighted least squares in projector px,
    float64; NaN = no depth.

    ``weight_u`` and ``weight_v``: 1 / sigma^2 of the coordinates, up to a common factor; for
    sinusoids (B / P)^2. Solved for the inverse depth w, in which ``u - u_p(w)`` is a ratio of
    linear functions: algebraic start, then three Gauss-Newton steps. ``disagreement_px`` is the
    measured point's distance from the epipolar line, for any weights, in undistorted px."""
    from fpp_ml_bench.decoding import kernels

    x, y, u, v, *weights = _arrays(*rays, u_px, v_px, weight_u, weight_v)
    straight, pixels, device = (
        (u, v),
        tuple(zip(rig.projector.focal, rig.projector.centre, strict=True)),
        rig.projector,
    )
    if device.is_distorted:
        straight, pixels = device.normalised(u, v), ((1.0, 0.0), (1.0, 0.0))
    result = DepthFromBoth(np.empty(u.shape), np.empty(u.shape))
    rays, straight, by_weight, filled = (
        (first.ravel(), second.ravel()) for first, second in ((x, y), straight, weights, result)
    )
    kernels.depth_from_both(rays, straight, pixels, by_weight, geometry(rig), filled)
    return result


def depth_noise_mm(
    rig: Rig,
    depth_mm: ArrayLike,
    direction: Direction | str,
    steps: int,
    modulation: ArrayLike,
    noise: ArrayLike = 1.0,
    rays: Maps | None = None,
) -> NDArray[np.float64]:
    """Standard deviation of the depth in mm that intensity noise causes, float64.

    ``modulation`` B and ``noise`` sigma in grey levels, ``rays`` the pixels' normalised (x, y), by
    default the optical axis. sigma_phi = sqrt(2 / N) sigma / B, sigma_u = P sigma_phi / (2 pi),
    sigma_Z = sigma_u / ``|du/dZ|``; for the paper's rig sigma_Z is sigma_u Z^2 / (f_p b). For
    ``direction`` "both" the two directions' precisions add. Projector distortion is ignored; it
    changes the slope by a few percent."""
    if direction != "both" and direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal, vertical or both, got {direction!r}")
    if steps < 3:
        raise DecodeError(f"steps: expected at least 3, got {steps}")
    along: Maps = rays if rays is not None else (np.zeros(()), np.zeros(()))
    precision: NDArray[np.float64] | float = 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma_phase = np.sqrt(2.0 / steps) * np.asarray(noise) / np.asarray(modulation)
        for name in DIRECTIONS if direction == "both" else (direction,):
            slope = coordinate_slope_px_per_mm(rig, depth_mm, name, along)  # type: ignore[arg-type]
            sigma_px = rig.pitch(name) * sigma_phase / (2 * np.pi)  # type: ignore[arg-type]
            precision = precision + (slope / sigma_px) ** 2
        return 1.0 / np.sqrt(precision)


def coordinate_slope_px_per_mm(
    rig: Rig, depth_mm: ArrayLike, direction: Direction, rays: Maps
) -> NDArray[np.float64]:
    """Projector px by which the coordinate of ``direction`` changes for a mm of depth, at
    normalised ``rays`` (x, y); float64. The projector's distortion is ignored, as in
    `depth_noise_mm`."""
    axis, forward = AXES.index(direction), rotated_ray(rays, rig, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        z_m = np.asarray(depth_mm, dtype=np.float64) / MM_PER_M
        slope = rig.projector.focal[axis] * (
            rotated_ray(rays, rig, axis) * rig.t[2] - rig.t[axis] * forward
        )
        px_per_mm: NDArray[np.float64] = slope / (forward * z_m + rig.t[2]) ** 2 / MM_PER_M
        return px_per_mm


def depth_sigma_mm(
    decoded: "Decoded",
    rig: Rig,
    noise_grey: NDArray | float,
    steps: int | None = None,
    systematic_rad: float | Mapping[str, float] = 0.0,
) -> NDArray[np.float32]:
    """Standard uncertainty of every decoded pixel in mm, float32 (H, W), 0 = none, from noise of
    ``noise_grey`` grey levels a frame, one number or (H, W). Of ``decoded`` with details, and with
    so many ``steps`` of each direction (default: all). It is that of the noise, of an error
    ``systematic_rad`` of every phase, one for all or by direction: gamma, blur, further bounces,
    and of `Rig.calibration_px`. Raises `DecodeError` for a decoding without details, or noise that
    is none."""
    valid = decoded.depth_mm > 0
    precision = sum(
        share.precision for share in _shares(decoded, rig, noise_grey, steps, systematic_rad)
    )
    sigma_mm = np.zeros(decoded.depth_mm.shape, dtype=np.float32)
    with np.errstate(divide="ignore"):
        sigma_mm[valid] = np.where(precision > 0, 1 / np.sqrt(precision), np.finfo(np.float32).max)
    return sigma_mm


def depth_budget_mm(
    decoded: "Decoded",
    rig: Rig,
    noise_grey: NDArray | float,
    systematic_rad: Mapping[str, float],
    rounding_grey: float = ROUNDING_GREY,
) -> dict[str, NDArray[np.float64]]:
    """What `depth_sigma_mm` consists of: the standard uncertainty in mm of each source alone, (n,)
    of the n decoded pixels in the order of the image, whose squares add up to its square; infinite
    where nothing tells the depth. ``rounding_grey``: the part of the noise that is the frames'
    rounding to levels. Arguments and errors as there."""
    shares = list(_shares(decoded, rig, noise_grey, None, systematic_rad))
    rounded = np.minimum(rounding_grey / shares[0].noise_grey, 1.0) ** 2
    precision = sum(share.precision for share in shares)
    with np.errstate(divide="ignore", invalid="ignore"):

        def together(variance: Callable[[_Share], NDArray[np.float64] | float]) -> NDArray:
            parts = (share.precision * variance(share) / share.total_px2 for share in shares)
            return np.where(precision > 0, np.sqrt(sum(parts)) / precision, np.inf)

        return {
            "noise": together(lambda share: share.noise_px2 * (1 - rounded)),
            "rounding to grey levels": together(lambda share: share.noise_px2 * rounded),
            "response and epipolar pattern": together(lambda share: share.systematic_px2),
            "calibration": together(lambda share: rig.calibration_px**2),
        }


class _Share(NamedTuple):
    """Of a direction's coordinate: variances in px2, (n,) or one number, and the precision of the
    depth by it alone in 1/mm2 (n,)."""

    noise_grey: NDArray[np.float64]
    noise_px2: NDArray[np.float64]
    systematic_px2: float
    total_px2: NDArray[np.float64]
    precision: NDArray[np.float64]


def _shares(
    decoded: "Decoded",
    rig: Rig,
    noise_grey: NDArray | float,
    steps: int | None,
    systematic_rad: float | Mapping[str, float],
) -> Iterator[_Share]:
    """Of every decoded direction; see `depth_sigma_mm`."""
    if not decoded.details:
        raise DecodeError("details: missing; decode with details=True")
    noise = np.asarray(noise_grey, dtype=np.float64)
    if not (np.isfinite(noise) & (noise > 0)).all():
        raise DecodeError(f"noise_grey: expected grey levels above 0, got {noise.min():g}")
    valid = decoded.depth_mm > 0
    rays = tuple(axis[valid] for axis in rig.camera.rays())
    valid_noise = noise[valid] if noise.ndim else noise
    for direction, measured in decoded.details.items():
        code, modulation = rig.code(direction), measured.modulation[valid]
        fewer, systematic_px = 1.0, 0.0
        if isinstance(code, PhaseShift):
            fewer = 1.0 if steps is None else steps / code.fringes[0].steps
            rad = (
                systematic_rad
                if isinstance(systematic_rad, float)
                else systematic_rad.get(direction, 0.0)
            )
            systematic_px = code.pitch_px * rad / (2 * np.pi)
        noise_px = code.sigma_px(modulation, valid_noise / np.sqrt(fewer))
        total_px2 = noise_px**2 + systematic_px**2 + rig.calibration_px**2
        slope = coordinate_slope_px_per_mm(
            rig, decoded.depth_mm[valid], direction, (rays[0], rays[1])
        )
        precision = (slope / np.sqrt(total_px2)) ** 2
        yield _Share(valid_noise, noise_px**2, systematic_px**2, total_px2, precision)


def noise_of_frames(frames: Sequence[NDArray | None], rig: Rig) -> float | None:
    """Noise of the frames in grey levels, from what their sinusoids can't explain: the median over
    lit pixels; None where every period has three steps, which explain anything, or too few pixels
    are lit. A frame may be None."""
    estimates = [
        _variance(squares, freedom)
        for _, squares, freedom in _unexplained(frames, rig, straight=True)
    ]
    return float(np.median(np.sqrt(estimates))) if estimates else None


def noise_by_light(frames: Sequence[NDArray | None], rig: Rig) -> tuple[float, float] | None:
    """Variance of the noise in squared grey levels without light, and what a grey level of light
    adds to it: photons come by chance. From the same pixels as `noise_of_frames`, by their
    brightness; None as there."""
    means, variances = [], []
    for mean, squares, freedom in _unexplained(frames, rig):
        limits = np.quantile(mean, np.linspace(0, 1, _BRIGHTNESSES + 1))
        for low, high in pairwise(limits):
            here = (mean >= low) & (mean <= high)
            means.append(float(mean[here].mean()))
            variances.append(_variance(squares[here], freedom))
    if not means:
        return None
    (per_grey, dark) = np.polynomial.Polynomial.fit(means, variances, 1).convert().coef[::-1]
    return (
        (float(np.median(variances)), 0.0)
        if per_grey <= 0
        else (max(float(dark), _LEAST_VARIANCE), float(per_grey))
    )


def _variance(squares: NDArray[np.float64], freedom: int) -> float:
    """Variance of normal errors from the median of what they leave, squared and over
    ``freedom``."""
    known = freedom <= len(_MEDIAN_OF_SQUARE)
    return float(np.median(squares)) / (
        _MEDIAN_OF_SQUARE[freedom - 1] if known else (1 - 2 / (9 * freedom)) ** 3
    )


def _unexplained(
    frames: Sequence[NDArray | None], rig: Rig, straight: bool = False
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64], int]]:
    """Of every period with four and more steps, at some of the lit pixels: mean grey level, squared
    residual over its degrees of freedom, and these. ``straight``: without what a response that is
    not straight adds (`_harmonics`)."""
    for direction in rig.directions:
        code = rig.code(direction)
        for number, fringe in enumerate(code.fringes if isinstance(code, PhaseShift) else ()):
            indices = rig.sequence.period(direction, number)
            captured = [step for step, index in enumerate(indices) if frames[index] is not None]
            freedom = len(captured) - 3
            if freedom < 1:
                continue
            flat = [np.asarray(frames[indices[step]]).reshape(-1) for step in captured]
            levels = np.stack(
                [frame[:: max(frame.size // _SAMPLED_PX, 1)] for frame in flat]
            ).astype(np.float64)
            angles = 2 * np.pi * fringe.turns[captured]
            mean, cosine, sine = weighted_sums(levels, phase_weights(angles))
            lit = (cosine**2 + sine**2 >= MIN_MODULATION**2) & (
                (levels > 0) & (levels < GREY_LEVELS)
            ).all(axis=0)
            if lit.sum() < _LEAST_PX:
                continue
            residual = levels - (
                mean + cosine * np.cos(angles)[:, None] + sine * np.sin(angles)[:, None]
            )
            if straight:
                residual[:, lit] -= _harmonics(residual[:, lit], cosine[lit], sine[lit], angles)
            yield mean[lit], (residual[:, lit] ** 2).sum(axis=0) / freedom, freedom


def _harmonics(
    residual: NDArray, cosine: NDArray, sine: NDArray, angles: NDArray
) -> NDArray[np.float64]:
    """The part of residuals (N, n) that higher harmonics make, which all pixels share as a share of
    their modulation (gamma), and that is no noise; 0 where the share is below `_LEAST_HARMONIC`, as
    in straight light."""
    phase, modulation, part = (
        np.arctan2(-sine, cosine),
        np.hypot(cosine, sine),
        np.zeros_like(residual),
    )
    for harmonic in range(2, min(len(angles) // 2, _HIGHEST_HARMONIC) + 1):
        turned = harmonic * (phase + angles[:, None])
        shares = []
        for wave in (modulation * np.cos(turned), modulation * np.sin(turned)):
            power = float((wave * wave).sum())
            shares.append((float((residual * wave).sum()) / power if power > 0 else 0.0, wave))
        if np.hypot(shares[0][0], shares[1][0]) > _LEAST_HARMONIC:
            part += sum(share * wave for share, wave in shares)
    return part
