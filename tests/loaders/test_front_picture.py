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
def panels(monkeypatch):
    """What is drawn: title, image, colour map, ends."""
    drawn, draw = [], pictures._draw
    monkeypatch.setattr(pictures, "_draw", lambda axes, *panel: (drawn.append(panel), draw(axes, *panel)))
    return drawn


def test_it_shows_frame_depth_error_and_points(panels):
    depth_mm = np.where(EXACT_MM > 0, EXACT_MM + 2, 0).astype(np.float32)
    content = front_picture(FRAME, depth_mm, EXACT_MM, RIG, "one $ and _ more $")
    width, height = Image.open(io.BytesIO(content)).size
    assert 1400 <= width <= 1600 and 350 <= height <= 500 and len(content) < 300_000
    frame, depth, error = panels
    assert frame[1].max() == 255 and frame[1].shape == depth[1].shape == error[1].shape
    assert 0.3 < np.isfinite(depth[1]).mean() < 0.9  # cut to the object
    assert "object MAE 2.00 mm" in error[0] and error[3:] == (pytest.approx(-2), pytest.approx(2))
    np.testing.assert_allclose(error[1][np.isfinite(error[1])], 2, atol=1e-3)


def test_no_answer_is_an_error_of_the_whole_depth(panels):
    depth_mm, half = EXACT_MM.copy(), X > 0
    depth_mm[half] = 0
    front_picture(FRAME, depth_mm, EXACT_MM, RIG, "half")
    expected = EXACT_MM[half & (EXACT_MM > 0)].sum(dtype=np.float64) / (EXACT_MM > 0).sum()
    assert f"object MAE {expected:.2f} mm" in panels[2][0]
    missing = np.isposinf(panels[2][1])
    assert missing.sum() == (half & (EXACT_MM > 0)).sum()  # drawn in a colour of their own


def test_missing_pixels_have_a_colour_and_a_legend():
    drawn = pictures.panel_figure([("error", np.array([[np.inf, 9.0, np.nan]]), "coolwarm", -1.0, 1.0)])
    axes = drawn.axes[0]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["missing: no answer"]
    image = axes.images[0]
    colours = image.to_rgba(image.get_array())[0]
    np.testing.assert_allclose(colours[0], [0, 0xA6 / 255, 0x51 / 255, 1], atol=0.005)
    assert not np.allclose(colours[0], colours[1]) and colours[2, 3] == 0
    plain = pictures.panel_figure([("error", np.array([[1.0, 9.0]]), "coolwarm", -1.0, 1.0)])
    assert plain.axes[0].get_legend() is None


def test_an_answer_off_the_object_alone_and_none(panels):
    other = np.where(EXACT_MM > 0, 0, 1700).astype(np.float32)
    assert front_picture(FRAME, other, EXACT_MM, RIG, "off").startswith(b"\x89PNG")
    assert front_picture(FRAME, EXACT_MM, EXACT_MM * 0, RIG, "no object").startswith(b"\x89PNG")
    with pytest.raises(CaptureError, match="all pixels are background"):
        front_picture(FRAME, EXACT_MM * 0, EXACT_MM, RIG, "none")
    with pytest.raises(CaptureError, match="expected finite"):
        front_picture(FRAME, EXACT_MM * np.nan, EXACT_MM, RIG, "NaN")
