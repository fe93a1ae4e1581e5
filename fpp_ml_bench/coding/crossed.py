"""Crossed fringes: two carriers in one frame, since light adds.

Frame n is ``127.5 + 127.5 (w1 cos(2 pi c1 / P1 + s1n) + w2 cos(2 pi c2 / P2 + s2n))`` with the
projector coordinate ``c_k = v cos(a_k) + u sin(a_k)`` across carrier k. One carrier leaves the
fringe order open; the wrapped phases of two agree in depth at few orders (`fpp_ml_bench.design`
finds periods for which only the true one is left). Each carrier is found from its neighbourhood, or
from three frames that shift the first and keep the second still.

`Composite` is the other code with several sinusoids in a frame: periods of one direction. It tells
a coordinate only together with its neighbours, so that it is made and described here, and
demodulated by methods that look at windows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import (
    SMALLEST_PITCH_PX,
    Code,
    Coordinates,
    Limits,
    Shown,
    mapping,
    numbers,
    require,
)
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.portable import cosine_of_turns, sine_of_turns

if TYPE_CHECKING:
    from fpp_ml_bench.optics.rig import Rig

Pair = tuple[float, float]
WINDOW_PERIODS = 0.27
"""Sigma of the window in which a depth is fitted to one frame, in periods of the longer carrier."""
LEAST_ANGLE_DEG = 5.0
"""Between the two carriers. Spectra of a window must be apart, and nearly parallel carriers are
apart by their periods alone."""


@dataclass(frozen=True)
class Crossed:
    """A family of crossed frames; pairs are of the first and the second carrier.

    ``pitches_px``: periods in projector px. ``angles_deg``: 0 for a phase that grows along the
    projector's rows v (horizontal fringes), 90 along its columns u (vertical fringes), anything
    else for tilted ones. ``weights``: shares of the modulation, above 0, their sum at most 1.
    ``shifts_deg``: one pair of phase shifts a frame. Raises `RigError` naming the key.
    """

    pitches_px: Pair
    angles_deg: Pair = (0.0, 90.0)
    weights: Pair = (0.5, 0.5)
    shifts_deg: tuple[Pair, ...] = ((0.0, 0.0),)

    def __post_init__(self) -> None:
        if not min(self.pitches_px) >= SMALLEST_PITCH_PX:
            raise RigError(
                f"pitches_px: expected {SMALLEST_PITCH_PX:g} px and more, got "
                f"{min(self.pitches_px):g} px"
            )
        apart = abs(float(np.mod(self.angles_deg[0] - self.angles_deg[1] + 90, 180)) - 90)
        if apart < LEAST_ANGLE_DEG:
            first, second = self.angles_deg
            raise RigError(
                f"angles_deg: the carriers at {first:g} and {second:g} degrees are parallel; turn "
                f"them apart by "
                f"{LEAST_ANGLE_DEG:g} degrees or more (periods in one direction: the scheme "
                f"composite)"
            )
        if not (min(self.weights) > 0 and sum(self.weights) <= 1 + 1e-12):
            raise RigError(
                f"weights: expected two above 0 with a sum of at most 1, got {list(self.weights)}"
            )
        if not self.shifts_deg:
            raise RigError("shifts_deg: expected a pair of degrees for each frame, got none")

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any]) -> Crossed:
        """The family of a rig file's entries, whose keys are the fields; `RigError` naming the
        key."""
        given: dict[str, Any] = {
            key: numbers(entries[key], 2, key) for key in entries if key != "shifts_deg"
        }
        if "shifts_deg" in entries:
            shifts = entries["shifts_deg"]
            pairs = (
                f"shifts_deg: expected a list with a pair of degrees for each frame, got {shifts!r}"
            )
            require(isinstance(shifts, list), pairs)
            given["shifts_deg"] = tuple(
                numbers(pair, 2, f"shifts_deg[{n}]") for n, pair in enumerate(shifts)
            )
        return cls(**given)

    @classmethod
    def of_pair(cls, rig: Rig) -> Crossed:
        """The family of which `crossed_from_pair` makes the frame, from the first finest sinusoids
        of both directions of a rig. Raises `RigError` where a direction has none."""
        pitches = rig.pitch("horizontal"), rig.pitch("vertical")
        first, second = (
            math.degrees(rig.shifts_rad(direction)[0]) for direction in ("horizontal", "vertical")
        )
        return cls(pitches, shifts_deg=((first, second),))

    def to_dict(self) -> dict[str, Any]:
        """The entries of a rig file; `from_entries` gives an equal family back."""
        return {
            "pitches_px": list(self.pitches_px),
            "angles_deg": list(self.angles_deg),
            "weights": list(self.weights),
            "shifts_deg": [list(pair) for pair in self.shifts_deg],
        }

    def __len__(self) -> int:
        return len(self.shifts_deg)

    @property
    def title(self) -> str:
        """The family in a few words."""
        carriers = " and ".join(
            f"{pitch:g} px at {angle:g} degrees"
            for pitch, angle in zip(self.pitches_px, self.angles_deg, strict=True)
        )
        return f"{len(self)} crossed frame(s) of {carriers}"

    @property
    def cycles_per_px(self) -> tuple[Pair, Pair]:
        """The carriers' frequencies (f_u, f_v) in cycles per projector px: ``turns = f_u u + f_v
        v``."""
        return tuple(  # type: ignore[return-value]
            (float(sine_of_turns(angle / 360)) / pitch, float(cosine_of_turns(angle / 360)) / pitch)
            for pitch, angle in zip(self.pitches_px, self.angles_deg, strict=True)
        )

    def check(self, width: int, height: int) -> None:
        """Raise `RigError` where a period exceeds a pattern of ``width`` x ``height`` px."""
        for number, (along_u, along_v) in enumerate(self.cycles_per_px):
            if abs(along_u) * width + abs(along_v) * height < 1:
                raise RigError(
                    f"pitches_px[{number}]: a period of {self.pitches_px[number]:g} px exceeds the "
                    f"pattern of "
                    f"{width} x {height} px in its direction"
                )

    def image(self, width: int, height: int, n: int) -> NDArray[np.uint8]:
        """Frame ``n`` as the projector shows it, uint8 (height, width), the same bytes on every
        processor."""
        u, v, half = np.arange(width), np.arange(height)[:, None], GREY_LEVELS / 2
        first, second = (
            weight * cosine_of_turns(v * along_v + u * along_u + shift / 360)
            for weight, (along_u, along_v), shift in zip(
                self.weights, self.cycles_per_px, self.shifts_deg[n], strict=True
            )
        )
        return np.rint(half + half * (first + second)).astype(np.uint8)


def crossed_from_pair(
    first_horizontal: NDArray[np.uint8], first_vertical: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """The crossed frame that a camera would have taken, from the first sinusoids of both
    directions, uint8 (H, W) each: their mean, rounded half to even, uint8 (H, W). Its family is
    `Crossed.of_pair`. The mean of two exposures has less noise than a single one: by a factor of
    sqrt(2). Raises `RigError` for other shapes or types."""
    pair = first_horizontal, first_vertical
    if (
        any(frame.ndim != 2 or frame.dtype != np.uint8 for frame in pair)
        or pair[0].shape != pair[1].shape
    ):
        given = " and ".join(f"{frame.dtype} {frame.shape}" for frame in pair)
        raise RigError(
            f"crossed frame of a pair: expected two uint8 images of one shape (H, W), got {given}"
        )
    total = first_horizontal.astype(np.uint16) + first_vertical
    return np.rint(total / 2).astype(np.uint8)


@dataclass(frozen=True)
class Composite(Code):
    """``127.5 + 127.5 / K sum cos(2 pi w / P_k)`` of the K periods ``pitches_px``."""

    scheme: ClassVar[str] = "composite"
    pitches_px: tuple[float, ...]

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any], length_px: int) -> Composite:
        pitches = mapping(entries, ("pitches_px",))["pitches_px"]
        if not isinstance(pitches, list) or len(pitches) < 2:
            raise RigError(f"pitches_px: expected a list of two periods and more, got {pitches!r}")
        return cls(numbers(pitches, len(pitches), "pitches_px"))

    def to_dict(self) -> dict[str, Any]:
        return {"scheme": self.scheme, "pitches_px": list(self.pitches_px)}

    @property
    def title(self) -> str:
        return f"one frame of {' + '.join(f'{pitch:g}' for pitch in self.pitches_px)} px"

    @property
    def shown(self) -> tuple[Shown, ...]:
        return (Shown("sinusoid"),)

    @property
    def pitch_px(self) -> float:
        return min(self.pitches_px)

    def check(self, length_px: int) -> None:
        if not self.pitch_px >= SMALLEST_PITCH_PX:
            raise RigError(
                f"pitches_px: expected {SMALLEST_PITCH_PX:g} px and more, got {self.pitch_px:g} px"
            )

    def profiles(self, length_px: int) -> NDArray[np.uint8]:
        waves = [cosine_of_turns(np.arange(length_px) / pitch) for pitch in self.pitches_px]
        half = GREY_LEVELS / 2
        return np.rint(half + half * (sum(waves[1:], waves[0]) / len(waves)))[None].astype(np.uint8)

    def decode(self, levels: NDArray, length_px: int, limits: Limits) -> Coordinates:
        raise DecodeError(
            "a single frame with several periods can't be decoded pixel by pixel; project each "
            "period in three steps "
            "or more (phase-shift), or use a method for one frame"
        )

    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        raise DecodeError("a single frame with several periods has no uncertainty pixel by pixel")
