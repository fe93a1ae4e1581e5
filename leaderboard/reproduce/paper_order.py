"""Which of the paper's orderings hold here: every pair of a table's rows, by object MAE, judged by number.

An ordering *holds* where the paired difference has the paper's sign and its 95% interval leaves 0 out, is *reversed*
where it has the opposite sign and leaves 0 out, and is *within noise* otherwise. The interval is that of
`fpp-eval compare`: differences sample by sample, resampled over objects.
"""

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.leaderboard.reproduce.lines import MAIN_KEY, Line, Scored

Verdict = Literal["holds", "within noise", "reversed"]


@dataclass(frozen=True)
class Ordering:
    """The paper reports a smaller object MAE for ``better`` than for ``worse``, by ``paper_gap_mm``.

    ``gap_mm`` is worse minus better here, the mean over samples, ``interval_mm`` its 95% interval (None with fewer than
    two objects). ``same_track`` is False where the two rows were told different things about the test samples.
    """

    better: str
    worse: str
    paper_gap_mm: float
    gap_mm: float
    interval_mm: tuple[float, float] | None
    same_track: bool

    @property
    def verdict(self) -> Verdict:
        if self.interval_mm is None or self.interval_mm[0] <= 0 <= self.interval_mm[1]:
            return "within noise"
        return "holds" if self.interval_mm[0] > 0 else "reversed"


def orderings(lines: Sequence[Line]) -> list[Ordering]:
    """Every pair of measured lines whose numbers in the paper differ, the paper's best first."""
    compared = sorted((line for line in lines if line.compared), key=_reported)
    judged = []
    for better, worse in combinations(compared, 2):
        gap = _reported(worse) - _reported(better)
        if gap == 0 or better.scored is None or worse.scored is None:
            continue
        differences, objects = paired(better.scored, worse.scored)
        if not differences:
            continue
        tracks = {line.entry.result.track for line in (better, worse) if line.entry is not None}
        judged.append(
            Ordering(
                better.label,
                worse.label,
                gap,
                statistics.fmean(differences),
                object_interval(differences, objects),
                len(tracks) == 1,
            )
        )
    return judged


def paired(first: Scored, second: Scored) -> tuple[list[float], list[str]]:
    """Second minus first in mm for each sample that both have a score of, and the samples' objects."""
    differences, objects = [], []
    for sample, (name, first_mm) in first.samples.items():
        second_mm = second.samples.get(sample, (name, None))[1]
        if first_mm is not None and second_mm is not None:
            differences.append(second_mm - first_mm)
            objects.append(name)
    return differences, objects


def _reported(line: Line) -> float:
    return (line.paper_mm or {})[MAIN_KEY]
