"""The paper's two theorems (Section 4.2), checked numerically; the subject is not used.

*A single fringe does not determine depth.* Two surfaces are rendered, a whole period apart on every ray. Their frames
of that direction are the same bytes, noise included. Brightness would distinguish them, so at each pixel the brighter
surface gets a lower albedo, by the factor that inverse square law and tilt require. The ambient light is a constant of
this benchmark and does not depend on the surface. The frames of the other direction differ.

*An error of one period costs Z^2.* The depth error of an order error of one period, at distances from 0.3 to 10 m along
the camera's axis, through the calibration layer. In closed form, with kappa = P / (f_p b) for the paper's rig, it is
Z^2 kappa / (1 -+ Z kappa), one sign for each side. The exponent of Z is 2 +- Z kappa / (1 -+ Z kappa), and 2 only where
Z kappa, the error relative to the disparity, is small.
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
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.baselines.diagnostics.synth import Scene, SceneRenderer
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, moved
from fpp_ml_bench.baselines.diagnostics.theory_report import draw, summary, tables
from fpp_ml_bench.baselines.phase_route import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.optics import Direction, Rig

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

DISTANCES_M = (0.3, 10.0)
POINTS = 400
SMALL_PERIODS = 1 / 64
"""An error so small that the linear model holds over all distances."""
WITHIN = 0.01
"""Relative difference from exponent 2 that still counts as quadratic."""
STARTS_PERIODS = (0.0, -1.0, -0.5)
"""Position of the first of two scenes that are a period apart, in periods from the object's own position."""
SET_BACK_M = 0.1
"""Distance of the projector behind the camera in the rig that shows the limit of the thin baseline."""


@dataclass(frozen=True)
class Twins:
    """Two scenes that a frame can't distinguish. Depths float64 (H, W) in mm, 0 outside the object; frames uint8."""

    sample: str
    direction: Direction
    frame: int
    other_frame: int
    depths_mm: tuple[NDArray[np.float64], NDArray[np.float64]]
    frames: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    noiseless: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    other_frames: tuple[NDArray[np.uint8], NDArray[np.uint8]]
    paint: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        inside = self.depths_mm[0] > 0
        distance_mm = np.abs(self.depths_mm[1] - self.depths_mm[0])[inside]
        return {
            "sample": self.sample,
            "direction": self.direction,
            "frame": self.frame,
            "object_pixels": int(inside.sum()),
            "differing_pixels": int((self.frames[0] != self.frames[1]).sum()),
            "differing_pixels_noiseless": int((self.noiseless[0] != self.noiseless[1]).sum()),
            "differing_pixels_other_direction": int((self.other_frames[0] != self.other_frames[1]).sum()),
            "depth_apart_mean_mm": float(distance_mm.mean()),
            "depth_apart_least_mm": float(distance_mm.min()),
            "paint_least": float(self.paint.min()),
            "paint_most": float(self.paint.max()),
        }


@dataclass(frozen=True)
class ErrorCurve:
    """Depth error (n,) in mm of a phase error of ``periods`` at ``distances_m`` (n,), inf where there is no depth; the
    exponent of distance, ``local`` (n,) and ``exponent`` fitted over ``fitted_m``."""

    name: str
    periods: float
    distances_m: NDArray[np.float64]
    error_mm: NDArray[np.float64]
    local: NDArray[np.float64]
    exponent: float
    fitted_m: tuple[float, float]

    def quadratic_m(self) -> tuple[float, float] | None:
        """Range of distances whose local exponent is within `WITHIN` of 2; None where there are none."""
        quadratic = self.distances_m[np.abs(self.local - 2) <= 2 * WITHIN]
        return (float(quadratic.min()), float(quadratic.max())) if quadratic.size else None


class Theory:
    """Both theorems on the dataset's rig."""

    name = "theory"
    title = "Theory in numbers"
    question = "Can two depths give the same fringe, and how large is the depth error of one period at each distance?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        progress(0, 2, "two scenes, one frame")
        twins = twins_of(dataset, SceneRenderer.of(dataset))
        progress(1, 2, "one period, many distances")
        curves = error_curves(dataset.rig, twins.direction)
        values = {
            "twins": twins.to_dict(),
            "kappa_per_m": kappa_per_m(dataset.rig, twins.direction),
            "curves": [
                {"name": curve.name, "periods": curve.periods, "exponent": curve.exponent,
                 "fitted_m": list(curve.fitted_m), "quadratic_m": curve.quadratic_m()}
                for curve in curves
            ],
        }  # fmt: skip
        return Finding(
            self.name, self.title, summary(values), values, tables(values, curves), draw(twins, curves, folder)
        )


def twins_of(dataset: "DatasetFolder", renderer: SceneRenderer, direction: Direction = "horizontal") -> Twins:
    """The first test object that fits into the working range twice, a whole period apart: at its own position and a
    period away, or half a period to either side.

    Raises `DiagnosisError` where there is none.
    """
    near_m, far_m = (end / MM_PER_M for end in renderer.rig.working_range_mm)
    for sample in dataset.samples("test"):
        first = original(dataset, renderer, sample)
        if not first.target.any():
            continue
        for start in STARTS_PERIODS:
            pair = tuple(
                moved(first.surface, renderer.rig, direction, partial(_constant, TAU * turns))
                for turns in (start, start + 1)
            )
            if all(near_m <= surface.depth_m.min() and surface.depth_m.max() <= far_m for surface in pair):
                return _photographed(renderer, first, pair, direction)
    raise DiagnosisError(
        f"{dataset.path}: no test object fits twice, a period of {direction} fringes apart, within "
        f"{near_m:g} to {far_m:g} m; use a rig with a finer pitch or a wider range"
    )


def _constant(turn_rad: float, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.full_like(x, turn_rad)


def _photographed(renderer: SceneRenderer, first: Original, pair: tuple[Surface, ...], direction: Direction) -> Twins:
    lights = [renderer.light(surface) for surface in pair]
    gains = [light.gain.astype(np.float64) for light in lights]
    # Albedo can only be lowered, so at each pixel it is lowered on the brighter surface.
    least, most = np.minimum(*gains), np.maximum(*gains)
    paint = np.divide(least, most, out=np.ones_like(most), where=most > 0)
    scenes = [replace(first.scene, lit=replace(light, gain=least.astype(np.float32))) for light in lights]
    sequence = renderer.rig.sequence
    frame = sequence.sinusoids(direction)[0]
    across = sequence.sinusoids("vertical" if direction == "horizontal" else "horizontal")[0]
    silent = SceneRenderer(renderer.rig, noise_sigma_grey=0.0)
    return Twins(
        first.sample, direction, frame, across,
        (pair[0].depth_mm(renderer.shape), pair[1].depth_mm(renderer.shape)),
        _pair(renderer, scenes, frame), _pair(silent, scenes, frame), _pair(renderer, scenes, across), paint,
    )  # fmt: skip


def _pair(renderer: SceneRenderer, scenes: Sequence[Scene], index: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    first, second = (renderer.frames(scene, [index])[index] for scene in scenes)
    if first is None or second is None:
        raise ValueError(f"frame {index} is missing")
    return first, second


def kappa_per_m(rig: Rig, direction: Direction) -> float:
    """P / (f_p b) on the camera's axis in 1 / m: a period relative to the disparity, per metre of distance."""
    layer = _axis(rig, direction)
    return float(TAU / abs(layer.gain[0]) * layer.forward[0])


def _axis(rig: Rig, direction: Direction) -> CalibrationLayer:
    return CalibrationLayer.of(rig, direction, (np.zeros(1), np.zeros(1)))


def depth_error_mm(
    rig: Rig, direction: Direction, distances_m: NDArray[np.float64], periods: float
) -> NDArray[np.float64]:
    """|depth of the wrong phase - depth| along the camera's axis, in mm; inf where no point in front of the camera has
    the wrong phase."""
    layer = _axis(rig, direction)
    residual = layer.absolute_phase(distances_m * MM_PER_M) - layer.infinity_rad - TAU * layer.infinity_order
    # A depth error away from the camera reduces the magnitude of the residual phase.
    wrong_phase = residual - np.sign(residual) * TAU * periods
    with np.errstate(divide="ignore"):
        depth = layer.depth_of_residual_mm(wrong_phase)
    return np.where((depth > 0) & np.isfinite(depth), np.abs(depth - distances_m * MM_PER_M), np.inf)


def error_curves(rig: Rig, direction: Direction) -> list[ErrorCurve]:
    """Curves of a small error, of a period away from and toward the camera, of their mean, and of a small error on a
    rig whose projector is behind the camera."""
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
    """The exponent is fitted where the local exponent is within `WITHIN` of 2; if nowhere, over all finite values."""
    with np.errstate(invalid="ignore"):
        local = np.gradient(np.log(error_mm), np.log(distances))
    finite = np.isfinite(error_mm) & np.isfinite(local)
    quadratic = finite & (np.abs(np.where(finite, local, 0.0) - 2) <= 2 * WITHIN)
    fitted = quadratic if quadratic.sum() > 2 else finite
    exponent = float(np.polyfit(np.log(distances[fitted]), np.log(error_mm[fitted]), 1)[0])
    ends = float(distances[fitted].min()), float(distances[fitted].max())
    return ErrorCurve(name, periods, distances, error_mm, np.where(finite, local, np.nan), exponent, ends)
