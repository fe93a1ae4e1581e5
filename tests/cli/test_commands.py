"""The command line: quick help, bad input without a traceback, output for machines and people."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from shutil import rmtree
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
import trimesh
from conftest import TINY_SIZE, fpp_bench, printed, refusal
from scored_dataset import write_predictions

from fpp_ml_bench.cli import BENCH, COMMANDS, EVAL, Program
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import save_rig
from fpp_ml_bench.optics.sequence import Sequence

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {
    "numpy",
    "torch",
    "datasets",
    "pyarrow",
    "scipy",
    "cv2",
    "numba",
    "matplotlib",
    "pydantic",
    "yaml",
    "trimesh",
}


# ---- help


AT_ONCE = "", "fpp-eval"
"""Help that no heavy import precedes. That of a command may import what the command needs at once,
but no torch."""
HELPS = """
import json, sys
from contextlib import redirect_stdout
from io import StringIO
from fpp_ml_bench.cli import main, main_eval
loaded = set()
for name in sys.argv[1:]:
    program, words = (main_eval, []) if name == "fpp-eval" else (main, [name] if name else [])
    with redirect_stdout(StringIO()) as text:
        status = program([*words, "--help"])
    print(json.dumps([name, status, text.getvalue(), sorted(set(sys.modules) - loaded)]))
    loaded = set(sys.modules)
"""
"""Prints the help of each name, one after the other in one process, and the modules that it was the
first to import."""


@pytest.fixture(scope="module")
def helps():
    command = [sys.executable, "-c", HELPS, *AT_ONCE, *COMMANDS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}


@pytest.mark.processes
@pytest.mark.parametrize("name", [*AT_ONCE, *COMMANDS])
def test_help_answers_without_importing_anything_heavy(helps, name):
    status, text, imported = helps[name]
    heavy = HEAVY if name in AT_ONCE else {"torch", "datasets"}
    assert status == 0 and heavy.isdisjoint(imported)
    assert "usage:" in text and "examples:" in text
    if name not in AT_ONCE:
        assert f"usage: fpp-bench {name}" in text
    assert max(map(len, text.splitlines())) <= 125


@pytest.mark.processes
def test_help_of_the_program_imports_no_command(helps):
    imported = {
        name.removeprefix("fpp_ml_bench.")
        for name in helps[""][2]
        if name.startswith("fpp_ml_bench.")
    }
    assert imported <= {"cli", "cli.options", "errors", "files", "machine", "options"}


def test_version_and_no_arguments():
    assert printed(fpp_bench, "--version").startswith("fpp-ml-bench ")
    assert "usage: fpp-bench" in refusal(fpp_bench)


def test_every_command_of_the_tables_is_grouped_and_says_what_it_does():
    for program in (BENCH, EVAL):
        assert len(program.commands) == sum(map(len, program.groups.values()))
        for name in program.commands:
            command = program.command(name)
            if isinstance(command, Program):
                assert (
                    all(command.command(inner).help for inner in command.commands)
                    and command.purpose
                )
            else:
                assert command.help and command.examples


def test_examples_in_the_help_are_accepted_by_their_parsers(tmp_path, monkeypatch):
    """All examples of all commands are parsed: the help shows no option that a command lacks."""
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from fpp_ml_bench.baselines.method import Method\nclass Mine(Method):\n    name = 'mine'\n"
    )
    found = 0
    for program in (BENCH, EVAL):
        for name in program.commands:
            command = program.command(name)
            lines = [line for line in command.examples.splitlines() if line.startswith("fpp-")]
            assert lines, name
            for line in lines:
                first, *words = shlex.split(
                    line.split("   ")[0].split(" && ")[0].split(" | ")[0].split(" > ")[0]
                )
                other = {"fpp-bench": BENCH, "fpp-eval": EVAL}[first]
                default = other.default and words[0] not in other.commands
                target = other.command(other.default if default else words[0])
                words = words if default else words[1:]
                if isinstance(target, Program):
                    target, words = target.command(words[0]), words[1:]
                target.make_context("x", list(words))
                found += 1
    assert found > 90


# ---- bad input


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("bild", "did you mean 'build'"),
        ("--bogus", "unknown option '--bogus'"),
        ("build --out OUT --size 0", "1 to 8192"),
        ("build --out OUT --size 120", "pitch of at least"),
        ("build --out OUT --preset huge", "--preset"),
        ("build --out OUT --config some", "--config some: there are single_shot"),
        ("build --out OUT --objects mugg", "did you mean 'mug'"),
        ("build --out OUT --objects ,", "name at least one"),
        ("build --out OUT --seed -1", "seed -1"),
        ("build --out OUT --workers 0", "--workers 0"),
        ("build --out OUT --noise-sigma nan", "--noise-sigma nan: expected 0 to 50"),
        ("build --out OUT --pitch nan", "pitch"),
        ("build --out OUT --rig none.yaml", "none.yaml"),
        ("build --out OUT --mesh none.stl", "none.stl"),
        ("build --out FILE --objects mug", "is a file"),
        ("info", "DATASET"),
        ("info OUT", "no such folder"),
        ("verify FILE", "no such folder"),
        ("show TINY", "expected either a SAMPLE or --sheet"),
        ("show TINY mug_A1 --out x.png", "did you mean 'mug_A"),
        ("show TINY mug_A0 --out x.jpg", "ending in .png"),
        ("show TINY mug_A0 --out FILE/x.png", "can't be written"),
        ("show TINY --sheet --split val --out x.png", "no split 'val'"),
        ("show TINY --sheet --views 0 --out x.png", "--views 0: expected 1 or more"),
        ("show TINY --sheet --cloud --out x.png", "--cloud: expected a SAMPLE"),
        ("predict magic TINY --out OUT", "there are classical"),
        ("predict classical TINY --out OUT --steps 2", "3 to the 18"),
        ("predict classical TINY --out OUT --threads 0", "--threads 0"),
        ("predict classical TINY --out TINY", "already holds"),
        ("train fringe-net --out OUT --unions -1", "unions -1"),
        ("train fringe-net --out OUT --rate nan", "rate above 0"),
        ("train fringe-net TINY --out OUT", "renders what it learns from"),
        (
            "train loss/l1 TINY --out OUT --rate 0.1",
            "--rate is an option of fringe-net, not of loss/l1",
        ),
    ],
)
def test_bad_input_exits_2_with_a_message_and_makes_nothing(
    tiny, tmp_path, monkeypatch, line, message
):
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("x")
    assert message in refusal(fpp_bench, line.replace("TINY", str(tiny)))
    assert [path.name for path in tmp_path.iterdir()] == ["FILE"]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(13, "Permission denied", "/somewhere"), "/somewhere: Permission denied"),
        (
            OSError(28, "No space left on device"),
            "standard output or a temporary file: No space left on device",
        ),
        (OSError("the stream ended"), "the stream ended"),
    ],
)
def test_unexpected_system_errors_are_messages(tiny, monkeypatch, error, message):
    monkeypatch.setattr("fpp_ml_bench.cli.dataset.split_statistics", Mock(side_effect=error))
    assert refusal(fpp_bench, "info", tiny) == f"fpp-bench info: error: {message}\n"


def test_ctrl_c_is_130(tiny, monkeypatch, capsys):
    stop = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("fpp_ml_bench.cli.dataset.split_statistics", stop)
    assert fpp_bench("info", tiny) == 130
    assert capsys.readouterr().err == "fpp-bench info: stopped\n"
    monkeypatch.setattr("fpp_ml_bench.cli.predict.DatasetFolder", stop)
    assert fpp_bench("predict phase", tiny, "--out out") == 130
    assert "fpp-bench predict: stopped; the same command continues\n" in capsys.readouterr().err


# ---- info


def test_info_json_says_what_is_there(tiny, opened):
    content = json.loads(printed(fpp_bench, "info", tiny, "--json -"))
    assert content["fingerprint"] == opened.fingerprint and content["size"] == [TINY_SIZE] * 2
    assert content["samples"] == opened.splits
    on_disk = sum(
        p.stat().st_size for p in tiny.rglob("*") if p.is_file() and p.name != "manifest.json"
    )
    assert content["bytes"] == on_disk
    assert content["rig"]["sequence"]["steps"] == 18
    for split in content["splits"]:
        names = opened.splits[split["split"]]
        errors, covers = [], []
        for sample in names:
            depth, exact = (
                opened.depth_mm(sample, c).astype(np.float64) for c in ("depth", "depth_exact")
            )
            decoded = (depth > 0) & (exact > 0) & ((opened.flags(sample) & VOID) == 0)
            errors.append(np.abs(depth - exact)[decoded].mean())
            covers.append((depth > 0).mean())
        assert split["samples"] == len(names)
        assert split["gt_mae_mm"] == pytest.approx(np.mean(errors), rel=1e-9)
        assert split["cover_mean"] == pytest.approx(np.mean(covers), rel=1e-9)
        # Void pixels, most of them at edges, count in neither: the drill has 0.48 mm, and in its
        # interior, with more bounced light, 0.50 mm.
        assert 0 < split["gt_mae_mm"] < 0.5
        assert 0 < split["gt_interior_mae_mm"] < 0.6


def test_info_for_people(tiny, opened):
    out = printed(fpp_bench, "info", tiny)
    for text in (
        opened.fingerprint,
        "baseline 160.1 mm",
        "1500-2100 mm",
        "ground-truth error",
        "single_shot, first_frames, horizontal",
    ):
        assert text in out


# ---- show


@pytest.mark.long
def test_show_writes_a_picture_of_the_sample(tiny, tmp_path):
    out = tmp_path / "new" / "bowl.png"
    assert fpp_bench(f"show {tiny} bowl_A0 --out {out}") == 0
    picture = cv2.imread(str(out))
    height, width = picture.shape[:2]
    assert width > 1000 and height > 500
    colour = picture.max(axis=2).astype(int) - picture.min(axis=2)
    assert (colour > 40).mean() > 0.01  # depth maps are in colour
    assert (
        (colour < 3) & (picture[..., 0] > 20) & (picture[..., 0] < 235)
    ).mean() > 0.05  # frames are grey


def test_show_draws_fewer_views_larger_or_more_objects_in_a_line(tiny, tmp_path):
    """Of the four objects; six views make two lines of two."""
    for views, size in (
        (1, (258, 4 * 248 - 8)),
        (2, (138, 4 * 248 - 8)),
        (99, (2 * 138, 2 * 728 - 8)),
    ):
        assert fpp_bench(f"show {tiny} --sheet --views {views} --out {tmp_path}/x.png") == 0
        assert cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_GRAYSCALE).shape == size


def test_show_with_a_damaged_mesh_names_it(copied, tmp_path):
    (copied / "meshes" / "cork.ply").write_bytes(b"ply\nhalf")
    assert "cork.ply" in refusal(fpp_bench, f"show {copied} cork_A0 --out {tmp_path}/x.png")


@pytest.mark.long
def test_show_by_default_writes_into_the_current_folder(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert fpp_bench("show", tiny, "cork_A0") == 0
    assert [p.name for p in tmp_path.iterdir()] == ["cork_A0.png"]


def test_show_reads_predictions_in_the_units_that_they_declare_and_below_0_there_is_nothing(
    tiny, tmp_path
):
    dataset, clouds = DatasetFolder(tiny), []
    for units, per_mm in (("mm", np.float32(1)), ("m", np.float32(0.001))):
        folder = write_predictions(tmp_path / units, dataset, units=units)
        for path in folder.glob("*.npy"):
            depth = np.load(path)  # below 0 as networks put out
            np.save(path, np.where(depth > 0, depth * per_mm, np.float32(-0.01)))
        words = f"--predictions {folder} --cloud --out {tmp_path / units}.png"
        assert fpp_bench("show", tiny, "power_drill_A60", words) == 0
        clouds.append(trimesh.load(tmp_path / f"{units}.ply").vertices)
    assert len(clouds[0]) == np.count_nonzero(dataset.depth_mm("power_drill_A60")) > 100
    np.testing.assert_allclose(clouds[1], clouds[0], rtol=1e-6, atol=1e-9)


def test_show_refuses_predictions_that_could_not_be_scored(tiny, tmp_path):
    folder = write_predictions(tmp_path / "predictions", DatasetFolder(tiny))
    (folder / "power_drill_A60.npy").unlink()
    words = f"show {tiny} power_drill_A60 --predictions {folder} --out {tmp_path}/x.png"
    assert "power_drill_A60.npy: is missing" in refusal(fpp_bench, words)
    assert not (tmp_path / "x.png").exists()


@pytest.mark.long
@pytest.mark.parametrize("words", [f"--size {TINY_SIZE} --config single_shot", "--rig rig.yaml"])
def test_show_works_with_one_frame_without_meshes_and_with_few_gray_bits(
    tmp_path, monkeypatch, words
):
    monkeypatch.chdir(tmp_path)
    coarse = replace(
        paper_rig(TINY_SIZE),
        pitch_horizontal_px=1140,
        pitch_vertical_px=912,
        sequence=Sequence(3, 1, 1),
    )
    save_rig(coarse, Path("rig.yaml"))
    assert fpp_bench("build --out data --objects cork --workers 1", words) == 0
    rmtree("data/meshes")
    assert fpp_bench("show data cork_A0 --out picture.png") == 0
    assert cv2.imread("picture.png") is not None


def test_contact_sheet_shows_every_object_and_view(tiny, opened, tmp_path):
    out = tmp_path / "sheet.png"
    assert fpp_bench(f"show {tiny} --sheet --out {out}") == 0
    sheet = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
    tile, label = 120, 18
    assert sheet.shape == (2 * (tile + label), 2 * 6 * tile + 8)
    for number, name in enumerate(("bowl", "cork", "mug", "power_drill")):
        for view_number, view in enumerate(VIEWS):
            y = (number // 2) * (tile + label) + label
            x = (number % 2) * (6 * tile + 8) + view_number * tile
            shown = sheet[y : y + tile, x : x + tile].ravel()
            frame = opened.frame(f"{name}_{view}", 51)
            expected = cv2.resize(frame, (tile, tile), interpolation=cv2.INTER_AREA).ravel()
            assert np.corrcoef(shown, expected)[0, 1] > 0.99
