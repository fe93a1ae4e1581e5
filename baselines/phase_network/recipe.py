"""The training recipe: every number that changes the result."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field
from typing import Any

from fpp_ml_bench.baselines.phase_network.windows import Variation
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.optics import DIRECTIONS, Direction


@dataclass(frozen=True)
class Recipe:
    """``steps`` of ``batch`` windows of ``window`` px; AdamW at ``rate``, after ``warm_up`` steps falling as a cosine.

    ``widths`` to ``bound_rad`` make the network; ``directions``: the fringes it learns from, one frame each;
    ``unions``: images that join several objects, made from each sample (see `samples`); ``weight_*``: of the losses;
    ``averaged``: decay of the weights' moving average, which is what the weights file holds.
    Raises `RecipeError` for values that train nothing.
    """

    name: str = "phase-net"
    steps: int = 5000
    batch: int = 6
    window: int = 160
    rate: float = 3e-3
    warm_up: int = 100
    decay: float = 1e-4
    averaged: float = 0.995
    seed: int = 42
    widths: tuple[int, ...] = (24, 32, 48, 64)
    fine: int = 14
    squeezed: int = 20
    order_widths: tuple[int, ...] = (32, 48, 64)
    bound_rad: float = math.pi / 2
    directions: tuple[Direction, ...] = DIRECTIONS
    unions: int = 1
    weight_order: float = 2.0
    weight_mask: float = 0.5
    weight_phase: float = 10.0
    validate_every: int = 500
    vary: Variation = field(default_factory=Variation)

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "window", "validate_every"):
            if not getattr(self, name) >= 1:
                raise RecipeError(f"{name} {getattr(self, name)!r}: expected 1 or more")
        if not 0 <= self.unions <= 100:
            raise RecipeError(f"unions {self.unions!r}: expected 0 to 100 for every sample")
        if not self.rate > 0 or not 0 <= self.averaged < 1:
            raise RecipeError(f"expected rate above 0 and averaged 0 to below 1, got {self.rate} and {self.averaged}")
        if not self.directions or any(direction not in DIRECTIONS for direction in self.directions):
            raise RecipeError(f"directions {self.directions}: expected some of {', '.join(DIRECTIONS)}")

    def rate_at(self, step: int) -> float:
        """Learning rate of step 0, 1, ..."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        progress = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))

    def to_dict(self) -> dict[str, Any]:
        """Plain mapping of everything."""
        return json.loads(json.dumps(asdict(self)))

    @property
    def digest(self) -> str:
        """Hex digest of everything."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()
