"""A coding scheme: how frames tell a projector coordinate, in one direction, and what it measures
at each pixel.

A scheme is a small class that makes the patterns, decodes the frames to coordinates with a reason
for every pixel without one, states their noise, and says what its frames show. `SCHEMES` lists all;
a rig file names one for each direction.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.errors import RigError

MIN_MODULATION = 5.0
"""Grey levels. At a read noise of 1 grey level and only 3 steps the phase noise is then 0.16 rad: a
tenth of the pi/2 that the fringe order tolerates, about 7 mm of depth at 1.8 m. Less means shadow,
glare or no projector light."""
CLIPPED_STEPS_DIVISOR = 9
"""A pixel may be saturated in N // 9 of its N steps (2 of 18, none below 9). N steps cancel
harmonics up to N - 2, so that a clipped crest then distorts the phase by under 5 mrad; with few
steps it would be tens of mrad."""
MAX_DISAGREEMENT_PX = 1.5
"""Projector px between a pixel's measured (u, v) and its epipolar line. Noise at the least
modulation and 3 steps gives a sigma of 0.5 px; a fringe order that is wrong by 1 shifts an 18 px
fringe by more than 10 px."""
AMBIGUOUS_FRACTION = 0.25
"""A bit nearer to the threshold than this part of the modulation is ambiguous. A code bit swings by
the full modulation, so noise must reach 1.25 times the modulation before a clear bit is misread
unnoticed."""
Kind = Literal["sinusoid", "gray", "crossed", "black", "white"]
LARGEST = 1e12
"""Magnitude of any number of a rig: no rig comes near it, and products of several stay far from
overflow."""
SMALLEST_PITCH_PX = 4.0
"""A Gray cell is half a period; below two pixels a cell its edges and centres can't be told
apart."""


class Reason(IntEnum):
    """Why a pixel has no depth. Where several reasons apply, the lowest code is stored.

    NO_RAY: the camera's lens model has no inverse at this pixel, or the ray does not meet the
    measured projector plane in front of both devices. NOT_ASKED: the pixel is outside the mask.
    """

    DECODED = 0
    NO_RAY = 1
    LOW_MODULATION = 2
    SATURATED = 3
    INCONSISTENT_ORDER = 4
    OUTSIDE_PATTERN = 5
    DIRECTIONS_DISAGREE = 6
    OUTSIDE_RANGE = 7
    NOT_ASKED = 8

    @property
    def words(self) -> str:
        return self.name.lower().replace("_", " ")


STAGE_REASONS = (
    Reason.LOW_MODULATION,
    Reason.SATURATED,
    Reason.INCONSISTENT_ORDER,
    Reason.OUTSIDE_PATTERN,
)
"""Reasons that a code gives, in the order in which they are looked at."""


@dataclass(frozen=True)
class Limits:
    """Conditions that a decoded pixel meets; the defaults are explained beside their constants."""

    min_modulation: float = MIN_MODULATION
    max_clipped_steps: int | None = None
    max_disagreement_px: float = MAX_DISAGREEMENT_PX
    ambiguous_fraction: float = AMBIGUOUS_FRACTION


@dataclass(frozen=True)
class Coordinates:
    """A block's measurement in one direction: coordinate (px), modulation (grey levels) and phase
    (rad), float64 (n,) each, and the reason codes, uint8 (n,)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float64]
    phase: NDArray[np.float64]
    reason: NDArray[np.uint8]

    @classmethod
    def judged(
        cls,
        coordinate_px: NDArray,
        modulation: NDArray,
        phase: NDArray,
        saturated: NDArray,
        inconsistent: NDArray,
        length_px: float,
        limits: Limits,
    ) -> "Coordinates":
        """With the first reason that applies of `STAGE_REASONS`; ``saturated`` and ``inconsistent``
        bool (n,)."""
        outside = (coordinate_px < -0.5) | (coordinate_px > length_px - 0.5)
        faults = modulation < limits.min_modulation, saturated, inconsistent, outside
        reason = np.select(faults, [np.uint8(code) for code in STAGE_REASONS], np.uint8(0))
        return cls(coordinate_px, modulation, phase, reason)

    def at(self, indices: NDArray[np.intp]) -> "Coordinates":
        """The coordinates of the pixels at ``indices`` only."""
        return Coordinates(
            self.coordinate_px[indices],
            self.modulation[indices],
            self.phase[indices],
            self.reason[indices],
        )


class Shown(NamedTuple):
    """What a frame of a code shows: the ``step`` of the ``fringe``-th sinusoid, or the bit, 0 =
    most significant, of a Gray code, ``inverse`` or not."""

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
        """What each frame shows, in the order of `profiles` and of the levels that `decode`
        takes."""

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
        """Coordinates of n pixels from grey levels of 0 to 255, uint8 or float32 (F, n), with black
        and white as the last two rows where the code `needs_flat`. Raises `DecodeError` for a code
        that can't be decoded pixel by pixel.
        """

    @abstractmethod
    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        """Standard uncertainty of a coordinate in projector px, from noise of ``noise_grey`` grey
        levels a frame."""

    @classmethod
    @abstractmethod
    def from_entries(cls, entries: Mapping[str, Any], length_px: int) -> "Code":
        """The code of a rig file's entries without ``scheme``; `RigError` naming the key."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The entries of a rig file; `code_from_dict` gives an equal code back."""


def mapping(
    value: object, keys: Iterable[str], name: str = "", optional: Iterable[str] = ()
) -> dict[str, Any]:
    """``value`` as a mapping that has all ``keys``, and beside them ``optional`` ones at most;
    raises `RigError` naming the key below ``name``."""
    keys, optional = tuple(keys), tuple(optional)
    expected = " and optionally ".join(", ".join(listed) for listed in (keys, optional) if listed)
    if not isinstance(value, Mapping):
        raise RigError(
            f"{name}: expected a mapping with the keys {expected}, got {value!r}".removeprefix(": ")
        )
    below = f"{name}." if name else ""
    problems = [f"{below}{key}: unknown key" for key in value if key not in (*keys, *optional)]
    problems += [f"{below}{key}: missing" for key in keys if key not in value]
    require(not problems, f"{', '.join(problems)}; expected {expected}")
    return dict(value)


def whole(value: object, name: str, least: int, most: int) -> int:
    """``value`` as a whole number from ``least`` to ``most``; raises `RigError` naming the key."""
    if (
        isinstance(value, bool)
        or not isinstance(value, int | np.integer)
        or not least <= value <= most
    ):
        raise RigError(f"{name}: expected a whole number from {least} to {most}, got {value!r}")
    return int(value)


def require(met: object, message: str) -> None:
    """Raise `RigError` with ``message`` unless ``met``."""
    if not met:
        raise RigError(message)


def number(value: object, name: str, *, positive: bool = False) -> float:
    """``value`` as a finite float; raises `RigError` naming the key for anything else (text,
    booleans, NaN)."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise RigError(f"{name}: expected a number, got {value!r}")
    if not -LARGEST <= value <= LARGEST or (positive and value <= 0):
        kind = f"{'positive ' if positive else ''}finite number of at most {LARGEST:g}"
        raise RigError(f"{name}: expected a {kind}, got {value!r}")
    return float(value)


def numbers(value: object, counts: int | tuple[int, ...], name: str) -> tuple[float, ...]:
    """``value`` as finite floats, as many as ``counts`` allows; raises `RigError` naming the key
    and the entry."""
    counts = (counts,) if isinstance(counts, int) else counts
    expected = f"{name}: expected {' or '.join(map(str, counts))} numbers"
    if isinstance(value, str | bytes | dict) or not isinstance(value, Iterable):
        raise RigError(f"{expected}, got {value!r}")
    entries = list(value)
    require(len(entries) in counts, f"{expected}, got {len(entries)}")
    return tuple(number(entry, f"{name}[{i}]") for i, entry in enumerate(entries))
