"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance
and tilt.

The paper shows a network a plane at 1.8 m in front of the background. Here planes have several
distances and tilts, each filling the frame (no edge at all), as a rectangle in front of the
background (the paper's scene), and cut to the silhouettes of test objects. The paper does not give
the size of its rectangle, so a facing one grows until it fills the frame. The prediction of an
individually normalised network is converted to mm by the mean D_min and D_max of the test split: a
facing plane has no depth range of its own.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    table_of,
)
from fpp_ml_bench.baselines.diagnostics.scenes import Mask, Scene, SceneRenderer, original, plane
from fpp_ml_bench.baselines.diagnostics.subjects import Subject, background_below
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.paper import paper_rows
from fpp_ml_bench.style import DEPTH_COLOURS, Picture, gallery
from fpp_ml_bench.tables import Table

TILTS_DEG = ((0.0, 0.0), (20.0, 0.0), (0.0, 20.0))
"""Tilts of the planes across and down, in degrees: facing the camera, and clearly tilted each
way."""
DISTANCES_M = (1.6, 1.8, 2.0)
"""Distances of the planes, in m: around the paper's standoff, within its range."""
OUTLINES = 5
"""Silhouettes of test objects that planes get: one for each object of the test split."""
QUICK_OUTLINES = 2
"""The same in a quick run."""
FRAME, RECTANGLE, SILHOUETTE = "fills the frame", "rectangle", "silhouette"
KINDS = FRAME, RECTANGLE, SILHOUETTE
"""Kinds of outlines; a silhouette is named by its sample."""
GROWING = {
    f"{RECTANGLE}, side {side:g}": side for side in (0.3, 0.45, 0.5, 0.6, 0.7, 0.8, 0.9, 0.96, 1.0)
}
"""Sides, as shares of the image's, of rectangles that face the camera at the paper's distance."""
SIDES = {FRAME: 1.0, RECTANGLE: 0.5, **GROWING}
PAPER = paper_rows()["probes"]["flat_plane"]
FACING = TILTS_DEG[0], PAPER["distance_m"]
"""Tilt and distance of the paper's plane."""
Row = dict[str, Any]
"""A plane's numbers. Mean, least and largest prediction (`Subject.answer`) in its own units, the
share that collapsed to background, mean and error in mm."""


class FlatPlane(Probe):
    """Predictions for planes in three outlines, and for the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    version = 3
    question = "Is a plane without features predicted at its distance, or as background?"

    def applies_to(self, subject: Subject) -> str | None:
        reason = (
            f"{subject.name} uses the object's mask, and a plane that fills the frame has none."
        )
        return reason if subject.uses_ground_truth_mask else None

    def run(
        self, subject: Subject, dataset: DatasetFolder, settings: ProbeSettings, progress: Progress
    ) -> Finding:
        renderer, normalised = SceneRenderer.of(dataset), subject.answers_normalised
        limit = background_below(normalised, renderer.rig.working_range_mm[0])
        silhouettes = outlines_of(dataset, settings)
        records = [dataset.measured(sample) for sample in dataset.samples("test")]
        ranges = [
            (record["depth_min_mm"], record["depth_max_mm"])
            for record in records
            if record.get("depth_max_mm")
        ]
        low, high = (float(np.mean(ends)) for ends in zip(*ranges, strict=True))
        masks = {
            outline: rectangle(renderer.shape, side) for outline, side in SIDES.items()
        } | silhouettes
        poses = [
            (outline, *pose) for outline in masks for pose in poses_of(outline, settings.quick)
        ]
        rows: list[Row] = []
        shown: dict[str, tuple[Row, NDArray, NDArray]] = {}
        for outline, tilt_deg, distance_m in poses:
            scene = plane_scene(renderer, masks[outline], tilt_deg, distance_m)
            seen = scene.mask
            frames = renderer.frames(scene, subject.frames_used)
            prediction = subject.predict(frames)
            values = prediction[seen].astype(np.float64)
            millimetres = values * (high - low) + low if normalised else values
            row = {
                "outline": outline,
                "distance_m": distance_m,
                "tilt_deg": list(tilt_deg),
                "pixels": int(seen.sum()),
                "answer_mean": float(values.mean()),
                "answer_min": float(values.min()),
                "answer_max": float(values.max()),
                "collapsed_share": float((values < limit).mean()),
                "mean_mm": float(millimetres.mean()),
                "mae_mm": float(np.abs(millimetres - scene.depth_mm[seen]).mean()),
            }
            rows.append(row)
            if (tilt_deg, distance_m) == FACING:
                shown.setdefault(
                    kind_of(outline), (row, np.asarray(frames[subject.frames_used[0]]), prediction)
                )
            progress(len(rows), len(poses), f"{outline}, {distance_m:g} m")
        control = control_of(subject, dataset, renderer, list(silhouettes), limit)
        range_mm = [low, high] if normalised else None
        content = {
            "planes": rows,
            "objects": control,
            "range_mm": range_mm,
            "collapse_below": limit,
        }
        drawn = draw([shown[kind] for kind in KINDS], normalised)
        return Finding(
            summary(rows, shown[RECTANGLE][0], control, normalised),
            content,
            table(rows, normalised),
            drawn,
        )


def kind_of(outline: str) -> str:
    """A name in `SIDES`, or `SILHOUETTE`."""
    return outline if outline in SIDES else SILHOUETTE


def outlines_of(dataset: DatasetFolder, settings: ProbeSettings) -> dict[str, Mask]:
    """Silhouettes (H, W) of a test sample of each object, by sample. Raises `DiagnosisError`
    without any."""
    first = [samples[0] for samples in dataset.samples_by_object("test").values()]
    names = settings.choose(first, OUTLINES, QUICK_OUTLINES)
    masks = {name: mask for name in names if (mask := object_mask(dataset.depth_mm(name))).any()}
    if not masks:
        raise DiagnosisError(
            f"{dataset.path}: split test holds no sample with an object, whose outline a plane gets"
        )
    return masks


def poses_of(outline: str, quick: bool) -> list[tuple[tuple[float, float], float]]:
    """Tilts in degrees and distances in m of the planes with ``outline``."""
    return (
        [FACING]
        if outline in GROWING
        else list(product(TILTS_DEG[: 1 if quick else None], DISTANCES_M))
    )


def rectangle(shape: tuple[int, int], side: float) -> Mask:
    """Mask of ``shape`` (H, W) of a central rectangle whose sides are the share ``side`` of the
    image's."""
    mask = np.zeros(shape, dtype=bool)
    down, across = (round(length * (1 - side) / 2) for length in shape)
    mask[down : shape[0] - down, across : shape[1] - across] = True
    return mask


def plane_scene(
    renderer: SceneRenderer, mask: Mask, tilt_deg: tuple[float, float], distance_m: float
) -> Scene:
    """A `plane` in front of the background; the scene's mask is ``mask`` without what no fringe
    reaches."""
    surface = plane(renderer.rig, distance_m, tilt_deg, mask)
    lit, seen = renderer.light(surface), mask.copy()
    seen.ravel()[surface.pixels] &= lit.gain > 0  # no fringe beyond the projector's field
    return Scene(surface, lit, seen, (0, "plane", ""))


def control_of(
    subject: Subject,
    dataset: DatasetFolder,
    renderer: SceneRenderer,
    samples: list[str],
    limit: float,
) -> dict[str, float]:
    """Share of the test objects' pixels that the subject predicts as background, and that are as
    near in truth."""
    shares = []
    for sample in samples:
        scene = original(dataset, renderer, sample)
        answer, true = (
            subject.predict(renderer.frames(scene, subject.frames_used)),
            scene.depth_mm[scene.mask],
        )
        if subject.answers_normalised:
            true = (true - true.min()) / (float(np.ptp(true)) or MM_PER_M)
        shares.append(
            [(values < limit).mean() for values in (answer[scene.mask].astype(np.float64), true)]
        )
    predicted, true_share = np.mean(shares, axis=0).tolist()
    return {"collapsed_share": predicted, "collapsed_share_true": true_share}


def summary(rows: Sequence[Row], paper: Row, control: Mapping[str, float], normalised: bool) -> str:
    """The share that collapsed in each outline, and the prediction for the paper's rectangle."""
    frame, rectangles, silhouettes = (
        np.mean([row["collapsed_share"] for row in rows if kind_of(row["outline"]) == kind])
        for kind in KINDS
    )
    unit = "of the range (paper: {answer_mean})".format(**PAPER) if normalised else "mm"
    return (
        f"Predicted as background: {rectangles:.0%} of a rectangular plane, {frame:.0%} of a plane "
        f"that "
        f"fills the frame, {silhouettes:.0%} of a plane in an object's outline; "
        f"{control['collapsed_share']:.0%} of real objects ({control['collapsed_share_true']:.0%} "
        f"in truth). The "
        f"prediction for the rectangle at 1.8 m has a mean of {paper['answer_mean']:.4g} {unit}, "
        f"from "
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
        poses[
            f"{kind_of(row['outline'])}, {row['distance_m']:g} m, tilt {across:g}, {down:g}"
        ].append(row)
    lines = {
        pose: {key: float(np.mean([row[key] for row in same])) for key in columns}
        for pose, same in poses.items()
    }
    title = "Predictions for planes" + (
        ", mm by the mean range of the test split" if normalised else ""
    )
    return table_of(title, "Outline, distance, tilt in degrees", lines, columns)


def draw(shown: Sequence[tuple[Row, NDArray, NDArray]], normalised: bool) -> Figure:
    """The paper's figure, input and prediction, for each outline at 1.8 m."""
    low, high, unit = (-0.2, 1.2, "share of range") if normalised else (0.0, 2400.0, "mm")
    facts, frames, predictions = zip(*shown, strict=True)
    columns = [
        "{outline}\n{answer_min:.4g} to {answer_max:.4g}, mean {answer_mean:.4g}".format(**row)
        for row in facts
    ]
    rows = {
        "fringes": [Picture(frame) for frame in frames],
        f"prediction,\n{low:g} to {high:g}\n{unit}": [
            Picture(prediction, DEPTH_COLOURS, low, high) for prediction in predictions
        ],
    }
    alt = "Fringes on planes in three outlines, and the predictions"
    return Figure("Flat planes at 1.8 m", alt, gallery(rows, columns, 2.4))
