"""The picture of what a method makes of one frame."""

import io

import numpy as np
import pytest
from PIL import Image
from rendering import RIG

from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.loaders import pictures
from fpp_ml_bench.loaders.pictures import front_picture

X, Y = RIG.camera.rays()
EXACT_MM = np.where(np.hypot(X, Y) < 0.12, 1800 + 400 * X, 0).astype(np.float32)
FRAME = np.where(EXACT_MM > 0, 120, 20).astype(np.uint8)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that become files."""
    figures, png = [], pictures.figure_png
    monkeypatch.setattr(
        pictures, "figure_png", lambda figure: (figures.append(figure), png(figure))[1]
    )
    return figures


def test_it_shows_frame_depth_error_and_points(drawn):
    depth_mm = np.where(EXACT_MM > 0, EXACT_MM + 2, 0).astype(np.float32)
    content = front_picture(FRAME, depth_mm, EXACT_MM, RIG, "one $ and _ more $")
    width, height = Image.open(io.BytesIO(content)).size
    assert 1400 <= width <= 1600 and 350 <= height <= 500 and len(content) < 300_000
    frame, depth, error = (axes.images[0] for axes in drawn[0].axes[:3])
    assert frame.get_array().max() == 255
    assert frame.get_array().shape == depth.get_array().shape == error.get_array().shape
    assert 0.3 < depth.get_array().count() / depth.get_array().size < 0.9  # cut to the object
    assert "object MAE 2.00 mm" in drawn[0].axes[2].get_title()
    assert error.get_clim() == (pytest.approx(-2), pytest.approx(2))
    np.testing.assert_allclose(error.get_array().compressed(), 2, atol=1e-3)


def test_no_answer_is_an_error_of_the_whole_depth(drawn):
    depth_mm, half = EXACT_MM.copy(), X > 0
    depth_mm[half] = 0
    front_picture(FRAME, depth_mm, EXACT_MM, RIG, "half")
    expected = EXACT_MM[half & (EXACT_MM > 0)].sum(dtype=np.float64) / (EXACT_MM > 0).sum()
    assert f"object MAE {expected:.2f} mm" in drawn[0].axes[2].get_title()
    error = drawn[0].axes[2].images[0]
    missing = error.get_array() > error.get_clim()[1]
    assert missing.sum() == (half & (EXACT_MM > 0)).sum()


def test_missing_pixels_have_a_colour_and_a_legend():
    drawn = pictures.panel_figure(
        [("error", np.array([[np.inf, 9.0, np.nan]]), "coolwarm", -1.0, 1.0)]
    )
    axes = drawn.axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["missing: no answer"]
    image = axes.images[0]
    colours = image.to_rgba(image.get_array())[0]
    np.testing.assert_allclose(colours[0], [0, 0xA6 / 255, 0x51 / 255, 1], atol=0.005)
    assert not np.allclose(colours[0], colours[1]) and colours[2, 3] == 0
    plain = pictures.panel_figure([("error", np.array([[1.0, 9.0]]), "coolwarm", -1.0, 1.0)])
    assert plain.axes[0].get_legend() is None


@pytest.mark.long
def test_an_answer_off_the_object_alone_and_none():
    other = np.where(EXACT_MM > 0, 0, 1700).astype(np.float32)
    assert front_picture(FRAME, other, EXACT_MM, RIG, "off").startswith(b"\x89PNG")
    assert front_picture(FRAME, EXACT_MM, EXACT_MM * 0, RIG, "no object").startswith(b"\x89PNG")
    with pytest.raises(CaptureError, match="all pixels are background"):
        front_picture(FRAME, EXACT_MM * 0, EXACT_MM, RIG, "none")
    with pytest.raises(CaptureError, match="expected finite"):
        front_picture(FRAME, EXACT_MM * np.nan, EXACT_MM, RIG, "NaN")
