"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance and tilt.

The paper shows a network a plane at 1.8 m in front of the background. Here planes have several distances and tilts,
each filling the frame (no edge at all), as a rectangle in front of the background (the paper's scene), and cut to the
silhouettes of test objects. The paper does not give the size of its rectangle, so a facing one grows until it fills the
frame. For an individually normalised network the prediction is its own output, without range heads, converted to mm by
the mean D_min and D_max of the test split: a facing plane has no depth range of its own.
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
from fpp_ml_bench.baselines.diagnostics.probe import Figure, Picture, Table, gallery
from fpp_ml_bench.baselines.diagnostics.scene_renderer import Scene, SceneRenderer, plane
from fpp_ml_bench.baselines.diagnostics.subjects import Subject, background_below
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.paper import paper_rows
from fpp_ml_bench.style import DEPTH_COLOURS

TILTS_DEG = ((0.0, 0.0), (20.0, 0.0), (0.0, 20.0))
DISTANCES_M = (1.6, 1.8, 2.0)
OUTLINES, QUICK_OUTLINES = 5, 2
FRAME, RECTANGLE, SILHOUETTE = "fills the frame", "rectangle", "silhouette"
KINDS = FRAME, RECTANGLE, SILHOUETTE
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
    """A plane's numbers, its image and prediction (H, W)."""

    row: Row
    frame: NDArray[np.uint8]
    prediction: NDArray[np.float32]


class FlatPlane(probe.Probe):
    """Predictions for planes in three outlines, and for the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    version = 3
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
        return self.finding(
            summary(rows, control, normalised), values, table(rows, normalised), draw(shown, normalised)
        )


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
    """A plane cut to ``mask`` (H, W), rendered and predicted (`Subject.answer`). Of its row: mean, least and largest
    prediction in its own units, the share that collapsed to background, mean and error in mm; in float64."""
    surface = plane(renderer.rig, distance_m, tilt_deg, mask)
    lit, seen = renderer.light(surface), mask.copy()
    seen.ravel()[surface.pixels] &= lit.gain > 0  # no fringe beyond the projector's field
    frames = renderer.frames(Scene(surface.pixels.astype(np.uint32), lit, seen, STREAM), subject.frames_used)
    prediction, true_mm = subject.answer(frames), surface.depth_mm(renderer.shape)[seen]
    values = prediction[seen].astype(np.float64)
    millimetres = scale.mm(values)
    row = {
        "outline": outline,
        "distance_m": distance_m,
        "tilt_deg": list(tilt_deg),
        "pixels": int(seen.sum()),
        "answer_mean": float(values.mean()),
        "answer_min": float(values.min()),
        "answer_max": float(values.max()),
        "collapsed_share": float((values < scale.limit).mean()),
        "mean_mm": float(millimetres.mean()),
        "mae_mm": float(np.abs(millimetres - true_mm).mean()),
    }
    return PlanePrediction(row, np.asarray(frames[subject.frames_used[0]]), prediction)


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


def summary(rows: Sequence[Row], control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline, and the prediction for the paper's rectangle."""
    shares = {kind: [row["collapsed_share"] for row in rows if kind_of(row["outline"]) == kind] for kind in KINDS}
    frame, rectangles, silhouettes = (float(np.mean(of_kind)) for of_kind in shares.values())
    paper = next(row for row in rows if row["outline"] == RECTANGLE and is_facing(row, PAPER_DISTANCE_M))
    unit = "of the range (paper: {answer_mean})".format(**PAPER) if normalised else "mm"
    return (
        f"Predicted as background: {rectangles:.0%} of a rectangular plane, {frame:.0%} of a plane that "
        f"fills the frame, {silhouettes:.0%} of a plane in an object's outline; "
        f"{control['collapsed_share']:.0%} of real objects ({control['collapsed_share_true']:.0%} in truth). The "
        f"prediction for the rectangle at 1.8 m has a mean of {paper['answer_mean']:.4g} {unit}, from "
        f"{paper['answer_min']:.4g} to {paper['answer_max']:.4g}."
    )


def table(rows: Sequence[Row], normalised: bool) -> Table:
    """A row per plane; silhouettes as means over objects."""
    columns = {
        "answer_mean": "Mean, of range" if normalised else "Mean, mm",
        "collapsed_share": "Predicted as background",
        "mean_mm": "Mean, mm",
        "mae_mm": "MAE, mm",
    }
    poses = defaultdict(list)
    for row in rows:  # in the order of `SIDES`, then silhouettes
        across, down = row["tilt_deg"]
        poses[f"{kind_of(row['outline'])}, {row['distance_m']:g} m, tilt {across:g}, {down:g}"].append(row)
    lines = {
        pose: {key: float(np.mean([row[key] for row in same_pose])) for key in columns}
        for pose, same_pose in poses.items()
    }
    title = "Predictions for planes" + (", mm by the mean range of the test split" if normalised else "")
    return Table.of(title, "Outline, distance, tilt in degrees", lines, columns)


def draw(shown: Mapping[str, PlanePrediction], normalised: bool) -> Figure:
    """The paper's figure, input and prediction, for each outline at 1.8 m."""
    low, high, unit = (-0.2, 1.2, "share of range") if normalised else (0.0, 2400.0, "mm")
    planes = [shown[kind] for kind in KINDS]
    columns = [
        "{outline}\n{answer_min:.4g} to {answer_max:.4g}, mean {answer_mean:.4g}".format(**one.row) for one in planes
    ]
    rows = {
        "fringes": [Picture(one.frame) for one in planes],
        f"prediction,\n{low:g} to {high:g}\n{unit}": [
            Picture(one.prediction, DEPTH_COLOURS, low, high) for one in planes
        ],
    }
    alt = "Fringes on planes in three outlines, and the predictions"
    return Figure("Flat planes at 1.8 m", alt, gallery(rows, columns, 2.4))
