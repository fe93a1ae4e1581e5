"""A ladder: one stage of the package run on growing amounts of one thing, and the least time on each rung."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.leaderboard.tradeoff_clock import Rules
from fpp_ml_bench.leaderboard.tradeoff_growth import growth
from fpp_ml_bench.leaderboard.tradeoff_points import Growth

ROUNDS, LEAST_ROUNDS, LIMIT_S = 40, 2, 4.0
"""Rounds over all rungs, fewer (but two) once the seconds are spent. The least time of each rung counts: what else the
machine does can only add to it. Going round and round spreads a busy minute over all rungs instead of over one."""

Stages = Mapping[str, float]


@dataclass(frozen=True)
class Rung:
    """``amount`` of what grows, and ``run``, which does the work; it may return the seconds of its own stages."""

    amount: float
    run: Callable[[], Stages | None]


@dataclass(frozen=True)
class Ladder:
    """``stage`` over ``over`` (pixels, frames, objects or rows) at ``steps``; ``prepare(step, folder)`` makes a rung,
    outside the clock, with an empty ``folder`` of its own."""

    stage: str
    over: str
    steps: tuple[int, ...]
    prepare: Callable[[int, Path], Rung]

    @property
    def key(self) -> str:
        """Name of the ladder among all."""
        return f"{self.stage} over {self.over}"


def climb(ladder: Ladder, rules: Rules | None = None) -> list[Growth]:
    """The growth of the ladder's stage, the longest first, and of each part that its runs tell apart: parts come by the
    wall's clock, so they are left out where ``rules`` go by another."""
    rules = rules or Rules()
    with tempfile.TemporaryDirectory(prefix="fpp-bench-costs-") as folder:
        rungs = [ladder.prepare(step, _made(Path(folder) / str(step))) for step in ladder.steps]
        least: list[dict[str, float]] = [{} for _ in rungs]
        for rung in rungs[:2]:  # compiled code and caches; the second too, for some code is only met on larger input
            rung.run()
        spent = 0.0
        for number in range(ROUNDS):
            for rung, best in zip(rungs, least, strict=True):
                told: list[Stages | None] = []
                whole = rules.once(lambda: told.append(rung.run()))  # noqa: B023  called at once
                spent += whole
                apart = (told[0] or {}) if rules.clock == "wall" else {}
                parts = {f"{ladder.stage}: {part}": seconds for part, seconds in apart.items()}
                for name, seconds in {ladder.stage: whole, **parts}.items():
                    best[name] = min(seconds, best.get(name, float("inf")))
            if number + 1 >= LEAST_ROUNDS and spent > LIMIT_S * rules.limit_s / Rules.limit_s:
                break
    amounts = [rung.amount for rung in rungs]
    by_stage = {stage: [best[stage] for best in least if stage in best] for stage in least[0]}
    found = [growth(stage, ladder.over, amounts, seconds) for stage, seconds in _whole(by_stage, len(amounts))]
    return sorted(found, key=lambda one: -one.seconds[-1])


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _whole(least: Mapping[str, list[float]], rungs: int) -> Iterator[tuple[str, list[float]]]:
    """Stages that every rung has, in times that a clock can tell from 0."""
    for stage, seconds in least.items():
        if len(seconds) == rungs and min(seconds) > 1e-6:
            yield stage, seconds
