"""What the user of the pipeline may set: whose fringes are used, how many frames, and what may
decide their order."""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from fpp_ml_bench.coding.phase_shift import choose_steps
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction
from fpp_ml_bench.options import option

Prior = Literal["none", "standoff"]
PIXELWISE = 3
"""Frames from which on every pixel has a phase of its own: three equations for phase, modulation
and mean."""
PAIR_DEGREES = 120.0
"""Phase shift between two frames: that of the first two of three, so that a third frame completes
them."""
MIN_CONFIDENCE = "mask pixels of less confidence, 0 to 1 (default: 0, dense)"
DIRECTION = "direction of the fringes (default: horizontal)"
WHITE_GREY = (
    "for images without a lit background: grey level of a white pattern on a surface that faces "
    "the projector at the "
    "near end of the working range"
)
AMBIENT_GREY = (
    "for images without a lit background: grey level of a surface in ambient light alone (default: "
    "the image's darkest)"
)
"""Help of options that several methods have."""


@dataclass(frozen=True)
class Settings:
    """``direction`` of the fringes and how many ``frames`` of them, 1 to all that are projected;
    what the choice of the order may use: ``shading`` and ``prior`` ("standoff": objects are near
    the rig's standoff, true of fixed placement); ``min_confidence``: pixels below it are 0 (0:
    dense, every object pixel gets a depth). The defaults were chosen on train and validation
    objects. ``white_grey`` and ``ambient_grey``, if given, calibrate brightness (see `EmptyScene`);
    without them it is taken from the lit background, and where the image shows none, range and
    continuity settle the order, or it is ambiguous and has no depth (`order.margin_by_range`). Of
    these, crossed fringes use ``min_confidence`` alone.
    """

    direction: Direction = option("horizontal", DIRECTION)
    frames: int = option(1, "fringes of that direction, 1 to 18; no Gray code (default: 1)", "N")
    shading: bool = option(True, "choose the fringe order without brightness", flag="--no-shading")
    prior: Prior = option(
        "none",
        "standoff: assume that objects are near the rig's standoff, true of fixed placement "
        "(default: none)",
    )
    min_confidence: float = option(0.0, MIN_CONFIDENCE, "C")
    white_grey: float | None = option(None, WHITE_GREY, "GREY")
    ambient_grey: float | None = option(None, AMBIENT_GREY, "GREY")

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise PredictionError(
                f"direction {self.direction!r}: one fringe is {' or '.join(DIRECTIONS)}, not both"
            )
        if self.prior not in get_args(Prior):
            raise PredictionError(f"prior {self.prior!r}: expected {' or '.join(get_args(Prior))}")
        if not 0 <= self.min_confidence < 1:
            raise PredictionError(
                f"min_confidence {self.min_confidence!r}: expected 0 (dense) to below 1"
            )
        if self.white_grey is not None and not 0 < self.white_grey < np.inf:
            raise PredictionError(f"white_grey {self.white_grey!r}: expected more than 0")
        if self.ambient_grey is not None and not 0 <= self.ambient_grey <= GREY_LEVELS:
            raise PredictionError(
                f"ambient_grey {self.ambient_grey!r}: expected 0 to {GREY_LEVELS} grey levels"
            )


def steps_of(steps: int, frames: int) -> tuple[int, ...]:
    """Which of ``steps`` phase shifts ``frames`` of them are: 0 alone, 0 and a third, or
    `choose_steps`. Raises `PredictionError` for a number of frames that can't be had."""
    if (
        isinstance(frames, bool)
        or not isinstance(frames, int | np.integer)
        or not 1 <= frames <= steps
    ):
        raise PredictionError(
            f"frames {frames!r}: expected a whole number from 1 to the {steps} sinusoids of a "
            f"direction that were "
            "projected"
        )
    if frames < PIXELWISE:
        return (0, round(steps * PAIR_DEGREES / 360))[:frames]
    return choose_steps(steps, frames)
