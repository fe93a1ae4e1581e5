"""Pixel sets and depth edges, on maps drawn by hand; the paper's three depth representations
(Section 3.3), compared with float64, and the way back to mm."""

import numpy as np
import pytest
from edges import edge_distance_px
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fpp_ml_bench.depth import (
    NORMALISATIONS,
    denormalise,
    depth_edges,
    edge_jump_mm,
    extremes,
    normalise,
    object_box,
    object_mask,
    object_near_edges,
)


def drawn(text):
    """One character per pixel: '.' background, digits are depth steps of 100 mm from 1500 mm."""
    return np.array(
        [[0.0 if c == "." else 1500 + 100 * int(c) for c in line] for line in text.split()],
        np.float32,
    )


def marked(text):
    return np.array([[c == "x" for c in line] for line in text.split()])


def test_object_is_depth_above_zero():
    depth = np.array([[0.0, 1e-30, 1500.0, -0.0, np.nan, -5.0]], np.float32)
    assert object_mask(depth).tolist() == [[False, True, True, False, False, False]]


def test_extremes_are_those_of_every_block_and_carry_nan():
    # More than two blocks.
    values = np.random.default_rng(1).normal(0, 1, (300, 450)).astype(np.float32)
    expected = float(values.min()), float(values.max())
    for order in "CF":
        assert extremes(np.asarray(values, order=order)) == expected
    assert extremes(np.array([[np.inf, -np.inf]], np.float16)) == (-np.inf, np.inf)
    values[299, 449] = np.nan
    assert np.isnan(extremes(values)).all()


@pytest.mark.parametrize(
    ("pixels", "box"),
    [
        ([], None),
        ([(2, 3)], np.s_[1:4, 2:5]),
        ([(0, 0), (4, 6)], np.s_[0:6, 0:8]),
        ([(5, 7)], np.s_[4:7, 6:9]),
    ],
)
def test_the_box_is_one_pixel_around_the_object(pixels, box):
    inside = np.zeros((6, 8), bool)
    for pixel in pixels:
        inside[pixel] = True
    assert object_box(inside) == box


def test_outline_of_a_square():
    depth = drawn("...... .1111. .1111. .1111. ......")
    expected = marked(".xxxx. xxxxxx xx..xx xxxxxx .xxxx.")
    np.testing.assert_array_equal(depth_edges(depth, 50), expected)


def test_step_inside_an_object_marks_both_sides():
    depth = drawn("111333 111333 111333")
    np.testing.assert_array_equal(depth_edges(depth, 50), marked("..xx.. ..xx.. ..xx.."))
    assert not depth_edges(depth, 201).any()
    assert not depth_edges(depth, 200).any()  # above, not at, the jump
    assert depth_edges(depth, 199).any()


def test_background_zero_is_no_depth_of_its_own():
    """With a limit above the jump from object to background, the outline is still an edge."""
    assert depth_edges(drawn("..11 ..11"), 1e6).any()
    assert not depth_edges(drawn(".... ....")).any()


@pytest.mark.parametrize(("size", "jump"), [(960, 10.0), (480, 20.0), (176, 10 * 960 / 176)])
def test_default_jump_grows_with_the_pixel_footprint(size, jump):
    assert edge_jump_mm(size) == pytest.approx(jump)
    depth = np.full((4, size), 1800, np.float32)
    depth[:, size // 2 :] += jump + 0.01
    assert depth_edges(depth).sum() == 8
    depth[:, size // 2 :] -= 0.02
    assert not depth_edges(depth).any()


maps = arrays(
    np.float32,
    st.tuples(st.integers(2, 14), st.integers(2, 14)),
    elements=st.sampled_from([0, 1500, 1505, 1900]),
)


@settings(max_examples=150, deadline=None)
@given(maps, st.integers(0, 8))
def test_band_is_the_distance_cut_off(depth, band):
    expected = object_mask(depth) & (edge_distance_px(depth, 50) < band)
    np.testing.assert_array_equal(object_near_edges(depth, [band], 50)[0], expected)


def depth_map(low=1510.123, high=1987.654, shape=(40, 50)):
    rng = np.random.default_rng(0)
    depth = np.where(rng.random(shape) < 0.5, rng.uniform(low, high, shape), 0).astype(np.float32)
    inside = depth[depth > 0]
    return depth, float(inside.min()), float(inside.max())


def paper(depth_mm, name, low, high):
    """Section 3.3 in float64, background 0."""
    d = depth_mm.astype(np.float64)
    if name == "raw":
        return d
    if name == "global":
        return d / 1000
    return np.where(d > 0, (d - low) / (high - low), 0.0)


@pytest.mark.parametrize("name", NORMALISATIONS)
def test_is_the_papers_equation_up_to_rounding(name):
    depth, low, high = depth_map()
    normalised = normalise(depth, name, low, high)
    assert normalised.dtype == np.float32 and normalised.shape == depth.shape
    # At most two float32 roundings (the span, the quotient), 2**-24 each; the bound leaves a factor
    # of two.
    np.testing.assert_allclose(normalised, paper(depth, name, low, high), rtol=2**-22, atol=0)
    assert (normalised[depth == 0] == 0).all()


@pytest.mark.parametrize("name", NORMALISATIONS)
def test_way_back(name):
    depth, low, high = depth_map()
    back = denormalise(normalise(depth, name, low, high), name, low, high)
    assert back.dtype == np.float64
    inside = depth > 0
    # float32 roundings of 2**-24 each: none in raw, the quotient in global, span and quotient in
    # individual.
    error_mm = {"raw": 0, "global": 2**-24 * high, "individual": 2 * 2**-24 * (high - low)}[name]
    np.testing.assert_allclose(back[inside], depth[inside], rtol=1e-12, atol=error_mm)
    expected = low if name == "individual" else 0.0
    assert (back[~inside] == expected).all()  # paper Section 5.3.2: a predicted 0 becomes D_min


def test_flat_depth_map_is_defined():
    depth = np.array([[0, 1800.5], [1800.5, 0]], np.float32)
    normalised = normalise(depth, "individual", 1800.5, 1800.5)
    assert (normalised == 0).all()
    assert (denormalise(normalised, "individual", 1800.5, 1800.5) == 1800.5).all()


@pytest.mark.parametrize("name", NORMALISATIONS)
def test_out_buffer_is_filled_completely(name):
    depth, low, high = depth_map()
    out = np.full(depth.shape, np.nan, np.float32)
    assert normalise(depth, name, low, high, out=out) is out
    np.testing.assert_array_equal(out, normalise(depth, name, low, high))


@pytest.mark.parametrize(("low", "high"), [(np.nan, 2.0), (1.0, np.inf), (2000.0, 1500.0)])
@pytest.mark.parametrize("function", [normalise, denormalise])
def test_invalid_ranges_are_refused(function, low, high):
    with pytest.raises(ValueError, match="depth_min <= depth_max"):
        function(np.zeros((2, 2), np.float32), "individual", low, high)


def test_unknown_names():
    for function in (normalise, denormalise):
        with pytest.raises(ValueError, match="raw, global, individual"):
            function(np.zeros((2, 2), np.float32), "Individual", 1.0, 2.0)


@pytest.mark.parametrize("span", [0.0, 0.002, 600.0])
def test_individual_stays_between_zero_and_one_and_in_order(span):
    low, high = np.float32(1510.123), np.float32(1510.123 + span)
    depth = np.sort(
        np.random.default_rng(0).uniform(low, high, 1000).astype(np.float32).clip(low, high)
    )
    normalised = normalise(depth[None], "individual", float(low), float(high))
    assert ((normalised >= 0) & (normalised <= 1)).all()
    assert (np.diff(normalised[0]) >= 0).all()
