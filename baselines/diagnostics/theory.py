"""The paper's two theorems (Section 4.2), checked in numbers; nothing is asked of the subject.

*A single fringe does not determine depth.* An object is photographed, and another one whose surface lies one whole
period away on every ray. Their frames of that direction are the same bytes, noise included. Brightness would tell them
apart, so at each pixel the surface that is the brighter there is painted darker, by the factor that the inverse square
and the tilt demand; the ambient light is a constant of this benchmark, whatever it falls on. The frames of the other
direction differ.

*A mistake of one period costs Z^2.* The depth error of a mistake of one period, at distances from 0.3 to 10 m along
the camera's axis, through the calibration layer. In closed form, with kappa = P / (f_p b) for the paper's rig, it is
Z^2 kappa / (1 -+ Z kappa), one for each side: the exponent of Z is 2 +- Z kappa / (1 -+ Z kappa), and 2 only where
Z kappa, the mistake over the disparity itself, is small.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import Original, original
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress
from fpp_ml_bench.baselines.diagnostics.subject import Subject
from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, moved
from fpp_ml_bench.baselines.diagnostics.theory_report import draw, summary, tables
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.rig import Rig

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

DISTANCES_M = (0.3, 10.0)
POINTS = 400
SMALL_PERIODS = 1 / 64
"""A mistake so small that the linear model holds over all distances."""
WITHIN = 0.01
"""Relative difference from exponent 2 that still counts as quadratic."""
STARTS_PERIODS = (0.0, -1.0, -0.5)
"""Where the first of two scenes that are a period apart stands, in periods from the object's own place."""
SET_BACK_M = 0.1
"""How far the projector of the rig that shows the thin-baseline limit stands behind the camera."""


@dataclass(frozen=True)
class Twins:
    """Two scenes that one frame can't tell apart. Depths float64 (H, W) in mm, 0 outside the object; frames uint8."""

    sample: str
    direction: Direction
    frame: int
    other_frame: int
    depths_mm: tuple[NDArray[np.float64], NDArray[np.float64]]
    frames: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    noiseless: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    others: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    paint: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        seen = self.depths_mm[0] > 0
        apart = np.abs(self.depths_mm[1] - self.depths_mm[0])[seen]
        return {
            "sample": self.sample,
            "direction": self.direction,
            "frame": self.frame,
            "object_pixels": int(seen.sum()),
            "differing_pixels": int((self.frames[0] != self.frames[1]).sum()),
            "differing_pixels_noiseless": int((self.noiseless[0] != self.noiseless[1]).sum()),
            "differing_pixels_other_direction": int((self.others[0] != self.others[1]).sum()),
            "depth_apart_mean_mm": float(apart.mean()),
            "depth_apart_least_mm": float(apart.min()),
            "paint_least": float(self.paint.min()),
            "paint_most": float(self.paint.max()),
        }


@dataclass(frozen=True)
class ErrorCurve:
    """Depth error (n,) in mm of a mistake of ``periods`` at ``distances_m`` (n,), inf where no depth is left; its
    ``exponent`` fitted over ``fitted_m``, and the local one (n,)."""

    name: str
    periods: float
    distances_m: NDArray[np.float64]
    error_mm: NDArray[np.float64]
    local: NDArray[np.float64]
    exponent: float
    fitted_m: tuple[float, float]

    def quadratic_m(self) -> tuple[float, float] | None:
        """Distances between which the local exponent is within `WITHIN` of 2, None where it never is."""
        good = self.distances_m[np.abs(self.local - 2) <= 2 * WITHIN]
        return (float(good.min()), float(good.max())) if good.size else None


class Theory:
    """Both theorems on the dataset's rig."""

    name = "theory"
    title = "Theory in numbers"
    question = "Can one fringe mean two depths, and what does a mistake of one period cost at which distance?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        progress(0, 2, "two scenes, one frame")
        twins = twins_of(dataset, Darkroom.of(dataset))
        progress(1, 2, "one period, many distances")
        curves = error_curves(dataset.rig, twins.direction)
        values = {
            "twins": twins.to_dict(),
            "kappa_per_m": kappa_per_m(dataset.rig, twins.direction),
            "curves": [
                {"name": one.name, "periods": one.periods, "exponent": one.exponent, "fitted_m": list(one.fitted_m),
                 "quadratic_m": one.quadratic_m()}
                for one in curves
            ],
        }  # fmt: skip
        return Finding(
            self.name, self.title, summary(values), values, tables(values, curves), draw(twins, curves, folder)
        )


def twins_of(dataset: "DatasetFolder", room: Darkroom, direction: Direction = "horizontal") -> Twins:
    """The first test object that fits twice, a whole period apart, into the working range: where it stands and beside
    it, or half a period to either side.

    Raises `DiagnosisError` where none has.
    """
    near, far = (end / MM_PER_M for end in room.rig.working_range_mm)
    for sample in dataset.samples("test"):
        first = original(dataset, room, sample)
        if not first.target.any():
            continue
        for start in STARTS_PERIODS:
            pair = tuple(
                moved(first.surface, room.rig, direction, partial(_constant, TAU * turns))
                for turns in (start, start + 1)
            )
            if all(near <= one.depth_m.min() and one.depth_m.max() <= far for one in pair):
                return _photographed(room, first, pair, direction)
    raise DiagnosisError(
        f"{dataset.path}: no test object fits twice, a period of {direction} fringes apart, within "
        f"{near:g} to {far:g} m; use a rig with a finer pitch or a wider range"
    )


def _constant(turn_rad: float, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(x, turn_rad)


def _photographed(room: Darkroom, first: Original, pair: tuple[Surface, ...], direction: Direction) -> Twins:
    lights = [room.light(surface) for surface in pair]
    gains = [light.gain.astype(np.float64) for light in lights]
    # No paint is brighter than white: each pixel is painted on the surface that is the brighter there.
    least, most = np.minimum(*gains), np.maximum(*gains)
    paint = np.divide(least, most, out=np.ones_like(most), where=most > 0)
    scenes = [replace(first.scene, lit=replace(light, gain=least.astype(np.float32))) for light in lights]
    sequence = room.rig.sequence
    frame = sequence.sinusoids(direction)[0]
    across = sequence.sinusoids("vertical" if direction == "horizontal" else "horizontal")[0]
    silent = Darkroom(room.rig, noise_sigma_grey=0.0)
    return Twins(
        first.sample, direction, frame, across,
        (pair[0].depth_mm(room.shape), pair[1].depth_mm(room.shape)),
        _pair(room, scenes, frame), _pair(silent, scenes, frame), _pair(room, scenes, across), paint,
    )  # fmt: skip


def _pair(room: Darkroom, scenes: Sequence[Scene], index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    first, second = (room.frames(scene, [index])[index] for scene in scenes)
    if first is None or second is None:
        raise ValueError(f"frame {index} was asked for and is missing")
    return first, second


def kappa_per_m(rig: Rig, direction: Direction) -> float:
    """P / (f_p b) of the camera's axis in 1 / m: what one period is of the disparity, per metre of distance."""
    layer = _axis(rig, direction)
    return float(TAU / abs(layer.gain[0]) * layer.forward[0])


def _axis(rig: Rig, direction: Direction) -> CalibrationLayer:
    return CalibrationLayer.of(rig, direction, (np.zeros(1), np.zeros(1)))


def depth_error_mm(
    rig: Rig, direction: Direction, distances_m: NDArray[np.float64], periods: float
) -> NDArray[np.float64]:
    """|depth of the mistaken phase - depth| along the camera's axis, in mm; inf where the mistaken phase is that of no
    point in front of the camera."""
    layer = _axis(rig, direction)
    residual = layer.absolute_phase(distances_m * MM_PER_M) - layer.infinity_rad - TAU * layer.infinity_order
    # A mistake away from the camera lessens the residual phase, whatever its sign.
    mistaken = residual - np.sign(residual) * TAU * periods
    with np.errstate(divide="ignore"):
        depth = layer.depth_of_residual_mm(mistaken)
    return np.where((depth > 0) & np.isfinite(depth), np.abs(depth - distances_m * MM_PER_M), np.inf)


def error_curves(rig: Rig, direction: Direction) -> list[ErrorCurve]:
    """The small mistake, one period away from and toward the camera, their mean, and a small one on a rig whose
    projector stands back."""
    distances = np.geomspace(*DISTANCES_M, POINTS)
    away, toward = (depth_error_mm(rig, direction, distances, periods) for periods in (1.0, -1.0))
    # The set-back is along the projector's axis, in its own frame.
    behind = replace(rig, translation_m=(rig.translation_m[0], rig.translation_m[1], rig.translation_m[2] + SET_BACK_M))
    return [
        _curve("1/64 period", SMALL_PERIODS, distances,
               depth_error_mm(rig, direction, distances, SMALL_PERIODS)),
        _curve("one period, away", 1.0, distances, away),
        _curve("one period, toward", -1.0, distances, toward),
        _curve("one period, mean of both", 1.0, distances, (away + toward) / 2),
        _curve(f"1/64 period, projector {SET_BACK_M:g} m behind", SMALL_PERIODS, distances,
               depth_error_mm(behind, direction, distances, SMALL_PERIODS)),
    ]  # fmt: skip


def _curve(name: str, periods: float, distances: NDArray[np.float64], error_mm: NDArray[np.float64]) -> ErrorCurve:
    """The exponent is fitted where the local one is within `WITHIN` of 2; where it nowhere is, over all finite ones."""
    with np.errstate(invalid="ignore"):
        local = np.gradient(np.log(error_mm), np.log(distances))
    known = np.isfinite(error_mm) & np.isfinite(local)
    good = known & (np.abs(np.where(known, local, 0.0) - 2) <= 2 * WITHIN)
    used = good if good.sum() > 2 else known
    exponent = float(np.polyfit(np.log(distances[used]), np.log(error_mm[used]), 1)[0])
    ends = float(distances[used].min()), float(distances[used].max())
    return ErrorCurve(name, periods, distances, error_mm, np.where(known, local, np.nan), exponent, ends)
