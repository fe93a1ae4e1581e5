"""Settings of the phase route; the default values were chosen on train and validation objects."""

from dataclasses import dataclass
from typing import Literal

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.render import Lighting
from fpp_ml_bench.optics import DIRECTIONS, Direction

Prior = Literal["none", "standoff"]
PRIORS: tuple[Prior, ...] = ("none", "standoff")


@dataclass(frozen=True)
class Settings:
    """``direction`` of the fringes and how many ``frames`` of them, 1 to all that are projected; what the choice of
    the order may use: ``shading`` and ``prior``; ``min_confidence``: pixels below it are 0 (0: dense, every object
    pixel gets a depth).

    ``prior`` "standoff" assumes that objects are near the rig's standoff, which is true of fixed placement;
    "none" leaves only the working range. Windows are in image px per fringe period: of the first fit, of the second,
    of the last one to two frames, and of the slopes. Costs (no unit): ``shading_cost`` a pixel for each
    ``shading_spread`` of log brightness, up to ``shading_limit`` of them; ``prior_cost`` a pixel for each 100 mm;
    ``jump_rad``: a jump of phase between neighbours from which on it costs no more. ``slack_mm`` widens the working
    range for noise at its ends. ``white_grey`` and ``ambient_grey`` calibrate images that show no background (see
    `EmptyScene`).
    """

    direction: Direction = "horizontal"
    frames: int = 1
    shading: bool = True
    prior: Prior = "none"
    min_confidence: float = 0.0
    first_window: float = 0.35
    second_window: float = 0.27
    pair_window: float = 0.06
    slope_window: float = 0.13
    shading_cost: float = 0.003
    shading_spread: float = 0.1
    shading_limit: float = 3.0
    prior_cost: float = 0.002
    jump_rad: float = 2.5
    slack_mm: float = 15.0
    white_grey: float = Lighting.white_grey
    ambient_grey: float = Lighting.ambient_grey

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise PredictionError(f"direction {self.direction!r}: one fringe is {' or '.join(DIRECTIONS)}, not both")
        if self.prior not in PRIORS:
            raise PredictionError(f"prior {self.prior!r}: expected {' or '.join(PRIORS)}")
        if not 0 <= self.min_confidence < 1:
            raise PredictionError(f"min_confidence {self.min_confidence!r}: expected 0 (dense) to below 1")
        for name in (
            "first_window",
            "second_window",
            "pair_window",
            "slope_window",
            "jump_rad",
            "shading_spread",
            "white_grey",
        ):
            if not getattr(self, name) > 0:
                raise PredictionError(f"{name} {getattr(self, name)!r}: expected more than 0")
