"""Object, background and depth-edge sets: on maps drawn by hand, and compared with SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import ndimage

from fpp_ml_bench.depth import (
    background_mask,
    depth_edges,
    edge_distance_px,
    edge_jump_mm,
    object_mask,
    object_near_edge,
)


def drawn(text):
    """One character per pixel: '.' background, digits are depth steps of 100 mm from 1500 mm."""
    return np.array([[0.0 if c == "." else 1500 + 100 * int(c) for c in line] for line in text.split()], np.float32)


def marked(text):
    return np.array([[c == "x" for c in line] for line in text.split()])


def test_object_is_depth_above_zero_and_the_rest_is_background():
    depth = np.array([[0.0, 1e-30, 1500.0, -0.0, np.nan, -5.0]], np.float32)
    assert object_mask(depth).tolist() == [[False, True, True, False, False, False]]
    assert (object_mask(depth) ^ background_mask(depth)).all()


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
    np.float32, st.tuples(st.integers(2, 14), st.integers(2, 14)), elements=st.sampled_from([0, 1500, 1505, 1900])
)


@settings(max_examples=150, deadline=None)
@given(maps)
def test_distance_is_scipys(depth):
    edge = depth_edges(depth, 50)
    distance = edge_distance_px(depth, 50)
    if not edge.any():
        assert np.isinf(distance).all()
    else:
        np.testing.assert_allclose(distance, ndimage.distance_transform_edt(~edge), atol=1e-3)  # OpenCV: float32 px


@settings(max_examples=150, deadline=None)
@given(maps, st.integers(0, 8))
def test_band_is_the_distance_cut_off(depth, band):
    expected = object_mask(depth) & (edge_distance_px(depth, 50) < band)
    np.testing.assert_array_equal(object_near_edge(depth, band, 50), expected)


@settings(max_examples=100, deadline=None)
@given(maps)
def test_edges_do_not_depend_on_orientation(depth):
    edge = depth_edges(depth, 50)
    np.testing.assert_array_equal(depth_edges(depth.T.copy(), 50), edge.T)
    np.testing.assert_array_equal(depth_edges(depth[::-1, ::-1].copy(), 50), edge[::-1, ::-1])
