"""How far a row is from the best method that looks at nothing, or only at the nearest training image."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean

from fpp_ml_bench.baselines.registry import methods
from fpp_ml_bench.evaluation.metrics import RANK_KEY
from fpp_ml_bench.leaderboard.groups import Group, GroupKey, Ranked


def is_trivial(row: Ranked) -> bool:
    """Whether it is a row of a trivial method (`Method.trivial`) that was measured here; what others call their methods
    does not count."""
    method = methods().get(row.entry.row.submission.method)
    return method is not None and method.trivial and row.entry.all_checked


def more_than_trivial(groups: Sequence[Group]) -> list[Group]:
    """The groups that hold more than trivial rows, whose errors the others' ratios show; all where none does."""
    return [group for group in groups if not all(map(is_trivial, group.rows))] or list(groups)


def with_ratios(groups: Sequence[Group]) -> list[Group]:
    """``groups`` whose rows have their ``ratio``: object MAE over the smallest that a trivial row by the same rules has
    on the row's objects. Trivial rows need at most one frame, so they count in all classes; a row that is told
    something of the ground truth counts in the tracks that are told no less."""
    trivial: dict[tuple[object, ...], list[tuple[set[str], dict[str, float]]]] = {}
    for group in groups:
        for row in filter(is_trivial, group.rows):
            trivial.setdefault(_data(group.key), []).append((_given(group.key), row.object_means(RANK_KEY)))
    with_ratio = []
    for group in groups:
        means = [own for given, own in trivial.get(_data(group.key), []) if given <= _given(group.key)]
        with_ratio.append(replace(group, rows=tuple(replace(row, ratio=_ratio(row, means)) for row in group.rows)))
    return with_ratio


def _given(key: GroupKey) -> set[str]:
    """What of the ground truth the track's methods are told, in the words of `Track`."""
    return set(key.track.removeprefix("oracle ").split(" + ")) - {"metric"}


def _data(key: GroupKey) -> tuple[object, ...]:
    return key.data, key.size, key.split, key.target, key.mode, key.edge_band_px, key.protocol_version


def _ratio(row: Ranked, trivial: Sequence[Mapping[str, float]]) -> float | None:
    errors = row.object_means(RANK_KEY)
    means = [fmean(means[name] for name in errors) for means in trivial if errors and means.keys() >= errors.keys()]
    return fmean(errors.values()) / min(means) if means and min(means) > 0 else None
