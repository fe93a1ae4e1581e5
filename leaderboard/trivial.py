"""How far a row is from the best method that looks at nothing, or only at the nearest training image."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from statistics import fmean

from fpp_ml_bench.baselines import TRIVIAL
from fpp_ml_bench.leaderboard.groups import Group, GroupKey, Ranked
from fpp_ml_bench.leaderboard.rows import LOCAL, MEASURED_HERE

_KEY = "object_mae_mm"


def is_trivial(row: Ranked) -> bool:
    """Whether it is a row of `TRIVIAL` that was measured here; what others call their methods does not count."""
    return row.entry.result.submission.method in TRIVIAL and row.entry.provenance in (MEASURED_HERE, LOCAL)


def more_than_trivial(groups: Sequence[Group]) -> list[Group]:
    """The groups that hold more than trivial rows, whose errors the others' ratios show; all where none does."""
    return [group for group in groups if not all(map(is_trivial, group.rows))] or list(groups)


def with_ratios(groups: Sequence[Group]) -> list[Group]:
    """``groups`` whose rows have their ``ratio``: object MAE over the smallest that a trivial row on the same data has
    on the row's objects. Trivial rows need at most one frame and are told nothing, so they count in all classes and
    tracks."""
    trivial: dict[tuple[object, ...], list[dict[str, float]]] = {}
    for group in groups:
        for row in filter(is_trivial, group.rows):
            trivial.setdefault(_data(group.key), []).append(row.object_means(_KEY))
    return [
        replace(group, rows=tuple(replace(r, ratio=_ratio(r, trivial.get(_data(group.key), []))) for r in group.rows))
        for group in groups
    ]


def _data(key: GroupKey) -> tuple[object, ...]:
    return key.fingerprint, key.size, key.split, key.target, key.edge_band_px, key.protocol_version


def _ratio(row: Ranked, trivial: Sequence[Mapping[str, float]]) -> float | None:
    errors = row.object_means(_KEY)
    means = [fmean(means[name] for name in errors) for means in trivial if errors and means.keys() >= errors.keys()]
    return fmean(errors.values()) / min(means) if means and min(means) > 0 else None
