"""The logarithmic scale on which a table draws the intervals of its rows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fpp_ml_bench.evaluation.metrics import RANK_KEY
from fpp_ml_bench.leaderboard.groups import Ranked

_CLIP, _MARGIN = 10, 1.05
"""An interval is drawn down to this part of its mean, and the scale goes on beyond its ends by this factor."""
_STEPS = (1,), (1, 3), (1, 2, 5), tuple(range(1, 10))


@dataclass(frozen=True)
class LogScale:
    """From ``low`` to ``high`` mm, logarithmic, the same for all rows of a table."""

    low: float
    high: float

    @classmethod
    def of(cls, rows: Sequence[Ranked]) -> "LogScale":
        """A scale that holds the means of ``rows``, and their intervals as far down as a part of the mean."""
        means = [(mean, row.interval(RANK_KEY) or (mean, mean)) for row in rows if (mean := row.value(RANK_KEY))]
        low = min((max(ends[0], mean / _CLIP) for mean, ends in means), default=1.0)
        return cls(low / _MARGIN, max((ends[1] for _, ends in means), default=1.0) * _MARGIN)

    def share(self, value_mm: float) -> float:
        """Where a value stands, from 0 at ``low`` to 1 at ``high``; beyond them, at the nearer end."""
        inside = min(max(value_mm, self.low), self.high)
        return math.log(inside / self.low) / math.log(self.high / self.low)

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place and label of the powers of ten on the scale; with multiples of them where it holds fewer than two."""
        powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        for steps in _STEPS:
            values = [step * 10.0**power for power in powers for step in steps]
            inside = [(self.share(value), f"{value:g}") for value in values if self.low <= value <= self.high]
            if len(inside) > 1:
                break
        return inside
