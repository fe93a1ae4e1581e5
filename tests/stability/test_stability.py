"""The stability cases: nothing fails here, and everything that should be able to fail does."""

import json

import numpy as np
import pytest
from conftest import fpp_bench, printed, refusal

from fpp_ml_bench.baselines.stability.cases import (
    CASES,
    GROUPS,
    Outcome,
    Row,
    all_cases,
    document,
    family,
    judge,
    run_cases,
    worst,
    write_report,
)
from fpp_ml_bench.errors import DecodeError, StabilityError
from fpp_ml_bench.evaluation.score.sample_scores import ErrorStats

pytestmark = pytest.mark.long


def cases_of(group, *families):
    cases = [case for case in all_cases([group]) if case.family in families]
    assert {case.family for case in cases} == set(families)
    return cases


def failing(rows):
    return {row.case.name: row.against for row in rows if row.verdict == "FAIL"}


@pytest.mark.parametrize("group", GROUPS)
def test_no_case_fails(group):
    rows = run_cases(all_cases([group], quick=True))
    assert not failing(rows)
    assert {row.verdict for row in rows} >= {"within"}


def case(run, expects="number"):
    def made_up():
        """x"""
        return run()

    family("made up", "made up", "1", against="x", bound="x", expects=expects)(made_up)
    return CASES.pop()


@pytest.mark.parametrize(
    "outcome, expects, verdict, says",
    [
        (Outcome(1.0, 2.0), "number", "within", ""),
        (Outcome(0.0, 0.0), "number", "within", ""),
        (Outcome(2.0, 1.0), "number", "FAIL", "exceeds its bound"),
        (Outcome(float("nan"), 1.0), "number", "FAIL", "exceeds its bound"),
        (Outcome(1.0, float("inf")), "number", "FAIL", "no finite error"),
        (Outcome(1.0, 2.0, flagged_share=0.5), "number", "FAIL", "refused 50.00%"),
        (Outcome(1.0, 2.0, flagged_share=0.5), "either", "within", ""),
        (Outcome(None), "number", "FAIL", "refused what can be computed"),
        (Outcome(None), "refusal", "flagged", ""),
        (Outcome(None), "either", "flagged", ""),
        (Outcome(0.0, 1.0), "refusal", "FAIL", "where there is none"),
    ],
)
def test_the_verdict(outcome, expects, verdict, says):
    judged = case(lambda: outcome, expects)
    row = Row(judged, outcome, judge(judged, outcome), 0.0)
    assert row.verdict is verdict and says in row.against


def test_the_worst_element_is_the_one_nearest_to_its_bound_and_nan_beats_them_all():
    assert worst([1.0, 5.0, 2.0], [1.1, 50.0, 100.0]).error == 1.0
    assert worst([1.0, 5.0], [1.0, 1.0], [False, True]) == Outcome(1.0, 1.0, flagged_share=0.5)
    assert np.isnan(worst([1.0, np.nan], 1.0).error)
    assert worst([np.nan, 1.0], 1.0, [True, True]).error is None


def test_a_crash_is_a_finding_and_not_the_end():
    row, of_another_kind = run_cases([case(lambda: 1 / 0), case(lambda: 1 / 0, "refusal")])
    assert row.verdict == of_another_kind.verdict == "FAIL" and "ZeroDivisionError" in row.against


def test_an_error_of_the_package_is_a_refusal():
    def refused():
        raise DecodeError("too dim")

    (row,) = run_cases([case(refused, "refusal")])
    assert row.verdict == "flagged" and row.outcome == Outcome(
        None, flagged_share=1.0, note="too dim"
    )
    assert run_cases([case(refused)])[0].against == "refused what can be computed: too dim"


def naive_float32(errors):
    """MAE and RMSE by a running float32 sum."""
    total, squares = (
        np.cumsum(np.abs(errors), dtype=np.float32)[-1],
        np.cumsum(errors**2, dtype=np.float32)[-1],
    )
    return ErrorStats(
        errors.size, float(total) / errors.size, float(np.sqrt(squares / errors.size))
    )


def break_metrics(monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.baselines.stability.scores.stats_of", naive_float32)
    return cases_of("metrics", "magnitude")


def break_arctangent(monkeypatch):
    def arctan(sine, cosine):
        return -np.arctan(sine / cosine)  # loses the quadrant

    monkeypatch.setattr("fpp_ml_bench.coding.phase_shift.minus_atan2", arctan)
    return cases_of("phase", "modulation, real frames", "gamma")


def break_interval(monkeypatch):
    monkeypatch.setattr(
        "fpp_ml_bench.baselines.stability.frames.minus_atan2", lambda y, x: -np.arctan2(y, x)
    )
    return cases_of("order", "arctangent")


def break_triangulation(monkeypatch):
    def in_single(rays, coordinate, rig, direction):
        x, u, device = np.float32(rays[0]), np.float32(coordinate), rig.projector
        bottom = u - np.float32(device.cx) - np.float32(device.fx) * x
        return (np.float32(device.fx * rig.t[0]) / bottom).astype(float) * 1000

    monkeypatch.setattr(
        "fpp_ml_bench.baselines.stability.geometry.depth_from_coordinate", in_single
    )
    return [
        member
        for member in cases_of("triangulation", "baseline and range")
        if member.parameters["direction"] == "vertical" and not member.parameters["ahead"]
    ]


def break_normalisation(monkeypatch):
    def in_single(depth, name, low, high):
        share = (np.float32(depth) - np.float32(low)) / (np.float32(high) - np.float32(low))
        return np.where(depth > 0, share, 0)

    monkeypatch.setattr("fpp_ml_bench.baselines.stability.scores.normalise", in_single)
    return cases_of("normalisation", "range from a file")


def break_instance_norm(monkeypatch):
    import torch
    from torch import nn

    class OnePass(nn.InstanceNorm2d):
        def forward(self, x):
            mean = x.mean((2, 3), keepdim=True)
            variance = (x * x).mean((2, 3), keepdim=True) - mean * mean  # may even be negative
            return (x - mean) / torch.sqrt(variance + self.eps)

    monkeypatch.setattr("fpp_ml_bench.baselines.stability.networks.InstanceNorm", OnePass)
    return cases_of("networks", "instance norm")


def break_guard(monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.decoding.decode.check_frames", lambda *_: None)
    return cases_of("phase", "dead frame")


def break_lens(monkeypatch):
    monkeypatch.setattr(
        "fpp_ml_bench.optics.pinhole._radial_start", lambda x, y, _: (x.copy(), y.copy())
    )
    missed = {"k1": 0.6, "k2": 0.9, "k3": -0.3, "p1": 0.0}
    return [member for member in cases_of("rig", "lens inverse") if member.parameters == missed]


@pytest.mark.parametrize(
    "broken",
    [
        break_metrics,
        break_arctangent,
        break_interval,
        break_triangulation,
        break_normalisation,
        break_instance_norm,
        break_guard,
        break_lens,
    ],
)
def test_code_that_is_broken_on_purpose_fails(broken, monkeypatch):
    assert failing(run_cases(broken(monkeypatch)))


def test_every_group_has_cases_that_say_what_they_are():
    cases = all_cases()
    assert {member.group for member in cases} == set(GROUPS)
    assert len({(member.group, member.name) for member in cases}) == len(cases)
    for member in cases:
        assert member.computes and member.reference and member.predicts and member.unit
    assert any(member.heavy for member in cases) and not any(
        member.heavy for member in all_cases(quick=True)
    )
    with pytest.raises(StabilityError, match="unknown group 'chance'"):
        all_cases(["chance"])


def test_the_report_says_what_failed(tmp_path):
    endless = Outcome(float("inf"), 1.0, note="<b>not bold</b>")
    made_up = [case(lambda: Outcome(2.0, 1.0)), case(lambda: endless)]
    rows = run_cases([*cases_of("order", "arctangent"), *made_up])
    data, picture = write_report(rows, tmp_path / "out")
    content = json.loads(data.read_text(encoding="utf-8"))
    assert content == json.loads(json.dumps(document(rows)))
    assert content["summary"]["all"]["FAIL"] == 2 and content["cases"][-1]["error"] == "inf"
    assert content["cases"][-2]["against"] == "error 2 exceeds its bound 1"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_command(tmp_path, capsys, monkeypatch):
    content = printed(fpp_bench, "stability", "--group", "normalisation", "--json", "-")
    assert json.loads(content)["summary"]["normalisation"]["FAIL"] == 0
    listed = printed(fpp_bench, "stability", "--group", "rig", "--list")
    assert "rig: intrinsic matrix (30)" in listed
    (tmp_path / "file").write_text("x")
    for words in (["--group", "rig", "--out", tmp_path / "file"], ["--group", "chance"]):
        assert refusal(fpp_bench, "stability", *words)
    broken = break_interval(monkeypatch)
    monkeypatch.setattr("fpp_ml_bench.cli.tradeoff.all_cases", lambda *_, **__: broken)
    assert fpp_bench("stability", "--group", "order") == 1
    assert "FAIL order: arctangent" in capsys.readouterr().out
