"""Flat planes: what a right, a collapsed and a template answer look like in the numbers."""

from types import SimpleNamespace

import numpy as np
import pytest

from fpp_ml_bench.baselines.diagnostics import flat_plane
from fpp_ml_bench.baselines.diagnostics.counterfactual import Counterfactual
from fpp_ml_bench.baselines.diagnostics.flat_plane import FlatPlane
from fpp_ml_bench.baselines.diagnostics.probe import ProbeSettings, save_finding, silent
from fpp_ml_bench.baselines.diagnostics.subjects import background_below, subject_of_method
from fpp_ml_bench.baselines.method import Answer
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.stability.cases import U32


def answering(dataset, answer, units="mm"):
    def predict(frames):
        return answer(frames).astype(np.float32)

    return SimpleNamespace(
        name="known",
        title="Known",
        units=units,
        answers_normalised=units == "normalised",
        predict=predict,
        answer=lambda frames: Answer(predict(frames)),
        uses_ground_truth_mask=False,
        frames_used=(51,),
        image_size=dataset.size,
        weights_sha256=None,
        network=None,
    )


@pytest.fixture(scope="module")
def decoded(opened):
    exact = subject_of_method(load_method("classical", opened.rig, direction="horizontal"), opened)
    return FlatPlane().run(exact, opened, ProbeSettings(quick=True), silent)


def test_the_exact_decoder_finds_every_plane(decoded, tmp_path):
    finding = decoded
    planes = finding.values["planes"]
    assert {row["distance_m"] for row in planes} == {1.6, 1.8, 2.0}
    assert {row["outline"] for row in planes} == {*flat_plane.SIDES, "power_drill_A0"}
    for row in planes:
        assert row["collapsed_share"] == 0 and row["mae_mm"] < 1
        assert row["mean_mm"] == pytest.approx(1000 * row["distance_m"], abs=0.5)
    assert (
        finding.values["objects"]["collapsed_share"] <= 0.02 and finding.values["range_mm"] is None
    )
    assert len(finding.figure.png) > 5000
    save_finding(tmp_path, "known", "key", finding, 1.0)


def test_background_everywhere_is_a_collapse(opened, monkeypatch):
    monkeypatch.setattr(flat_plane, "draw", lambda *arguments: None)
    background = answering(opened, lambda frames: np.full(frames[51].shape, 0.05), "normalised")
    finding = FlatPlane().run(background, opened, ProbeSettings(quick=True), silent)
    assert all(row["collapsed_share"] == 1 for row in finding.values["planes"])
    low, high = finding.values["range_mm"]
    records = [opened.measured(sample) for sample in opened.samples("test")]
    assert low == pytest.approx(np.mean([record["depth_min_mm"] for record in records]))
    assert high == pytest.approx(np.mean([record["depth_max_mm"] for record in records]))
    # The answer 0.05 is rounded to float32 once.
    assert finding.values["planes"][0]["mean_mm"] == pytest.approx(
        low + 0.05 * (high - low), abs=U32 * (high - low)
    )
    assert (
        finding.values["objects"]["collapsed_share"]
        == 1
        > finding.values["objects"]["collapsed_share_true"]
    )
    assert "100% of a rectangular plane" in finding.summary


def test_the_rectangle_grows_and_a_collapse_from_a_side_on_is_told(opened, monkeypatch):
    """A model that predicts background where less than half of its image is lit."""
    monkeypatch.setattr(flat_plane, "draw", lambda *arguments: None)
    half_lit = answering(
        opened, lambda frames: np.full(frames[51].shape, (frames[51] < 60).mean()), "normalised"
    )
    finding = FlatPlane().run(half_lit, opened, ProbeSettings(quick=True), silent)
    sizes = [row for row in finding.values["planes"] if row["outline"] in flat_plane.GROWING]
    height, width = opened.size
    assert len(sizes) == 9
    for side, row in zip((0.3, 0.45, 0.5, 0.6), sizes, strict=False):
        assert row["pixels"] == pytest.approx(side**2 * height * width, rel=0.05)
        assert (row["distance_m"], row["tilt_deg"]) == (1.8, [0.0, 0.0])
    shares = [row["collapsed_share"] for row in sizes]
    assert shares == sorted(shares) and {shares[0], shares[-1]} == {0, 1}


def test_collapse_is_nearer_to_background_than_to_any_object():
    values = np.array([-1.0, 0.0, 749.0, 751.0])
    assert (values < background_below(False, 1500.0)).tolist() == [True, True, True, False]
    assert (np.array([-1.2, 0.09, 0.11]) < background_below(True, 1500.0)).tolist() == [
        True,
        True,
        False,
    ]


def test_who_is_told_the_mask_is_not_asked(opened):
    masked = answering(opened, lambda frames: frames[51])
    masked.uses_ground_truth_mask = True
    assert (
        "uses the object's mask" in FlatPlane().applies_to(masked)
        and Counterfactual().applies_to(masked) is None
    )


def test_the_counterfactual_probe_reports_and_draws(opened, tmp_path):
    still = answering(opened, lambda frames: np.full(frames[51].shape, 1800.0))
    finding = Counterfactual().run(still, opened, ProbeSettings(quick=True), silent)
    assert finding.values["reliance"]["score"] == 0
    assert "does not follow the phase" in finding.summary
    assert len(finding.figure.png) > 5000
    save_finding(tmp_path, "known", "key", finding, 1.0)
