"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance and tilt.

The paper shows a network a plane at 1.8 m in front of the background. Here planes have several distances and tilts,
each in three outlines: filling the frame (no edge at all), a rectangle in front of the background (the paper's scene),
and cut to the silhouettes of test objects (a familiar outline around an unfamiliar surface). They are rendered with the
dataset's own light and sensor.

A pixel of the plane is *collapsed to background* if its prediction is nearer to background than to any object: below
0.1 for a normalised prediction (background is 0; the paper reports a mean of 0.088), below half of the near end of the
working range for mm. The same share over the test objects is the control. For an individually normalised network the
prediction is its own output, without range heads. A plane that faces the camera has no depth range (D_min = D_max), so
normalised predictions are converted to mm by the mean D_min and D_max of the test split, the same for every plane.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.counterfactual_original import original
from fpp_ml_bench.baselines.diagnostics.flat_plane_report import draw, summary, tables
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress, spread
from fpp_ml_bench.baselines.diagnostics.subjects import Frames, Subject
from fpp_ml_bench.baselines.diagnostics.synth import Scene, SceneRenderer
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, plane
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

TILTS_DEG = ((0.0, 0.0), (20.0, 0.0), (0.0, 20.0))
DISTANCES_M = (1.6, 1.8, 2.0)
RECTANGLE = 0.5
"""Side of the rectangle, as a share of the image's side."""
NORMALISED_BACKGROUND = 0.1
OUTLINES, QUICK_OUTLINES = 5, 2
STREAM = (0, "plane", "")


@dataclass(frozen=True)
class PlanePrediction:
    """A plane and its prediction: name of the ``outline``, ``mask`` of the plane, ``depth_mm`` float64, ``prediction``
    float32, and the rendered ``frame`` uint8, each (H, W)."""

    outline: str
    distance_m: float
    tilt_deg: tuple[float, float]
    mask: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]
    frame: NDArray[np.uint8]
    prediction: NDArray[np.float32]

    def statistics(self, scale: "Scale") -> dict[str, Any]:
        """Mean, standard deviation, least and largest prediction over ``mask``, in its own units and in mm, its error,
        and the share that collapsed to background; in float64."""
        values = self.prediction[self.mask].astype(np.float64)
        millimetres = scale.mm(values)
        error = millimetres - self.depth_mm[self.mask]
        own = {"answer_mean": values.mean(), "answer_std": values.std(), "answer_min": values.min(),
               "answer_max": values.max(), "collapsed_share": scale.collapsed(values).mean(),
               "mean_mm": millimetres.mean(), "std_mm": millimetres.std(), "bias_mm": error.mean(),
               "mae_mm": np.abs(error).mean(), "true_std_mm": self.depth_mm[self.mask].std()}  # fmt: skip
        return {
            "outline": self.outline, "distance_m": self.distance_m, "tilt_deg": list(self.tilt_deg),
            "pixels": int(self.mask.sum()), **{key: float(value) for key, value in own.items()},
        }  # fmt: skip


@dataclass(frozen=True)
class Scale:
    """Converts predictions to mm: ``range_mm`` for normalised ones; ``near_mm`` is the working range's near end."""

    normalised: bool
    range_mm: tuple[float, float]
    near_mm: float

    def mm(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.range_mm
        return values * (high - low) + low if self.normalised else values

    def collapsed(self, values: NDArray[np.float64]) -> NDArray[np.bool_]:
        limit = NORMALISED_BACKGROUND if self.normalised else self.near_mm / 2
        return np.asarray(values < limit)


class FlatPlane:
    """Predictions for planes in three outlines, and for the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    question = "Is a plane without features predicted at its distance, or as background?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.uses_ground_truth_mask:
            return f"{subject.name} uses the object's mask, and a plane that fills the frame has none."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        renderer = SceneRenderer.of(dataset)
        records = [dataset.measured(sample) for sample in dataset.samples("test")]
        ranges = [(record["depth_min_mm"], record["depth_max_mm"]) for record in records if record.get("depth_max_mm")]
        low, high = (float(np.mean(ends)) for ends in zip(*ranges, strict=True))
        scale = Scale(normalised(subject), (low, high), renderer.rig.working_range_mm[0])
        outlines = outlines_of(dataset, settings)
        total = len(DISTANCES_M) * len(TILTS_DEG) * (2 + len(outlines)) + len(outlines)
        planes = []
        for plane_prediction in predict_planes(subject, renderer, outlines, settings.quick):
            planes.append(plane_prediction)
            progress(len(planes), total, f"{plane_prediction.outline}, {plane_prediction.distance_m:g} m")
        control = control_of(subject, dataset, renderer, list(outlines), scale)
        rows = [plane_prediction.statistics(scale) for plane_prediction in planes]
        return Finding(
            self.name,
            self.title,
            summary(rows, control, scale.normalised),
            {
                "planes": rows, "objects": control, "range_mm": [low, high] if scale.normalised else None,
                "collapse_below": NORMALISED_BACKGROUND if scale.normalised else scale.near_mm / 2,
            },
            tables(rows, control, scale.normalised),
            draw(planes, scale.normalised, folder),
        )  # fmt: skip


def normalised(subject: Subject) -> bool:
    """Whether the subject's own output is normalised to the sample's range."""
    return subject.units == "normalised" or subject.normalisation == "individual"


def prediction_of(subject: Subject, frames: Frames) -> NDArray[np.float32]:
    """The subject's prediction (H, W) in mm, or the network's own output where it is normalised. Range heads, which
    would convert it to mm, are not part of the paper's probe."""
    return subject.represent(frames) if subject.normalisation == "individual" else subject.predict(frames)


def outlines_of(dataset: "DatasetFolder", settings: ProbeSettings) -> dict[str, NDArray[np.bool_]]:
    """Silhouettes (H, W) of a test sample of each object, by sample."""
    first: dict[str, str] = {}
    for sample in dataset.samples("test"):
        first.setdefault(dataset.measured(sample)["object"], sample)
    names = spread(list(first.values()), settings.samples or (QUICK_OUTLINES if settings.quick else OUTLINES))
    masks = {name: object_mask(dataset.depth_mm(name)) for name in names}
    return {name: mask for name, mask in masks.items() if mask.any()}


def predict_planes(
    subject: Subject, renderer: SceneRenderer, outlines: dict[str, NDArray[np.bool_]], quick: bool = False
) -> Iterator[PlanePrediction]:
    """Every plane, rendered and predicted."""
    height, width = renderer.shape
    rectangle = np.zeros(renderer.shape, dtype=bool)
    down, across = (round(side * (1 - RECTANGLE) / 2) for side in renderer.shape)
    rectangle[down : height - down, across : width - across] = True
    masks = {"fills the frame": np.ones(renderer.shape, dtype=bool), "rectangle": rectangle, **outlines}
    for outline, mask in masks.items():
        for tilt in TILTS_DEG[: 1 if quick else None]:
            for distance_m in DISTANCES_M:
                surface = plane(renderer.rig, distance_m, tilt, mask)
                yield predict_plane(subject, renderer, surface, mask, outline, distance_m, tilt)


def predict_plane(
    subject: Subject, renderer: SceneRenderer, surface: Surface, mask: NDArray[np.bool_], outline: str,
    distance_m: float, tilt_deg: tuple[float, float],
) -> PlanePrediction:  # fmt: skip
    """A plane, rendered and predicted."""
    lit = renderer.light(surface)
    mask = mask.copy()
    mask.ravel()[surface.pixels] &= lit.gain > 0  # no fringe beyond the projector's field
    scene = Scene(surface.pixels.astype(np.uint32), lit, mask, STREAM)
    frames = renderer.frames(scene, subject.frames_used, subject.uses_ground_truth_mask)
    frame = frames[subject.frames_used[0]]
    if frame is None:
        raise ValueError("the frame of the plane is missing")
    prediction = prediction_of(subject, frames)
    return PlanePrediction(outline, distance_m, tilt_deg, mask, surface.depth_mm(renderer.shape), frame, prediction)


def control_of(
    subject: Subject, dataset: "DatasetFolder", renderer: SceneRenderer, samples: list[str], scale: Scale
) -> dict[str, float]:
    """Share of the test objects' pixels that the subject predicts as background, and that are as near in truth."""
    predicted_shares, true_shares = [], []
    for sample in samples:
        sample_scene = original(dataset, renderer, sample)
        frames = renderer.frames(sample_scene.scene, subject.frames_used, subject.uses_ground_truth_mask)
        predicted_shares.append(
            scale.collapsed(prediction_of(subject, frames)[sample_scene.target].astype(np.float64)).mean()
        )
        depth_mm = dataset.depth_mm(sample)[sample_scene.target].astype(np.float64)
        span = float(np.ptp(depth_mm)) or MM_PER_M
        true_shares.append(scale.collapsed((depth_mm - depth_mm.min()) / span if scale.normalised else depth_mm).mean())
    return {"collapsed_share": float(np.mean(predicted_shares)), "collapsed_share_true": float(np.mean(true_shares))}
