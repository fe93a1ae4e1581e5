"""Least energy over candidates: exact on chains, close to the optimum on grids, compiled or not."""

from itertools import product

import numpy as np

from fpp_ml_bench.baselines.phase_route import label_kernels
from fpp_ml_bench.baselines.phase_route.labels import least_energy


def problem(shape: tuple[int, int], count: int, seed: int) -> tuple[np.ndarray, ...]:
    random = np.random.default_rng(seed)
    unary = random.uniform(0, 1, (count, *shape)).astype(np.float32)
    phase = (2 * np.pi * np.arange(count)[:, None, None] + random.normal(0, 0.7, shape)).astype(np.float32)
    links = [random.uniform(0, 0.6, (shape[0], shape[1] - 1)), random.uniform(0, 0.6, (shape[0] - 1, shape[1]))]
    return unary, phase, links[0].astype(np.float32), links[1].astype(np.float32)


def energy(choice: np.ndarray, unary: np.ndarray, phase: np.ndarray, lx: np.ndarray, ly: np.ndarray) -> float:
    pick = np.take_along_axis(phase, choice[None], 0)[0]
    total = np.take_along_axis(unary, choice[None], 0).sum()
    total += (np.minimum(np.abs(np.diff(pick, axis=1)), 1.5) * lx).sum()
    return float(total + (np.minimum(np.abs(np.diff(pick, axis=0)), 1.5) * ly).sum())


def best(*arrays: np.ndarray) -> float:
    count, *shape = arrays[0].shape
    every = product(range(count), repeat=int(np.prod(shape)))
    return min(energy(np.array(labels).reshape(shape), *arrays) for labels in every)


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
    choice, _ = least_energy(unary, phase, np.ones((50, 49), np.float32), np.ones((49, 50), np.float32), 2.5)
    assert (choice == 1).all()


def test_compiled_and_plain_lines_agree_to_rounding() -> None:
    arrays = problem((6, 5), 3, 11)
    unary, phase = (np.ascontiguousarray(a.transpose(1, 2, 0)) for a in arrays[:2])
    results = []
    kernel = label_kernels.iterate
    plain = getattr(kernel, "py_func", kernel)
    for run in (kernel, plain):
        messages = np.zeros((6, 5, 4, 3), np.float32)
        run(unary, phase, *arrays[2:], np.float32(1.5), 4, messages)
        results.append(messages)
    assert np.abs(results[0] - results[1]).max() < 1e-6
