"""Timing on a shared machine: warm-up, bounded runs, spread, and the machine's pace beside each setting."""

import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter, process_time
from typing import Literal, get_args

import numpy as np

PACE_VALUES = 100_000
"""Numbers that the pace is measured with: about 10 ms of sorting and arctangents, in and out of the cache."""
PACE_RUNS = 5

Clock = Literal["wall", "processor"]
CLOCKS: tuple[Clock, ...] = get_args(Clock)


@dataclass(frozen=True)
class Rules:
    """``threads`` that a method may use; timed ``runs`` of each setting, fewer (but ``least``) once ``limit_s`` is used
    up; ``warm_up`` runs, which are not timed, come first.

    ``clock``: wall-clock time, or the time that processors worked for this process. For a single thread that waits for
    nothing both agree on an idle machine; on a shared machine only processor time stays the same.
    """

    clock: Clock = "wall"
    threads: int = 1
    runs: int = 15
    least: int = 3
    limit_s: float = 3.0
    warm_up: int = 2

    def extended(self, seconds: list[float], call: Callable[[], object]) -> list[float]:
        """``seconds`` and those of further runs of ``call``, as many as these rules ask for. A run longer than the
        limit is not repeated."""
        seconds = list(seconds)
        while len(seconds) < self.runs and (len(seconds) < self.least or sum(seconds) < self.limit_s):
            if seconds and min(seconds) > self.limit_s:
                break
            seconds.append(self.seconds_of(call))
        return seconds

    def seconds_of(self, call: Callable[[], object]) -> float:
        """Seconds of a single run of ``call``."""
        clock = perf_counter if self.clock == "wall" else process_time
        started = clock()
        call()
        return clock() - started


def pace_ms(rules: Rules) -> float:
    """Milliseconds that a fixed piece of work takes now, the median of a few runs.

    Times of two settings are comparable where their paces agree: other load, clock frequency and temperature of the
    machine change the pace.
    """
    values = np.random.Generator(np.random.PCG64(7)).random(PACE_VALUES)

    def work() -> None:
        np.arctan2(np.sort(values), values)

    return 1000 * statistics.median(rules.seconds_of(work) for _ in range(PACE_RUNS))


def load() -> float | None:
    """The system's load average over the last minute; None where the system does not provide it."""
    try:
        return round(os.getloadavg()[0], 2)
    except OSError:
        return None


def spread(seconds: list[float]) -> tuple[float, float, float]:
    """Median, 5th and 95th percentile, four significant digits each."""
    low, middle, high = (float(f"{float(np.percentile(seconds, q)):.4g}") for q in (5, 50, 95))
    return middle, low, high
