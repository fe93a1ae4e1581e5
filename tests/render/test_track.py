"""The track of rigs: what its rigs are, building it, predicting and scoring all of it."""

import math
from collections import Counter
from dataclasses import replace
from shutil import rmtree
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import fpp_bench, fpp_eval, printed, read_json, refusal

from fpp_ml_bench.design.rigs import broken_rule
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.result.parts import TrackScores
from fpp_ml_bench.evaluation.score.track import score_track
from fpp_ml_bench.evaluation.submission.prediction_files import REFUSED_FILE
from fpp_ml_bench.leaderboard.columns import rigs
from fpp_ml_bench.leaderboard.row_file import RowTrack, in_brief
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.track import TRACK_LIGHTS, TRACK_VIEWS, track
from fpp_ml_bench.loaders.storage.benchmark import TRACK, benchmark_sentence
from fpp_ml_bench.loaders.storage.manifest import datasets_below
from fpp_ml_bench.loaders.storage.store import DatasetFolder

SUBMISSION = """\
name: mine
method: mine
units: mm
frames_used: [0]
uses_ground_truth_range: false
seconds_per_sample: null
"""
NEAR = """\
import numpy as np
from fpp_ml_bench import Method
from fpp_ml_bench.errors import DatasetError, PredictionError

class Near(Method):
    name, title, frames_used = "near", "Near rigs alone", (0,)

    @classmethod
    def for_rig(cls, rig, **options):
        if rig.standoff_m > 0.58:
            raise PredictionError("near: sees no farther than 0.58 m")
        return cls(rig, **options)

    def predict(self, frames):
        return np.full(frames[0].shape, np.float32(500))
"""
SHRUNK = 2
"""Times that the images of the small track are smaller."""


def test_the_rigs_are_sixteen_that_a_lab_could_own():
    settings = track()
    assert len(settings) == 16 * len(TRACK_LIGHTS)
    assert list(settings) == list(TRACK.content)
    of_paper = [entry.rig for name, entry in settings.items() if name.endswith("paper")]
    assert len(set(of_paper)) == 16
    assert [broken_rule(rig) for rig in of_paper] == [None] * 16
    turns = [
        math.degrees(math.atan2(abs(place[1]), abs(place[0])))
        for place in (-rig.R.T @ rig.t for rig in of_paper)
    ]
    kinds = Counter("beside" if t < 10 else "above" if t > 80 else "oblique" for t in turns)
    assert kinds == {"beside": 6, "above": 6, "oblique": 4}
    assert 0.3 <= min(rig.standoff_m for rig in of_paper) < 0.45
    assert 2.0 < max(rig.standoff_m for rig in of_paper) <= 2.5
    assert {rig.camera.width for rig in of_paper} >= {640, 1280}
    assert any(any(rig.camera.distortion) for rig in of_paper)
    errors = [entry.stated_rig.calibration_px for entry in settings.values()]
    assert min(errors) == 0.1 and max(errors) <= 1 and errors.count(0.1) >= 16
    for name, entry in settings.items():
        assert entry.light.name == name.rsplit("-", 1)[1] and entry.views == TRACK_VIEWS
        assert len(entry.objects) == 6 and len(entry.rig.crossed) == 3


def test_the_preset_takes_no_settings_of_another(tmp_path):
    for words in ("--size 96", "--light hard", "--objects gear", "--seed 1"):
        said = refusal(fpp_bench, f"build --out {tmp_path}/no --preset rigs", words)
        assert f"{words.split()[0]}: the preset rigs has" in said
    assert not (tmp_path / "no").exists()


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Two rigs of the track with one object and smaller images."""
    folder = tmp_path_factory.mktemp("track") / "rigs"
    for name in ("rig-02-paper", "rig-14-workshop"):
        given = track()[name]
        rig = given.rig.scaled(given.rig.camera.width // SHRUNK)
        build(folder / name, replace(given, rig=rig, objects=("gear",)), workers=1)
    return folder


def _predict(small, below, error_mm: float) -> None:
    """Predictions that are ``error_mm`` too far."""
    for name, place in datasets_below(small).items():
        dataset, folder = DatasetFolder(place), below / name
        folder.mkdir(parents=True)
        for sample in dataset.samples("test"):
            depth_mm = dataset.depth_mm(sample, "depth_exact").copy()
            depth_mm[depth_mm > 0] += error_mm
            np.save(folder / f"{sample}.npy", depth_mm)
        (folder / "submission.yaml").write_text(SUBMISSION)


def test_a_track_is_no_dataset_and_its_datasets_are_named(small):
    with pytest.raises(DatasetError, match=r"holds 2 datasets and is none itself.*rig-02-paper"):
        DatasetFolder(small)


def test_a_track_is_scored_in_units_that_compare_between_rigs(small, tmp_path):
    _predict(small, tmp_path / "mine", 2.0)
    scores = score_track(tmp_path / "mine", datasets_below(small))
    assert scores.benchmark is None and scores.title == "no named track"
    assert scores.lights == ["paper", "workshop"]
    for name, row in scores.datasets.items():
        dataset = DatasetFolder(small / name)
        rig = dataset.rig
        assert row.mae_mm == pytest.approx(2.0, rel=1e-4)
        assert row.per_mille == pytest.approx(2.0 / rig.standoff_m, rel=1e-4)
        assert row.answered_per_mille == pytest.approx(row.per_mille, rel=1e-9)
        # How far the pattern moves on the ray of the principal point, by the projection's derivative.
        ray, z = np.array([0.0, 0.0, 1.0]), rig.standoff_m
        point, turned = rig.R @ (z * ray) + rig.t, rig.R @ ray
        slopes = [
            focal * (turned[axis] * point[2] - point[axis] * turned[2]) / point[2] ** 2 / 1000
            for axis, focal in enumerate(rig.projector.focal)
        ]
        assert row.projector_px == pytest.approx(2.0 * math.hypot(*slopes), rel=0.02)
        errors = [dataset.measured(sample)["gt_mae_mm"] for sample in dataset.samples("test")]
        assert row.of_decoded == pytest.approx(row.mae_mm / np.mean(errors), rel=1e-9)
        assert row.missing_share == row.invented_share == 0
    assert scores.worst("paper") == "rig-02-paper"


def test_a_refused_rig_has_its_reason_and_no_score(small, tmp_path):
    below = tmp_path / "mine"
    _predict(small, below, 2.0)
    for file in (below / "rig-02-paper").iterdir():
        file.unlink()
    with pytest.raises(PredictionError, match=r"rig-02-paper"):
        score_track(below, datasets_below(small))
    reason = "needs another projector" + 20 * ", which tells more of the depth"
    (below / "rig-02-paper" / REFUSED_FILE).write_text(f"{reason}\n")
    scores = score_track(below, datasets_below(small))
    assert scores.refused == {"rig-02-paper": reason}
    assert scores.lights == ["workshop"] and list(scores.datasets) == ["rig-14-workshop"]


def test_from_prediction_to_table_and_row(small, tmp_path):
    below, table, result = (tmp_path / name for name in ("crossed", "rigs.json", "result.json"))
    predict = f"predict crossed {small} --out {below}"
    assert "1 frame" in printed(fpp_bench, predict)
    assert "complete already" in printed(fpp_bench, predict)
    assert "rig-02-paper" in refusal(fpp_bench, predict, "--frames 3")
    one = f"{below}/rig-02-paper {small}/rig-02-paper"
    assert fpp_eval(one, f"--target depth_exact --json {result}") == 0
    said = printed(fpp_eval, f"{below} {small} --json {table} --into {result}")
    assert "worst, workshop: rig-14-workshop" in said
    scores = read_json(table)
    assert scores == read_json(result)["rigs"]
    assert scores["method"] == "crossed" and not scores["refused"]
    brief = in_brief(TrackScores.model_validate(scores))
    assert brief["per_mille"].keys() == scores["datasets"].keys()
    named = brief | {"benchmark": {"name": TRACK.name, "version": TRACK.version}}
    row = SimpleNamespace(rigs=RowTrack.model_validate(named | {"refused": ["rig-01-paper"]}))
    shown = rigs(SimpleNamespace(row=row, all_checked=True))
    assert shown == f"{brief['per_mille']['rig-02-paper']:.1f} (1 refused)"
    assert rigs(SimpleNamespace(row=SimpleNamespace(rigs=None), all_checked=True)) == "-"
    assert brief["mean"]["paper"]["per_mille"] == brief["worst_per_mille"]["paper"]
    assert fpp_eval(one, "--into", result) == 2
    assert "is of one dataset" in refusal(fpp_eval, f"{below} {small} --report {tmp_path}/page")


def test_a_method_that_cannot_be_for_a_rig_says_so(small, tmp_path):
    below, method = tmp_path / "near", tmp_path / "near.py"
    method.write_text(NEAR)
    said = printed(fpp_bench, f"predict {method}:Near {small} --out {below}")
    assert "rig-14-workshop: refused: near: sees no farther" in said
    assert (below / "rig-14-workshop" / REFUSED_FILE).is_file()
    assert "rig-14-workshop: refused. near: sees" in printed(fpp_eval, below, small)
    rmtree(below / "rig-02-paper")
    (below / "rig-02-paper").mkdir()
    (below / "rig-02-paper" / REFUSED_FILE).write_text("not in the mood")
    assert "refused every rig" in refusal(fpp_eval, below, small)
    assert fpp_bench(f"predict no-such-method {small} --out {tmp_path}/none") == 2
    assert not (tmp_path / "none").exists()


def test_a_dataset_of_the_track_with_other_content_is_warned_of(small, monkeypatch):
    manifest = DatasetFolder(small / "rig-02-paper").manifest
    assert benchmark_sentence(manifest)[0]
    given = track()["rig-02-paper"]
    stated = replace(
        manifest, settings=given.describe(), rig=given.stated_rig.to_dict(), stored="first_frames"
    )
    as_expected, sentence = benchmark_sentence(stated)
    assert not as_expected and "rig-02-paper of fpp-bench-rigs version 1" in sentence
    assert benchmark_sentence(replace(stated, content=TRACK.content["rig-02-paper"]))[0]
