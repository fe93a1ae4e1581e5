"""The stated chance of a wrong order: calibrated, never denied where doubted, and 0 where there is
no other order."""

import numpy as np
import pytest

from fpp_ml_bench.baselines.learned.odds import (
    DOUBT,
    DOUBTED,
    Judged,
    Odds,
    chosen_odds,
    confident_shares,
    draw_reliability,
    margin_of,
    reliability,
    wrong_chance,
)


def judged(scale: float, group: str = "paper", seed: int = 0, count: int = 20000) -> Judged:
    """Orders that are wrong as often as logits ``scale`` times smaller would say."""
    random = np.random.default_rng([seed, int(10 * scale)])
    log_odds = random.uniform(0, 6, count)
    wrong = random.random(count) < 1 / (1 + np.exp(log_odds))
    logits = np.stack([np.zeros(count), scale * log_odds, np.full(count, -np.inf)]).astype(
        np.float32
    )
    return Judged(group, logits, np.ones(count, np.intp), wrong)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_a_network_that_is_too_sure_is_calmed(scale: float) -> None:
    views = [judged(scale, seed=seed) for seed in range(12)]
    odds = chosen_odds(views)
    assert odds.temperature == pytest.approx(scale, rel=0.25)
    assert abs(odds.offset) <= 0.25
    for stated, seen, share in reliability(views, odds):
        assert share < 0.02 or stated == pytest.approx(seen, rel=0.35, abs=0.002)


def test_a_light_in_which_orders_are_wrong_makes_pixels_doubted() -> None:
    easy, hard = judged(1.0), judged(3.0, "workshop")
    odds = chosen_odds([easy, hard])
    assert odds.doubted in DOUBTED and max(confident_shares([easy, hard], odds).values()) <= 0.0005
    stated = wrong_chance(hard.logits, hard.choice, odds)
    assert not ((stated > odds.doubted) & (stated < DOUBT)).any() and (stated >= DOUBT).any()
    assert confident_shares([easy, hard], Odds(odds.temperature, odds.offset))["workshop"] > 0.0005


def test_one_candidate_is_certain() -> None:
    logits = np.array([[-np.inf], [0.3], [-np.inf]], np.float32)
    chance = wrong_chance(logits, np.array([1]), Odds(2.0, 1.0, 0.0))
    assert chance[0] == 0 and margin_of(chance)[0] > 0.5
    assert margin_of(np.array([0.5, 0.7], np.float32)).tolist() == [0.0, 0.0]


def test_the_picture_is_drawn(tmp_path) -> None:
    draw_reliability(tmp_path / "reliability.png", [judged(1.0)], Odds())
    assert (tmp_path / "reliability.png").read_bytes().startswith(b"\x89PNG")
