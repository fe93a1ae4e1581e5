"""The paper's two theorems (Section 4.2), checked numerically (docs/reliance.md); the subject is not used.

*A single fringe does not determine depth*: surfaces a whole period apart on every ray give the same frame of that
direction, noise included, if at each pixel the brighter one gets a lower albedo (in direct light from a projector in
focus at both: its blur would be a hint). *An error of one period costs Z^2*,
and along the camera's axis Z^2 kappa / (1 -+ Z kappa), one sign for each side, with kappa = P / (f_p b).

And which of two depths a training loss chooses where both share an image: the paper says that under l1 or l2 losses a
network may learn an average. A network gives one answer for it: first + c (second - first) on every pixel of the
object, c from 0 to 1. Each image of a batch is the second scene with a given chance, and the expected loss is evaluated
by the training's own functions. Where the answer is right beside the object, the other pixels only scale the loss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import comb
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import Original, original
from fpp_ml_bench.baselines.diagnostics.probe import (
    COLOURS,
    Figure,
    Finding,
    Line,
    Panel,
    Picture,
    Probe,
    ProbeSettings,
    Progress,
    Table,
    chart,
    gallery,
)
from fpp_ml_bench.baselines.diagnostics.scene_renderer import SceneRenderer, Surface, constant, moved
from fpp_ml_bench.baselines.diagnostics.subjects import Subject
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.baselines.training.losses import loss_function
from fpp_ml_bench.baselines.training.tables import LOSSES
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.render.sensor import camera_noise
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

DISTANCES_M = (0.3, 10.0)
POINTS = 400
SMALL_PERIODS = 1 / 64  # an error so small that the linear model holds over all distances
WITHIN = 0.01  # relative difference from exponent 2 that still counts as quadratic
STARTS_PERIODS = (0.0, -1.0, -0.5)
"""Position of the first of two scenes that are a period apart, in periods from the object's own position."""
SET_BACK_M = 0.1  # distance of the projector behind the camera in the rig that shows the limit of the thin baseline
_SHOWN_M = (0.3, 1.0, 1.8, 3.0, 5.0, 10.0)
AWAY, BOTH = "one period, away", "one period, mean of both"

CHANCES = (0.25, 0.5, 0.75)  # of the second scene
BATCHES = (1, 4)  # images; 4 is the paper's
ALPHA = 0.7
STEPS, PIXELS = 100, 64
_SAME = 1e-6
"""Relative difference of two expected losses that count as equal: no training tells them apart."""

Maps = list[NDArray[np.float64]]
Frames = list[NDArray[np.uint8]]


@dataclass(frozen=True)
class Twins:
    """Two scenes that a frame can't tell apart: depths float64 (H, W) in mm, 0 outside the object; frames uint8."""

    sample: str
    direction: Direction
    frame: int
    other_frame: int
    depths_mm: Maps
    frames: Frames
    noiseless: Frames
    other_frames: Frames
    paint: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        inside = self.depths_mm[0] > 0
        distance_mm = np.abs(self.depths_mm[1] - self.depths_mm[0])[inside]
        pairs = {"": self.frames, "_noiseless": self.noiseless, "_other_direction": self.other_frames}
        return {
            "sample": self.sample,
            "direction": self.direction,
            "frame": self.frame,
            "object_pixels": int(inside.sum()),
            **{f"differing_pixels{which}": int(np.not_equal(*pair).sum()) for which, pair in pairs.items()},
            "depth_apart_mean_mm": float(distance_mm.mean()),
            "depth_apart_least_mm": float(distance_mm.min()),
            "paint_least": float(self.paint.min()),
            "paint_most": float(self.paint.max()),
        }


Curve = dict[str, Any]
"""Depth error ``error_mm`` (n,) of a phase error of ``periods`` at ``distances_m`` (n,), inf where there is no depth;
the exponent of distance, ``local`` (n,) and ``exponent`` fitted over ``fitted_m``; ``quadratic_m``: range of distances
whose local exponent is within `WITHIN` of 2, None where there are none."""


class Theory(Probe):
    """Both theorems on the dataset's rig."""

    name = "theory"
    title = "Theory in numbers"
    asks_subject = False
    question = "Can two depths give the same fringe, and how large is the depth error of one period at each distance?"

    def run(self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress) -> Finding:
        progress(0, 2, "two scenes, one frame")
        twins = twins_of(dataset, SceneRenderer.of(dataset))
        progress(1, 2, "one period, many distances")
        curves = error_curves(dataset.rig, twins.direction)
        keys = "name", "periods", "exponent", "fitted_m", "quadratic_m"
        values = {
            "twins": twins.to_dict(),
            "kappa_per_m": kappa_per_m(dataset.rig, twins.direction),
            "curves": [{key: curve[key] for key in keys} for curve in curves],
            "choices": choices(twins.depths_mm),
        }
        return self.finding(summary(values), values, tables(values, curves), _draw_twins(twins), _draw_curves(curves))


def twins_of(dataset: DatasetFolder, renderer: SceneRenderer, direction: Direction = "horizontal") -> Twins:
    """The first test object that fits into the working range twice, a whole period apart: at its own position and a
    period away, or half a period to either side. Raises `DiagnosisError` where there is none."""
    near_m, far_m = (end / MM_PER_M for end in renderer.rig.working_range_mm)
    for sample in dataset.samples("test"):
        first = original(dataset, renderer, sample)
        for start in STARTS_PERIODS if first.target.any() else ():
            shifts_rad = (TAU * turns for turns in (start, start + 1))
            pair = [moved(first.surface, renderer.rig, direction, constant, shift) for shift in shifts_rad]
            if all(near_m <= surface.depth_m.min() and surface.depth_m.max() <= far_m for surface in pair):
                return _photographed(renderer, first, pair, direction)
    raise DiagnosisError(
        f"{dataset.path}: no test object fits twice, a period of {direction} fringes apart, within "
        f"{near_m:g} to {far_m:g} m; use a rig with a finer pitch or a wider range"
    )


def _photographed(renderer: SceneRenderer, first: Original, pair: Sequence[Surface], direction: Direction) -> Twins:
    renderer = SceneRenderer(renderer.rig, renderer.lamp.changed("projector", defocus_px=0.0))
    lights = [renderer.light(surface) for surface in pair]
    gains = [light.gain.astype(np.float64) for light in lights]
    # Albedo can only be lowered, so at each pixel it is lowered on the brighter surface.
    least, most = np.minimum(*gains), np.maximum(*gains)
    paint = np.divide(least, most, out=np.ones_like(most), where=most > 0)
    scenes = [replace(first.scene, lit=replace(light, gain=least.astype(np.float32))) for light in lights]

    def frames(index: int, camera: SceneRenderer = renderer) -> Frames:
        return [np.asarray(camera.frames(scene, [index])[index]) for scene in scenes]

    sinusoids = renderer.rig.sequence.sinusoids
    quiet = SceneRenderer(renderer.rig, renderer.lamp.changed("camera", **camera_noise(0.0)))
    frame, across = sinusoids(direction)[0], sinusoids("vertical" if direction == "horizontal" else "horizontal")[0]
    noiseless = frames(frame, quiet)
    depths_mm = [surface.depth_mm(renderer.shape) for surface in pair]
    return Twins(first.sample, direction, frame, across, depths_mm, frames(frame), noiseless, frames(across), paint)


def choice_of(
    depths_mm: Sequence[NDArray[np.float64]], loss: str, chance: float, batch: int, alpha: float | None = None
) -> tuple[float, float]:
    """Least and largest c of least expected ``loss``: 0 is the first of two depth maps (H, W), 0 outside the object, 1
    the second, which comes with ``chance``, and between them is a depth of neither; in batches of so many images."""
    inside = np.flatnonzero((depths_mm[0] > 0) & (depths_mm[1] > 0))
    some = inside[np.linspace(0, inside.size - 1, min(PIXELS, inside.size)).astype(np.int64)]
    first, second = (torch.from_numpy(depth.ravel()[some] / MM_PER_M).view(1, 1, 1, -1) for depth in depths_mm)
    function = loss_function(loss, alpha)
    places = np.linspace(0, 1, STEPS + 1)
    expected = np.zeros(places.size)
    for count in range(batch + 1):
        weight = comb(batch, count) * chance**count * (1 - chance) ** (batch - count)
        target = torch.cat([second] * count + [first] * (batch - count))
        answers = ((first + c * (second - first)).expand_as(target) for c in places.tolist())
        expected += weight * np.array([float(function(answer, target)) for answer in answers])
    chosen = places[expected <= expected.min() * (1 + _SAME)]
    return float(chosen[0]), float(chosen[-1])


def choices(depths_mm: Sequence[NDArray[np.float64]]) -> list[dict[str, Any]]:
    """`choice_of` for each loss of the paper's comparison, each of `BATCHES` and each of `CHANCES`."""
    rows = []
    for loss in LOSSES:
        alpha = ALPHA if loss.startswith("hybrid") else None
        for batch in BATCHES:
            chosen = {str(chance): choice_of(depths_mm, loss, chance, batch, alpha) for chance in CHANCES}
            rows.append({"loss": loss, "alpha": alpha, "batch": batch, "chosen": chosen})
    return rows


def _axis(rig: Rig, direction: Direction) -> CalibrationLayer:
    """The layer on the camera's axis alone."""
    return CalibrationLayer.of(rig, direction, (np.zeros(1), np.zeros(1)))


def kappa_per_m(rig: Rig, direction: Direction) -> float:
    """P / (f_p b) on the camera's axis in 1 / m: a period relative to the disparity, per metre of distance."""
    layer = _axis(rig, direction)
    return float(TAU / abs(layer.gain[0]) * layer.forward[0])


def depth_error_mm(
    rig: Rig, direction: Direction, distances_m: NDArray[np.float64], periods: float
) -> NDArray[np.float64]:
    """|depth of the wrong phase - depth| on the camera's axis, in mm; inf where no point ahead has the wrong phase."""
    layer = _axis(rig, direction)
    residual = layer.absolute_phase(distances_m * MM_PER_M) - layer.infinity_rad - TAU * layer.infinity_order
    # A depth error away from the camera reduces the magnitude of the residual phase.
    wrong_phase = residual - np.sign(residual) * TAU * periods
    with np.errstate(divide="ignore"):
        depth = layer.depth_of_residual_mm(wrong_phase)
    return np.where((depth > 0) & np.isfinite(depth), np.abs(depth - distances_m * MM_PER_M), np.inf)


def error_curves(rig: Rig, direction: Direction) -> list[Curve]:
    """Curves of a small error, of a period away from and toward the camera, of their mean, and of a small error on a
    rig whose projector is behind the camera."""
    distances = np.geomspace(*DISTANCES_M, POINTS)
    small, away, toward = (depth_error_mm(rig, direction, distances, p) for p in (SMALL_PERIODS, 1.0, -1.0))
    # The set-back is along the projector's axis, in its own frame.
    behind = replace(rig, translation_m=(rig.translation_m[0], rig.translation_m[1], rig.translation_m[2] + SET_BACK_M))
    small_behind = depth_error_mm(behind, direction, distances, SMALL_PERIODS)
    return [
        _curve("1/64 period", SMALL_PERIODS, distances, small),
        _curve(AWAY, 1.0, distances, away),
        _curve("one period, toward", -1.0, distances, toward),
        _curve(BOTH, 1.0, distances, (away + toward) / 2),
        _curve(f"1/64 period, projector {SET_BACK_M:g} m behind", SMALL_PERIODS, distances, small_behind),
    ]


def _curve(name: str, periods: float, distances: NDArray[np.float64], error_mm: NDArray[np.float64]) -> Curve:
    """The exponent is fitted where the local exponent is within `WITHIN` of 2; if nowhere, over all finite values."""
    with np.errstate(invalid="ignore"):
        local = np.gradient(np.log(error_mm), np.log(distances))
    finite = np.isfinite(error_mm) & np.isfinite(local)
    quadratic = finite & (np.abs(np.where(finite, local, 0.0) - 2) <= 2 * WITHIN)
    fitted = quadratic if quadratic.sum() > 2 else finite
    spans = {"fitted_m": distances[fitted], "quadratic_m": distances[quadratic]}
    return {
        "name": name,
        "periods": periods,
        "distances_m": distances,
        "error_mm": error_mm,
        "local": np.where(finite, local, np.nan),
        "exponent": float(np.polyfit(np.log(distances[fitted]), np.log(error_mm[fitted]), 1)[0]),
        **{key: [float(chosen.min()), float(chosen.max())] if chosen.size else None for key, chosen in spans.items()},
    }


def summary(values: Mapping[str, Any]) -> str:
    """Both theorems with their numbers."""
    twins, curves = values["twins"], {curve["name"]: curve for curve in values["curves"]}
    small = values["curves"][0]
    away, both = (
        f"from {_span(curves[name]['quadratic_m'])}" if curves[name]["quadratic_m"] else "at no distance from 0.3 m"
        for name in (AWAY, BOTH)
    )
    return (
        f"{twins['sample']} and a surface {twins['depth_apart_mean_mm']:.0f} mm from it on average give the same "
        f"{twins['direction']} fringe: {twins['differing_pixels']} of the image's pixels differ (the frame of the "
        f"other direction: {twins['differing_pixels_other_direction']}). The depth error of a small phase error grows "
        f"with exponent {small['exponent']:.3f} over {_span(small['fitted_m'])}. For a whole period the exponent is 2 "
        f"within 1% {away} for an error away from the camera, and {both} for the mean of both sides."
    )


def _span(ends: Sequence[float] | None) -> str:
    return "-" if ends is None else f"{ends[0]:.2g} to {ends[1]:.2g} m"


def tables(values: Mapping[str, Any], curves: Sequence[Curve]) -> list[Table]:
    """The two scenes, the choices of losses, exponents, and errors at some distances."""
    same = {
        "pixels of the object": "object_pixels",
        "depth between the two, mean, mm": "depth_apart_mean_mm",
        "pixels that differ, with noise": "differing_pixels",
        "pixels that differ, without noise": "differing_pixels_noiseless",
        "pixels that differ in the other direction's frame": "differing_pixels_other_direction",
        "least albedo factor on the brighter surface": "paint_least",
    }
    chosen = {}
    for row in values["choices"]:
        alpha = "" if row["alpha"] is None else f", alpha {row['alpha']:g}"
        chosen[f"{row['loss']}{alpha}, batches of {row['batch']}"] = row["chosen"]
    errors = []
    for curve in curves:
        shown = np.interp(np.log(_SHOWN_M), np.log(curve["distances_m"]), curve["error_mm"])
        errors.append((curve["name"], *("no depth" if not np.isfinite(value) else f"{value:.4g}" for value in shown)))
    return [
        Table("Two scenes, one frame", ("What", "Value"), [(what, values["twins"][key]) for what, key in same.items()]),
        Table.of(
            "Which depth a loss chooses for one image of two scenes: 0 the first, 1 the second, between them neither",
            "Loss",
            chosen,
            {str(chance): f"second scene in {chance:.0%}" for chance in CHANCES},
        ),
        Table.of(
            "Exponent of distance in the depth error",
            "Phase error",
            {curve["name"]: curve for curve in values["curves"]},
            {"exponent": "Fitted exponent", "fitted_m": "Fitted over, m", "quadratic_m": "Within 1% of 2, m"},
        ),
        Table("Depth error, mm", ("Phase error", *(f"{z:g} m" for z in _SHOWN_M)), errors),
    ]


def _draw_twins(twins: Twins) -> Figure:
    inside = twins.depths_mm[0] > 0
    low, high = np.stack(twins.depths_mm)[:, inside].min(), np.stack(twins.depths_mm)[:, inside].max()
    depths = [Picture(np.where(inside, depth, np.nan), "viridis", low, high) for depth in twins.depths_mm]
    rows = {f"depth,\n{low:.0f} to {high:.0f} mm": depths}
    for name, pair in ((f"{twins.direction} fringe", twins.frames), ("other direction", twins.other_frames)):
        difference = pair[1].astype(np.int64) - pair[0]
        label = f"{name},\n{np.count_nonzero(difference)} pixels differ"
        rows[label] = [*map(Picture, pair), Picture(difference, "coolwarm", -60, 60)]
    png = gallery(rows, ("scene A", "scene B", "B - A, blue -60 to red 60"), 2.2)
    alt = "Two depths a period apart, their identical fringes, and their difference"
    return Figure("Two scenes, one frame", "theory_twins.png", alt, png)


def _draw_curves(curves: Sequence[Curve]) -> Figure:
    def lines(key: str) -> list[Line]:
        drawn = []
        for curve, colour in zip(curves, ("edges", "depth", "phase", "order", "raw"), strict=True):
            values = np.where(np.isfinite(curve[key]), curve[key], np.nan)
            drawn.append(Line(curve["name"], curve["distances_m"], values, COLOURS[colour], "-"))
        return drawn

    across = {"xscale": "log", "xticks": [0.3, 1, 3, 10], "xticklabels": ["0.3", "1", "3", "10"]}
    local = [*lines("local"), Line("exponent 2", DISTANCES_M, (2.0, 2.0), COLOURS["ink"], ":")]
    panels = [
        Panel("Depth error of a phase error", lines("error_mm"), "distance, m", "mm", across | {"yscale": "log"}),
        Panel("Local exponent of distance", local, "distance, m", "", across | {"ylim": (1.0, 3.5)}),
    ]
    panels = [replace(panel, shaded=(1.5, 2.1)) for panel in panels]
    alt = "Depth error of a phase error from 0.3 to 10 m, and its exponent"
    title = "Depth error against distance; shaded: the working range of the paper's rig"
    return Figure(title, "theory_range.png", alt, chart(panels, 2))
