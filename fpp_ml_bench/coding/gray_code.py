"""Gray code in half periods, the fringe order from it, and its frames: behind sinusoids, or as a
code of their own.

The fringe order is the whole number k that brings ``phi + 2 pi k`` nearest to the cell's centre. A
bit misread at an edge gives the neighbouring cell, half a period away; but at an edge the true
phase is a quarter of a period from BOTH centres, so k stays right. The classical code with one cell
per period has its edges where the phase wraps, and there the order can be wrong by 1; a median
filter hides such errors but moves depth edges.
"""

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import (
    AMBIGUOUS_FRACTION,
    Code,
    Coordinates,
    Limits,
    Shown,
    mapping,
    number,
    whole,
)
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import RigError

INCONSISTENT_RAD = 0.75 * math.pi
"""Largest accepted distance from absolute phase to cell centre: pi/2 reaches the cell's edge, pi/4
more allows for a bit misread at the edge."""
AMBIGUOUS_ALONE = 0.1
"""As `AMBIGUOUS_FRACTION`, without sinusoids: black and white frames tell the threshold better than
their mean, and the finest bits lose contrast to the camera's blur. On a real capture with cells of
two projector px 0.25 leaves 45% of the object, 0.1 85% with a robust sigma of 0.3 mm, 0.02 98% with
0.5 mm."""
Inverse = Literal["none", "after each", "after all"]


def binary_to_gray(value: ArrayLike) -> NDArray[np.int64]:
    """Reflected binary (Gray) code of non-negative integers, int64."""
    number = np.asarray(value, dtype=np.int64)
    return number ^ (number >> 1)


def gray_to_binary(code: ArrayLike) -> NDArray[np.int64]:
    """Inverse of `binary_to_gray` for codes of up to 32 bits, int64."""
    number = np.array(code, dtype=np.int64)
    for shift in (1, 2, 4, 8, 16):
        number ^= number >> shift
    return number


def cell_of(position_px: ArrayLike, pitch_px: float) -> NDArray[np.int64]:
    """Number of the half-period cell that contains the projector pixel ``position_px`` (whole
    numbers), int64."""
    return np.floor(np.asarray(position_px, dtype=np.float64) / (pitch_px / 2)).astype(np.int64)


def cell_count(length_px: float, pitch_px: float) -> int:
    """Gray-code cells of half a period on a pattern ``length_px`` long."""
    return int(cell_of(length_px - 1, pitch_px)) + 1


def bits_needed(length_px: float, pitch_px: float) -> int:
    """Gray bits that tell all cells of a pattern apart: ceil(log2(cells)), at least 1."""
    return max(1, (cell_count(length_px, pitch_px) - 1).bit_length())


@lru_cache(maxsize=8)
def cell_centres_rad(length_px: int, pitch_px: float) -> NDArray[np.float64]:
    """Absolute phase at the centre of the pixels of each cell, float64 (cells,): with 9 px per cell
    9j + 4. Half a pixel later, at (j + 1/2) P/2, it would reduce the tolerance of a quarter
    period."""
    edges = np.ceil(np.arange(cell_count(length_px, pitch_px) + 1) * (pitch_px / 2))
    return (edges[:-1] + edges[1:] - 1) / 2 * (2 * np.pi / pitch_px)


def decode_cells(
    bits: ArrayLike,
    threshold: ArrayLike,
    modulation: ArrayLike,
    ambiguous_fraction: float = AMBIGUOUS_FRACTION,
) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Cell numbers and whether they can be trusted, int32 and bool (H, W), from the Gray frames of
    a direction. ``bits`` (n, H, W) grey levels, most significant bit first; ``threshold`` and
    ``modulation`` (H, W): the mean A and amplitude B of its sinusoids. A bit within
    ``ambiguous_fraction`` B of the threshold is ambiguous; a cell is trusted when no bit is, or
    when a single bit is and flipping it gives a neighbour."""
    mean, amplitude = (
        np.asarray(threshold, dtype=np.float64),
        np.asarray(modulation, dtype=np.float64),
    )
    margin = ambiguous_fraction * amplitude
    cells = np.zeros(mean.shape, dtype=np.int32)
    ambiguous = np.zeros(mean.shape, dtype=np.int32)
    previous = np.zeros(mean.shape, dtype=bool)
    dark, bright = mean - margin, mean + margin
    for frame in np.asarray(bits):
        previous = previous ^ (frame > mean)
        cells = cells * 2 + previous
        ambiguous = ambiguous * 2 + ((frame > dark) & (frame < bright))
    # The neighbours of n differ from it in bit 0 and in the lowest set bit of n (even) or n + 1
    # (odd).
    even = cells + (cells & 1)
    trusted = (ambiguous <= 1) | (ambiguous == (even & -even))
    return cells, trusted


class DecodedCells(NamedTuple):
    """Cell ``number`` and the ``other`` that it would be with all ambiguous bits flipped (itself
    where none is), int32 (n,) each. ``trusted`` bool (n,): no bit is ambiguous, or a single one
    that makes the other a neighbour."""

    number: NDArray[np.int32]
    other: NDArray[np.int32]
    trusted: NDArray[np.bool_]

    def clear(self) -> NDArray[np.bool_]:
        """Where no bit is ambiguous, bool (n,)."""
        return self.number == self.other


@dataclass(frozen=True)
class GrayCells:
    """Gray-code frames: cells of ``cell_px``, ``bits`` most significant first (or ``least_first``),
    without inverse frames, or each followed by its inverse, or all of them followed by all
    inverses. ``origin_px``: where cell 0 begins, 0 or less: codes for a power of two that is larger
    than the projector are often centred on it."""

    cell_px: float
    bits: int
    inverse: Inverse = "none"
    origin_px: float = 0.0
    least_first: bool = False

    @classmethod
    def from_entries(cls, entries: Any, length_px: int, cell_px: float = 1.0) -> Self:
        """From a rig file's mapping, whose keys are the fields; ``cell_px`` by default as given
        here, ``bits`` as many as the pattern needs. Raises `RigError`."""
        mapping(entries, (), "", ("cell_px", "bits", "inverse", "origin_px", "least_first"))
        size = number(entries.get("cell_px", cell_px), "cell_px")
        if not size >= 1:
            raise RigError(f"cell_px: expected 1 px and more, got {size:g}")
        origin_px, least_first = (
            number(entries.get("origin_px", 0.0), "origin_px"),
            entries.get("least_first", False),
        )
        if not isinstance(least_first, bool):
            raise RigError(f"least_first: expected true or false, got {least_first!r}")
        bits = whole(
            entries.get("bits", bits_needed(length_px - origin_px, 2 * size)), "bits", 1, 15
        )
        inverse = entries.get("inverse", "none")
        if inverse not in ("none", "after each", "after all"):
            raise RigError(f"inverse: expected none, after each or after all, got {inverse!r}")
        return cls(size, bits, inverse, origin_px, least_first)

    def to_dict(self) -> dict[str, Any]:
        usual = {"origin_px": 0.0, "least_first": False}
        return {key: value for key, value in asdict(self).items() if usual.get(key) != value}

    @property
    def shown(self) -> tuple[Shown, ...]:
        order = range(self.bits)[:: -1 if self.least_first else 1]
        plain, inverse = (
            [Shown("gray", bit, inverse=way) for bit in order] for way in (False, True)
        )
        if self.inverse == "none":
            return tuple(plain)
        pairs = zip(plain, inverse, strict=True)
        return (
            (*plain, *inverse)
            if self.inverse == "after all"
            else tuple(frame for pair in pairs for frame in pair)
        )

    @property
    def rows(self) -> tuple[list[int], list[int]]:
        """Rows of the plain and of the inverse frames, most significant bit first."""
        shown = self.shown
        ranked = sorted(range(len(shown)), key=lambda row: shown[row].step)
        return [row for row in ranked if not shown[row].inverse], [
            row for row in ranked if shown[row].inverse
        ]

    def check(self, length_px: int) -> None:
        """Raise `RigError` where the bits are too few for a pattern ``length_px`` long, or begin
        within it."""
        if self.origin_px > 0:
            raise RigError(
                f"origin_px: expected 0 or less, for every pixel to have a code, got "
                f"{self.origin_px:g}"
            )
        needed = bits_needed(length_px - self.origin_px, 2 * self.cell_px)
        if self.bits < needed:
            cells = cell_count(length_px - self.origin_px, 2 * self.cell_px)
            raise RigError(
                f"bits: {length_px} px hold {cells} Gray cells of {self.cell_px:g} px, which need "
                f"{needed} bits, got "
                f"{self.bits}"
            )

    def profiles(self, length_px: int) -> NDArray[np.uint8]:
        """The frames along the coordinate, uint8 (frames, length_px)."""
        code = binary_to_gray(cell_of(np.arange(length_px) - self.origin_px, 2 * self.cell_px))
        rows = [(code >> (self.bits - 1 - shown.step) & 1) ^ shown.inverse for shown in self.shown]
        return (np.array(rows) * GREY_LEVELS).astype(np.uint8)

    def centre_px(self, number: NDArray[np.integer], length_px: int) -> NDArray[np.float64]:
        """Middle of the pixels of cells ``number``; NaN for a cell that the pattern does not
        hold."""
        centres = cell_centres_rad(length_px, 2 * self.cell_px) * (2 * self.cell_px / (2 * np.pi))
        if self.origin_px:
            count = cell_count(length_px - self.origin_px, 2 * self.cell_px)
            edges = np.ceil(np.arange(count + 1) * self.cell_px + self.origin_px)
            first, last = np.maximum(edges[:-1], 0), np.minimum(edges[1:], length_px) - 1
            centres = np.where(first <= last, (first + last) / 2, np.nan)
        return np.append(centres, np.nan)[np.minimum(number, len(centres))]

    def cells_of(
        self, levels: NDArray, threshold: NDArray, modulation: NDArray, ambiguous_fraction: float
    ) -> DecodedCells:
        """Cells of n pixels from grey levels (frames, n). ``threshold`` and ``modulation`` (n,):
        mean and amplitude of what the bits swing between; with inverse frames a bit is the half
        difference of its pair."""
        plain, inverse = self.rows
        bits = levels[plain].astype(np.float64)
        if self.inverse != "none":
            bits = threshold + (bits - levels[inverse]) / 2
        number, trusted = decode_cells(bits, threshold, modulation, ambiguous_fraction)
        doubtful = np.abs(bits - threshold) < ambiguous_fraction * modulation
        if not doubtful.any():
            return DecodedCells(number, number, trusted)
        flipped = np.where(doubtful, 2 * threshold - bits, bits)
        return DecodedCells(
            number, decode_cells(flipped, threshold, modulation, ambiguous_fraction)[0], trusted
        )


@dataclass(frozen=True)
class GrayOnly(GrayCells, Code):
    """Gray code alone, with a black and a white frame as its threshold, or with inverse frames: a
    coordinate to a cell, and to the edge of two where a bit is ambiguous there."""

    scheme: ClassVar[str] = "gray"

    @property
    def needs_flat(self) -> bool:
        return self.inverse == "none"

    @property
    def step_px(self) -> float:
        return self.cell_px / 2

    def to_dict(self) -> dict[str, Any]:
        return {"scheme": self.scheme, **super().to_dict()}

    @property
    def title(self) -> str:
        return f"Gray code, cells of {self.cell_px:g} px"

    @property
    def pitch_px(self) -> None:
        return None

    def decode(self, levels: NDArray, length_px: int, limits: Limits) -> Coordinates:
        if self.needs_flat:
            black, white = levels[-2].astype(np.float64), levels[-1].astype(np.float64)
        else:
            plain, inverse = (levels[rows].astype(np.float64) for rows in self.rows)
            black = np.minimum(plain, inverse).max(axis=0)
            white = black + np.abs(plain - inverse).max(
                axis=0
            )  # the finest bits lose contrast to blur
        threshold, modulation = (white + black) / 2, (white - black) / 2
        fraction = min(limits.ambiguous_fraction, AMBIGUOUS_ALONE)
        cells = self.cells_of(levels[: len(self.shown)], threshold, modulation, fraction)
        centre_px, other_px = (self.centre_px(n, length_px) for n in (cells.number, cells.other))
        coordinate_px = np.where(np.isnan(other_px), centre_px, (centre_px + other_px) / 2)
        inconsistent = ~cells.trusted | np.isnan(centre_px)
        saturated = black >= GREY_LEVELS
        phase = np.full_like(modulation, np.nan)
        return Coordinates.judged(
            coordinate_px, modulation, phase, saturated, inconsistent, length_px, limits
        )

    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        """That of a uniform distribution over a cell, whatever the noise."""
        return np.full(np.broadcast(modulation, noise_grey).shape, self.cell_px / math.sqrt(12))
