"""Commands made of functions and dataclasses: what the command line gives, what it refuses, and
methods of a user."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
import pytest
import yaml
from conftest import fpp_bench, fpp_eval, printed, read_json, refusal
from scored_dataset import make_dataset, write_description, write_predictions

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.cli import run_command
from fpp_ml_bench.cli.options import WORKING_RANGE, command, command_line, given, names, value
from fpp_ml_bench.options import (
    REQUIRED,
    argument,
    described,
    did_you_mean,
    flag_of,
    option,
    options_of,
)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Settings in a section of their own."""

    HEADING = "lens"
    focal: float = option(8.0, "focal length", "MM")
    kind: str = option("wide", "kind of lens", choices=("wide", "tele"))
    sharp: bool = option(True, "use a dull one", flag="--dull")


@command("fpp-bench shoot mug --out x\n")
def shoot(
    *,
    subject: str = argument("what to shoot", "SUBJECT"),
    frames: tuple[int, ...] = argument("frame numbers", "N", (), many=True),
    out: Path = option(REQUIRED, "where to", "DIR"),
    count: int = option(2, "how many", "N"),
    near: "tuple[float, float] | None" = option(None, "range", "NEAR,FAR", parse=WORKING_RANGE),
    mesh: tuple[Path, ...] = option((), "meshes", "FILE", parse=Path, many=True),
    json: Path | None = option(None, "write it here", "FILE"),
    lens: Lens,
) -> None:
    """Shoot a picture.

    What the help leaves out."""
    found = {"subject": subject, "frames": frames, "out": str(out), "count": count, "near": near}
    found |= {
        "mesh": [str(path) for path in mesh],
        "focal": lens.focal,
        "kind": lens.kind,
        "sharp": lens.sharp,
    }
    if json is not None:
        json.write_text(globals()["json"].dumps(found))
    print(found, given(lens, Lens), command_line())


def shot(capsys, words):
    status = run_command(lambda: shoot, "fpp-bench shoot", words.split())
    captured = capsys.readouterr()
    return status, captured.out if status == 0 else captured.err


def test_a_command_gets_what_the_line_says_and_defaults_of_its_fields(capsys):
    status, out = shot(capsys, "mug --out here")
    assert status == 0 and "'frames': ()" in out and "'count': 2, 'near': None, 'mesh': []" in out
    assert "'focal': 8.0, 'kind': 'wide', 'sharp': True} [] fpp-bench shoot mug --out here" in out
    words = (
        "mug 3 4 --mesh a.ply --mesh b.ply --near 1,2.5 --count 7 --out=here --focal 4 --dull "
        "--kind tele"
    )
    status, out = shot(capsys, words)
    assert (
        status == 0
        and "'frames': (3, 4)" in out
        and "'near': (1.0, 2.5), 'mesh': ['a.ply', 'b.ply']" in out
    )
    assert "'focal': 4.0, 'kind': 'tele', 'sharp': False} ['--focal', '--kind', '--dull']" in out
    assert f"fpp-bench shoot {words}" in out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--out here", "SUBJECT is missing: what to shoot"),
        ("mug", "--out DIR is missing: where to"),
        ("mug --out", "'--out' requires an argument"),
        ("mug --out --dull", "--out: expected a value behind it, got the option --dull"),
        ("mug --out here --conut 3", "unknown option '--conut'; did you mean '--count'?"),
        ("mug --out here --xyz", "unknown option '--xyz'; there are --out, --count"),
        ("mug --out here --count 1.5", "--count 1.5: expected a whole number"),
        ("mug --out here --focal far", "--focal far: expected a number"),
        ("mug --out here --kind tle", "--kind tle: did you mean 'tele'?"),
        ("mug --out here --near 5,4", "--near 5,4: expected NEAR,FAR in mm such as 350,450"),
        ("mug x --out here", "N x: expected a whole number"),
        ("mug --out here --dull=1", "does not take a value"),
    ],
)
def test_what_a_line_can_not_mean_is_refused(capsys, words, message):
    status, error = shot(capsys, words)
    assert status == 2 and error.startswith("fpp-bench shoot: error: ") and message in error, error


def test_help_lists_arguments_options_and_sections(capsys):
    status, out = shot(capsys, "--help")
    assert status == 0 and out.startswith(
        "usage: fpp-bench shoot [options] SUBJECT [N ...] --out DIR\n\nShoot a picture.\n"
    )
    assert "leaves out" not in out and out.endswith("examples:\n  fpp-bench shoot mug --out x\n")
    assert "\nlens:\n  --focal MM" in out and "--kind wide|tele" in out and "--near NEAR,FAR" in out


def test_json_on_standard_output_stands_alone(tmp_path, capsys):
    status, out = shot(capsys, "mug --out here --json -")
    assert status == 0 and json.loads(out)["subject"] == "mug"
    assert shot(capsys, f"mug --out here --json {tmp_path / 'a.json'}")[1].startswith("{'subject'")
    assert (tmp_path / "a.json").read_text() == out


def test_fields_describe_themselves():
    focal, kind, sharp = options_of(Lens)
    assert [flag_of(entry) for entry in options_of(Lens)] == ["--focal", "--kind", "--dull"]
    assert (
        described(kind).choices == ("wide", "tele")
        and described(focal).metavar == "MM"
        and sharp.default
    )
    assert options_of(None) == []
    assert names(" a, b,,c ") == ("a", "b", "c")
    with pytest.raises(ValueError, match="expected an even number"):
        value("an even number", int, lambda number: number % 2 == 0)("3")
    assert did_you_mean("x", [f"name {number}" for number in range(200)]).endswith("name 79, ...")


def test_almost_right_names_of_options_are_named():
    said = refusal(fpp_bench, "build --halp")
    assert "unknown option '--halp'; did you mean '--help'?" in said


# ---- methods of a user

MINE = """
from dataclasses import dataclass
import numpy as np
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.options import option

@dataclass(frozen=True)
class Settings:
    lit: int = option(60, "grey level above which a pixel is lit", "GREY")
    steps: bool = option(False, "fail")

class Mine(Method):
    name, title, frames_used, purpose = "mine", "Everything lit is 1.5 m away", (0,), "everything lit"
    Options = Settings

    def predict(self, frames):
        if self.options.steps:
            raise KeyError("a fault of mine")
        return np.where(frames[0] > self.options.lit, np.float32(1500), np.float32(0))

class Clashing(Mine):
    @dataclass(frozen=True)
    class Options:
        split: int = option(1, "a name that is taken")
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(MINE)


def test_options_of_a_method_in_a_file_are_options_of_the_command(mine, tiny):
    assert fpp_bench("predict mine.py:Mine", tiny, "--out bright --lit 200") == 0
    settings = yaml.safe_load(Path("bright/submission.yaml").read_text())["settings"]
    assert settings == {"lit": 200, "steps": False, "source_sha256": settings["source_sha256"]}
    out = printed(fpp_bench, "predict mine.py:Mine --help")
    assert "mine (everything lit):\n  --lit GREY  grey level above which a pixel is lit" in out
    assert "--depth-noise" not in out  # of another method
    out = printed(fpp_bench, "predict --help")
    assert "predict METHOD --help shows the options of one" in out and "--depth-noise" not in out
    assert all(f"\n  {name} " in out for name in registry.methods())
    assert "--depth-noise MM" in printed(fpp_bench, "predict classical --help")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("mine.py:Mine DATA --steps", "a method of yours failed"),
        (
            "mine.py:Mine DATA --frames 3",
            "--frames is an option of phase, crossed, not of mine.py:Mine; leave it out",
        ),
        (
            "mine.py:Clashing DATA",
            "its option --split is one of fpp-bench predict; give it another flag",
        ),
        ("mine.py:Min DATA", "did you mean 'Mine'"),
        ("phase DATA --frames 3 --error-mm 1", "--frames and --error-mm: give one of them"),
        ("phas DATA", "unknown method 'phas'; did you mean 'phase'"),
        ("DATA phase", "expected the method first, then the dataset: fpp-bench predict phase DATA"),
        ("DATA mine.py:Mine", "then the dataset: fpp-bench predict mine.py:Mine DATA"),
    ],
)
def test_options_of_another_method_are_refused(mine, tiny, words, message):
    said = refusal(fpp_bench, "predict", words.replace("DATA", str(tiny)), "--out out")
    assert message.replace("DATA", str(tiny)) in said


def test_a_folder_called_as_a_method_is_a_dataset(mine, tiny):
    Path("phase").symlink_to(tiny)
    assert "1 frame and" in printed(fpp_bench, "predict constant phase --out out")


def test_a_used_folder_is_refused_before_the_bar(mine, tiny):
    Path("used").mkdir()
    Path("used/notes.txt").write_text("mine")
    error = refusal(fpp_bench, "predict constant", tiny, "--out used")
    assert "already holds notes.txt; give a new or empty folder, or remove this one" in error
    assert "0%" not in error


def test_a_word_that_no_argument_takes_may_be_the_missing_option():
    assert "did you mean --out data/mini?" in refusal(fpp_bench, "build data/mini")


def test_help_of_a_command_by_a_word():
    assert "usage: fpp-bench predict" in printed(fpp_bench, "help predict")
    assert "COMMAND ..." in printed(fpp_bench, "help")


@pytest.mark.long
def test_measurements_go_only_to_the_code_that_was_scored(mine, tiny):
    Path("other.py").write_text(MINE.replace("1500", "1501"))
    assert fpp_bench("predict mine.py:Mine", tiny, "--out out") == 0
    assert fpp_eval("out --json result.json") == 0
    for name in ("time", "reliance"):
        error = refusal(fpp_bench, name, "other.py:Mine", tiny, "--into result.json")
        assert "settings.source_sha256 is" in error and "give the same options and code" in error
    assert fpp_bench("time mine.py:Mine", tiny, "--repeats 1 --into result.json") == 0


# ---- scoring without naming the dataset


@pytest.fixture
def predicted(copied, tmp_path, monkeypatch):
    """A copy of a dataset, ``copy``, and predictions of it, in the current folder."""
    monkeypatch.chdir(tmp_path)
    assert fpp_bench("predict constant copy --split validation --out predictions") == 0


BUILD = "build --workers 1 --size 176 --objects mug,cork,bowl,power_drill --out"
VALIDATION = "--split validation"


def score(*words):
    return fpp_eval("predictions", *words, "--json result.json")


def test_predictions_say_what_was_predicted(predicted, tmp_path, monkeypatch):
    block = yaml.safe_load(Path("predictions/submission.yaml").read_text())["predicted"]
    assert block["dataset"] == str(tmp_path / "copy") and block["split"] == "validation"
    assert {"validation/frame_00", "validation/depth", "validation/flags"} <= set(block["content"])
    results = []
    for words in ("", f"copy {VALIDATION}", "copy"):
        assert score(words) == 0
        results.append(read_json(Path("result.json")))
        assert results[-1]["dataset"]["split"] == "validation"
        assert results[-1]["metrics"] == results[0]["metrics"]
    assert "predicted" not in results[0]["submission"]
    assert score("--split test") == 2  # those were not predicted
    monkeypatch.chdir("/")
    assert fpp_eval(tmp_path / "predictions") == 0


def test_a_dataset_that_was_moved_is_asked_for(predicted):
    Path("copy").rename("elsewhere")
    error = refusal(score)
    assert "copy: no such folder" in error
    assert "if the data was moved, give the dataset: fpp-eval predictions DATASET" in error
    assert score("elsewhere") == 0


@pytest.mark.long
def test_a_dataset_that_was_changed_is_refused(predicted):
    shutil.rmtree("copy")
    assert fpp_bench(BUILD, "copy --seed 1") == 0
    error = refusal(score)
    assert "is not what predictions was predicted from, validation/frame_00 is another now" in error
    assert "give the dataset: fpp-eval predictions DATASET, or predict again" in error


def test_a_description_by_hand_needs_the_dataset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_predictions(tmp_path / "predictions", make_dataset(tmp_path / "data"))
    said = "(predicted:) what was predicted; give the dataset: fpp-eval predictions DATASET"
    assert said in refusal(score)
    assert score("data") == 0


def test_a_slip_in_the_name_of_a_command_is_no_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = refusal(fpp_eval, "chek predictions")
    assert "unknown command 'chek'; did you mean 'check'?" in said
    Path("chek").mkdir()
    error = refusal(fpp_eval, "chek data")
    assert "can't be scored" not in error and "unknown command" not in error


def test_click_is_told_to_take_no_defaults_from_the_environment(monkeypatch):
    monkeypatch.setenv("FPP_BENCH_SHOOT_COUNT", "9")
    context = shoot.make_context("x", ["mug", "--out", "here"])
    assert shoot.values(context)["count"] == 2 and isinstance(context, click.Context)
    assert np.isfinite(shoot.values(context)["lens"].focal)


@pytest.mark.long
def test_predictions_of_another_dataset_are_refused(predicted):
    line = "build --out other --objects mug,cork --size 176 --pitch 24 --workers 1"
    assert fpp_bench(line, "--config single_shot") == 0
    error = refusal(score, "other", VALIDATION)
    assert (
        "other: is not what predictions was predicted from, validation/frame_00 is another now"
        in error
    )
    description = yaml.safe_load(Path("predictions/submission.yaml").read_text())
    write_description(Path("predictions"), **{**description, "predicted": ...})
    assert score("other", VALIDATION) == 0  # it says nothing


@pytest.mark.long
def test_the_same_data_with_fewer_frames_are_scored(predicted):
    assert fpp_bench(BUILD, "fewer --config single_shot") == 0
    assert score("fewer", VALIDATION) == 0
