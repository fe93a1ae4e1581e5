"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance and tilt.

The paper shows a network a plane at 1.8 m in front of the background. Here planes have several distances and tilts,
each filling the frame (no edge at all), as a rectangle in front of the background (the paper's scene), and cut to the
silhouettes of test objects. The paper does not give the size of its rectangle, so a facing one grows until it fills the
frame. For an individually normalised network the prediction is its own output, without range heads, converted to mm by
the mean D_min and D_max of the test split: a facing plane has no depth range of its own.

Grad-CAM on the rectangle (the paper's figure beside Section 7.3) tells whether a layer attends to the plane's fringes.
A heatmap that is the same everywhere has the plane's share of the area within it. Random weights stand beside: their
heatmaps may follow the brighter fringes of a near plane without having learnt anything.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics import probe
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import original
from fpp_ml_bench.baselines.diagnostics.grad_cam import cam_layers, heat_by_layer
from fpp_ml_bench.baselines.diagnostics.probe import (
    COLOURS,
    TRAINED,
    UNTRAINED,
    Figure,
    Line,
    Panel,
    Picture,
    Table,
    layer_title,
)
from fpp_ml_bench.baselines.diagnostics.scene_renderer import Scene, SceneRenderer, plane
from fpp_ml_bench.baselines.diagnostics.subjects import Subject, background_below
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage.store import DatasetFolder
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
    """A plane's numbers, its mask, image and prediction (H, W)."""

    row: Row
    mask: NDArray[np.bool_]
    frame: NDArray[np.uint8]
    prediction: NDArray[np.float32]


class FlatPlane(probe.Probe):
    """Predictions for planes in three outlines, and for the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    version = 2
    question = "Is a plane without features predicted at its distance, or as background?"

    def applies_to(self, subject: Subject) -> str | None:
        reason = f"{subject.name} uses the object's mask, and a plane that fills the frame has none."
        return reason if subject.uses_ground_truth_mask else None

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: probe.ProbeSettings, progress: probe.Progress
    ) -> probe.Finding:
        renderer = SceneRenderer.of(dataset)
        records = [dataset.measured(sample) for sample in dataset.samples("test")]
        ranges = [(record["depth_min_mm"], record["depth_max_mm"]) for record in records if record.get("depth_max_mm")]
        low, high = (float(np.mean(ends)) for ends in zip(*ranges, strict=True))
        normalised = subject.answers_normalised
        scale = Scale(normalised, (low, high), renderer.rig.working_range_mm[0])
        silhouettes = outlines_of(dataset, settings)
        masks = {outline: rectangle(renderer.shape, side) for outline, side in SIDES.items()} | silhouettes
        poses = [
            (outline, mask, *pose) for outline, mask in masks.items() for pose in poses_of(outline, settings.quick)
        ]
        planes = []
        for outline, mask, tilt_deg, distance_m in poses:
            planes.append(predict_plane(subject, renderer, scale, outline, mask, tilt_deg, distance_m))
            progress(len(planes), len(poses), f"{outline}, {distance_m:g} m")
        control = control_of(subject, dataset, renderer, list(silhouettes), scale)
        rows, range_mm = [one.row for one in planes], [low, high] if normalised else None
        values = {"planes": rows, "objects": control, "range_mm": range_mm, "collapse_below": scale.limit}
        shown = {kind_of(one.row["outline"]): one for one in reversed(planes) if is_facing(one.row, PAPER_DISTANCE_M)}
        found, figures = tables(rows, control, normalised), draw(shown, rows, normalised)
        if subject.network is not None:
            frame, mask = shown[RECTANGLE].frame, shown[RECTANGLE].mask
            heat = plane_heat(subject, frame)
            values["grad_cam"] = shares = shares_within(heat, mask)
            found.append(attention_table(shares))
            figures.append(draw_attention(frame, heat))
        return self.finding(summary(rows, control, normalised), values, found, *figures)


def kind_of(outline: str) -> str:
    """A name in `SIDES`, or `SILHOUETTE`."""
    return outline if outline in SIDES else SILHOUETTE


def is_facing(row: Row, distance_m: float) -> bool:
    """Whether a plane faces the camera at a distance."""
    return row["tilt_deg"] == [0.0, 0.0] and row["distance_m"] == distance_m


def outlines_of(dataset: DatasetFolder, settings: probe.ProbeSettings) -> dict[str, NDArray[np.bool_]]:
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


def predict_plane(
    subject: Subject,
    renderer: SceneRenderer,
    scale: Scale,
    outline: str,
    mask: NDArray[np.bool_],
    tilt_deg: tuple[float, float],
    distance_m: float,
) -> PlanePrediction:
    """A plane cut to ``mask`` (H, W), rendered and predicted (`Subject.answer`). Of its row: mean, standard deviation,
    least and largest prediction, in its own units and in mm, its error, and the share that collapsed to background; in
    float64."""
    surface = plane(renderer.rig, distance_m, tilt_deg, mask)
    lit, seen = renderer.light(surface), mask.copy()
    seen.ravel()[surface.pixels] &= lit.gain > 0  # no fringe beyond the projector's field
    frames = renderer.frames(Scene(surface.pixels.astype(np.uint32), lit, seen, STREAM), subject.frames_used)
    prediction, true_mm = subject.answer(frames), surface.depth_mm(renderer.shape)[seen]
    values = prediction[seen].astype(np.float64)
    millimetres = scale.mm(values)
    error = millimetres - true_mm
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
        "true_std_mm": true_mm.std(),
    }
    row = {
        "outline": outline,
        "distance_m": distance_m,
        "tilt_deg": list(tilt_deg),
        "pixels": int(seen.sum()),
        **{key: float(value) for key, value in own.items()},
    }
    return PlanePrediction(row, seen, np.asarray(frames[subject.frames_used[0]]), prediction)


def control_of(
    subject: Subject, dataset: DatasetFolder, renderer: SceneRenderer, samples: list[str], scale: Scale
) -> dict[str, float]:
    """Share of the test objects' pixels that the subject predicts as background, and that are as near in truth."""
    shares = []
    for sample in samples:
        unchanged = original(dataset, renderer, sample)
        answer = subject.answer(renderer.frames(unchanged.scene, subject.frames_used))
        true = unchanged.depth_mm[unchanged.target]
        if scale.normalised:
            true = (true - true.min()) / (float(np.ptp(true)) or MM_PER_M)
        predicted = answer[unchanged.target].astype(np.float64)
        shares.append([(values < scale.limit).mean() for values in (predicted, true)])
    means = (float(np.mean(column)) for column in zip(*shares, strict=True))
    return dict(zip(("collapsed_share", "collapsed_share_true"), means, strict=True))


def plane_heat(subject: Subject, frame: NDArray[np.uint8]) -> dict[str, dict[str, NDArray[np.float32]]]:
    """Heatmaps float32 (H, W) of an image by `TRAINED` or `UNTRAINED` weights and by layer, after the ReLU. Raises
    `DiagnosisError` as `grad_cam.heatmaps`."""
    network, untrained = subject.networks()
    stack: list[NDArray[np.uint8] | None] = [None] * subject.frames_used[0] + [frame]
    fringe, layers = subject.input_batch([stack]), cam_layers(subject)
    return {
        weights: {name: heat[0] for name, heat in heat_by_layer(subject, one, fringe, layers).items()}
        for weights, one in ((TRAINED, network), (UNTRAINED, untrained(0)))
    }


def shares_within(heat: Mapping[str, Mapping[str, NDArray[np.float32]]], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """``area``: the share of ``mask`` (H, W) in the image; for each layer the share of its heat within the mask, None
    where it has no heat at all."""

    def share(values: NDArray[np.float32]) -> float | None:
        total = float(values.sum(dtype=np.float64))
        return float(values[mask].sum(dtype=np.float64)) / total if total > 0 else None

    of_layers = {weights: {name: share(values) for name, values in layers.items()} for weights, layers in heat.items()}
    return {"area": float(mask.mean()), **of_layers}


def attention_table(shares: Mapping[str, Any]) -> Table:
    """A row per layer."""
    rows = [(layer_title(layer), share, shares[UNTRAINED][layer]) for layer, share in shares[TRAINED].items()]
    title = f"Grad-CAM on the rectangle at 1.8 m, which covers {shares['area']:.0%} of the image: heat within it"
    return Table(title, ("Layer", "Share", "Random weights"), rows)


def draw_attention(frame: NDArray[np.uint8], heat: Mapping[str, Mapping[str, NDArray[np.float32]]]) -> Figure:
    """The paper's figure, and the same with random weights."""
    rows = {
        weights: [Picture(frame), *(Picture(one, "inferno", high=float(one.max())) for one in layers.values())]
        for weights, layers in heat.items()
    }
    alt = "Grad-CAM by layer on a plane with an outline, with trained and with random weights"
    png = probe.gallery(rows, ("input", *heat[TRAINED]))
    return Figure("Grad-CAM on the plane, each to its own largest value", "flat_plane_attention.png", alt, png)


def summary(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline and by size, the mean at the paper's distance, and for mm those at all
    distances."""
    frame, rectangles, silhouettes = (
        float(np.mean([row["collapsed_share"] for row in rows if kind_of(row["outline"]) == kind]))
        for kind in (FRAME, RECTANGLE, SILHOUETTE)
    )
    rectangles_at = {z: row for z in DISTANCES_M for row in rows if row["outline"] == RECTANGLE and is_facing(row, z)}
    paper = rectangles_at[PAPER_DISTANCE_M]
    mean_text, range_text = f"{paper['mean_mm']:.0f} mm", ""
    if normalised:
        mean_text = f"{paper['answer_mean']:.3f} of the range (paper: {PAPER['answer_mean']})"
        range_text = " (paper: {:g} to {:g})".format(*PAPER["answer_range"])
    sizes = ", ".join(
        f"{row['collapsed_share']:.0%} at {GROWING[row['outline']]:g}" for row in rows if row["outline"] in GROWING
    )
    text = (
        f"Predicted as background: {rectangles:.0%} of a rectangular plane, {frame:.0%} of a plane that "
        f"fills the frame, {silhouettes:.0%} of a plane in an object's outline; "
        f"{control['collapsed_share']:.0%} of real objects ({control['collapsed_share_true']:.0%} in truth). The "
        f"prediction for the rectangle at 1.8 m has a mean of {mean_text} and a spread of {paper['answer_std']:.3g}, "
        f"from {paper['answer_min']:.4g} to {paper['answer_max']:.4g}{range_text}. "
        f"Share of a facing rectangle there predicted as background, by its side relative to the image's: {sizes}."
    )
    if not normalised:
        means = ", ".join(f"{row['mean_mm']:.0f}" for row in rectangles_at.values())
        distances = ", ".join(f"{1000 * distance_m:.0f}" for distance_m in rectangles_at)
        text += f" Facing planes at {distances} mm are predicted with means of {means} mm."
    return text


def tables(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> list[Table]:
    """A row per plane; silhouettes as means over objects."""
    unit = "of range" if normalised else "mm"
    columns = {
        "answer_mean": f"Mean, {unit}",
        "answer_std": f"Spread, {unit}",
        "span": f"Least to most, {unit}",
        "collapsed_share": "Collapsed",
        "mean_mm": "Mean, mm",
        "std_mm": "Spread, mm",
        "true_std_mm": "True spread, mm",
        "mae_mm": "MAE, mm",
    }
    poses = defaultdict(list)
    for row in rows:  # in the order of `SIDES`, then silhouettes
        across, down = row["tilt_deg"]
        pose = f"{kind_of(row['outline'])}, {row['distance_m']:g} m, tilt {across:g}, {down:g}"
        poses[pose].append(row)
    lines = {}
    for pose, same_pose in poses.items():
        span = min(row["answer_min"] for row in same_pose), max(row["answer_max"] for row in same_pose)
        means = {key: float(np.mean([row[key] for row in same_pose])) for key in columns if key != "span"}
        lines[pose] = {**means, "span": span}
    title = "Predictions for planes" + (", mm by the mean range of the test split" if normalised else "")
    keys = {"real objects, predicted": "collapsed_share", "real objects, in truth": "collapsed_share_true"}
    shares = [(pixels, control[key]) for pixels, key in keys.items()]
    return [
        Table.of(title, "Outline, distance, tilt in degrees", lines, columns),
        Table("Share of background: the control", ("Pixels of", "Share"), shares),
    ]


def draw(shown: Mapping[str, PlanePrediction], rows: Sequence[Row], normalised: bool) -> list[Figure]:
    """The paper's figure, input and prediction, for each outline at 1.8 m; and what changes with distance and size,
    with the distribution of the predictions."""
    low, high, unit = (-0.2, 1.2, "share of range") if normalised else (0.0, 2400.0, "mm")
    bins = np.linspace(low, high, 57)
    columns, frames, predictions, histograms, distances = [], [], [], [], []
    for kind, colour in ((FRAME, "edges"), (RECTANGLE, "depth"), (SILHOUETTE, "phase")):
        one = shown[kind]
        values = one.prediction[one.mask]
        columns.append(f"{one.row['outline']}\n{values.min():.4g} to {values.max():.4g}, mean {values.mean():.4g}")
        frames.append(Picture(one.frame))
        predictions.append(Picture(one.prediction, "viridis", low, high))
        shares = np.histogram(np.clip(values, low, high), bins)[0] / values.size
        histograms.append(Line(kind, ((bins[1:] + bins[:-1]) / 2).tolist(), shares, COLOURS[colour], "-"))
        of_kind = [row for row in rows if kind_of(row["outline"]) == kind]
        means = [np.mean([row["answer_mean"] for row in of_kind if is_facing(row, z)]) for z in DISTANCES_M]
        distances.append(Line(kind, DISTANCES_M, means, COLOURS[colour]))
    if not normalised:
        distances.append(Line("true", DISTANCES_M, [MM_PER_M * z for z in DISTANCES_M], COLOURS["ink"], ":"))
    sizes = {side: row for outline, side in GROWING.items() for row in rows if row["outline"] == outline}
    mean, collapsed = ([Line.of(RECTANGLE, sizes, key, COLOURS["depth"])] for key in ("answer_mean", "collapsed_share"))
    side = "side of the rectangle, share of the image's"
    panels = [
        Panel("Mean prediction of a facing plane", distances, "distance, m", unit),
        Panel("Predictions at 1.8 m (ends: beyond)", histograms, unit, "share of pixels"),
        Panel("Mean prediction, 1.8 m", mean, side, unit),
        Panel("Predicted as background, 1.8 m", collapsed, side, "share of pixels"),
    ]
    png = probe.gallery({"fringes": frames, f"prediction,\n{low:g} to {high:g}\n{unit}": predictions}, columns, 2.4)
    curves = probe.chart(panels, 2)
    return [
        Figure(
            "Flat planes at 1.8 m", "flat_plane.png", "Fringes on planes in three outlines, and the predictions", png
        ),
        Figure("Predictions by distance and size", "flat_plane_curves.png", "Means against distance and size", curves),
    ]
