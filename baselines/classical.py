"""Classical multi-frame FPP: N-step phase, Gray-code order, triangulation (paper Section 2.1).

It is the benchmark's reference: what the optics allow when 10 to 50 frames are captured instead of one. With all steps
and both directions it is the process that made the ``depth`` column, so only ``--target depth_exact`` shows its error.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decoding import Decoded, Directions, choose_steps, decode_stack, fewest_gray_bits
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import DIRECTIONS, Direction, Rig


@dataclass(frozen=True)
class ClassicalMethod:
    """``steps`` of the N sinusoids of one direction or both, and their Gray code. Metric, nothing learned.

    ``fewest``: of the Gray code only the frames that the rig's working range needs (`fpp_ml_bench.decoding.fewest`)."""

    rig: Rig
    direction: Directions = "both"
    steps: int = 18
    threads: int = 1
    fewest: bool = False

    name = "classical"
    uses_ground_truth_range = False

    def __post_init__(self) -> None:
        if not 3 <= self.steps <= self.rig.sequence.steps:
            raise DecodeError(f"steps {self.steps}: expected 3 to the {self.rig.sequence.steps} that were captured")

    @property
    def directions(self) -> tuple[Direction, ...]:
        return DIRECTIONS if self.direction == "both" else (self.direction,)

    @property
    def frames_used(self) -> tuple[int, ...]:
        """Frames that must be captured, ascending."""
        sequence = self.rig.sequence
        used: list[int] = []
        gray = self._gray_bits
        for direction in self.directions:
            sinusoids = sequence.sinusoids(direction)
            used += [sinusoids[n] for n in choose_steps(sequence.steps, self.steps)]
            bits = gray[direction]
            used += [sequence.gray(direction)[bit] for bit in bits]
        return tuple(sorted(used))

    @property
    def title(self) -> str:
        fringes = "both directions" if self.direction == "both" else f"{self.direction} fringes"
        count = sum(map(len, self._gray_bits.values()))
        if not self.fewest:
            return f"Classical {self.steps}-step + Gray code, {fringes}"
        return f"Classical {self.steps}-step, {fringes}, " + (f"{count} Gray frames" if count else "no Gray code")

    @property
    def _gray_bits(self) -> Mapping[Direction, tuple[int, ...]]:
        """Gray bits that are captured, by direction."""
        if self.fewest:
            return fewest_gray_bits(self.rig, self.direction)
        return {direction: tuple(range(self.rig.sequence.bits(direction))) for direction in self.directions}

    @property
    def settings(self) -> dict[str, str | int | bool]:
        fewest: dict[str, str | int | bool] = {"fewest": True} if self.fewest else {}
        return {"direction": self.direction, "steps": self.steps, "threads": self.threads, **fewest}

    def decode(self, frames: Sequence[NDArray[np.uint8] | None], reasons: bool = True) -> Decoded:
        """Full result of a captured sequence; frames that are not in `frames_used` may be None. ``reasons`` False is
        faster where only the depth is wanted: see `decode_stack`."""
        return decode_stack(
            frames,
            self.rig,
            direction=self.direction,
            steps=self.steps,
            threads=self.threads,
            reasons=reasons,
            fewest=self.fewest,
        )

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm, 0 = background or not measured."""
        return self.decode(frames, reasons=False).depth_mm
