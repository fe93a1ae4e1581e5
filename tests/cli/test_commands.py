"""The command line: quick help, bad input without a traceback, output for machines and people."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from conftest import TINY_SIZE
from scored_dataset import write_predictions

from fpp_ml_bench.cli import BENCH, COMMANDS, EVAL, Program, main, main_eval
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.loaders.storage.store import DatasetFolder

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("numpy", "torch", "datasets", "pyarrow", "scipy", "cv2", "numba", "matplotlib", "pydantic", "yaml", "trimesh")


def call(*arguments, command=main):
    """Exit status of a command run in this process; unexpected errors are raised."""
    try:
        return command([str(a) for a in arguments])
    except SystemExit as stop:
        return 0 if stop.code is None else stop.code


# ---- help


AT_ONCE = "", "fpp-eval"
"""Help that no heavy import precedes. That of a command may import what the command needs at once, but no torch."""
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
"""Prints the help of each name, one after the other in one process, and the modules that it was the first to import."""


@pytest.fixture(scope="module")
def helps():
    command = [sys.executable, "-c", HELPS, *AT_ONCE, *COMMANDS]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return {name: rest for name, *rest in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize("name", [*AT_ONCE, *COMMANDS])
def test_help_answers_without_importing_anything_heavy(helps, name):
    status, text, imported = helps[name]
    assert status == 0 and not set(imported) & (set(HEAVY) if name in AT_ONCE else {"torch", "datasets"})
    assert "usage:" in text and "examples:" in text
    if name not in AT_ONCE:
        assert f"usage: fpp-bench {name}" in text
    assert max(map(len, text.splitlines())) <= 125


def test_help_and_version_of_the_programs_import_no_command():
    for program, words in (("main", "['--help']"), ("main", "['--version']")):
        code = f"import sys\nfrom fpp_ml_bench.cli import {program}\n{program}({words})\n"
        code += "print([m for m in sys.modules if m.startswith('fpp_ml_bench.')])"
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
        loaded = set(json.loads(done.stdout.splitlines()[-1].replace("'", '"')))
        core = {"cli", "cli.options", "errors", "files", "machine", "options"}
        assert loaded <= {f"fpp_ml_bench.{name}" for name in core}


def test_version_and_no_arguments(capsys):
    assert call("--version") == 0
    assert capsys.readouterr().out.startswith("fpp-ml-bench ")
    assert call() == 2
    assert "usage: fpp-bench" in capsys.readouterr().err


def _parsed(command, words):
    """Whether the command's parser accepts the words; raises click's error."""
    command.make_context("x", list(words))


def test_every_command_of_the_tables_is_grouped_and_says_what_it_does():
    for program in (BENCH, EVAL):
        assert len(program.commands) == sum(map(len, program.groups.values()))
        for name in program.commands:
            command = program.command(name)
            if isinstance(command, Program):
                assert all(command.command(inner).help for inner in command.commands) and command.purpose
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
                first, *words = shlex.split(line.split("   ")[0].split(" && ")[0].split(" | ")[0].split(" > ")[0])
                other = {"fpp-bench": BENCH, "fpp-eval": EVAL}[first]
                default = other.default and words[0] not in other.commands
                target = other.command(other.default if default else words[0])
                words = words if default else words[1:]
                if isinstance(target, Program):
                    target, words = target.command(words[0]), words[1:]
                _parsed(target, words)
                found += 1
    assert found > 90


# ---- bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bild"], "did you mean 'build'"),
        (["xyz"], "unknown command 'xyz'"),
        (["--bogus"], "unknown option '--bogus'"),
        (["--bogus", "build"], "unknown option '--bogus'"),
        (["build"], "--out DIR is missing"),
        (["build", "--out", "OUT", "--sise", "9"], "--sise"),
        (["build", "--out", "OUT", "--size", "big"], "--size"),
        (["build", "--out", "OUT", "--size", "0"], "1 to 8192"),
        (["build", "--out", "OUT", "--size", "-5"], "1 to 8192"),
        (["build", "--out", "OUT", "--size", "9000"], "1 to 8192"),
        (["build", "--out", "OUT", "--size", "120"], "pitch of at least"),
        (["build", "--out", "OUT", "--preset", "huge"], "--preset"),
        (["build", "--out", "OUT", "--config", "some"], "--config some: there are single_shot"),
        (["build", "--out", "OUT", "--placement", "random"], "--placement"),
        (["build", "--out", "OUT", "--objects", "mugg"], "did you mean 'mug'"),
        (["build", "--out", "OUT", "--objects", ","], "name at least one"),
        (["build", "--out", "OUT", "--objects", "mug,mug"], "named twice"),
        (["build", "--out", "OUT", "--seed", "-1"], "seed -1"),
        (["build", "--out", "OUT", "--seed", "1.5"], "--seed"),
        (["build", "--out", "OUT", "--seed", "9" * 20], "seed 9999"),
        (["build", "--out", "OUT", "--workers", "0"], "--workers 0"),
        (["build", "--out", "OUT", "--workers", "two"], "--workers"),
        (["build", "--out", "OUT", "--noise-sigma", "nan"], "--noise-sigma nan: expected 0 to 50"),
        (["build", "--out", "OUT", "--noise-sigma", "-1"], "--noise-sigma -1: expected 0 to 50"),
        (["build", "--out", "OUT", "--pitch", "nan"], "pitch"),
        (["build", "--out", "OUT", "--pitch", "inf"], "pitch"),
        (["build", "--out", "OUT", "--pitch", "0"], "pitch"),
        (["build", "--out", "OUT", "--pitch", "3"], "pitch"),
        (["build", "--out", "OUT", "--pitch", "5000"], "pitch"),
        (["build", "--out", "OUT", "--rig", "none.yaml"], "none.yaml"),
        (["build", "--out", "OUT", "--rig", "FILE.txt"], "FILE.txt"),
        (["build", "--out", "OUT", "--mesh", "none.stl"], "none.stl"),
        (["build", "--out", "OUT", "--meshes", "none.yaml"], "none.yaml"),
        (["build", "--out", "FILE", "--objects", "mug"], "is a file"),
        (["build", "--out", "FILE/inside", "--objects", "mug"], "FILE"),
        (["info"], "DATASET"),
        (["info", "OUT"], "no such folder"),
        (["info", "."], "no manifest.json"),
        (["verify", "OUT"], "no such folder"),
        (["verify", "FILE"], "no such folder"),
        (["show", "TINY"], "expected either a SAMPLE or --sheet"),
        (["show", "TINY", "mug_A0", "--sheet"], "expected either a SAMPLE or --sheet"),
        (["show", "TINY", "mug_A1", "--out", "x.png"], "did you mean 'mug_A"),
        (["show", "TINY", "mug_A0", "--out", "x.jpg"], "ending in .png"),
        (["show", "TINY", "mug_A0", "--out", "FILE/x.png"], "can't be written"),
        (["show", "TINY", "--sheet", "--split", "val", "--out", "x.png"], "no split 'val'"),
        (["show", "TINY", "--sheet", "--views", "0", "--out", "x.png"], "--views 0: expected 1 or more"),
        (["show", "TINY", "--sheet", "--cloud", "--out", "x.png"], "--cloud: expected a SAMPLE"),
        (["show", "OUT", "mug_A0", "--out", "x.png"], "no such folder"),
        (["predict", "magic", "TINY", "--out", "OUT"], "there are classical"),
        (["predict", "classical", "TINY"], "--out"),
        (["predict", "classical", "TINY", "--out", "OUT", "--split", "val"], "--split"),
        (["predict", "classical", "TINY", "--out", "OUT", "--steps", "2"], "3 to the 18"),
        (["predict", "classical", "TINY", "--out", "OUT", "--steps", "19"], "3 to the 18"),
        (["predict", "classical", "TINY", "--out", "OUT", "--threads", "0"], "--threads 0"),
        (["predict", "classical", "TINY", "--out", "OUT", "--direction", "up"], "--direction"),
        (["predict", "classical", "TINY", "--out", "TINY"], "already holds"),
        (["predict", "classical", "OUT", "--out", "OUT2"], "no such folder"),
        (["train", "phase-net", "--out", "OUT", "--unions", "-1"], "unions -1"),
        (["train", "phase-net", "--out", "OUT", "--rate", "nan"], "rate above 0"),
        (["train", "phase-net", "--out", "OUT", "--steps", "0"], "steps 0"),
        (["train", "phase-net", "--out", "OUT", "--albedo", "two"], "--albedo"),
        (["train", "phase-net", "TINY", "--out", "OUT"], "renders what it learns from"),
        (
            ["train", "loss/l1", "TINY", "--out", "OUT", "--rate", "0.1"],
            "--rate is an option of classical-net, phase-net, crossed-net, fringe-net, not of loss/l1",
        ),
    ],
)
def test_bad_input_exits_2_with_a_message_and_makes_nothing(tiny, tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    for name in ("FILE", "FILE.txt"):
        Path(name).write_text("x")
    before = sorted(tmp_path.iterdir())
    assert call(*[str(tiny) if a == "TINY" else a for a in arguments]) == 2
    captured = capsys.readouterr()
    assert message in captured.err and "Traceback" not in captured.err
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (PermissionError(13, "Permission denied", "/somewhere"), "/somewhere: Permission denied"),
        (OSError(28, "No space left on device"), "standard output or a temporary file: No space left on device"),
        (OSError("the stream ended"), "the stream ended"),
    ],
)
def test_unexpected_system_errors_are_messages(tiny, monkeypatch, capsys, error, message):
    def fail(manifest):
        raise error

    monkeypatch.setattr("fpp_ml_bench.cli.dataset.split_statistics", fail)
    assert call("info", tiny) == 2
    assert capsys.readouterr().err == f"fpp-bench info: error: {message}\n"


def test_ctrl_c_is_130(tiny, monkeypatch, capsys):
    def stop(manifest):
        raise KeyboardInterrupt

    monkeypatch.setattr("fpp_ml_bench.cli.dataset.split_statistics", stop)
    assert call("info", tiny) == 130
    assert capsys.readouterr().err == "fpp-bench info: stopped\n"
    monkeypatch.setattr("fpp_ml_bench.cli.predict.DatasetFolder", stop)
    assert call("predict", "phase", tiny, "--out", "out") == 130
    assert "fpp-bench predict: stopped; the same command continues\n" in capsys.readouterr().err


def test_output_cut_off_by_its_reader_is_no_traceback(tiny):
    program = "import sys; from fpp_ml_bench.cli import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", program, "info", str(tiny)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    error = process.stderr.read().decode()
    process.stderr.close()
    assert (process.wait(), error) == (141, "")


# ---- info


def test_info_json_says_what_is_there(tiny, opened, capsys):
    assert call("info", tiny, "--json", "-") == 0
    content = json.loads(capsys.readouterr().out)
    assert content["fingerprint"] == opened.fingerprint and content["size"] == [TINY_SIZE, TINY_SIZE]
    assert content["samples"] == opened.splits
    on_disk = sum(p.stat().st_size for p in tiny.rglob("*") if p.is_file() and p.name != "manifest.json")
    assert content["bytes"] == on_disk
    assert content["rig"]["sequence"]["steps"] == 18
    for split in content["splits"]:
        names = opened.splits[split["split"]]
        errors, covers = [], []
        for sample in names:
            depth, exact = (opened.depth_mm(sample, c).astype(np.float64) for c in ("depth", "depth_exact"))
            decoded = (depth > 0) & (exact > 0) & ((opened.flags(sample) & VOID) == 0)
            errors.append(np.abs(depth - exact)[decoded].mean())
            covers.append((depth > 0).mean())
        assert split["samples"] == len(names)
        assert split["gt_mae_mm"] == pytest.approx(np.mean(errors), rel=1e-9)
        assert split["cover_mean"] == pytest.approx(np.mean(covers), rel=1e-9)
        assert split["cover_max"] == pytest.approx(max(covers), rel=1e-9)
        # Void pixels, most of them at edges, count in neither: the drill has 0.48 mm, and in its interior, with more
        # bounced light, 0.50 mm.
        assert 0 < split["gt_mae_mm"] < 0.5
        assert 0 < split["gt_interior_mae_mm"] < 0.6


def test_info_for_people(tiny, opened, capsys):
    assert call("info", tiny) == 0
    out = capsys.readouterr().out
    for text in (
        opened.fingerprint,
        "baseline 160.1 mm",
        "1500-2100 mm",
        "ground-truth error",
        "single_shot, horizontal",
    ):
        assert text in out


# ---- show


def test_show_writes_a_picture_of_the_sample(tiny, tmp_path, capsys):
    for sample in ("bowl_A0", "power_drill_A60"):
        assert call("show", tiny, sample, "--out", tmp_path / "new" / f"{sample}.png") == 0
    pictures = [cv2.imread(str(tmp_path / "new" / f"{s}.png")) for s in ("bowl_A0", "power_drill_A60")]
    for picture in pictures:
        height, width = picture.shape[:2]
        assert width > 1000 and height > 500
        colour = picture.max(axis=2).astype(int) - picture.min(axis=2)
        assert (colour > 40).mean() > 0.01  # depth maps are in colour
        assert ((colour < 3) & (picture[..., 0] > 20) & (picture[..., 0] < 235)).mean() > 0.05  # frames are grey
        assert (picture == 255).all(axis=2).mean() < 0.8
    assert pictures[0].shape != pictures[1].shape or (pictures[0] != pictures[1]).mean() > 0.02


def test_show_draws_fewer_views_larger_or_more_objects_in_a_line(tiny, tmp_path):
    sizes = {}
    for views in (1, 2, 6, 99):
        assert call("show", tiny, "--sheet", "--views", views, "--out", tmp_path / f"{views}.png") == 0
        sizes[views] = cv2.imread(str(tmp_path / f"{views}.png"), cv2.IMREAD_GRAYSCALE).shape
    stored = len({row["object"] for rows in DatasetFolder(tiny).manifest.samples.values() for row in rows})
    across = min(stored, 6)
    lines = -(-stored // across)
    assert sizes[1] == (lines * (18 + 240), across * 248 - 8)
    assert sizes[2] == (lines * (18 + 120), across * 248 - 8)
    assert sizes[6] == sizes[99] and sizes[6][0] == -(-stored // 2) * (18 + 120)


def test_show_with_a_damaged_mesh_names_it(tiny, tmp_path, capsys):
    folder = tmp_path / "copy"
    shutil.copytree(tiny, folder)
    (folder / "meshes" / "cork.ply").write_bytes(b"ply\nhalf")
    assert call("show", folder, "cork_A0", "--out", tmp_path / "x.png") == 2
    assert "cork.ply" in capsys.readouterr().err


def test_show_by_default_writes_into_the_current_folder(tiny, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("show", tiny, "cork_A0") == 0
    assert [p.name for p in tmp_path.iterdir()] == ["cork_A0.png"]


def test_show_reads_predictions_in_the_units_that_they_declare_and_below_0_there_is_nothing(tiny, tmp_path):
    dataset, clouds = DatasetFolder(tiny), []
    for units, per_mm in (("mm", 1), ("m", 0.001)):
        folder = write_predictions(tmp_path / units, dataset, units=units)
        for path in folder.glob("*.npy"):
            depth = np.load(path)
            np.save(path, np.where(depth > 0, depth * np.float32(per_mm), np.float32(-0.01)))  # as networks put out
        words = "show", tiny, "power_drill_A60", "--predictions", folder, "--cloud"
        assert call(*words, "--out", tmp_path / f"{units}.png") == 0
        clouds.append(trimesh.load(tmp_path / f"{units}.ply").vertices)
    assert len(clouds[0]) == np.count_nonzero(dataset.depth_mm("power_drill_A60")) > 100
    np.testing.assert_allclose(clouds[1], clouds[0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    "spoil, message",
    [
        (lambda folder: (folder / "power_drill_A60.npy").unlink(), "power_drill_A60.npy: is missing"),
        (lambda folder: np.save(folder / "bowl_A0.npy", np.zeros((8, 8), np.float32)), "bowl_A0.npy: is extra"),
        (lambda folder: np.save(folder / "power_drill_A0.npy", np.zeros((8, 8), np.float32)), "(8, 8)"),
        (lambda folder: (folder / "submission.yaml").unlink(), "submission.yaml"),
    ],
)
def test_show_refuses_predictions_that_could_not_be_scored(spoil, message, tiny, tmp_path, capsys):
    folder = write_predictions(tmp_path / "predictions", DatasetFolder(tiny))
    spoil(folder)
    picture = tmp_path / "x.png"
    assert call("show", tiny, "power_drill_A60", "--predictions", folder, "--out", picture) == 2
    assert message in capsys.readouterr().err and not picture.exists()


def test_show_works_with_one_frame_without_meshes_and_with_few_gray_bits(tmp_path):
    out, folder = tmp_path / "x.png", tmp_path / "set"
    assert (
        call(
            "build",
            "--out",
            folder,
            "--size",
            TINY_SIZE,
            "--objects",
            "cork",
            "--config",
            "single_shot",
            "--workers",
            1,
        )
        == 0
    )
    shutil.rmtree(folder / "meshes")
    assert call("show", folder, "cork_A0", "--out", out) == 0
    assert cv2.imread(str(out)) is not None
    from dataclasses import replace

    from fpp_ml_bench.optics.named_rigs import paper_rig
    from fpp_ml_bench.optics.rig_file import save_rig
    from fpp_ml_bench.optics.sequence import Sequence

    coarse = replace(paper_rig(TINY_SIZE), pitch_horizontal_px=1140, pitch_vertical_px=912, sequence=Sequence(3, 1, 1))
    save_rig(coarse, tmp_path / "rig.yaml")
    assert (
        call("build", "--out", tmp_path / "few", "--rig", tmp_path / "rig.yaml", "--objects", "bowl", "--workers", 1)
        == 0
    )
    assert call("show", tmp_path / "few", "bowl_A0", "--out", tmp_path / "y.png") == 0


def test_contact_sheet_shows_every_object_and_view(tiny, opened, tmp_path):
    out = tmp_path / "sheet.png"
    assert call("show", tiny, "--sheet", "--out", out) == 0
    sheet = cv2.imread(str(out), cv2.IMREAD_GRAYSCALE)
    tile, label = 120, 18
    assert sheet.shape == (2 * (tile + label), 2 * 6 * tile + 8)
    for number, name in enumerate(("bowl", "cork", "mug", "power_drill")):
        for view_number, view in enumerate(VIEWS):
            y, x = (number // 2) * (tile + label) + label, (number % 2) * (6 * tile + 8) + view_number * tile
            shown = sheet[y : y + tile, x : x + tile].astype(float)
            frame = cv2.resize(opened.frame(f"{name}_{view}", 51), (tile, tile), interpolation=cv2.INTER_AREA)
            assert np.corrcoef(shown.ravel(), frame.astype(float).ravel())[0, 1] > 0.99


# ---- the chain of commands in the README, with a user's mesh


def test_build_predict_and_evaluate_with_a_users_mesh(tmp_path, capsys):
    trimesh.creation.icosphere(3, 0.08).export(tmp_path / "ball.ply")
    data, out = tmp_path / "data", tmp_path / "predictions"
    assert call("build", "--out", data, "--mesh", tmp_path / "ball.ply", "--size", TINY_SIZE, "--workers", 1) == 0
    assert "6 samples, 312 images" in capsys.readouterr().out
    assert call("verify", data) == 0
    assert call("predict", "classical", data, "--out", out, "--steps", 6, "--direction", "vertical") == 0
    assert "next: fpp-eval" in capsys.readouterr().out
    result = tmp_path / "result.json"
    options = (data, "--split", "test", "--target", "depth_exact", "--json", result)
    assert call(out, *options, command=main_eval) == 0
    metrics = json.loads(result.read_text())["metrics"]
    assert 0 < metrics["object_mae_mm"] < 5


def test_commands_work_from_any_folder_in_a_process_of_their_own(tiny, tmp_path):
    program = "import sys; from fpp_ml_bench.cli import main; sys.exit(main())"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", program, "verify", str(tiny)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "intact" in done.stdout
