"""What one crossed frame says of the rig's calibration, and what follows for the depth.

Two phases of a pixel tell a point of the projector, and the depth takes one number of it: the place
along the epipolar line. The distance across the line is noise where the calibration fits. A
projector that rolled or zoomed against the camera leaves a pattern across the lines that tells the
change, so the depth is corrected by it. One that turned, or whose principal point is off, moves all
points alike: what it does across the lines is seen, what it does along them is not, and that is what
makes the depth wrong. It is taken to be about as large, and widens the stated uncertainty.

The changes are linear in the projector's coordinates (`examination.alignment.CHANGES`). Their
sizes are unknown: each group has a scale of its own, over which the Gaussian posterior is averaged.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.depth import Fitted, Measurement
from fpp_ml_bench.baselines.phase.geometry import Mask, main_carrier, wrapped
from fpp_ml_bench.baselines.phase.object_mask import disk
from fpp_ml_bench.baselines.phase.observe import CrossedObservation, Frames
from fpp_ml_bench.baselines.phase.route import CrossedRoute
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M, TAU
from fpp_ml_bench.examination.alignment import CHANGES, Part

GROUPS: tuple[tuple[Part, ...], ...] = (("shift", "turn"), ("roll",), ("zoom",))
"""Changes of the projector whose sizes go together."""
CORRECTED = 4
"""Parameters from here on are corrected: those of roll and zoom. What the
four before them do along the epipolar lines leaves hardly a pattern across them."""
SCALES_PX = np.concatenate([[1e-4], np.geomspace(0.02, 10, 11)])
"""Sizes of a change that are considered, in projector px (RMS over the points); the first is none,
and as probable as all others together."""
SURE_CHANCE = 0.3
"""Chance of a wrong order up to which a pixel says something of the calibration, and the surer half
of the object in any case."""
POINTS_PER_PERIOD = 4
"""Points that are looked at, along each axis."""
FEWEST_POINTS = 300
"""Points below which nothing is said: those of 19 square periods."""
ALIKE = 4.0 * POINTS_PER_PERIOD**2
"""Points beside each other share their errors: those of four square periods count as one."""
FLOOR_PX = 0.05
"""Error of the phases that looks like a change, in projector px: a right calibration leaves 0.04 to
0.09 px (RMS) across the lines on validation views."""
CERTAIN = 2.0
"""A change is corrected from so many standard uncertainties, so that a right calibration stays as it
is."""
ROUNDS = 6
"""Fits in a row, each without the points that the one before does not explain."""
UNEXPLAINED = 0.7
"""Of the distance from the epipolar lines that phases without any order would have: a frame that
stays above it after the changes does not fit the calibration. On validation views a right
calibration leaves at most 0.06 of it in `paper`, 0.48 in `workshop`, 0.64 in `hard`; a roll or zoom
of 4 px and more 0.9 to 1.0, 0.2 (where it is corrected) to 1.2, and 0.6 to 1.1."""
FURTHEST = 4.0
"""Residual, in robust standard deviations, beyond which a point is left out."""


@dataclass(frozen=True)
class Audit:
    """Of one frame: ``points`` that were used; ``across_px``: RMS distance from the epipolar lines
    in projector px, before and after the correction, ``chance_px`` that of phases without any
    order, and ``noise_px`` of one point; ``roll_deg`` and ``zoom_percent``, of the projector against
    the calibration, each with its standard uncertainty; ``along_px``: standard uncertainty along
    the lines that is left, from what can't be seen."""

    points: int
    across_px: tuple[float, float]
    chance_px: float
    noise_px: float
    roll_deg: tuple[float, float]
    zoom_percent: tuple[float, float]
    along_px: float

    @property
    def fits(self) -> bool:
        """Whether a small motion of the projector explains the frame, as far as it tells."""
        return self.across_px[1] <= UNEXPLAINED * self.chance_px

    @property
    def finding(self) -> str:
        """What is wrong where it does not fit, and what to do."""
        return (
            f"the calibration does not fit: across the epipolar lines the phases are "
            f"{self.across_px[0]:.2f} px (RMS) off, {self.across_px[1]:.2f} px after the best roll, "
            f"zoom and shift of the projector, and phases without any order would be "
            f"{self.chance_px:.2f} px off; calibrate again, or give --anyway, whose depth is not to "
            f"be trusted"
        )

    def report(self) -> Mapping[str, Any]:
        """Plain data, and a sentence."""
        if not self.points:
            return {"audit": {"points": 0, "says": "too few points to audit the calibration"}}
        before, after = self.across_px
        says = (
            f"across the epipolar lines the phases are {before:.2f} px (RMS) off, "
            f"{after:.2f} px after a roll by {self.roll_deg[0]:+.3f} +- {self.roll_deg[1]:.3f} "
            f"degrees and a zoom by {self.zoom_percent[0]:+.2f} +- {self.zoom_percent[1]:.2f}%; "
            f"along them {self.along_px:.2f} px stay uncertain"
        )
        if not self.fits:
            says = self.finding
        return {"audit": {**asdict(self), "says": says}}


NOTHING = Audit(0, (0.0, 0.0), 0.0, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0)


def measure_audited(
    route: CrossedRoute, frames: Frames, mask: Mask | None = None
) -> tuple[Measurement, Audit]:
    """As `Route.measure`, with orders and depth by the calibration as the frame corrects it."""
    chosen = route.choose(route.observe(frames, mask))
    audit, changes = _audited(chosen)
    if changes is not None:
        seen = changes.applied(chosen.seen)
        chosen = route.order(seen, route.candidates(seen))
    if route.learned is not None:
        chosen = route.learned(chosen)
    if changes is not None:
        fit = chosen.fit
        rad = np.hypot(fit.uncertainty_rad, changes.uncertain_rad).astype(np.float32)
        chosen = replace(chosen, fit=replace(fit, uncertainty_rad=rad))
    return route.depth(chosen), audit


@dataclass(frozen=True)
class _Changes:
    """What follows from an audit at every pixel: ``shift_rad`` (2, h, w), by which the carriers'
    phases are off, and ``uncertain_rad`` (h, w), the standard uncertainty of the joint phase from
    what the frame can't tell."""

    shift_rad: NDArray[np.float64]
    uncertain_rad: NDArray[np.float64]

    def applied(self, seen: CrossedObservation) -> CrossedObservation:
        """The observation with corrected carriers."""
        carriers = seen.carriers
        infinity = wrapped(carriers.infinity_rad + self.shift_rad).astype(np.float32)
        return replace(seen, carriers=replace(carriers, infinity_rad=infinity))


def _audited(fitted: Fitted) -> tuple[Audit, _Changes | None]:
    """What the two phases say, and what follows; nothing of a frame with too few sure pixels."""
    seen, nearness, carriers = fitted.seen, fitted.fit.nearness, fitted.seen.carriers
    if not seen.inside.any():
        return NOTHING, None
    step = max(1, round(seen.period_px / POINTS_PER_PERIOD))
    chance = fitted.order.wrong_chance
    sure = seen.inside & (chance <= max(SURE_CHANCE, float(np.median(chance[seen.inside]))))
    sure = cv2.erode(sure.astype(np.uint8), disk(step)) > 0
    used = np.zeros_like(sure)
    used[step // 2 :: step, step // 2 :: step] = sure[step // 2 :: step, step // 2 :: step]
    if np.count_nonzero(used) < FEWEST_POINTS:
        return NOTHING, None
    px_per_turn = np.linalg.inv(carriers.family.cycles_per_px)
    beside = wrapped(seen.phase_rad - carriers.phases(nearness)).astype(np.float64)
    off_px = np.einsum("ij,jhw->ihw", px_per_turn, beside / TAU)
    ahead = np.einsum("ij,jhw->ihw", px_per_turn, carriers.gain / TAU)
    px_per_q = np.hypot(*ahead)
    ahead = ahead / px_per_q
    changes = _changes_px(fitted)
    unit = 1 / np.sqrt(2 * np.mean(changes[..., used] ** 2, axis=(1, 2)))
    changes = changes * unit[:, None, None, None]
    chance_px = _chance_px(seen, used, ahead[:, used])
    across = (ahead[0] * changes[:, 1] - ahead[1] * changes[:, 0])[:, used].T
    off = (ahead[0] * off_px[1] - ahead[1] * off_px[0])[used]
    across, off, noise_px = _without_outliers(across, off)
    mean, covariance = _posterior(across, off, noise_px)
    certain = np.abs(mean) > CERTAIN * np.sqrt(np.diag(covariance))
    corrected = np.where(certain & (np.arange(len(mean)) >= CORRECTED), mean, 0.0)
    # What is seen and not corrected is an error about its own mean.
    covariance = covariance + np.outer(mean - corrected, mean - corrected)
    along = ahead[0] * changes[:, 0] + ahead[1] * changes[:, 1]
    variance = np.einsum("ihw,ij,jhw->hw", along, covariance, along)
    turns = np.einsum("ij,pjhw->pihw", np.array(carriers.family.cycles_per_px), changes)
    shift_rad = TAU * np.einsum("p,pihw->ihw", corrected, turns)
    size, sigma = mean * unit, np.sqrt(np.diag(covariance)) * unit
    audit = Audit(
        len(off),
        (_rms(off), _rms(off - across @ mean)),
        chance_px,
        noise_px,
        (float(np.rad2deg(size[4])), float(np.rad2deg(sigma[4]))),
        (100 * float(size[5]), 100 * float(sigma[5])),
        _rms(np.sqrt(variance[used])),
    )
    return audit, _Changes(shift_rad, np.sqrt(variance) * carriers.joint_gain / px_per_q)


def _changes_px(fitted: Fitted) -> NDArray[np.float64]:
    """By how many px along u and v a unit of each parameter moves the projector's point of each
    pixel (P, 2, h, w)."""
    carriers, rig = fitted.seen.carriers, fitted.seen.carriers.rig
    depth_m = carriers.depth_mm(fitted.fit.nearness).astype(np.float64) / MM_PER_M
    depth_m = np.where(fitted.seen.inside & (depth_m > 0), depth_m, rig.standoff_m)
    x, y = (axis[carriers.crop] for axis in rig.camera.rays())
    points = np.stack([x * depth_m, y * depth_m, depth_m], axis=-1) @ rig.R.T + rig.t
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    terms = [term for group in GROUPS for part in group for term in CHANGES[part].terms(x, y)]
    focal = np.array([rig.projector.fx, rig.projector.fy])
    return np.array(terms) * focal[:, None, None]


def _chance_px(seen: CrossedObservation, used: Mask, ahead: NDArray[np.float64]) -> float:
    """RMS distance in px from the epipolar lines of pixels ``used``, which run along ``ahead`` (2,
    P), in the best order of phases that are drawn at random."""
    carriers = seen.carriers
    gain, ends = carriers.gain[:, used], [carriers.nearness(end)[used] for end in seen.range_mm]
    main = main_carrier(gain)
    span = np.median(np.abs(gain[main] * (ends[0] - ends[1]))) / TAU
    turns = np.arange(max(1, round(float(span))))[:, None]
    drawn = np.random.default_rng(0).uniform(-np.pi, np.pi, gain.shape[1])
    beside = wrapped(drawn - TAU * turns * gain[1 - main] / gain[main])
    along_u, along_v = np.linalg.inv(carriers.family.cycles_per_px)[:, 1 - main]
    return _rms(
        ((ahead[0] * along_v - ahead[1] * along_u) * beside / TAU)[
            np.abs(beside).argmin(axis=0), np.arange(beside.shape[1])
        ]
    )


def _without_outliers(
    slopes: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """The points that changes explain (n, P) and (n,), and the robust standard deviation of what is
    left, never 0: those of wrong orders are anywhere."""
    left = values - np.median(values)
    for _ in range(ROUNDS):
        noise_px = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-3)
        kept = np.abs(left) < FURTHEST * noise_px
        change = np.linalg.lstsq(slopes[kept], values[kept], rcond=1e-3)[0]
        left = values - slopes @ change
    noise_px = max(MAD_TO_SIGMA * float(np.median(np.abs(left[kept]))), 1e-3)
    return slopes[kept], values[kept], noise_px


def _posterior(
    slopes: NDArray[np.float64], values: NDArray[np.float64], noise_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean (P,) and covariance (P, P) of the changes by ``values = slopes @ changes``, averaged
    over the scales of the groups."""
    sizes = [sum(CHANGES[part].parameters for part in group) for group in GROUPS]
    chances = np.r_[0.5, np.full(len(SCALES_PX) - 1, 0.5 / (len(SCALES_PX) - 1))]
    scales = np.array(
        [np.repeat(sizes_px, sizes) for sizes_px in product(SCALES_PX, repeat=len(GROUPS))]
    )
    prior = np.array([np.prod(each) for each in product(chances, repeat=len(GROUPS))])
    # A change is known no better than the phases, whose errors have patterns of their own.
    least = np.linalg.inv(
        slopes.T @ slopes / (ALIKE * noise_px**2) + 1e-9 * np.eye(slopes.shape[1])
    )
    known = np.linalg.inv(least + FLOOR_PX**2 * np.eye(len(least)))
    observed = known @ least @ (slopes.T @ values) / (ALIKE * noise_px**2)
    precision = known + np.eye(len(observed)) / scales[:, None, :] ** 2
    means = np.linalg.solve(precision, np.broadcast_to(observed[:, None], (*scales.shape, 1)))[
        ..., 0
    ]
    evidence = (
        np.log(prior)
        + 0.5 * means @ observed
        - 0.5 * np.linalg.slogdet(precision)[1]
        - np.log(scales).sum(axis=1)
    )
    weight = np.exp(evidence - evidence.max())
    weight /= weight.sum()
    mean = weight @ means
    apart = means - mean
    spread = np.einsum("k,ki,kj->ij", weight, apart, apart)
    return mean, np.einsum("k,kij->ij", weight, np.linalg.inv(precision)) + spread


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
