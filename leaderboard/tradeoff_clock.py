"""Timing on a machine that others use too: warm-up, bounded runs, spread, and the machine's own pace beside each."""

import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Literal, get_args

import numpy as np

PACE_VALUES = 100_000
"""Numbers that the pace is taken on: about 10 ms of sorting and arctangents, in and out of the cache."""
PACE_RUNS = 5

Clock = Literal["wall", "processor"]
CLOCKS: tuple[Clock, ...] = get_args(Clock)


@dataclass(frozen=True)
class Rules:
    """``threads`` a method may use; ``runs`` timed ones a setting, fewer (but ``least``) once ``limit_s`` is spent;
    ``warm_up`` runs before that do not count.

    ``clock``: the wall's, or the time that processors worked for this process. On one thread that waits for nothing
    the two are the same on an idle machine, and only the second stays the same on one that others use too.
    """

    clock: Clock = "wall"
    threads: int = 1
    runs: int = 15
    least: int = 3
    limit_s: float = 3.0
    warm_up: int = 2

    def extended(self, taken: list[float], call: Callable[[], object]) -> list[float]:
        """``taken`` and further runs of ``call``, as many as these rules want; one that takes longer than the limit is
        not repeated."""
        taken = list(taken)
        while len(taken) < self.runs and (len(taken) < self.least or sum(taken) < self.limit_s):
            if taken and min(taken) > self.limit_s:
                break
            taken.append(self.once(call))
        return taken

    def once(self, call: Callable[[], object]) -> float:
        """Seconds of one run."""
        now = perf_counter if self.clock == "wall" else process_time
        started = now()
        call()
        return now() - started


def pace_ms(rules: Rules) -> float:
    """Milliseconds that a fixed piece of work takes right now, the median of a few runs.

    Two settings are comparable where it is the same beside both: what else the machine does, its clock and its
    temperature show in it.
    """
    values = np.random.Generator(np.random.PCG64(7)).random(PACE_VALUES)

    def work() -> None:
        np.arctan2(np.sort(values), values)

    return 1000 * statistics.median(rules.once(work) for _ in range(PACE_RUNS))


def load() -> float | None:
    """The system's load average over the last minute; None where it does not tell."""
    try:
        return round(os.getloadavg()[0], 2)
    except OSError:
        return None


def spread(seconds: list[float]) -> tuple[float, float, float]:
    """Median, 5th and 95th percentile, four significant digits each."""
    low, middle, high = (float(f"{float(np.percentile(seconds, q)):.4g}") for q in (5, 50, 95))
    return middle, low, high
