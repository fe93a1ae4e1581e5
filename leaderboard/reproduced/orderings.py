"""Which of the paper's orderings hold here.

An ordering *holds* where the paired difference has the paper's sign and its 95% interval leaves 0 out, is *reversed*
where it has the opposite sign and leaves 0 out, and is *not decided* by these objects otherwise. The interval is
that of `fpp-eval compare`: differences sample by sample, resampled over objects.
"""

import statistics
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from fpp_ml_bench.baselines.reproduce import MAIN_KEY, AllFrames
from fpp_ml_bench.evaluation.score import object_interval
from fpp_ml_bench.leaderboard.reported import paper_tables
from fpp_ml_bench.leaderboard.reproduced.lines import Line
from fpp_ml_bench.leaderboard.row_file import view_means


@dataclass(frozen=True)
class Ordering:
    """The paper reports a smaller object MAE for ``better`` than for ``worse``, by ``paper_gap_mm``; here the mean over
    samples of worse minus better is ``gap_mm``, its 95% interval over ``objects`` objects ``interval_mm`` (None with
    fewer than two). ``same_track`` is False where the two rows were told different things about the test samples."""

    better: str
    worse: str
    paper_gap_mm: float
    gap_mm: float
    interval_mm: tuple[float, float] | None
    same_track: bool
    objects: int

    @property
    def verdict(self) -> Literal["holds", "not decided", "reversed"]:
        if self.interval_mm is None or self.interval_mm[0] <= 0 <= self.interval_mm[1]:
            return "not decided"
        return "holds" if self.interval_mm[0] > 0 else "reversed"


def orderings(lines: Sequence[Line]) -> list[Ordering]:
    """Every pair of measured lines whose numbers in the paper differ, the paper's best first."""
    compared = [
        (line.paper_mm[MAIN_KEY], line) for line in lines if line.scores is not None and line.paper_mm is not None
    ]
    judged = []
    for (better_mm, better), (worse_mm, worse) in combinations(sorted(compared, key=lambda c: c[0]), 2):
        difference = _difference(worse, better)
        if worse_mm == better_mm or difference is None:
            continue
        tracks = {line.entry.row.track for line in (better, worse) if line.entry is not None}
        gap, interval, objects = difference
        labels = better.label, worse.label
        judged.append(Ordering(*labels, worse_mm - better_mm, gap, interval, len(tracks) == 1, objects))
    return judged


def _difference(line: Line, other: Line) -> tuple[float, tuple[float, float] | None, int] | None:
    """Object MAE of ``line`` minus that of ``other``: mean over the samples of both, its 95% interval over objects, and
    how many objects; None where no sample is in both."""
    first, second = _errors(line), _errors(other)
    gaps = [
        (name, statistics.fmean(views) - statistics.fmean(second[name]))
        for name, views in first.items()
        if name in second
        for _ in views
    ]
    if not gaps:
        return None
    objects, differences = [name for name, _ in gaps], [gap for _, gap in gaps]
    return statistics.fmean(differences), object_interval(differences, objects), len(set(objects))


def _errors(line: Line) -> dict[str, list[float]]:
    """Object MAE of the views of each object; of a row, their mean for each view."""
    scores, errors = line.scores, dict[str, list[float]]()
    if isinstance(scores, AllFrames):
        views = [(sample.object, sample.metrics.object_mae_mm) for sample in scores.per_sample]
    else:
        views = list(view_means(scores.per_object, MAIN_KEY)) if scores is not None else []
    for name, mae_mm in views:
        if mae_mm is not None:
            errors.setdefault(name, []).append(mae_mm)
    return errors


def conclusion(table: str, lines: Sequence[Line]) -> str:
    """What the lines say, in a sentence: how many of the paper's orderings hold, or, in a table that the paper does not
    have, how far each line is from the first; "" where that is not known."""
    if table in paper_tables():
        return orderings_sentence(orderings(lines))
    said = []
    for line in lines[1:]:
        if (difference := _difference(line, lines[0])) is not None:
            gap, interval, objects = difference
            ends = "" if interval is None else f" (95% interval over {objects} objects {between(interval)})"
            said.append(f"{line.label} {gap:+.2f} mm{ends}")
    return f"Object MAE against {lines[0].label}, sample by sample: {'; '.join(said)}." if said else ""


def between(interval: tuple[float, float]) -> str:
    """Both ends of an interval, with their signs."""
    return " to ".join(f"{end:+.2f}" for end in interval)


def orderings_sentence(judged: Sequence[Ordering]) -> str:
    """How many of the paper's orderings hold, by the intervals of the paired differences, in a sentence."""
    if not judged:
        return "No two rows of the paper's have been measured here yet, so none of its orderings can be judged."
    count = Counter(ordering.verdict for ordering in judged)
    objects = max(ordering.objects for ordering in judged)
    return (
        f"The paper's pairwise orderings by object MAE, {len(judged)} among the rows measured here: {count['holds']} "
        f"hold, {count['reversed']} reversed, {count['not decided']} not decided by {objects} objects (the 95% "
        "interval of the paired difference holds 0)."
    )
