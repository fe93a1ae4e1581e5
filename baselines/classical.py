"""Classical multi-frame FPP: phase and order by whatever a rig codes, in the paper N steps and Gray code, then
triangulation (paper Section 2.1).

With all steps and both directions it is the process that made the ``depth`` column, so only ``--target depth_exact``
shows its error.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Answer, Frames, Method
from fpp_ml_bench.coding import Limits, PhaseShift
from fpp_ml_bench.decoding import (
    ASSUMED_NOISE_GREY,
    SYSTEMATIC_RAD,
    Decoded,
    DirectionPlan,
    Directions,
    decode_stack,
    depth_sigma_mm,
    fewest_plans,
    noise_by_light,
    plan_direction,
)
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import Rig


class ClassicalMethod(Method):
    """All that a rig codes in one direction or "both", decoded. With the paper's kind of code, ``steps`` of the N
    sinusoids (default: all) and the Gray code, or with ``fewest`` only those of its frames that the rig's working range
    needs (`fpp_ml_bench.decoding.fewest`). Metric, nothing learned. Raises `RigError` for a direction that the rig does
    not code, `DecodeError` for steps that were not captured, and for ``steps`` or ``fewest`` with another kind."""

    name = "classical"

    def __init__(
        self, rig: Rig, direction: Directions = "both", steps: int | None = None, threads: int = 1, fewest: bool = False
    ) -> None:
        directions = rig.directions if direction == "both" else (direction,)
        plans = [plan_direction(rig, way, steps, Limits()) for way in directions]
        if fewest:
            plans = fewest_plans(rig, plans)[0]
        self.rig, self.threads, self.fewest = rig, threads, fewest
        self.direction: Directions = "both" if len(directions) > 1 else directions[0]
        self.frames_used = tuple(sorted({index for plan in plans for index in plan.frames}))
        counts = {len(plan.sinusoids) if isinstance(plan, DirectionPlan) else 0 for plan in plans}
        if len(counts) > 1 or 0 in counts:
            if fewest:
                raise DecodeError(
                    "fewest: frames can be left out only with sinusoids of one period in equal steps from pixel 0 and "
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

    def decode(self, frames: Frames, reasons: bool = True, details: bool = False) -> Decoded:
        """`decode_stack` of a captured sequence; frames that are not in `frames_used` may be None."""
        return decode_stack(
            frames,
            self.rig,
            direction=self.direction,
            steps=self.steps,
            threads=self.threads,
            reasons=reasons,
            fewest=self.fewest,
            details=details,
        )

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return self.decode(frames, reasons=False).depth_mm

    def answer(self, frames: Frames) -> Answer:
        """Depth, and its standard uncertainty by the noise of the frames; none for a code that has none by pixel."""
        return self.measure(frames)[0]

    def measure(self, frames: Frames) -> tuple[Answer, NDArray[np.float32]]:
        """`answer`, and the modulation in grey levels (H, W), the larger of both directions; 0 where there is none."""
        decoded = self.decode(frames, reasons=False, details=True)
        measured = np.stack([measured.modulation for measured in decoded.details.values()]).max(axis=0)
        modulation = np.nan_to_num(measured).astype(np.float32)
        if not all(isinstance(self.rig.code(way), PhaseShift) for way in decoded.details):
            return Answer(decoded.depth_mm), modulation
        dark, per_grey = noise_by_light(frames, self.rig) or (ASSUMED_NOISE_GREY**2, 0.0)
        noise_grey = np.sqrt(dark + per_grey * modulation.astype(np.float64))
        sigma_mm = depth_sigma_mm(decoded, self.rig, noise_grey, self.steps, SYSTEMATIC_RAD)
        return Answer(decoded.depth_mm, sigma_mm), modulation
