"""Which row of a table is behind which: paired differences over the objects that two rows share, a sign-flip test of
each pair, Holm's correction over all pairs of the table, and the ranks that follow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import fmean

from fpp_ml_bench.evaluation.score import SIGNIFICANT, Interval, holm, object_interval, sign_flip_p


@dataclass(frozen=True)
class Pair:
    """Two rows by their short names, the smaller error first: the mean of second minus first over the ``objects`` that
    both have (at least 0), its 95% interval, the sign-flip test's p value, and that value after Holm's correction over
    all pairs of the table. ``behind``: whether the second is behind the first, the corrected value being at most 5%."""

    first: str
    second: str
    objects: int
    difference: float
    interval: Interval | None
    p: float
    p_holm: float
    behind: bool


def pairs(errors: Mapping[str, Mapping[str, float]]) -> list[Pair]:
    """Every pair of the rows by name, whose errors by object are ``errors``; smaller is better."""
    compared = []
    for first, second in combinations(errors, 2):
        shared = [name for name in errors[first] if name in errors[second]]
        differences = [errors[second][name] - errors[first][name] for name in shared]
        if differences and fmean(differences) < 0:
            first, second, differences = second, first, [-value for value in differences]
        compared.append((first, second, shared, differences, sign_flip_p(differences)))
    adjusted = holm([p for *_, p in compared])
    return [
        Pair(
            first, second, len(shared), fmean(differences) if differences else 0.0,
            object_interval(differences, shared), p, p_holm, p_holm <= SIGNIFICANT,
        )
        for (first, second, shared, differences, p), p_holm in zip(compared, adjusted, strict=True)
    ]  # fmt: skip


def rank_ranges(names: Sequence[str], tested: Sequence[Pair]) -> dict[str, tuple[int, int]]:
    """Best and worst rank of each of the ``names`` that the pairs allow. Best: 1 and the number of rows that it is
    behind. Worst: the number of all rows without those behind it."""
    behind = [(pair.first, pair.second) for pair in tested if pair.behind]
    return {
        name: (1 + sum(second == name for _, second in behind), len(names) - sum(first == name for first, _ in behind))
        for name in names
    }
