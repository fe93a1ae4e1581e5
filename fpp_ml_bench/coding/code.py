"""A coding scheme: how frames tell a projector coordinate, in one direction.

A scheme is a small class that makes the patterns, decodes the frames to coordinates with a reason for every pixel
without one, states their noise, and says what its frames show. `SCHEMES` lists all; a rig file names one for each
direction.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.coordinates import Coordinates, Limits
from fpp_ml_bench.errors import RigError

Kind = Literal["sinusoid", "gray", "crossed", "black", "white"]
LARGEST = 1e12
"""Magnitude of any number of a rig: no rig comes near it, and products of several stay far from overflow."""
SMALLEST_PITCH_PX = 4.0
"""A Gray cell is half a period; below two pixels a cell its edges and centres can't be told apart."""


class Shown(NamedTuple):
    """What a frame of a code shows: the ``step`` of the ``fringe``-th sinusoid, or the bit, 0 = most significant, of a
    Gray code, ``inverse`` or not."""

    kind: Kind
    step: int = 0
    fringe: int = 0
    inverse: bool = False


class Code(ABC):
    """The code of one direction; a frozen dataclass whose fields are the entries of a rig file."""

    scheme: ClassVar[str]

    @property
    def needs_flat(self) -> bool:
        """Whether decoding also needs a black and a white frame."""
        return False

    @property
    def step_px(self) -> float:
        """Largest error of a coordinate without noise, in projector px."""
        return 0.0

    @property
    @abstractmethod
    def title(self) -> str:
        """The code in a few words, with its periods or cells in projector px."""

    @property
    @abstractmethod
    def shown(self) -> tuple[Shown, ...]:
        """What each frame shows, in the order of `profiles` and of the levels that `decode` takes."""

    @property
    @abstractmethod
    def pitch_px(self) -> float | None:
        """The finest period in projector px; None without sinusoids."""

    @abstractmethod
    def check(self, length_px: int) -> None:
        """Raise `RigError` where the code does not fit a pattern ``length_px`` long."""

    @abstractmethod
    def profiles(self, length_px: int) -> NDArray[np.uint8]:
        """The frames along the coded coordinate, uint8 (F, length_px)."""

    @abstractmethod
    def decode(self, levels: NDArray, length_px: int, limits: Limits) -> Coordinates:
        """Coordinates of n pixels from grey levels of 0 to 255, uint8 or float32 (F, n), with black and white as the
        last two rows where the code `needs_flat`. Raises `DecodeError` for a code that can't be decoded pixel by pixel.
        """

    @abstractmethod
    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        """Standard uncertainty of a coordinate in projector px, from noise of ``noise_grey`` grey levels a frame."""

    @classmethod
    @abstractmethod
    def from_entries(cls, entries: Mapping[str, Any], length_px: int) -> "Code":
        """The code of a rig file's entries without ``scheme``; `RigError` naming the key."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The entries of a rig file; `code_from_dict` gives an equal code back."""


def entry(entries: Mapping[str, Any], key: str, default: Any = None) -> Any:
    """An entry of a rig file; raises `RigError` where it is missing and has no ``default``."""
    if key not in entries and default is None:
        raise RigError(f"{key}: missing")
    return entries.get(key, default)


def check_keys(entries: Mapping[str, Any], keys: tuple[str, ...]) -> None:
    """Raise `RigError` for an entry that is none of ``keys``."""
    unknown = [str(key) for key in entries if key not in keys]
    if unknown:
        raise RigError(f"{unknown[0]}: unknown key; expected some of {', '.join(keys)}")


def whole(value: object, key: str, least: int, most: int) -> int:
    """``value`` as a whole number from ``least`` to ``most``; raises `RigError` naming the key."""
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise RigError(f"{key}: expected a whole number from {least} to {most}, got {value!r}")
    return value


def real(value: object, key: str) -> float:
    """``value`` as a finite number of at most `LARGEST`; raises `RigError` naming the key."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise RigError(f"{key}: expected a finite number of at most {LARGEST:g}, got {value!r}")
    return float(value)
