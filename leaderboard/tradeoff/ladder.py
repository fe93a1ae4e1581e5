"""A ladder: a stage of the package run on growing amounts (pixels, frames, rows), and the least time at each amount."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.leaderboard.tradeoff.clock import Rules
from fpp_ml_bench.leaderboard.tradeoff.growth import growth
from fpp_ml_bench.leaderboard.tradeoff.points import Growth

ROUNDS, LEAST_ROUNDS, LIMIT_S = 40, 2, 4.0
"""Rounds over all rungs, fewer (but two) once the seconds are used up. The least time of each rung counts: other work
on the machine can only add to it. Rounds spread a busy minute over all rungs."""

Stages = Mapping[str, float]


@dataclass(frozen=True)
class Rung:
    """``run`` does the work for an ``amount`` of input; it may return the seconds of its own stages."""

    amount: float
    run: Callable[[], Stages | None]


@dataclass(frozen=True)
class Ladder:
    """``stage`` over ``over`` (pixels, frames, objects or rows) at ``steps``; ``prepare(step, folder)`` makes a
    rung, which is not timed, with an empty ``folder`` of its own."""

    stage: str
    over: str
    steps: tuple[int, ...]
    prepare: Callable[[int, Path], Rung]

    @property
    def key(self) -> str:
        """Name of the ladder, unique in a run."""
        return f"{self.stage} over {self.over}"


def time_ladder(ladder: Ladder, rules: Rules | None = None) -> list[Growth]:
    """The growth of the ladder's stage and of each part of it that its runs time themselves, the slowest first.

    Runs time their parts by the wall clock, so parts are left out where ``rules`` use the processor clock.
    """
    rules = rules or Rules()
    with tempfile.TemporaryDirectory(prefix="fpp-bench-costs-") as folder:
        rungs = [ladder.prepare(step, _made_folder(Path(folder) / str(step))) for step in ladder.steps]
        least: list[dict[str, float]] = [{} for _ in rungs]
        for rung in rungs[:2]:  # compiled code and caches; also the second, because some code runs only on larger input
            rung.run()
        total_s = 0.0
        for number in range(ROUNDS):
            for rung, best in zip(rungs, least, strict=True):
                stages: list[Stages | None] = []
                run_s = rules.seconds_of(lambda: stages.append(rung.run()))  # noqa: B023  called at once
                total_s += run_s
                stage_seconds = (stages[0] or {}) if rules.clock == "wall" else {}
                parts = {f"{ladder.stage}: {part}": seconds for part, seconds in stage_seconds.items()}
                for name, seconds in {ladder.stage: run_s, **parts}.items():
                    best[name] = min(seconds, best.get(name, float("inf")))
            if number + 1 >= LEAST_ROUNDS and total_s > LIMIT_S * rules.limit_s / Rules.limit_s:
                break
    amounts = [rung.amount for rung in rungs]
    by_stage = {stage: [best[stage] for best in least if stage in best] for stage in least[0]}
    growths = [
        growth(stage, ladder.over, amounts, seconds) for stage, seconds in _complete_stages(by_stage, len(amounts))
    ]
    return sorted(growths, key=lambda stage_growth: -stage_growth.seconds[-1])


def _made_folder(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _complete_stages(least: Mapping[str, list[float]], rungs: int) -> Iterator[tuple[str, list[float]]]:
    """Stages that every rung has, with times that a clock can tell from 0."""
    for stage, seconds in least.items():
        if len(seconds) == rungs and min(seconds) > 1e-6:
            yield stage, seconds
