"""How a cost grows: the power p of seconds = c amount^p, its interval, and whether it is steeper than linear."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fpp_ml_bench.leaderboard.tradeoff.points import Growth

LINEAR_LIMIT = 1.3
"""Every stage goes through its input once, so its power should be 1, or less with a fixed cost. Input that no longer
fits the caches adds some tenths; a second loop over the input gives 2."""
TAIL_POINTS = 3
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Power:
    """``exponent`` p with its 95% interval ``low`` to ``high``; ``tail``: the exponent over the largest amounts alone,
    where a fixed cost no longer hides a steep term."""

    exponent: float
    low: float
    high: float
    tail: float


def fit_power(amounts: Sequence[float], seconds: Sequence[float]) -> Power:
    """Least squares of log seconds on log amount; the interval is Student's t over the residuals.

    Raises ValueError for fewer than three amounts, amounts that do not ascend, and values without a logarithm.

    >>> fit_power([1, 2, 4, 8], [3, 12, 48, 192]).exponent
    2.0
    """
    x, y = np.asarray(amounts, np.float64), np.asarray(seconds, np.float64)
    if len(x) < 3 or len(x) != len(y):
        raise ValueError(f"expected at least 3 amounts and as many times, got {len(x)} and {len(y)}")
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(y)) and np.all(x > 0) and np.all(y > 0)):
        raise ValueError(f"expected finite amounts and times above 0, got {list(amounts)} and {list(seconds)}")
    if np.any(np.diff(x) <= 0):
        raise ValueError(f"expected ascending amounts, got {list(amounts)}")
    x, y = np.log(x), np.log(y)
    slope, error = _slope(x, y)
    from scipy.special import stdtrit

    half = float(stdtrit(len(x) - 2, 0.5 + CONFIDENCE / 2)) * error
    tail, _ = _slope(x[-TAIL_POINTS:], y[-TAIL_POINTS:])
    return Power(round(slope, 10), slope - half, slope + half, round(tail, 10))


def _slope(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope of the line of least squares, and its standard error."""
    across = x - x.mean()
    total = float(across @ across)
    slope = float(across @ (y - y.mean())) / total
    residual = y - y.mean() - slope * across
    return slope, float(np.sqrt(residual @ residual / max(1, len(x) - 2) / total))


def growth(stage: str, over: str, amounts: Sequence[float], seconds: Sequence[float]) -> Growth:
    """The growth of ``stage`` over ``over`` with its flag, None where it is at most linear.

    A power above `LINEAR_LIMIT` is flagged, over all amounts or over the largest. Where the interval includes the
    limit, the flag says that the times do not prove it.
    """
    power = fit_power(amounts, seconds)
    flag = None
    if power.exponent > LINEAR_LIMIT:
        above_limit = power.low > LINEAR_LIMIT
        flag = "steeper than linear" if above_limit else "perhaps steeper than linear: times scatter, run it again"
    elif power.tail > LINEAR_LIMIT:
        flag = "steeper than linear at the largest amounts"
    return Growth(
        stage=stage, over=over, amounts=[float(a) for a in amounts], seconds=[float(f"{s:.4g}") for s in seconds],
        exponent=round(power.exponent, 3), low=round(power.low, 3), high=round(power.high, 3),
        tail=round(power.tail, 3), flag=flag,
    )  # fmt: skip
