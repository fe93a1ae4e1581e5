"""Powers of costs: against closed forms and SciPy's regression, and what is flagged."""

import numpy as np
import pytest
from scipy import stats

from fpp_ml_bench.baselines.tradeoff import measure as tradeoff_measure
from fpp_ml_bench.baselines.tradeoff.ladders import Ladder, Rung
from fpp_ml_bench.baselines.tradeoff.measure import Rules, growth, time_ladder
from fpp_ml_bench.baselines.tradeoff.report import draw_growth, growth_csv

AMOUNTS = [10, 20, 40, 80, 160]


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_a_pure_power_is_found_exactly(power):
    fitted = growth("read", "rows", AMOUNTS, [3e-4 * n**power for n in AMOUNTS])
    assert fitted.exponent == fitted.tail == fitted.low == fitted.high == power


def test_slope_and_interval_are_those_of_least_squares():
    rng = np.random.default_rng(1)
    seconds = 2e-3 * np.array(AMOUNTS) ** 1.4 * np.exp(0.1 * rng.standard_normal(5))
    fitted = growth("read", "rows", AMOUNTS, list(seconds))
    line = stats.linregress(np.log(AMOUNTS), np.log(seconds))
    slope, half = line.slope, stats.t.ppf(0.975, 3) * line.stderr
    assert (fitted.exponent, fitted.low, fitted.high) == pytest.approx((slope, slope - half, slope + half), abs=6e-4)
    assert fitted.tail == pytest.approx(stats.linregress(np.log(AMOUNTS[2:]), np.log(seconds[2:])).slope, abs=6e-4)


def test_a_quadratic_shows_and_a_line_does_not():
    line = growth("read", "rows", AMOUNTS, [1e-3 * n for n in AMOUNTS])
    assert line.flag is None and line.exponent == 1.0
    assert growth("read", "rows", AMOUNTS, [1e-6 * n * n for n in AMOUNTS]).flag == "steeper than linear"
    hidden = growth("read", "rows", AMOUNTS, [0.01 + 1e-6 * n * n for n in AMOUNTS])
    assert hidden.exponent < 1 and hidden.flag is None  # the fixed cost still outweighs it everywhere
    late = growth(
        "read", "rows", [10, 20, 40, 80, 160, 320, 640], [0.01 + 1e-6 * n * n for n in (10, 20, 40, 80, 160, 320, 640)]
    )
    assert late.exponent < 1.3 and late.flag == "steeper than linear at the largest amounts"
    scattered = growth("read", "rows", AMOUNTS, [1e-3, 1e-3, 9e-3, 9e-3, 0.1])
    assert scattered.flag.startswith("perhaps") and scattered.low < 1.3


class World:
    """A clock that only the work moves; every third run is disturbed."""

    def __init__(self):
        self.now, self.runs = 0.0, 0

    def work(self, seconds):
        self.runs += 1
        self.now += seconds * (5 if self.runs % 3 == 0 else 1)


@pytest.fixture
def world(monkeypatch):
    clock = World()
    monkeypatch.setattr(tradeoff_measure, "perf_counter", lambda: clock.now)
    monkeypatch.setattr(tradeoff_measure, "process_time", lambda: clock.now)
    return clock


def quadratic(world, folders):
    def prepare(step, folder):
        assert folder.is_dir() and not any(folder.iterdir())
        folders.append(folder)

        def run():
            world.work(0.001 * step * step)
            return {"search": 0.0009 * step * step, "rest": 0.0001}

        return Rung(step, run)

    return Ladder("look up", "rows", (4, 8, 16, 32), prepare)


def test_a_ladder_takes_the_least_time_and_flags_a_nested_loop(world):
    folders = []
    stage, search, rest = time_ladder(quadratic(world, folders))
    assert stage.stage == "look up" and stage.over == "rows" and stage.amounts == [4, 8, 16, 32]
    assert stage.seconds == pytest.approx([0.016, 0.064, 0.256, 1.024]) and stage.flag == "steeper than linear"
    assert search.stage == "look up: search" and search.exponent == 2.0 and rest.exponent == 0.0 and rest.flag is None
    assert not any(folder.exists() for folder in folders)


def test_parts_are_the_walls_and_are_left_out_of_processor_time(world):
    assert [growth.stage for growth in time_ladder(quadratic(world, []), Rules(clock="processor"))] == ["look up"]


def test_csv_of_growth(world):
    growths = time_ladder(quadratic(world, []))
    lines = growth_csv(growths).splitlines()
    assert lines[0].startswith("stage,over,amount,seconds,exponent") and len(lines) == 1 + 3 * 4
    assert lines[1] == "look up,rows,4,0.016,2,2,2,2,steeper than linear"
    assert draw_growth([]) is None
