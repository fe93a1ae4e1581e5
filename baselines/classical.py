"""Classical multi-frame FPP: N-step phase, Gray-code order, triangulation (paper Section 2.1).

With all steps and both directions it is the process that made the ``depth`` column, so only ``--target depth_exact``
shows its error.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.coding import choose_steps
from fpp_ml_bench.decoding import Decoded, Directions, decode_stack, fewest_gray_bits
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import DIRECTIONS, Rig


class ClassicalMethod(Method):
    """``steps`` of the N sinusoids of one direction or both, and their Gray code. Metric, nothing learned. ``fewest``:
    of the Gray code only the frames that the rig's working range needs (`fpp_ml_bench.decoding.fewest`)."""

    name = "classical"

    def __init__(
        self, rig: Rig, direction: Directions = "both", steps: int = 18, threads: int = 1, fewest: bool = False
    ) -> None:
        sequence = rig.sequence
        if not 3 <= steps <= sequence.steps:
            raise DecodeError(f"steps {steps}: expected 3 to the {sequence.steps} that were captured")
        self.rig, self.direction, self.steps, self.threads, self.fewest = rig, direction, steps, threads, fewest
        directions = DIRECTIONS if direction == "both" else (direction,)
        every_bit = {way: tuple(range(sequence.bits(way))) for way in directions}
        gray_bits = fewest_gray_bits(rig, direction) if fewest else every_bit
        used: list[int] = []
        for way in directions:
            sinusoids = sequence.sinusoids(way)
            used += [sinusoids[step] for step in choose_steps(sequence.steps, steps)]
            used += [sequence.gray(way)[bit] for bit in gray_bits[way]]
        self.frames_used = tuple(sorted(used))
        fringes = "both directions" if direction == "both" else f"{direction} fringes"
        count = sum(map(len, gray_bits.values()))
        self.title = f"Classical {steps}-step + Gray code, {fringes}"
        self.settings = {"direction": direction, "steps": steps, "threads": threads}
        if fewest:
            self.title = f"Classical {steps}-step, {fringes}, " + (f"{count} Gray frames" if count else "no Gray code")
            self.settings = {**self.settings, "fewest": True}

    def decode(self, frames: Frames, reasons: bool = True) -> Decoded:
        """`decode_stack` of a captured sequence; frames that are not in `frames_used` may be None."""
        return decode_stack(
            frames, self.rig, direction=self.direction, steps=self.steps, threads=self.threads, reasons=reasons,
            fewest=self.fewest,
        )  # fmt: skip

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        return self.decode(frames, reasons=False).depth_mm
