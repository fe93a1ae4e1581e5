"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance and tilt.

The paper shows a network a plane at 1.8 m in front of the background. Here planes have several distances and tilts,
each filling the frame (no edge at all), as a rectangle in front of the background (the paper's scene), and cut to the
silhouettes of test objects. The paper does not give the size of its rectangle, so a facing one grows until it fills the
frame. For an individually normalised network the prediction is its own output, without range heads, converted to mm by
the mean D_min and D_max of the test split: a facing plane has no depth range of its own.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import original
from fpp_ml_bench.baselines.diagnostics.plane_attention import (
    attention_table,
    draw_attention,
    plane_heat,
    shares_within,
)
from fpp_ml_bench.baselines.diagnostics.probe import Figure, Finding, Probe, ProbeSettings, Progress, Sheet, Table
from fpp_ml_bench.baselines.diagnostics.scene_renderer import Scene, SceneRenderer, plane
from fpp_ml_bench.baselines.diagnostics.subjects import Subject, background_below
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.paper import paper_rows

TILTS_DEG = ((0.0, 0.0), (20.0, 0.0), (0.0, 20.0))
DISTANCES_M = (1.6, 1.8, 2.0)
OUTLINES, QUICK_OUTLINES = 5, 2
FRAME, RECTANGLE, SILHOUETTE = "fills the frame", "rectangle", "silhouette"
"""Kinds of outlines; a silhouette is named by its sample."""
GROWING = {f"{RECTANGLE}, side {side:g}": side for side in (0.3, 0.45, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 1.0)}
"""Sides, as shares of the image's, of rectangles that face the camera at the paper's distance."""
SIDES = {FRAME: 1.0, RECTANGLE: 0.5, **GROWING}
STREAM = (0, "plane", "")
PAPER = paper_rows()["probes"]["flat_plane"]
PAPER_DISTANCE_M = PAPER["distance_m"]
Row = Mapping[str, Any]


@dataclass(frozen=True)
class Scale:
    """Converts predictions to mm: ``range_mm`` for normalised ones; ``near_mm`` is the working range's near end."""

    normalised: bool
    range_mm: tuple[float, float]
    near_mm: float

    def mm(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.range_mm
        return values * (high - low) + low if self.normalised else values

    @property
    def limit(self) -> float:
        """Predictions below it collapsed to background."""
        return background_below(self.normalised, self.near_mm)


@dataclass(frozen=True)
class PlanePrediction:
    """A plane and its prediction: name of the ``outline``, and maps (H, W) with the plane's ``mask`` and true depth."""

    outline: str
    distance_m: float
    tilt_deg: tuple[float, float]
    mask: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]
    frame: NDArray[np.uint8]
    prediction: NDArray[np.float32]

    def statistics(self, scale: Scale) -> dict[str, Any]:
        """Mean, standard deviation, least and largest prediction over ``mask``, in its own units and in mm, its error,
        and the share that collapsed to background; in float64."""
        values = self.prediction[self.mask].astype(np.float64)
        millimetres = scale.mm(values)
        error = millimetres - self.depth_mm[self.mask]
        own = {
            "answer_mean": values.mean(),
            "answer_std": values.std(),
            "answer_min": values.min(),
            "answer_max": values.max(),
            "collapsed_share": (values < scale.limit).mean(),
            "mean_mm": millimetres.mean(),
            "std_mm": millimetres.std(),
            "bias_mm": error.mean(),
            "mae_mm": np.abs(error).mean(),
            "true_std_mm": self.depth_mm[self.mask].std(),
        }
        about = {"outline": self.outline, "distance_m": self.distance_m, "tilt_deg": list(self.tilt_deg)}
        return {**about, "pixels": int(self.mask.sum()), **{key: float(value) for key, value in own.items()}}


class FlatPlane(Probe):
    """Predictions for planes in three outlines, and for the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    version = 2
    question = "Is a plane without features predicted at its distance, or as background?"

    def applies_to(self, subject: Subject) -> str | None:
        reason = f"{subject.name} uses the object's mask, and a plane that fills the frame has none."
        return reason if subject.uses_ground_truth_mask else None

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        renderer = SceneRenderer.of(dataset)
        records = [dataset.measured(sample) for sample in dataset.samples("test")]
        ranges = [(record["depth_min_mm"], record["depth_max_mm"]) for record in records if record.get("depth_max_mm")]
        low, high = (float(np.mean(ends)) for ends in zip(*ranges, strict=True))
        normalised = subject.answers_normalised
        scale = Scale(normalised, (low, high), renderer.rig.working_range_mm[0])
        outlines = outlines_of(dataset, settings)
        total = sum(len(poses_of(outline, settings.quick)) for outline in (*SIDES, *outlines))
        planes: list[PlanePrediction] = []
        for one in predict_planes(subject, renderer, outlines, settings.quick):
            planes.append(one)
            progress(len(planes), total, f"{one.outline}, {one.distance_m:g} m")
        control = control_of(subject, dataset, renderer, list(outlines), scale)
        rows, range_mm = [one.statistics(scale) for one in planes], [low, high] if normalised else None
        values = {"planes": rows, "objects": control, "range_mm": range_mm, "collapse_below": scale.limit}
        found, figures = tables(rows, control, normalised), [draw(planes, rows, normalised, folder)]
        if subject.network is not None:
            shown = next(p for p in planes if (p.outline, p.distance_m) == (RECTANGLE, PAPER_DISTANCE_M))
            heat = plane_heat(subject, shown.frame)
            values["grad_cam"] = shares = shares_within(heat, shown.mask)
            found.append(attention_table(shares))
            figures.append(draw_attention(shown.frame, heat, folder))
        return self.finding(summary(rows, control, normalised), values, found, *figures)


def kind_of(outline: str) -> str:
    """A name in `SIDES`, or `SILHOUETTE`."""
    return outline if outline in SIDES else SILHOUETTE


def shown_to(
    subject: Subject, renderer: SceneRenderer, scene: Scene
) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32]]:
    """The first frame of ``scene`` that the subject uses, and its prediction (H, W) in mm, or normalised
    (`Subject.answer`)."""
    frames = renderer.frames(scene, subject.frames_used, subject.uses_ground_truth_mask)
    return frames[subject.frames_used[0]], subject.answer(frames)


def outlines_of(dataset: DatasetFolder, settings: ProbeSettings) -> dict[str, NDArray[np.bool_]]:
    """Silhouettes (H, W) of a test sample of each object, by sample."""
    first: dict[str, str] = {}
    for sample in dataset.samples("test"):
        first.setdefault(dataset.measured(sample)["object"], sample)
    names = settings.choose(list(first.values()), OUTLINES, QUICK_OUTLINES)
    masks = {name: object_mask(dataset.depth_mm(name)) for name in names}
    return {name: mask for name, mask in masks.items() if mask.any()}


def poses_of(outline: str, quick: bool) -> list[tuple[tuple[float, float], float]]:
    """Tilts in degrees and distances in m of the planes with ``outline``."""
    facing = outline in GROWING
    tilts, distances = TILTS_DEG[: 1 if quick or facing else None], (PAPER_DISTANCE_M,) if facing else DISTANCES_M
    return list(product(tilts, distances))


def rectangle(shape: tuple[int, int], side: float) -> NDArray[np.bool_]:
    """Mask of ``shape`` (H, W) of a central rectangle whose sides are the share ``side`` of the image's."""
    mask = np.zeros(shape, dtype=bool)
    down, across = (round(length * (1 - side) / 2) for length in shape)
    mask[down : shape[0] - down, across : shape[1] - across] = True
    return mask


def predict_planes(
    subject: Subject, renderer: SceneRenderer, outlines: dict[str, NDArray[np.bool_]], quick: bool = False
) -> Iterator[PlanePrediction]:
    """Every plane, rendered and predicted."""
    masks = {outline: rectangle(renderer.shape, side) for outline, side in SIDES.items()} | outlines
    for outline, mask in masks.items():
        for tilt, distance_m in poses_of(outline, quick):
            surface = plane(renderer.rig, distance_m, tilt, mask)
            lit, seen = renderer.light(surface), mask.copy()
            seen.ravel()[surface.pixels] &= lit.gain > 0  # no fringe beyond the projector's field
            scene = Scene(surface.pixels.astype(np.uint32), lit, seen, STREAM)
            frame, answer = shown_to(subject, renderer, scene)
            depth_mm = surface.depth_mm(renderer.shape)
            yield PlanePrediction(outline, distance_m, tilt, seen, depth_mm, np.asarray(frame), answer)


def control_of(
    subject: Subject, dataset: DatasetFolder, renderer: SceneRenderer, samples: list[str], scale: Scale
) -> dict[str, float]:
    """Share of the test objects' pixels that the subject predicts as background, and that are as near in truth."""
    shares = []
    for sample in samples:
        unchanged = original(dataset, renderer, sample)
        predicted = shown_to(subject, renderer, unchanged.scene)[1][unchanged.target].astype(np.float64)
        true = unchanged.depth_mm[unchanged.target]
        if scale.normalised:
            true = (true - true.min()) / (float(np.ptp(true)) or MM_PER_M)
        shares.append([(values < scale.limit).mean() for values in (predicted, true)])
    means = (float(np.mean(column)) for column in zip(*shares, strict=True))
    return dict(zip(("collapsed_share", "collapsed_share_true"), means, strict=True))


def summary(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline and by size, the mean at the paper's distance, and for mm those at all
    distances."""
    shares = {
        kind: float(np.mean([row["collapsed_share"] for row in rows if kind_of(row["outline"]) == kind]))
        for kind in (RECTANGLE, FRAME, SILHOUETTE)
    }
    facing = [row for row in rows if row["outline"] == RECTANGLE and row["tilt_deg"] == [0.0, 0.0]]
    paper = next(row for row in facing if row["distance_m"] == PAPER_DISTANCE_M)
    mean_text = (
        f"{paper['answer_mean']:.3f} of the range (paper: {PAPER['answer_mean']})"
        if normalised
        else f"{paper['mean_mm']:.0f} mm"
    )
    text = (
        f"Predicted as background: {shares[RECTANGLE]:.0%} of a rectangular plane, {shares[FRAME]:.0%} of a plane that "
        f"fills the frame, {shares[SILHOUETTE]:.0%} of a plane in an object's outline; "
        f"{control['collapsed_share']:.0%} of real objects ({control['collapsed_share_true']:.0%} in truth). The "
        f"prediction for the rectangle at 1.8 m has a mean of {mean_text} and a spread of {paper['answer_std']:.3g}, "
        f"from {paper['answer_min']:.4g} to {paper['answer_max']:.4g}"
        f"{' (paper: {:g} to {:g})'.format(*PAPER['answer_range']) if normalised else ''}."
    )
    collapsed = {GROWING[row["outline"]]: row["collapsed_share"] for row in rows if row["outline"] in GROWING}
    sizes = ", ".join(f"{share:.0%} at {side:g}" for side, share in collapsed.items())
    text += f" Share of a facing rectangle there predicted as background, by its side relative to the image's: {sizes}."
    if not normalised:
        means = ", ".join(f"{row['mean_mm']:.0f}" for row in facing)
        distances = ", ".join(f"{1000 * row['distance_m']:.0f}" for row in facing)
        text += f" Facing planes at {distances} mm are predicted with means of {means} mm."
    return text


def tables(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> list[Table]:
    """A row per plane; silhouettes as means over objects."""
    unit = "of range" if normalised else "mm"
    poses = defaultdict(list)
    for row in rows:  # in the order of `SIDES`, then silhouettes
        poses[kind_of(row["outline"]), row["distance_m"], *row["tilt_deg"]].append(row)
    lines = []
    for (kind, distance_m, across, down), same_pose in poses.items():
        name = f"{kind}, {len(same_pose)} objects" if kind == SILHOUETTE else kind
        least, most = min(row["answer_min"] for row in same_pose), max(row["answer_max"] for row in same_pose)
        mean, std, *others = (
            float(np.mean([row[key] for row in same_pose]))
            for key in ("answer_mean", "answer_std", "collapsed_share", "mean_mm", "std_mm", "true_std_mm", "mae_mm")
        )
        pose = f"{distance_m:g} m", f"{across:g}, {down:g}"
        lines.append((name, *pose, mean, std, f"{least:.4g} to {most:.4g}", *others))
    title = "Predictions for planes" + (", mm by the mean range of the test split" if normalised else "")
    header = (
        "Outline",
        "Distance",
        "Tilt, degrees",
        f"Mean, {unit}",
        f"Spread, {unit}",
        f"Least to most, {unit}",
        "Collapsed",
        "Mean, mm",
        "Spread, mm",
        "True spread, mm",
        "MAE, mm",
    )
    keys = {"real objects, predicted": "collapsed_share", "real objects, in truth": "collapsed_share_true"}
    shares = [(pixels, control[key]) for pixels, key in keys.items()]
    return [Table(title, header, lines), Table("Share of background: the control", ("Pixels of", "Share"), shares)]


def draw(planes: Sequence[PlanePrediction], rows: Sequence[Row], normalised: bool, folder: Path) -> Figure:
    """The paper's figure, input and prediction, for each outline at 1.8 m, and the distribution of the predictions,
    and what changes with distance and size."""
    facing = [shown for shown in planes if shown.distance_m == PAPER_DISTANCE_M and shown.tilt_deg == (0.0, 0.0)]
    examples = [next(shown for shown in facing if shown.outline == kind) for kind in (FRAME, RECTANGLE)]
    examples += [shown for shown in facing if kind_of(shown.outline) == SILHOUETTE][:1]
    sheet = Sheet(2, len(examples) + 2, 13.5, 5.2, width_ratios=[1] * len(examples) + [1.5, 1.5])
    low, high = (-0.2, 1.2) if normalised else (0.0, 2400.0)
    unit, digits = ("share of range", 2) if normalised else ("mm", 0)
    for (above, below), shown in zip(sheet.axes.T, examples, strict=False):
        values = shown.prediction[shown.mask]
        sheet.picture(above, shown.frame, f"{shown.outline}\n{shown.distance_m:g} m", "gray", 0, 255)
        least, most, mean = (f"{value:.{digits}f}" for value in (values.min(), values.max(), values.mean()))
        title = f"prediction over the plane:\n{least} to {most}, mean {mean}"
        image = sheet.picture(below, shown.prediction, title, "viridis", low, high)
    sheet.scale(image, sheet.axes[1, : len(examples)], fraction=0.05, pad=0.02, label=unit)
    _against_distance(sheet, planes, normalised)
    axis, bins = sheet.axes[1, -2], np.linspace(low, high, 57)
    for shown in examples:
        values = np.clip(shown.prediction[shown.mask], low, high)
        axis.hist(values, bins, histtype="step", weights=np.full(values.size, 1 / values.size), label=shown.outline)
    sheet.tidy(axis, "Predictions at 1.8 m (end bins: beyond)", unit, "share of pixels")
    axis.legend(fontsize=7, frameon=False)
    sizes = [row for row in rows if row["outline"] in GROWING]
    lines = ("answer_mean", "Mean prediction", unit), ("collapsed_share", "Predicted as background", "share of pixels")
    for axis, (key, title, label) in zip(sheet.axes[:, -1], lines, strict=True):
        axis.plot(list(GROWING.values()), [row[key] for row in sizes], "s-", markersize=5)
        sheet.tidy(axis, f"{title}, 1.8 m", "side of the rectangle, share of the image's", label)
    alt = "Fringes on planes in three outlines, the predictions, and their means against distance and size"
    return sheet.save(folder, "flat_plane.png", "Flat planes", alt)


def _against_distance(sheet: Sheet, planes: Sequence[PlanePrediction], normalised: bool) -> None:
    axis, scale = sheet.axes[0, -2], 1.0 if normalised else 1000.0
    for kind, mark in ((FRAME, "o"), (RECTANGLE, "s"), (SILHOUETTE, "^")):
        points = defaultdict(list)
        for shown in planes:
            if kind_of(shown.outline) == kind and shown.tilt_deg == (0.0, 0.0):
                points[shown.distance_m].append(float(shown.prediction[shown.mask].mean(dtype=np.float64)))
        means = [np.mean(values) / scale for values in points.values()]
        axis.plot(list(points), means, mark + "-", markersize=5, label=kind)
    if not normalised:
        ends = min(DISTANCES_M), max(DISTANCES_M)
        axis.plot(ends, ends, color=sheet.INK, linewidth=0.8, label="true")
    sheet.tidy(axis, "Mean prediction of a facing plane", "distance, m", "share of range" if normalised else "m")
    axis.legend(fontsize=7, frameon=False)
