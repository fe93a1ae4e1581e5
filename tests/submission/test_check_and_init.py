"""``fpp-eval init`` and ``fpp-eval check``: a description to fill in, and a submission checked
without ground truth."""

import re

import numpy as np
import pytest
from conftest import fpp_eval, printed, refusal
from scored_dataset import write_description, write_predictions

from fpp_ml_bench.evaluation.submission.description import TEMPLATE, Submission, read_submission


def test_init_writes_a_description_that_is_read_and_never_overwrites(tmp_path):
    folder = tmp_path / "new" / "predictions"
    assert fpp_eval("init", folder) == 0
    assert read_submission(folder).name == "My method"
    (folder / "submission.yaml").write_text("mine")
    assert "is not overwritten" in refusal(fpp_eval, "init", folder)
    assert (folder / "submission.yaml").read_text() == "mine"
    assert fpp_eval("init", folder / "submission.yaml") == 2


def test_the_description_to_fill_in_names_every_key_and_each_is_valid(tmp_path):
    keys = re.findall(r"^(?:# )?([a-z_]+):", TEMPLATE, re.MULTILINE)
    assert sorted(keys) == sorted(Submission.model_fields)
    every = re.sub(r"^# (?=(  )?[a-z_]+:)", "", TEMPLATE, flags=re.MULTILINE)
    every = every.replace("seconds_per_sample: null", "seconds_per_sample: 0.5")
    (tmp_path / "submission.yaml").write_text(every)
    read = read_submission(tmp_path)
    assert (
        read.model_fields_set == set(Submission.model_fields)
        and read.learned_from.data == "train-split"
    )


def test_a_sound_submission(predictions, dataset, capsys):
    for arguments in ([], [str(dataset.path)]):
        assert fpp_eval("check", predictions, *arguments) == 0
        captured = capsys.readouterr()
        assert "4 samples" in captured.out and "40x32 px" in captured.out and captured.err == ""


def test_other_forms_are_checked_too(tmp_path, dataset):
    folder = write_predictions(tmp_path / "p", dataset)
    for path in folder.glob("*.npy"):
        np.savez(path.with_suffix(".npz"), depth=np.load(path))
        path.unlink()
    assert ".npz, 40x32 px" in printed(fpp_eval, "check", folder)


FAULTS = {
    "NaN": (
        lambda f: np.save(f / "power_drill_A0.npy", np.full((32, 40), np.nan, np.float32)),
        "1280 NaN",
    ),
    "a sigma alone": (
        lambda f: np.save(f / "power_drill_A0.sigma.npy", np.ones((32, 40))),
        "A60.sigma.npy: is miss",
    ),
    "extra": (lambda f: (f / "notes.txt").write_text("x"), "notes.txt: is extra"),
    "bad description": (lambda f: write_description(f, units="inch"), "units: Input should be"),
    "a scale without PNG": (lambda f: write_description(f, png_mm_per_level=0.1), "remove the key"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_are_named(case, predictions, capsys):
    change, message = FAULTS[case]
    change(predictions)
    assert fpp_eval("check", predictions) == 1
    captured = capsys.readouterr()
    assert message in captured.out and "Traceback" not in captured.err


def test_only_a_dataset_knows_names_and_frames(predictions, dataset, capsys):
    (predictions / "power_drill_A0.npy").rename(predictions / "mug_A0.npy")
    write_description(predictions, frames_used=[99])
    assert fpp_eval("check", predictions) == 0
    assert fpp_eval("check", predictions, dataset.path) == 1
    said = capsys.readouterr().out
    for part in (
        "power_drill_A0.npy: is missing",
        "a sample of split validation",
        "frames_used: expected indices",
    ):
        assert part in said


def test_units_that_look_wrong_are_a_note(predictions, capsys):
    write_description(predictions, units="m")
    assert fpp_eval("check", predictions) == 0
    assert "are these mm?" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nowhere", "empty"])
def test_what_holds_no_predictions_is_an_error(name, tmp_path):
    (tmp_path / "empty").mkdir()
    assert "expected" in refusal(fpp_eval, "check", tmp_path / name)


@pytest.mark.parametrize("word", ["init", "check", "compare"])
def test_a_folder_of_that_name_is_scored_by_its_path(word, dataset, tmp_path, monkeypatch):
    write_predictions(tmp_path / word, dataset)
    monkeypatch.chdir(tmp_path)
    assert fpp_eval(f"./{word}", dataset.path) == 0
