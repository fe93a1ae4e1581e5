"""Point clouds to look at: what the page holds, the PLY file read by another program, and the page
in a browser."""

import base64
import io
import json
import os
import re
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh
from chromium import Browser
from conftest import fpp_bench, printed, refusal
from PIL import Image
from rendering import RIG

from fpp_ml_bench.errors import CaptureError
from fpp_ml_bench.loaders import cloud as cloud_module
from fpp_ml_bench.loaders.cloud import cloud_html, write_cloud

X, Y = RIG.camera.rays()
HOSTILE = "</script><script>hacked = 1</script>"


def _bowl() -> np.ndarray:
    """Depth float32 (H, W) in mm of a bowl, 0 around it."""
    radius = np.hypot(X, Y) / np.hypot(X, Y).max()
    return np.where(radius < 0.6, 1700 + 300 * radius**2, 0).astype(np.float32)


DEPTH_MM = _bowl()
GREY = np.linspace(0, 255, DEPTH_MM.size).reshape(DEPTH_MM.shape).astype(np.uint8)
THERE = DEPTH_MM > 0
POINTS_MM = np.stack([X * DEPTH_MM, Y * DEPTH_MM, DEPTH_MM], axis=-1)[THERE]


def held(page: bytes) -> dict:
    """The data of a page, with its positions in steps, int (N, 3), and its grey levels, uint8
    (N,)."""
    data = json.loads(re.search(r'id="cloud">(.*?)</script>', page.decode(), re.DOTALL)[1])
    data["places"] = (
        np.frombuffer(base64.b64decode(data["places"]), "<u2").reshape(-1, 3).astype(int)
    )
    data["greys"] = np.frombuffer(base64.b64decode(data["greys"]), np.uint8)
    return data


def test_page_holds_the_points():
    page = cloud_html("bowl", POINTS_MM, GREY[THERE])
    data = held(page)
    back = data["places"] * data["step_mm"] + data["first_mm"]
    assert np.abs(back - POINTS_MM).max() <= data["step_mm"] / 2 * (1 + 1e-9)
    assert data["step_mm"] == pytest.approx(np.ptp(POINTS_MM, axis=0).max() / 65535)
    np.testing.assert_array_equal(data["greys"], GREY[THERE])
    assert (
        f"{len(POINTS_MM):,} points in mm" in page.decode() and "one of every" not in page.decode()
    )
    assert b"http" not in page.replace(b"http-equiv", b"")


def test_page_says_that_it_leaves_points_out(monkeypatch):
    monkeypatch.setattr(cloud_module, "MOST_POINTS", 1000)
    page, every = cloud_html("bowl", POINTS_MM, GREY[THERE]), -(-len(POINTS_MM) // 1000)
    data = held(page)
    np.testing.assert_array_equal(data["greys"], GREY[THERE][::every])
    assert 500 < len(data["places"]) <= 1000
    assert f"Shown are {len(data['places']):,}: one of every {every}." in page.decode()


def test_one_point_and_a_hostile_title():
    page = cloud_html(HOSTILE, np.array([[1.0, 2.0, 3.0]]), np.array([7], np.uint8))
    assert held(page)["places"].tolist() == [[0, 0, 0]] and HOSTILE not in page.decode()


def test_files_are_read_back(tmp_path):
    paths = write_cloud(tmp_path / "new", "bowl", "A bowl", RIG, DEPTH_MM, GREY)
    assert [path.name for path in paths] == ["bowl.ply", "bowl.html"]
    read = trimesh.load(paths[0], process=False)
    np.testing.assert_allclose(read.vertices, POINTS_MM, atol=1e-3)
    np.testing.assert_array_equal(read.colors[:, 0], GREY[THERE])
    assert (
        b"\ncomment unit mm (millimetres); camera axes: x right, y down, z forward\n"
        in paths[0].read_bytes()
    )
    data = held(paths[1].read_bytes())
    np.testing.assert_array_equal(data["greys"], GREY[THERE])
    assert "<title>A bowl</title>" in paths[1].read_text()


@pytest.mark.parametrize(
    ("depth_mm", "grey", "said"),
    [
        (DEPTH_MM * 0, GREY, "all pixels are background .* no point to write"),
        (DEPTH_MM, GREY[:-1], "grey: expected real numbers of shape"),
    ],
)
def test_refused_maps(tmp_path, depth_mm, grey, said):
    with pytest.raises(CaptureError, match=said):
        write_cloud(tmp_path / "new", "bowl", "A bowl", RIG, depth_mm, grey)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("points_mm", "grey", "said"),
    [
        (np.zeros((0, 3)), np.zeros(0, np.uint8), "N > 0"),
        (np.full((4, 3), np.inf), np.zeros(4, np.uint8), "finite"),
        (np.zeros((4, 3)), np.zeros(4), "uint8"),
    ],
)
def test_refused_points(points_mm, grey, said):
    with pytest.raises(CaptureError, match=said):
        cloud_html("none", points_mm, grey)


@pytest.mark.long
def test_command(tiny, tmp_path):
    picture = tmp_path / "pictures" / "mug.png"
    said = printed(fpp_bench, f"show {tiny} mug_A0 --out {picture} --cloud")
    names = [picture, picture.with_suffix(".ply"), picture.with_suffix(".html")]
    assert said.splitlines()[-3:] == [str(name) for name in names]
    assert all(name.is_file() for name in names) and "mug_A0: exact depth" in names[2].read_text()
    assert len(trimesh.load(names[1]).vertices) == len(held(names[2].read_bytes())["places"]) > 50
    assert "expected a SAMPLE" in refusal(fpp_bench, "show", tiny, "--sheet --cloud")


@pytest.fixture(scope="module")
def browser():
    started = Browser()
    yield started
    started.close()


def _pixels(browser) -> np.ndarray:
    """What the canvas shows, uint8 (H, W, 3), after the next two frames."""
    browser.run(
        "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done))).then(() => "
        "1)"
    )
    address = browser.run("document.getElementById('view').toDataURL()")
    return np.asarray(
        Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")
    ).astype(int)


def _drawn(pixels: np.ndarray) -> np.ndarray:
    return (np.abs(pixels - pixels[0, 0]) > 8).any(axis=-1)


@pytest.mark.long
def test_page_in_a_browser(browser, tmp_path):
    width = 390
    (page := tmp_path / "bowl.html").write_bytes(cloud_html(HOSTILE, POINTS_MM, GREY[THERE]))
    browser.open(page, width, 844, dark=True)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run("document.getElementById('without').hidden") is True
    opened = _pixels(browser)
    assert 0.02 < _drawn(opened).mean() < 0.9
    # It opens coloured by depth and turned.
    assert np.ptp(opened, axis=-1).max() > 60
    assert browser.run("document.getElementById('scale').hidden") is False
    browser.click("#camera")
    assert np.abs(_pixels(browser) - opened).max() > 8
    browser.click("#grey")
    first = _pixels(browser)
    assert browser.run("document.getElementById('scale').hidden") is True
    # In the camera's view the bowl is round, and its darker half, with the first rows, is above.
    rows, columns = np.nonzero(_drawn(first))
    assert np.ptp(rows) == pytest.approx(np.ptp(columns), rel=0.1)
    top, bottom = (first[_drawn(first) & half].mean() for half in _halves(first, rows))
    assert top < bottom
    browser.run("document.getElementById('view').focus()")
    for key, text in (("ArrowLeft", ""), ("ArrowUp", ""), ("+", "+")):
        before = _pixels(browser)
        browser.key(key, text)
        assert np.abs(_pixels(browser) - before).max() > 8, key
    browser.key("r", "r")
    np.testing.assert_array_equal(_pixels(browser), first)
    browser.click("#depth")
    coloured = _pixels(browser)
    assert np.ptp(coloured, axis=-1).max() > 60 and np.ptp(first, axis=-1).max() < 16
    assert browser.run("document.getElementById('scale').hidden") is False
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run("typeof hacked") == "undefined"
    # The driver warns about what `_pixels` does, that pixels are read back.
    assert [line for line in browser.complaints() if "ReadPixels" not in line] == []
    assert browser.requests() == [page.resolve().as_uri()]


def _halves(pixels: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    upper = np.arange(len(pixels))[:, None] < (rows.min() + rows.max()) / 2
    return np.broadcast_to(upper, pixels.shape[:2]), np.broadcast_to(~upper, pixels.shape[:2])


@pytest.mark.long
def test_the_near_side_follows_the_pointer(browser, tmp_path):
    """A near point, bright, before a dark plane moves to the right with a drag to the right, and
    down with one down."""
    x, y = np.meshgrid(*2 * [np.linspace(-100, 100, 60)])
    plane = np.stack([x, y, x * 0 + 1800], axis=-1).reshape(-1, 3)
    knob = np.stack([x / 12, y / 12, x * 0 + 1650], axis=-1).reshape(-1, 3)
    grey = np.repeat(np.array([0, 255], np.uint8), len(plane))
    (page := tmp_path / "knob.html").write_bytes(
        cloud_html("knob", np.concatenate([plane, knob]), grey)
    )
    browser.open(page, 900, 844)
    browser.click("#camera")
    browser.click("#grey")

    def place() -> np.ndarray:
        return np.argwhere(_pixels(browser).min(axis=-1) > 200).mean(axis=0)

    start = place()
    box = browser.run("document.getElementById('view').getBoundingClientRect().toJSON()")
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def mouse(kind, across=0, down=0, **more):
        place = {"x": x + across, "y": y + down}
        browser.call("Input.dispatchMouseEvent", type=kind, **place, **more)

    mouse("mousePressed", button="left", clickCount=1)
    mouse("mouseMoved", 40, 30, button="left", buttons=1)
    mouse("mouseReleased", 40, 30, button="left", clickCount=1)
    row, column = place() - start
    assert column > 5 and row > 5
    before = _drawn(_pixels(browser)).sum()
    mouse("mouseWheel", deltaX=0, deltaY=-300)
    assert _wait(lambda: _drawn(_pixels(browser)).sum() > 1.2 * before)


def _wait(met, most_s: float = 5.0) -> bool:
    until = time.monotonic() + most_s
    while not met() and time.monotonic() < until:
        time.sleep(0.05)
    return met()


def test_without_webgl_the_page_says_so(browser, tmp_path):
    (tmp_path / "old.html").write_bytes(cloud_html("bowl", POINTS_MM, GREY[THERE]))
    source = "HTMLCanvasElement.prototype.getContext = () => null"
    script = browser.call("Page.addScriptToEvaluateOnNewDocument", source=source)["identifier"]
    browser.open(tmp_path / "old.html")
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)
    assert browser.run("document.getElementById('without').hidden") is False
    assert browser.run("document.getElementById('viewer').hidden") is True
    assert browser.complaints() == []


@pytest.mark.long
def test_axe_finds_nothing(browser, tmp_path):
    if os.environ.get("CI", "").lower() in ("1", "true"):
        import axe_core_python
    else:
        axe_core_python = pytest.importorskip("axe_core_python")
    axe = Path(axe_core_python.__file__).with_name("axe.min.js").read_text(encoding="utf-8")
    (page := tmp_path / "bowl.html").write_bytes(cloud_html("A bowl", POINTS_MM, GREY[THERE]))
    for width, dark in ((1280, False), (390, True)):
        browser.open(page, width, 844, dark)
        browser.click("#depth")
        browser.run(f"{axe}; 1")
        assert (
            browser.run("axe.run().then(r => r.violations.map(v => v.id + v.nodes[0].html))") == []
        )
