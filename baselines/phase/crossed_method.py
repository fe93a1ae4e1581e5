"""The crossed route as a method of ``fpp-bench predict``: one frame or three, nothing learned, no truth given."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames
from fpp_ml_bench.baselines.phase.crossed_observation import CrossedMeasurement, CrossedObservation, Settings
from fpp_ml_bench.baselines.phase.crossed_route import CrossedRoute
from fpp_ml_bench.baselines.phase.method import MASK, MIN_CONFIDENCE, RouteMethod
from fpp_ml_bench.baselines.phase.three_frames import FRAMES, ThreeFrameRoute, shifted_carrier
from fpp_ml_bench.coding.crossed import crossed_from_pair
from fpp_ml_bench.decoding.decode import grey_levels
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.captures.decoding import read_mask
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS
from fpp_ml_bench.options import option

if TYPE_CHECKING:
    from fpp_ml_bench.evaluation.submission.description import Submission


def frames_of(rig: Rig, name: str) -> tuple[int, ...]:
    """The frames that make one crossed frame: the rig's first crossed one, or the first sinusoid of both directions,
    whose mean is one. Raises `PredictionError` for a rig without either, in the words of the method ``name``."""
    if crossed := rig.sequence.crossed_frames:
        return crossed[:1]
    if rig.fringe_directions == DIRECTIONS:
        return tuple(sorted(rig.sequence.sinusoids(direction)[0] for direction in DIRECTIONS))
    listed = " and ".join(rig.fringe_directions) or "no"
    raise PredictionError(
        f"{name}: needs a crossed frame, or one fringe of each direction to make it from; this rig projects {listed} "
        "fringes. fpp-bench patterns --design proposes crossed fringes for a rig"
    )


def crossed_image(images: Sequence[NDArray]) -> NDArray[np.uint8]:
    """The crossed frame of the images of `frames_of`."""
    grey = [grey_levels(image) for image in images]
    return grey[0] if len(grey) == 1 else crossed_from_pair(grey[0], grey[1])


def has_crossed_fringes(rig: Rig) -> bool:
    """Whether `frames_of` finds a crossed frame."""
    return bool(rig.sequence.crossed_frames) or rig.fringe_directions == DIRECTIONS


@dataclass(frozen=True)
class CrossedOptions:
    """Options of `CrossedMethod`."""

    frames: int = option(1, "crossed frames, 1 or 3 (default: 1)", "N")
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    mask: str | Path | None = option(None, MASK, "FILE")


class CrossedMethod(RouteMethod):
    """Depth from one crossed frame; where the rig has none, from the mean of the first fringe of both directions, which
    is one. With ``frames`` 3: from three that shift one carrier (`ThreeFrameRoute`). ``mask``: a file
    (`captures.read_mask`) that says where the object is in every sample. Raises `PredictionError` for a rig without
    such frames and for an invalid option, `CaptureError` for a mask that can't be used."""

    name = "crossed"
    purpose = "one frame with two fringe directions, or three, nothing learned"
    Options = CrossedOptions
    scenes_rig = "crossed"

    def __init__(self, rig: Rig, **options: Any) -> None:
        given = self.checked_options(options)
        min_confidence, mask, frames = given.min_confidence, given.mask, given.frames
        self.rig, settings = rig, Settings(min_confidence)
        self.route: CrossedRoute
        if frames == FRAMES:
            moved = shifted_carrier(rig, self.name)
            self.frames_used = rig.sequence.crossed_frames[:FRAMES]
            self.route = ThreeFrameRoute(rig, moved, settings)
            count = "three frames"
        elif frames == 1:
            self.frames_used, self.route = frames_of(rig, self.name), CrossedRoute(rig, settings)
            count = "one frame" if len(self.frames_used) == 1 else "one frame, the mean of two"
        else:
            raise PredictionError(f"{self.name} --frames {frames}: expected 1 or {FRAMES} crossed frames")
        pitches = " and ".join(f"{pitch:g}" for pitch in self.route.family.pitches_px)
        self.title = f"Crossed fringes of {pitches} px, {count}, nothing learned"
        self.mask = None if mask is None else read_mask(Path(mask), (rig.camera.height, rig.camera.width))
        self.settings = {"min_confidence": min_confidence} | ({} if mask is None else {"mask": Path(mask).name})
        self.settings |= {} if frames == 1 else {"frames": frames}

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Any]]:
        if not has_crossed_fringes(rig):
            return []
        return [{}, {"frames": FRAMES}] if len(rig.sequence.crossed_frames) >= FRAMES else [{}]

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        return crossed_name(submission, "Crossed fringes ")

    def observe(self, frames: Frames) -> CrossedObservation:
        """What is measured before depth; frames that are not in `frames_used` may be None."""
        if isinstance(self.route, ThreeFrameRoute):
            return self.route.observe_frames([grey_levels(image) for image in self.images(frames)], self.mask)
        return self.route.observe(crossed_image(self.images(frames)), self.mask)

    def measure(self, frames: Frames) -> CrossedMeasurement:
        """All maps of a captured sequence; frames that are not in `frames_used` may be None."""
        return self.route.conclude(self.observe(frames))

    def crop(self, frames: Frames) -> tuple[slice, slice]:
        return self.route.resampling.captured_crop(self.observe(frames).carriers.crop)


def crossed_name(submission: "Submission", begins: str) -> str | None:
    """A short name for a submission of crossed fringes whose name ``begins`` so; None for another."""
    if not submission.name.startswith(begins):
        return None
    frames = {1: "1 frame", 2: "mean of 2"}.get(len(submission.frames_used), f"{len(submission.frames_used)} frames")
    return f"{printable(submission.settings.get('weights', 'Crossed'))}, {frames}"
