"""Least energy over candidates: exact on chains, close to the optimum on grids, compiled or not."""

from itertools import product

import numpy as np
import pytest

from fpp_ml_bench.baselines.phase import labels
from fpp_ml_bench.baselines.phase.labels import least_energy


def problem(shape: tuple[int, int], count: int, seed: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(seed)
    unary = random.uniform(0, 1, (count, *shape)).astype(np.float32)
    phase = (2 * np.pi * np.arange(count)[:, None, None] + random.normal(0, 0.7, shape)).astype(
        np.float32
    )
    links = [
        random.uniform(0, 0.6, (shape[0], shape[1] - 1)),
        random.uniform(0, 0.6, (shape[0] - 1, shape[1])),
    ]
    return unary, phase, links[0].astype(np.float32), links[1].astype(np.float32)


def energy(
    choice: np.ndarray, unary: np.ndarray, phase: np.ndarray, lx: np.ndarray, ly: np.ndarray
) -> float:
    pick = np.take_along_axis(phase, choice[None], 0)[0]
    total = np.take_along_axis(unary, choice[None], 0).sum()
    total += (np.minimum(np.abs(np.diff(pick, axis=1)), 1.5) * lx).sum()
    return float(total + (np.minimum(np.abs(np.diff(pick, axis=0)), 1.5) * ly).sum())


def best(*arrays: np.ndarray) -> float:
    count, *shape = arrays[0].shape
    every = product(range(count), repeat=int(np.prod(shape)))
    return min(energy(np.array(labels).reshape(shape), *arrays) for labels in every)


@pytest.mark.long
def test_chains_are_solved_exactly() -> None:
    for seed in range(5):
        for shape in ((1, 7), (7, 1)):
            arrays = problem(shape, 3, seed)
            choice, margin = least_energy(*arrays, limit_rad=1.5)
            assert abs(energy(choice, *arrays) - best(*arrays)) < 1e-5
            assert (margin >= 0).all()


def test_grids_come_within_two_percent_of_the_optimum() -> None:
    excess = []
    for seed in range(8):
        arrays = problem((3, 3), 2, seed)
        optimum = best(*arrays)
        excess.append(energy(least_energy(*arrays, limit_rad=1.5)[0], *arrays) / optimum - 1)
    assert min(excess) > -1e-5
    assert np.mean(excess) < 0.02


def test_a_weak_majority_wins_a_strongly_coupled_field() -> None:
    # What plain belief propagation gets wrong: 60% of 2,500 pixels prefer candidate 1 by a hair.
    random = np.random.default_rng(5)
    right = random.uniform(size=(50, 50)) < 0.6
    unary = np.stack([right * 0.02, ~right * 0.02]).astype(np.float32)
    phase = np.broadcast_to(np.array([0, 6.28], np.float32)[:, None, None], unary.shape).copy()
    choice, _ = least_energy(
        unary, phase, np.ones((50, 49), np.float32), np.ones((49, 50), np.float32), 2.5
    )
    assert (choice == 1).all()


@pytest.mark.parametrize("shape", [(6, 5), (1, 7), (7, 1), (13, 20)])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_compiled_code_gives_the_numbers_of_the_lines_it_was_made_from(
    shape: tuple[int, int], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = problem(shape, count, 11)
    for link in arrays[2:]:
        link[link < 0.1] = 0  # pixels that are not object
    results = [least_energy(*arrays, limit_rad=1.5)]
    for name in ("iterate", "decide", "_send"):
        monkeypatch.setattr(labels, name, getattr(labels, name).py_func)
    results.append(least_energy(*arrays, limit_rad=1.5))
    assert np.array_equal(results[0][0], results[1][0])
    assert np.array_equal(results[0][1], results[1][1])
    assert (
        not np.array_equal(results[0][0], arrays[0].argmin(axis=0)) or count == 1
    )  # smoothness had a say
