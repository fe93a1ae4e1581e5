"""Classical multi-frame FPP: phase and order by whatever a rig codes, in the paper N steps and Gray
code, then triangulation (paper Section 2.1).

With all steps and both directions it is the process that made the ``depth`` column, so only
``--target depth_exact`` shows its error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import index
from typing import TYPE_CHECKING, get_args

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Answer, Frames, Method, Photographed, Setting
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.decoding.blocks import plan_direction
from fpp_ml_bench.decoding.decode import Decoded, Directions, decode_stack
from fpp_ml_bench.decoding.fewest import fewest_plans, fewest_steps
from fpp_ml_bench.decoding.triangulation import (
    ASSUMED_NOISE_GREY,
    STATED_SYSTEMATIC_RAD,
    depth_sigma_mm,
    noise_by_light,
)
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.loaders.render.light import Light
from fpp_ml_bench.loaders.render.scene import modulation_at
from fpp_ml_bench.loaders.render.sensor import fringe_noise_at
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Sequence as FrameSequence
from fpp_ml_bench.options import option
from fpp_ml_bench.schema import validate

if TYPE_CHECKING:
    from fpp_ml_bench.evaluation.submission.description import Submission

DIRECTIONS: tuple[Directions, ...] = get_args(Directions)


@dataclass(frozen=True)
class ClassicalOptions:
    """Options of `ClassicalMethod`; ``threads`` a sample."""

    steps: int | None = option(
        None, "phase steps a direction, 3 to 18, with Gray code (default: all)", "N"
    )
    direction: Directions = option(
        "both",
        "fringes to use: one direction is enough for a depth (default: all that the rig codes)",
    )
    fewest: bool = option(
        False,
        "capture only the Gray frames that the rig's range needs: with both directions usually "
        "none",
    )
    depth_noise: float | None = option(
        None,
        "the fewest steps whose depth noise at the far end of the range is at most this (instead "
        "of --steps)",
        "MM",
    )
    threads: int = 1


class ClassicalMethod(Method):
    """All that a rig codes in one direction or "both", decoded. With the paper's kind of code,
    ``steps`` of the N sinusoids (default: all) and the Gray code, or with ``fewest`` only those of
    its frames that the rig's working range needs (`fpp_ml_bench.decoding.fewest`). Metric, nothing
    learned. Raises `RigError` for a direction that the rig does not code, `DecodeError` for steps
    that were not captured, and for ``steps`` or ``fewest`` with another kind, and `PredictionError`
    for ``depth_noise``, which needs a dataset."""

    options: ClassicalOptions
    name = "classical"
    purpose = "N-step phase, Gray-code order, triangulation"
    Options = ClassicalOptions

    def __init__(self, rig: Rig, **options: object) -> None:
        self.options = self.checked_options(ClassicalOptions, options)
        direction, steps, fewest = self.options.direction, self.options.steps, self.options.fewest
        threads = self.options.threads
        if self.options.depth_noise is not None:
            raise PredictionError(
                f"{self.name}: depth_noise needs a dataset, which says how noisy its frames are"
            )
        directions = rig.directions if direction == "both" else (direction,)
        plans = [plan_direction(rig, way, steps) for way in directions]
        if fewest:
            plans = fewest_plans(rig, plans)[0]
        self.rig, self.threads, self.fewest = rig, threads, fewest
        self.direction: Directions = "both" if len(directions) > 1 else directions[0]
        self.frames_used = tuple(sorted({index for plan in plans for index in plan.frames}))
        counts = {len(plan.sinusoids) for plan in plans}
        if len(counts) > 1 or 0 in counts:
            if fewest:
                raise DecodeError(
                    "fewest: frames can be left out only with sinusoids of one period in equal "
                    "steps from pixel 0 and "
                    "Gray code in half periods; the code of this rig is another: leave fewest out"
                )
            self.steps = None
            code = ", ".join(f"{way} {rig.code(way).title}" for way in directions)
            self.title = f"Classical, {code}"
            self.settings = {"direction": self.direction, "code": code, "threads": threads}
            return
        self.steps = counts.pop()
        fringes = "both directions" if self.direction == "both" else f"{self.direction} fringes"
        self.title = f"Classical {self.steps}-step + Gray code, {fringes}"
        self.settings = {"direction": self.direction, "steps": self.steps, "threads": threads}
        if fewest:
            count = len(self.frames_used) - self.steps * len(plans)
            gray = f"{count} Gray frames" if count else "no Gray code"
            self.title = f"Classical {self.steps}-step, {fringes}, {gray}"
            self.settings = {**self.settings, "fewest": True}

    @classmethod
    def for_dataset(cls, dataset: Photographed, **options: object) -> Method:
        """With the steps that ``depth_noise`` mm takes, by the light and the camera that the
        dataset was built with."""
        given = cls.checked_options(ClassicalOptions, options)
        if given.depth_noise is None:
            return cls.for_rig(dataset.rig, **options)
        steps = _steps_for(dataset, given.depth_noise, given)
        return cls.for_rig(dataset.rig, **{**options, "depth_noise": None, "steps": steps})

    @classmethod
    def variants(cls, rig: Rig) -> Sequence[Mapping[str, Setting]]:
        if not isinstance(rig.sequence, FrameSequence):
            return [{}] if rig.directions else []
        both = [{"steps": steps} for steps in (3, 4, 6, 9, rig.sequence.steps)]
        return [*both, {"steps": 3, "direction": "horizontal"}, {"steps": 3, "fewest": True}]

    @classmethod
    def short_name(cls, submission: "Submission") -> str | None:
        if not submission.name.startswith("Classical "):
            return None
        settings = submission.settings
        steps = index(settings["steps"])  # type: ignore[arg-type]
        direction = DIRECTIONS[DIRECTIONS.index(settings["direction"])]  # type: ignore[arg-type]
        if not settings.get("fewest"):
            return f"Classical {steps}+Gray, {direction}"
        gray = len(submission.frames_used) - steps * (2 if direction == "both" else 1)
        return f"Classical {steps}, {direction}, {f'{gray} Gray' if gray else 'no Gray'}"

    def decode(self, frames: Frames, details: bool = False) -> Decoded:
        """`decode_stack` of a captured sequence, without reasons; frames that are not in
        `frames_used` may be None."""
        return decode_stack(
            frames,
            self.rig,
            direction=self.direction,
            steps=self.steps,
            threads=self.threads,
            reasons=False,
            fewest=self.fewest,
            details=details,
        )

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return self.decode(frames).depth_mm

    def answer(self, frames: Frames) -> Answer:
        """Depth, and its standard uncertainty by the noise of the frames, light of further bounces
        and the calibration; none for a code that has none by pixel."""
        decoded = self.decode(frames, details=True)
        if not all(isinstance(self.rig.code(way), PhaseShift) for way in decoded.details):
            return Answer(decoded.depth_mm)
        measured = np.stack([measured.modulation for measured in decoded.details.values()]).max(
            axis=0
        )
        modulation = np.nan_to_num(measured).astype(np.float32)
        dark, per_grey = noise_by_light(frames, self.rig) or (ASSUMED_NOISE_GREY**2, 0.0)
        noise_grey = np.sqrt(dark + per_grey * modulation.astype(np.float64))
        systematic_rad = STATED_SYSTEMATIC_RAD
        sigma_mm = depth_sigma_mm(decoded, self.rig, noise_grey, self.steps, systematic_rad)
        return Answer(decoded.depth_mm, sigma_mm)


def _steps_for(dataset: Photographed, depth_noise_mm: float, given: ClassicalOptions) -> int:
    """The fewest steps whose depth noise at the far end of the working range is at most
    ``depth_noise_mm``."""
    described = dataset.manifest.settings.get("light")
    if given.steps is not None or not 0 < depth_noise_mm < float("inf"):
        raise PredictionError(
            f"--depth-noise {depth_noise_mm:g}: expected mm above 0, and not together with --steps"
        )
    if not isinstance(described, dict):
        raise PredictionError(
            "--depth-noise: this dataset does not say how noisy its frames are; give --steps"
        )
    light = validate(Light, described, dataset.path / "manifest.json", "light", PredictionError)
    far_mm = dataset.rig.working_range_mm[1]
    modulation = modulation_at(dataset.rig, far_mm, light)
    noise_grey = fringe_noise_at(dataset.rig, far_mm, light)
    steps = fewest_steps(dataset.rig, given.direction, depth_noise_mm, modulation, noise_grey)
    if steps is None:
        raise PredictionError(
            f"--depth-noise {depth_noise_mm:g}: more noise remains even with all "
            f"{dataset.sequence.steps} steps that "
            "were captured; allow more noise, or use both directions"
        )
    return steps
