"""The report: which samples it shows, that its pictures hold the numbers they claim, and that text
stays text."""

import base64
import re
import statistics
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest
from chromium import Browser
from conftest import fpp_eval
from scored_dataset import make_dataset, write_description, write_predictions

from fpp_ml_bench.errors import DatasetError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.report.report_page import (
    CLIP_PERCENTILE,
    chosen_samples,
    errors_figure,
    sample_panels,
    write_report,
)
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.pictures import panel_figure
from fpp_ml_bench.style import figure_png

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def scored(dataset, tmp_path_factory):
    """Predictions of the whole set, the error growing from sample to sample, and their result."""
    folder = tmp_path_factory.mktemp("predictions")
    for number, sample in enumerate(dataset.samples("all")):
        depth = dataset.depth_mm(sample)
        np.save(
            folder / f"{sample}.npy", np.where(depth > 0, depth + 1 + number, 0).astype(np.float32)
        )
    write_description(folder, name="A <b>method</b>")
    return folder, evaluate(folder, dataset, "all")


def decoded(png: bytes) -> np.ndarray:
    """RGBA (H, W, 4) by OpenCV, which had no part in writing it."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def test_page_shows_the_best_the_median_and_the_worst(dataset, scored, tmp_path):
    folder, result = scored
    path = write_report(result, dataset, folder, tmp_path / "out")
    assert path == tmp_path / "out" / "index.html"
    text = path.read_text()
    samples = dataset.samples("all")
    headings = re.findall(r"<h3>(.*?): (.*?)</h3>", text)
    assert headings[0] == ("Best", samples[0]) and headings[-1] == ("Worst", samples[-1])
    assert ("Median", samples[round(0.5 * 7)]) in headings and len(headings) == 5
    assert len(re.findall(r'<img src="data:image/png;base64,[^"]+" alt="[^"]{20,}"', text)) == 1 + 5
    assert "A &lt;b&gt;method&lt;/b&gt;" in text and "<b>" not in text
    assert f"mean {statistics.fmean(range(1, 9)):.3f} mm" in text
    assert "95% interval" in text and "Every sample, the largest object MAE first" in text
    outside = [
        address
        for address in re.findall(r'(?:src|href)="([^"]*)"', text)
        if not address.startswith(("data:", "#"))
    ]
    assert (
        outside == []
        and path.read_bytes()
        == write_report(result, dataset, folder, tmp_path / "two").read_bytes()
    )


def test_few_samples_are_shown_once_each(scored):
    rows = scored[1].per_sample
    for count in range(1, 8):
        chosen = chosen_samples(rows[:count])
        names = [row.sample for _, row in chosen]
        assert len(set(names)) == len(names) == min(count, 5)
        assert names[0] == rows[0].sample and names[-1] == rows[count - 1].sample
    assert chosen_samples([]) == []


def test_panels_show_the_errors_they_claim():
    target = np.zeros((40, 40), np.float32)
    target[10:30, 10:30] = 1800
    rng = np.random.default_rng(0)
    error = np.zeros_like(target)
    error[10:30, 10:30] = rng.normal(0, 2, (20, 20))
    prediction = target + error
    prediction[0, 0] = 1799
    fringe = rng.integers(0, 255, target.shape).astype(np.uint8)
    panels = {
        title.partition(",")[0]: panel
        for title, *panel in sample_panels(fringe, target, prediction)
    }
    assert list(panels) == ["Fringe", "Truth", "Prediction", "Absolute error", "Signed error"]
    difference = prediction.astype(float) - target
    clip = np.percentile(np.abs(difference[10:30, 10:30]), CLIP_PERCENTILE)
    assert panels["Absolute error"][1:] == ["magma", 0.0, pytest.approx(clip, rel=1e-6)]
    assert panels["Signed error"][1:] == [
        "coolwarm",
        pytest.approx(-clip, rel=1e-6),
        pytest.approx(clip, rel=1e-6),
    ]
    visible = (target > 0) | (prediction > 0)  # a pixel predicted in the background is visible too
    for title, expected in (("Absolute error", np.abs(difference)), ("Signed error", difference)):
        np.testing.assert_array_equal(panels[title][0], np.where(visible, expected, np.nan))
    np.testing.assert_array_equal(panels["Truth"][0] > 0, target > 0)
    np.testing.assert_array_equal(panels["Fringe"][0], fringe)


@pytest.mark.parametrize("value", [0.0, 1800.0])
def test_flat_and_empty_samples_have_pictures(value):
    target = np.full((8, 8), value, np.float32)
    picture = figure_png(panel_figure(sample_panels(np.zeros((8, 8), np.uint8), target, target)))
    assert decoded(picture).shape[0] > 200


@pytest.mark.parametrize(
    "errors", [[1.0], [0.0, 0.0], [2.0, np.nextafter(2.0, 3)], [1e-320, 1e-300], [0.0, 1e30]]
)
def test_any_errors_have_a_figure(errors):
    image = decoded(errors_figure(errors, None))
    assert image.shape[0] > 200 and image[..., :3].min() < 100


@dataclass
class Counting:
    """A dataset that counts which samples are read."""

    inner: object
    read: list[str] = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.inner, name)

    def depth_mm(self, sample, column="depth"):
        self.read.append(sample)
        return self.inner.depth_mm(sample, column)


def test_only_shown_samples_are_read(dataset, scored, tmp_path):
    counting = Counting(dataset)
    write_report(scored[1], counting, scored[0], tmp_path)
    assert len(counting.read) == 5 == len(set(counting.read))


def test_what_was_not_scored_is_not_reported(dataset, scored, tmp_path):
    folder, result = scored
    other_dataset = make_dataset(tmp_path / "other", size=(40, 40))
    with pytest.raises(DatasetError, match="is not what was scored"):
        write_report(result, other_dataset, folder, tmp_path / "out")
    copy = write_predictions(tmp_path / "changed", dataset, "all", offset_mm=3.0)
    with pytest.raises(PredictionError, match="is not the file that was scored"):
        write_report(result, dataset, copy, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(SubmissionError, match="can't be written"):
        write_report(result, dataset, folder, tmp_path / "file")


def test_command_and_browser(dataset, tmp_path):
    folder = write_predictions(
        tmp_path / "p",
        dataset,
        offset_mm=1.0,
        noise_mm=2.0,
        name="</title><script>hacked = 1</script>",
    )
    assert fpp_eval(folder, dataset.path, "--report", tmp_path / "out") == 0
    page = tmp_path / "out" / "index.html"
    browser = Browser()
    try:
        for width, dark in ((1280, False), (390, True)):
            browser.open(page, width, 844, dark)
            assert browser.complaints() == [] and browser.requests() == [page.resolve().as_uri()]
            assert browser.run("document.documentElement.scrollWidth") <= width
            assert browser.run("typeof hacked") == "undefined"
            assert (
                browser.run("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
                is True
            )
            assert browser.run("document.images.length") == 1 + 4
    finally:
        browser.close()
    text = page.read_text()
    assert base64.b64decode(re.search(r"base64,([^\"]+)", text)[1])[:4] == b"\x89PNG"
