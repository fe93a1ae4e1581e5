"""The projected sequence: what each frame shows, and which frames a configuration needs.

*Horizontal* fringes have horizontal stripes: they vary along the projector's rows and measure its
coordinate ``v``. *Vertical* fringes vary along its columns, measure ``u``. The paper's order
(Section 3.2) is `Sequence`: N horizontal sinusoids, N vertical sinusoids, horizontal Gray code,
vertical Gray code, black, white; 18 + 18 + 7 + 7 + 1 + 1 = 52 frames. Any other sequence is a
`CodedSequence`: a code of `fpp_ml_bench.coding` for one direction or both, crossed fringes, or all
of them.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Code, Kind, mapping, whole
from fpp_ml_bench.coding.crossed import Composite, Crossed
from fpp_ml_bench.coding.gray_code import GrayCells, GrayOnly
from fpp_ml_bench.coding.phase_shift import Fringes, PhaseShift, equal_shifts
from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.errors import RigError

Direction = Literal["horizontal", "vertical"]

DIRECTIONS: tuple[Direction, Direction] = ("horizontal", "vertical")
AXES: tuple[Direction, Direction] = ("vertical", "horizontal")
"""The direction whose fringes measure the projector's u, then the direction whose fringes measure
its v."""
PAPER_PITCH_PX = 18.0
"""Period of the paper's fringes in projector px."""
CODED_KEYS = ("order", "crossed", *DIRECTIONS)
"""Entries of a rig file's sequence that is not of the paper's kind."""


@dataclass(frozen=True)
class Frame:
    """A projected frame: ``step`` is n of a sinusoid or a crossed frame, or the Gray bit, 0 = most
    significant, ``inverse`` or not; ``fringe`` numbers the periods of a code with several."""

    index: int
    kind: Kind
    direction: Direction | None = None
    step: int = 0
    fringe: int = 0
    inverse: bool = False

    @property
    def column(self) -> str:
        return f"frame_{self.index:02d}"

    @property
    def title(self) -> str:
        period = f" of period {self.fringe}" if self.fringe else ""
        inverse = ", inverse" if self.inverse else ""
        part = {
            "sinusoid": f"{self.direction} sinusoid, step {self.step}{period}",
            "gray": f"{self.direction} Gray bit {self.step}{inverse}",
            "crossed": f"crossed fringes, step {self.step}",
        }.get(self.kind, self.kind)
        return f"{self.index}: {part}"


class AnySequence(ABC):
    """The frames of a capture."""

    @property
    @abstractmethod
    def frames(self) -> tuple[Frame, ...]:
        """All frames in the order in which they are projected."""

    @property
    @abstractmethod
    def directions(self) -> tuple[Direction, ...]:
        """The directions that are coded, in the order of `DIRECTIONS`."""

    @property
    def steps(self) -> int:
        """Phase steps of the finest sinusoids, the fewest of the coded directions."""
        return min((len(self.sinusoids(direction)) for direction in self.directions), default=0)

    @abstractmethod
    def code(self, direction: Direction, pitch_px: float = PAPER_PITCH_PX) -> Code:
        """The code of a direction; of the paper's kind with fringes of a period of ``pitch_px``.
        Raises `RigError` where it has none."""

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The entry ``sequence`` of a rig file."""

    def equal_steps(self) -> list[tuple[tuple[int, ...], NDArray[np.float64]]]:
        """Every set of sinusoids of one period in equal steps: frame indices, and shifts in
        turns."""
        sets = []
        for direction in self.directions:
            code = self.code(direction)
            for number, fringe in enumerate(code.fringes if isinstance(code, PhaseShift) else ()):
                steps = fringe.steps
                for sign in (1, -1):
                    if steps >= 3 and fringe.equal_steps(sign):
                        sets.append(
                            (self.period(direction, number), sign * np.arange(steps) / steps)
                        )
                        break
        return sets

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def indices(self, **wanted: object) -> tuple[int, ...]:
        """Indices of the frames whose attributes are as wanted, in the order of the sequence."""
        key = tuple(wanted.items())
        if key not in self._indices:  # a decoding asks thousands of times
            self._indices[key] = tuple(
                frame.index
                for frame in self.frames
                if all(getattr(frame, name) == value for name, value in key)
            )
        return self._indices[key]

    @cached_property
    def _indices(self) -> dict[tuple[tuple[str, object], ...], tuple[int, ...]]:
        """The answers of `indices` by what was wanted."""
        return {}

    def coded(self, direction: Direction) -> tuple[int, ...]:
        """Frame indices of a direction's code, in the code's own order: sinusoids, then Gray
        code."""
        return self.indices(direction=direction, kind="sinusoid") + self.gray(direction)

    def sinusoids(self, direction: Direction) -> tuple[int, ...]:
        """Frame indices of a direction's finest sinusoids, in the order of their steps; none where
        it has none."""
        return self.period(direction, self._finest(direction))

    def period(self, direction: Direction, fringe: int) -> tuple[int, ...]:
        """Frame indices of a direction's sinusoids of the ``fringe``-th period, in the order of
        their steps."""
        return self.indices(direction=direction, kind="sinusoid", fringe=fringe)

    def gray(self, direction: Direction) -> tuple[int, ...]:
        """Frame indices of a direction's Gray code, in the order of its frames; none where it has
        none."""
        return self.indices(direction=direction, kind="gray")

    @property
    def crossed_frames(self) -> tuple[int, ...]:
        """Frame indices of crossed fringes, in the order of their steps; none where the sequence
        has none."""
        return self.indices(kind="crossed")

    def bits(self, direction: Direction) -> int:
        """Gray bits of a direction."""
        return len(self.indices(direction=direction, kind="gray", inverse=False))

    def _finest(self, direction: Direction) -> int:
        return 0

    @property
    def black(self) -> int | None:
        return next(iter(self.indices(kind="black")), None)

    @property
    def white(self) -> int | None:
        return next(iter(self.indices(kind="white")), None)

    def config(self, name: str) -> tuple[int, ...]:
        """Frame indices of a dataset configuration (paper Section 5.4): see ``CONFIGS``; empty
        where the sequence has none."""
        horizontal, vertical = self.sinusoids("horizontal"), self.sinusoids("vertical")
        crossed = self.crossed_frames
        single = ((0,) if 0 in crossed else horizontal or vertical or crossed or (0,))[:1]
        first = (*crossed, *horizontal[:1], *vertical[:1])
        frames = (
            single,
            crossed,
            first if len(first) > 1 else (),
            horizontal,
            vertical,
            horizontal + vertical,
            tuple(range(len(self))),
        )
        if name not in CONFIGS:
            raise ValueError(f"unknown configuration {name!r}; there are {', '.join(CONFIGS)}")
        return frames[CONFIGS.index(name)]


@dataclass(frozen=True)
class Sequence(AnySequence):
    """The paper's kind: ``steps`` sinusoids, of a period that the rig names, and ``bits`` Gray-code
    frames per direction, black and white."""

    steps: int = 18  # type: ignore[assignment]  # a field takes the place of the property
    bits_horizontal: int = 7
    bits_vertical: int = 7

    def __post_init__(self) -> None:
        for name, least, most in (
            ("steps", 3, 1000),
            ("bits_horizontal", 1, 15),
            ("bits_vertical", 1, 15),
        ):
            whole(getattr(self, name), f"sequence.{name}", least, most)

    @property
    def directions(self) -> tuple[Direction, ...]:
        return DIRECTIONS

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    def code(self, direction: Direction, pitch_px: float = PAPER_PITCH_PX) -> PhaseShift:
        return _paper_code(self.steps, self._bits[direction], pitch_px)

    @property
    def _bits(self) -> dict[Direction, int]:
        return {"horizontal": self.bits_horizontal, "vertical": self.bits_vertical}

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        described: list[tuple[Kind, Direction | None, int]]
        described = [
            ("sinusoid", direction, n) for direction in DIRECTIONS for n in range(self.steps)
        ]
        described += [
            ("gray", direction, bit)
            for direction in DIRECTIONS
            for bit in range(self._bits[direction])
        ]
        described += [("black", None, 0), ("white", None, 0)]
        return tuple(Frame(i, *d) for i, d in enumerate(described))


@lru_cache
def _paper_code(steps: int, bits: int, pitch_px: float) -> PhaseShift:
    return PhaseShift(
        (Fringes(pitch_px, equal_shifts(steps, 1)),), 0.0, GrayCells(pitch_px / 2, bits)
    )


@dataclass(frozen=True)
class CodedSequence(AnySequence):
    """A ``horizontal`` or ``vertical`` code, or both, or ``crossed`` fringes, and the ``order`` of
    what is projected: these, black and white."""

    horizontal: Code | None
    vertical: Code | None
    order: tuple[str, ...]
    crossed: Crossed | None = None

    def __post_init__(self) -> None:
        described = (*(["crossed"] if self.crossed else []), *self.directions)
        if not described:
            raise RigError(
                "sequence: no direction is coded; describe horizontal, vertical, crossed or some "
                "of them"
            )
        known = (*described, "black", "white")
        for name in self.order:
            if name not in known or self.order.count(name) > 1:
                raise RigError(
                    f"sequence.order: expected each of {', '.join(known)} at most once, got "
                    f"{self.order}"
                )
        if self.crossed and "crossed" not in self.order:
            raise RigError("sequence.order: crossed missing, whose fringes are described")
        for direction in self.directions:
            code = self.code(direction)
            needed = (direction, *(("black", "white") if code.needs_flat else ()))
            missing = [name for name in needed if name not in self.order]
            if missing:
                raise RigError(
                    f"sequence.order: {', '.join(missing)} missing, which the {direction} code "
                    f"needs"
                )

    @property
    def directions(self) -> tuple[Direction, ...]:
        return tuple(direction for direction in DIRECTIONS if getattr(self, direction) is not None)

    def code(self, direction: Direction, pitch_px: float = PAPER_PITCH_PX) -> Code:
        code: Code | None = getattr(self, direction)
        if code is None:
            others = (*self.directions, "crossed")[0]
            raise RigError(f"this rig projects no {direction} fringes or codes, only {others} ones")
        return code

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        shown: list[tuple[Any, ...]] = []
        for name in self.order:
            if name == "crossed":
                shown += [(name, None, step) for step in range(len(self.crossed or ()))]
            elif name in DIRECTIONS:
                shown += [(kind, name, *about) for kind, *about in getattr(self, name).shown]
            else:
                shown.append((name,))
        return tuple(Frame(index, *about) for index, about in enumerate(shown))

    def _finest(self, direction: Direction) -> int:
        code = getattr(self, direction)
        return code.finest if isinstance(code, PhaseShift) else 0

    def to_dict(self) -> dict[str, Any]:
        crossed = {"crossed": self.crossed.to_dict()} if self.crossed else {}
        codes = {str(direction): self.code(direction).to_dict() for direction in self.directions}
        return {"order": list(self.order), **crossed, **codes}


SCHEMES: dict[str, type[Code]] = {
    scheme.scheme: scheme for scheme in (PhaseShift, GrayOnly, Composite)
}


def code_from_dict(entries: Mapping[str, Any], length_px: int, where: str) -> Code:
    """The code that a rig file's entry describes, on a pattern ``length_px`` long. Raises
    `RigError` naming the key."""
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


def sequence_from_dict(
    entries: object, lengths_px: Mapping[Direction, int]
) -> Sequence | CodedSequence:
    """The sequence that a rig file describes, on patterns of ``lengths_px``. Raises `RigError`
    naming the key."""
    if not isinstance(entries, Mapping):
        raise RigError(f"sequence: expected a mapping, got {entries!r}")
    paper = ("steps", "bits_horizontal", "bits_vertical")
    if any(key in entries for key in CODED_KEYS):
        mapping(entries, (), "sequence", CODED_KEYS)
        codes = {
            direction: code_from_dict(
                entries[direction], lengths_px[direction], f"sequence.{direction}"
            )
            for direction in DIRECTIONS
            if direction in entries
        }
        crossed = None
        if "crossed" in entries:
            pitches, *others = (entry.name for entry in fields(Crossed))
            family = mapping(entries["crossed"], (pitches,), "sequence.crossed", others)
            try:
                crossed = Crossed.from_entries(family)
                crossed.check(lengths_px["vertical"], lengths_px["horizontal"])
            except RigError as error:
                raise RigError(f"sequence.crossed.{error}") from error
        order = entries.get("order", [*(["crossed"] if crossed else []), *codes])
        if not isinstance(order, list) or not all(isinstance(name, str) for name in order):
            raise RigError(f"sequence.order: expected a list of names, got {order!r}")
        return CodedSequence(codes.get("horizontal"), codes.get("vertical"), tuple(order), crossed)
    try:
        mapping(entries, paper, "sequence")
    except RigError as error:
        raise RigError(
            f"{error}, or a code for each direction under {' and '.join(DIRECTIONS)}"
        ) from error
    return Sequence(**entries)


PAPER_SEQUENCE = Sequence()
