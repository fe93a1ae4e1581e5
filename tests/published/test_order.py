"""The frame order of a raw scan, determined from its images: all named orders, and exchanged
files."""

from itertools import combinations

import numpy as np
import pytest

from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published.order import (
    FrameOrder,
    all_orders,
    check_order,
    find_order,
    parse_order,
)
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE, Sequence

PAPER = FrameOrder()


@pytest.fixture(scope="module")
def scan(opened):
    """All 52 frames of a rendered view in the paper's order, and the rig that took them."""
    return opened.frames("power_drill_A60", range(52)), opened.rig


def test_the_papers_order_is_that_of_the_sequence():
    assert [frame.index for frame in PAPER.frames(PAPER_SEQUENCE)] == list(range(52))


def test_every_order_is_a_different_permutation_with_its_own_name():
    sequence = Sequence(steps=6, bits_horizontal=8, bits_vertical=7)
    orders = list(all_orders())
    permutations = {tuple(frame.index for frame in order.frames(sequence)) for order in orders}
    assert len(permutations) == len(orders) == 32
    assert all(sorted(indices) == list(range(len(sequence))) for indices in permutations)
    assert [parse_order(order.name) for order in orders] == orders and parse_order("auto") is None


@pytest.mark.parametrize("name", ["", "sideways", "paper+upside-down", "white-first", "Paper"])
def test_an_unknown_name_is_refused_with_the_list_of_names(name):
    with pytest.raises(LayoutError, match="vertical-first"):
        parse_order(name)


@pytest.mark.long
def test_every_named_order_is_found_on_the_images(scan):
    frames, rig = scan
    for order in all_orders():
        files = [frames[frame.index] for frame in order.frames(rig.sequence)]
        assert find_order(files, rig) == order


@pytest.mark.long
def test_any_two_exchanged_files_are_noticed_and_at_least_one_is_named(scan):
    frames, rig = scan
    for i, j in list(combinations(range(52), 2))[::5]:
        files = list(frames)
        files[i], files[j] = files[j], files[i]
        misfits = "; ".join(check_order(files, PAPER, rig))
        assert f"A_{i}.png" in misfits or f"A_{j}.png" in misfits, (i, j)


def test_a_repeated_file_is_noticed(scan):
    frames, rig = scan
    for i in (3, 20, 38, 45):
        files = list(frames)
        files[i] = files[i + 1]
        assert check_order(files, PAPER, rig), i


def test_images_without_any_pattern_fit_no_order():
    rng = np.random.default_rng(0)
    rig = paper_rig(64)
    for grey in (
        lambda: rng.integers(0, 256, (64, 64), np.uint8),
        lambda: np.full((64, 64), 90, np.uint8),
    ):
        assert find_order([grey() for _ in range(52)], rig) is None
