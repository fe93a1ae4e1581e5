"""The flat plane (paper Section 7.3): fringes on a surface without features, at a known distance and tilt.

The paper shows a network one plane at 1.8 m in front of the background. Here planes stand at several distances and
tilts, each in three outlines: filling the frame (no edge at all), a rectangle in front of the background (the paper's
scene), and cut to the silhouettes of test objects (an outline that the network knows, around a surface that it does
not). They are photographed by the dataset's own light and sensor.

*Collapsed to background* are pixels of the plane whose answer is nearer to background than to any object: below 0.1
where the answer is normalised (background is 0, the paper found a mean of 0.088), below half the working range's near
end where it is in mm. The same share over the test objects themselves is the control: a network may put out such values
anywhere. Of an individually normalised network the answer is its own output, without range heads. A plane has no range
of its own (a flat one has D_min = D_max): where such an answer is told in mm, the range is the mean of the test split's
D_min and D_max, the same for every plane.
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
from fpp_ml_bench.baselines.diagnostics.subject import Frames, Subject
from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, plane
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.pixel_sets import object_mask

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

TILTS_DEG = ((0.0, 0.0), (20.0, 0.0), (0.0, 20.0))
DISTANCES_M = (1.6, 1.8, 2.0)
RECTANGLE = 0.5
"""Side of the rectangle, in sides of the image."""
NORMALISED_BACKGROUND = 0.1
OUTLINES, QUICK_OUTLINES = 5, 2
STREAM = (0, "plane", "")


@dataclass(frozen=True)
class Shown:
    """A plane and what was answered: ``outline`` in words, ``depth_mm`` float64 and ``answer`` float32 (H, W), ``mask``
    of the plane, ``frame`` uint8 that was captured."""

    outline: str
    distance_m: float
    tilt_deg: tuple[float, float]
    mask: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]
    frame: NDArray[np.uint8]
    answer: NDArray[np.float32]

    def statistics(self, scale: "Scale") -> dict[str, Any]:
        """Mean, spread, least and largest answer over the plane, as it is and in mm, its error, the share that
        collapsed to background; over ``mask``, in float64."""
        values = self.answer[self.mask].astype(np.float64)
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
    """How an answer is read: ``range_mm`` for normalised ones, ``near_mm`` of the working range for those in mm."""

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
    """Answers to planes in three outlines, and to the test objects as the control."""

    name = "flat-plane"
    title = "Flat plane"
    question = "Is a plane without features answered with its distance, or as background?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        if subject.uses_ground_truth_mask:
            return f"{subject.name} is told the object's mask, and a plane that fills the frame has none."
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        room = Darkroom.of(dataset)
        ranges = [(about["depth_min_mm"], about["depth_max_mm"])
                  for about in map(dataset.measured, dataset.samples("test")) if about.get("depth_max_mm")]  # fmt: skip
        low, high = (float(np.mean(ends)) for ends in zip(*ranges, strict=True))
        scale = Scale(normalised(subject), (low, high), room.rig.working_range_mm[0])
        outlines = outlines_of(dataset, settings)
        total = len(DISTANCES_M) * len(TILTS_DEG) * (2 + len(outlines)) + len(outlines)
        planes = []
        for shown in answers(subject, room, outlines, settings.quick):
            planes.append(shown)
            progress(len(planes), total, f"{shown.outline}, {shown.distance_m:g} m")
        control = control_of(subject, dataset, room, list(outlines), scale)
        rows = [shown.statistics(scale) for shown in planes]
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
    """Whether the subject's own answer is a share of the sample's range."""
    return subject.units == "normalised" or subject.normalisation == "individual"


def answer_of(subject: Subject, frames: Frames) -> NDArray[np.float32]:
    """The subject's answer (H, W) in mm, or the network's own output where it is normalised: range heads, which would
    make mm of it, are no part of what the paper looked at."""
    return subject.represent(frames) if subject.normalisation == "individual" else subject.predict(frames)


def outlines_of(dataset: "DatasetFolder", settings: ProbeSettings) -> dict[str, NDArray[np.bool_]]:
    """Silhouettes (H, W) of test samples, one an object, by sample."""
    first: dict[str, str] = {}
    for sample in dataset.samples("test"):
        first.setdefault(dataset.measured(sample)["object"], sample)
    names = spread(list(first.values()), settings.samples or (QUICK_OUTLINES if settings.quick else OUTLINES))
    masks = {name: object_mask(dataset.depth_mm(name)) for name in names}
    return {name: mask for name, mask in masks.items() if mask.any()}


def answers(
    subject: Subject, room: Darkroom, outlines: dict[str, NDArray[np.bool_]], quick: bool = False
) -> Iterator[Shown]:
    """Every plane photographed and answered."""
    height, width = room.shape
    rectangle = np.zeros(room.shape, dtype=bool)
    down, across = (round(side * (1 - RECTANGLE) / 2) for side in room.shape)
    rectangle[down : height - down, across : width - across] = True
    masks = {"fills the frame": np.ones(room.shape, dtype=bool), "rectangle": rectangle, **outlines}
    for outline, mask in masks.items():
        for tilt in TILTS_DEG[: 1 if quick else None]:
            for distance_m in DISTANCES_M:
                surface = plane(room.rig, distance_m, tilt, mask)
                yield shown(subject, room, surface, mask, outline, distance_m, tilt)


def shown(
    subject: Subject, room: Darkroom, surface: Surface, mask: NDArray[np.bool_], outline: str, distance_m: float,
    tilt_deg: tuple[float, float],
) -> Shown:  # fmt: skip
    """One plane photographed and answered."""
    lit = room.light(surface)
    mask = mask.copy()
    mask.ravel()[surface.pixels] &= lit.gain > 0  # beyond the projector's field there is no fringe to read
    scene = Scene(surface.pixels.astype(np.uint32), lit, mask, STREAM)
    frames = room.frames(scene, subject.frames_used, subject.uses_ground_truth_mask)
    frame = frames[subject.frames_used[0]]
    if frame is None:
        raise ValueError("a frame that was asked for is missing")
    answer = answer_of(subject, frames)
    return Shown(outline, distance_m, tilt_deg, mask, surface.depth_mm(room.shape), frame, answer)


def control_of(
    subject: Subject, dataset: "DatasetFolder", room: Darkroom, samples: list[str], scale: Scale
) -> dict[str, float]:
    """The same over real test objects: share that the subject answers as background, and that is so in truth."""
    answered, true = [], []
    for sample in samples:
        found = original(dataset, room, sample)
        frames = room.frames(found.scene, subject.frames_used, subject.uses_ground_truth_mask)
        answered.append(scale.collapsed(answer_of(subject, frames)[found.target].astype(np.float64)).mean())
        depth_mm = dataset.depth_mm(sample)[found.target].astype(np.float64)
        span = float(np.ptp(depth_mm)) or MM_PER_M
        true.append(scale.collapsed((depth_mm - depth_mm.min()) / span if scale.normalised else depth_mm).mean())
    return {"collapsed_share": float(np.mean(answered)), "collapsed_share_true": float(np.mean(true))}
