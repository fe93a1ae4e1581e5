"""The style of the pictures: it is applied to our own alone, and the bytes are the same each
time."""

import io

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from fpp_ml_bench.style import DPI, LINE_COLOURS, figure, figure_png, panels, styled, with_legend


@styled
def drawn(reduced: bool = False) -> bytes:
    picture = figure(2, 1)
    axes = picture.subplots()
    axes.plot([0, 1], [0, 1], lw=6)
    axes.set_axis_off()
    return figure_png(picture, reduced)


def test_a_picture_has_the_style_and_the_settings_stay():
    before = dict(matplotlib.rcParams)
    content = drawn()
    assert dict(matplotlib.rcParams) == before
    image = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
    assert image.shape == (DPI, 2 * DPI, 3)
    line = np.rint(255 * np.array(to_rgb(LINE_COLOURS[0])))
    assert (np.abs(image - line).max(axis=-1) <= 1).mean() > 0.02


def test_the_bytes_are_the_same_each_time_and_fewer_when_reduced():
    assert drawn() == drawn() and drawn(reduced=True) == drawn(reduced=True)
    assert len(drawn(reduced=True)) < len(drawn()) and b"matplotlib" not in drawn()


def test_a_legend_of_long_titles_is_in_the_picture():
    picture, (axes,) = panels(["one"], 1, 13, 2)
    for number in range(6):
        axes.plot(
            [0, 1],
            [0, number],
            label=f"{number}" + 4 * ", order by range and shading, nothing learned",
        )
    styled(with_legend)(picture, 3)
    legend, whole = picture.legends[0].get_window_extent(), picture.bbox
    assert whole.x0 <= legend.x0 and legend.x1 <= whole.x1


def test_line_colours_differ_to_everyone():
    """Every two differ in lightness or along the blue-yellow axis, which red-green blindness
    leaves."""
    rgb = np.array([to_rgb(colour) for colour in LINE_COLOURS])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    # What is seen without the red-sensitive cones (Vienot, Brettel and Mollon, 1999).
    seen = (
        linear @ np.array([[0.11238, 0.88762, 0], [0.11238, 0.88762, 0], [0.00401, -0.00401, 1]]).T
    )
    apart = np.abs(seen[:, None] ** (1 / 2.2) - seen[None] ** (1 / 2.2)).max(axis=-1)
    assert apart[~np.eye(len(rgb), dtype=bool)].min() > 0.08


# ---- a user's settings, and names


@styled
def titled(title):
    picture = figure(3, 2)
    axes = picture.subplots()
    axes.plot([1, 2, 3], [1e-3, 1, 1e3], label=title)
    axes.set(title=title, yscale="log", xlabel=title)
    return with_legend(picture, 1)


@pytest.mark.parametrize(
    "settings",
    [
        {"text.usetex": True},
        {"font.size": 30, "axes.facecolor": "red", "savefig.bbox": "tight", "savefig.dpi": 10},
    ],
)
def test_a_users_matplotlib_settings_change_no_picture_and_stay(settings):
    before = titled("a title")
    with matplotlib.rc_context(settings):
        assert titled("a title") == before
        assert {key: matplotlib.rcParams[key] for key in settings} == settings


@pytest.mark.parametrize("name", ["$x^{2$ and $", "100%", "x" * 300])
def test_a_name_is_no_formula(name):
    assert titled(name).startswith(b"\x89PNG")
