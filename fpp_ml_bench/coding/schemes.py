"""Several periods in a single frame, the sum of their sinusoids; and the registry of coding schemes, by the name that a
rig file gives.

A composite frame alone tells a coordinate only together with its neighbours, so that it is made and described here, and
demodulated by methods that look at windows.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import SMALLEST_PITCH_PX, Code, Coordinates, Limits, Shown, check_keys, numbers
from fpp_ml_bench.coding.gray_code import GrayOnly
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.portable import cosine_of_turns


@dataclass(frozen=True)
class Composite(Code):
    """``127.5 + 127.5 / K sum cos(2 pi w / P_k)`` of the K periods ``pitches_px``."""

    scheme: ClassVar[str] = "composite"
    pitches_px: tuple[float, ...]

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any], length_px: int) -> "Composite":
        check_keys(entries, ("pitches_px",))
        pitches = entries.get("pitches_px")
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
            raise RigError(f"pitches_px: expected {SMALLEST_PITCH_PX:g} px and more, got {self.pitch_px:g} px")

    def profiles(self, length_px: int) -> NDArray[np.uint8]:
        waves = [cosine_of_turns(np.arange(length_px) / pitch) for pitch in self.pitches_px]
        half = GREY_LEVELS / 2
        return np.rint(half + half * (sum(waves[1:], waves[0]) / len(waves)))[None].astype(np.uint8)

    def decode(self, levels: NDArray, length_px: int, limits: Limits) -> Coordinates:
        raise DecodeError(
            "a single frame with several periods can't be decoded pixel by pixel; project each period in three steps "
            "or more (phase-shift), or use a method for one frame"
        )

    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        raise DecodeError("a single frame with several periods has no uncertainty pixel by pixel")


SCHEMES: dict[str, type[Code]] = {scheme.scheme: scheme for scheme in (PhaseShift, GrayOnly, Composite)}


def code_from_dict(entries: Mapping[str, Any], length_px: int, where: str) -> Code:
    """The code that a rig file's entry describes, on a pattern ``length_px`` long. Raises `RigError` naming the key."""
    if not isinstance(entries, Mapping):
        raise RigError(f"{where}: expected a mapping with the key scheme, got {entries!r}")
    scheme = entries.get("scheme")
    if not isinstance(scheme, str) or scheme not in SCHEMES:
        raise RigError(f"{where}.scheme: expected {', '.join(SCHEMES)}, got {scheme!r}")
    rest = {key: value for key, value in entries.items() if key != "scheme"}
    try:
        code: Code = SCHEMES[scheme].from_entries(rest, length_px)
        code.check(length_px)
    except RigError as error:
        raise RigError(f"{where}.{error}") from error
    return code
