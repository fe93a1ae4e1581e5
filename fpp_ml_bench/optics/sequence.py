"""The projected sequence: what each frame shows, and which frames a configuration needs.

The order is the paper's (Section 3.2): N horizontal sinusoids, N vertical sinusoids, horizontal Gray code, vertical
Gray code, black, white; 18 + 18 + 7 + 7 + 1 + 1 = 52 frames. *Horizontal* fringes have horizontal stripes: they vary
along the projector's rows and measure its coordinate ``v``. *Vertical* fringes vary along its columns, measure ``u``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

Direction = Literal["horizontal", "vertical"]
Kind = Literal["sinusoid", "gray", "black", "white"]

DIRECTIONS: tuple[Direction, Direction] = ("horizontal", "vertical")
AXES: tuple[Direction, Direction] = ("vertical", "horizontal")
"""The direction whose fringes measure the projector's u, then the direction whose fringes measure its v."""
CONFIGS = ("single_shot", "horizontal", "vertical", "sinusoidal", "all")


@dataclass(frozen=True)
class Frame:
    """A projected frame: ``step`` is n of a sinusoid (phase shift 2 pi n / N) or the Gray bit, 0 = most significant."""

    index: int
    kind: Kind
    direction: Direction | None = None
    step: int = 0

    @property
    def column(self) -> str:
        return f"frame_{self.index:02d}"

    @property
    def title(self) -> str:
        part = {"sinusoid": f"{self.direction} sinusoid, step {self.step}",
                "gray": f"{self.direction} Gray bit {self.step}"}.get(self.kind, self.kind)  # fmt: skip
        return f"{self.index}: {part}"


@dataclass(frozen=True)
class Sequence:
    """The frames of a capture: ``steps`` sinusoids and ``bits`` Gray-code frames per direction, black and white."""

    steps: int = 18
    bits_horizontal: int = 7
    bits_vertical: int = 7

    def __post_init__(self) -> None:
        if self.steps < 3:
            raise ValueError(f"a phase needs at least 3 steps, got steps={self.steps}")
        across, down = self.bits_horizontal, self.bits_vertical
        if not (1 <= across <= 15 and 1 <= down <= 15):
            raise ValueError(f"Gray bits must be 1 to 15 per direction, got {across} horizontal and {down} vertical")

    def __len__(self) -> int:
        return 2 * self.steps + self.bits_horizontal + self.bits_vertical + 2

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def bits(self, direction: Direction) -> int:
        return self.bits_horizontal if direction == "horizontal" else self.bits_vertical

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        described: list[tuple[Kind, Direction | None, int]]
        described = [("sinusoid", direction, n) for direction in DIRECTIONS for n in range(self.steps)]
        described += [("gray", direction, bit) for direction in DIRECTIONS for bit in range(self.bits(direction))]
        described += [("black", None, 0), ("white", None, 0)]
        return tuple(Frame(i, *d) for i, d in enumerate(described))

    def sinusoids(self, direction: Direction) -> range:
        """Frame indices of a direction's sinusoids, in the order of their phase shift."""
        first = 0 if direction == "horizontal" else self.steps
        return range(first, first + self.steps)

    def gray(self, direction: Direction) -> range:
        """Frame indices of a direction's Gray code, most significant bit first."""
        first = 2 * self.steps + (0 if direction == "horizontal" else self.bits_horizontal)
        return range(first, first + self.bits(direction))

    @property
    def black(self) -> int:
        return len(self) - 2

    @property
    def white(self) -> int:
        return len(self) - 1

    def config(self, name: str) -> tuple[int, ...]:
        """Frame indices of a dataset configuration (paper Section 5.4): see ``CONFIGS``."""
        horizontal, vertical = tuple(self.sinusoids("horizontal")), tuple(self.sinusoids("vertical"))
        frames = ((0,), horizontal, vertical, horizontal + vertical, tuple(range(len(self))))
        if name not in CONFIGS:
            raise ValueError(f"unknown configuration {name!r}; there are {', '.join(CONFIGS)}")
        return frames[CONFIGS.index(name)]


PAPER_SEQUENCE = Sequence()
