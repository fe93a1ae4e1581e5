"""A logarithmic axis: the position of a value, and the round numbers along it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

_FACTORS = ((1,), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 7))


@dataclass(frozen=True)
class LogAxis:
    """From ``low`` to ``high`` (both above 0) onto ``start`` to ``end`` (px)."""

    low: float
    high: float
    start: float
    end: float

    @classmethod
    def around(cls, values: Sequence[float], start: float, end: float) -> "LogAxis":
        """An axis over all ``values`` with a margin at both ends, over at least a factor of 2."""
        low, high = min(values), max(values)
        margin = max(0.08 * math.log(high / low), 0.5 * (math.log(2) - math.log(high / low)), 0.05)
        return cls(low * math.exp(-margin), high * math.exp(margin), start, end)

    def at(self, value: float) -> float:
        """Position of ``value`` in px."""
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return self.start + (self.end - self.start) * share

    def ticks(self, most: int = 7) -> list[float]:
        """Round numbers on the axis, the densest choice of at most ``most``."""
        first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
        chosen: list[float] = []
        for factors in _FACTORS:
            candidates = [float(f"{factor}e{power}") for power in range(first, last + 1) for factor in factors]
            inside = [value for value in candidates if self.low <= value <= self.high]
            if len(inside) > most and chosen:
                break
            chosen = inside[:: max(1, math.ceil(len(inside) / most))]
        return chosen
