"""Scores that no errors have are told from those that some have, of a sample, of means over samples, and rounded."""

import math

import numpy as np
import pytest

from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS
from fpp_ml_bench.evaluation.result.model import over_samples
from fpp_ml_bench.evaluation.result.parts import AGREES, Metrics
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.leaderboard.row_file import _ROUNDED, ObjectMeans, _check_object, rounded

ROUNDS = 25
SIZE = (8, 9)
"""Small images, so that quantiles fall between few errors."""


def scores(rng, kind):
    """Scores and pixel counts of a random view: errors of a ``kind`` on a random object with void and unlit pixels."""
    inside = rng.random(SIZE) < rng.choice([0.02, 0.3, 0.9])
    inside[rng.integers(SIZE[0]), rng.integers(SIZE[1])] = True
    target = np.where(inside, 1800 + 40 * rng.random(SIZE), 0.0)
    spread = {
        "none": np.zeros(SIZE),
        "one wrong": np.where(rng.random(SIZE) < 0.05, 1000.0, 0.0),
        "normal": rng.normal(0, 2, SIZE),
        "heavy": rng.standard_cauchy(SIZE).clip(-1700, 1e6),
        "offset": np.full(SIZE, rng.choice([1.0, 5.0, 80.0])),
        "tiny": rng.random(SIZE) * 1e-200,
    }[kind]
    prediction = (target if kind != "tiny" else np.where(inside, 1e-200, 0.0)) + spread
    if kind == "tiny":
        target = np.where(inside, 1e-200, 0.0)
    prediction[rng.random(SIZE) < rng.choice([0.0, 0.2])] = 0.0
    void = rng.random(SIZE) < rng.choice([0.0, 0.3])
    unlit = np.where(void & ~inside, 1800.0, 0.0)
    sample = score_sample(prediction, target, 1, void, unlit)
    return sample.metrics(), sample.pixels()


def rounded_metrics(content, digits):
    return Metrics(**{key: content.get(key) for key in METRICS if key in content} | rounded(content, digits))


@pytest.mark.parametrize("kind", ["none", "one wrong", "normal", "heavy", "offset", "tiny", "mixed"])
def test_scores_of_any_errors_pass(kind):
    rng = np.random.default_rng(7)
    kinds = ["none", "one wrong", "normal", "heavy", "offset"]
    for _ in range(ROUNDS):
        views = [scores(rng, rng.choice(kinds) if kind == "mixed" else kind) for _ in range(rng.integers(1, 7))]
        for content, _pixels in views:
            assert Metrics(**content).problem(1, AGREES) is None
        means = over_samples([content for content, _ in views])
        assert Metrics(**means).problem(len(views), AGREES) is None
        assert rounded_metrics(means, 5).problem(len(views), _ROUNDED) is None
        counts = {name: [pixels[f"{name}_pixels"] for _, pixels in views] for name in ("object", "background", "void")}
        if all(map(sum, zip(*list(counts.values())[:2], strict=True))):
            part = ObjectMeans(
                object="thing",
                samples=len(views),
                **{f"{name}_pixels": sum(numbers) for name, numbers in counts.items()},
                **{f"without_{name}": counts[name].count(0) for name in ("object", "background")},
                **rounded({key: means[key] for key in HEADLINE}, 5),
            )
            _check_object(part, math.prod(SIZE))
