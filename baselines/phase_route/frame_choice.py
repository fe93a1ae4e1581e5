"""The fewest frames that a scene needs for a stated error, decided while capturing, without ground truth.

Capture one fringe and look: the measurement says how far off it expects to be, through its phase and through doubt
about its order. Where that is not good enough, capture what would help: another fringe or some for the phase, the Gray
code for the order, and look again. Every level completes the one before it, so that no captured frame is wasted: 1, 2
and 3 fringes a third of a period apart, then 6, then 18; the Gray code may join from 3 on. What was not captured is
never looked at.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.measurement import Measurement
from fpp_ml_bench.baselines.phase_route.method import PhaseMethod
from fpp_ml_bench.baselines.phase_route.several_frames import PIXELWISE, steps_of
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.rig import Rig

Frames = Sequence[NDArray[np.uint8] | None]

ORDER_SHARE = (0.16, 0.10, 0.05)
"""Of the error that doubt about the order makes one expect: what 1, 2, and 3 or more frames really had of it, over
training views (``benchmarks/frames_choice.py --calibrate`` counts it again). A margin knows that an order is doubtful;
that most doubtful orders are right, only counting tells."""


@dataclass(frozen=True)
class Look:
    """What was seen with ``frames`` frames captured, ``gray``: Gray code among them. Means over object pixels, mm."""

    frames: int
    gray: bool
    phase_mm: float
    order_mm: float

    @property
    def expected_mm(self) -> float:
        return self.phase_mm + self.order_mm


@dataclass(frozen=True)
class Chosen:
    """``depth_mm`` float32 (H, W) of the last look, the ``frames_used`` for it (indices, ascending), every look."""

    depth_mm: NDArray[np.float32]
    frames_used: tuple[int, ...]
    looks: tuple[Look, ...]

    def report(self) -> dict[str, Any]:
        """JSON of one sample: how many frames, which, and what was expected at each look."""
        looks = [
            {"frames": one.frames, "gray_code": one.gray, "expected_error_mm": round(one.expected_mm, 4),
             "by_phase_mm": round(one.phase_mm, 4), "by_order_mm": round(one.order_mm, 4)}
            for one in self.looks
        ]  # fmt: skip
        last = self.looks[-1]
        return {
            "frames": last.frames, "expected_error_mm": round(last.expected_mm, 4),
            "frames_used": list(self.frames_used), "looks": looks,
        }  # fmt: skip


def levels_of(steps: int) -> tuple[int, ...]:
    """Numbers of fringes that can be captured one after the other, each completing the last: 1, 2, 3 and more where
    ``steps`` divides into three, else one and then all."""
    if steps % PIXELWISE:
        return (1, steps)
    levels = [1, 2, PIXELWISE]
    for more in (6, steps):
        if more > levels[-1] and set(steps_of(steps, levels[-1])) <= set(steps_of(steps, more)):
            levels.append(more)
    return tuple(levels)


class FewestFrames:
    """The phase route with as many frames of one direction as ``error_mm`` takes, scene by scene; further options are
    those of `Settings`, ``frames`` aside.

    Raises `PredictionError` for an error that is no positive number of mm, and as `PhaseMethod`.
    """

    name = "phase"
    uses_ground_truth_range = False
    units = "mm"

    def __init__(self, rig: Rig, error_mm: float, **options: Any) -> None:
        if isinstance(error_mm, bool) or not isinstance(error_mm, int | float) or not 0 < error_mm < np.inf:
            raise PredictionError(f"error_mm {error_mm!r}: expected the largest error to accept, in mm, above 0")
        if "frames" in options:
            raise PredictionError("frames and error_mm: give one of them; error_mm chooses the frames itself")
        self.rig, self.error_mm = rig, float(error_mm)
        self.methods = {n: PhaseMethod(rig, **options, frames=n) for n in levels_of(rig.sequence.steps)}
        self.options = self.methods[1].options

    @property
    def gray(self) -> tuple[int, ...]:
        return tuple(self.rig.sequence.gray(self.options.direction))

    @property
    def frames_used(self) -> tuple[int, ...]:
        """All frames that a scene may need; most need few of them."""
        fringes = {index for one in self.methods.values() for index in one.frames_used}
        return tuple(sorted(fringes | set(self.gray)))

    @property
    def title(self) -> str:
        return f"Phase route, fewest {self.options.direction} fringes for {self.error_mm:g} mm, nothing learned"

    @property
    def settings(self) -> dict[str, Any]:
        return {"error_mm": self.error_mm} | {k: v for k, v in self.methods[1].settings.items() if k != "frames"}

    def choose(self, frames: Frames) -> Chosen:
        """Look, capture more, look again, until the expected error is at most ``error_mm`` or nothing is left."""
        looks: list[Look] = []
        levels = list(self.methods)
        place, gray = 0, False
        while True:
            count = levels[place]
            made = self.methods[count]
            found = made.measure(frames)
            look = self._look(found, count)
            depth_mm, used = found.depth_mm, made.frames_used
            if gray:
                decoded = decode_stack(frames, self.rig, direction=self.options.direction, steps=count)
                depth_mm, used = decoded.depth_mm, tuple(sorted({*made.frames_used, *self.gray}))
                look = replace(look, frames=len(used), gray=True, order_mm=0.0)
            looks.append(look)
            if look.expected_mm <= self.error_mm:
                break
            # The Gray code settles the order and nothing else: it is asked for when the phase is good enough already,
            # or when there are no more fringes.
            last = place + 1 == len(levels)
            if not gray and count >= PIXELWISE and (look.phase_mm <= self.error_mm or last):
                gray = True
            elif last:
                break
            else:
                place += 1
        return Chosen(depth_mm, used, tuple(looks))

    def _look(self, found: Measurement, count: int) -> Look:
        there = found.depth_mm > 0
        if not there.any():
            return Look(count, False, 0.0, 0.0)
        order = float(found.order_doubt_mm[there].mean(dtype=np.float64))
        whole = float(found.expected_error_mm[there].mean(dtype=np.float64))
        return Look(count, False, whole - order, order * ORDER_SHARE[min(count, len(ORDER_SHARE)) - 1])

    def predict_reported(self, frames: Frames) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Depth as `predict`, and the sample's report (see `Chosen.report`)."""
        chosen = self.choose(frames)
        return chosen.depth_mm, chosen.report()

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background."""
        return self.choose(frames).depth_mm

    def summary(self, reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
        """What a split's reports come to, for the submission's settings: frames a sample, mean and most."""
        counts = [int(one["frames"]) for one in reports]
        return {"frames_mean": round(float(np.mean(counts)), 3), "frames_most": max(counts)}
