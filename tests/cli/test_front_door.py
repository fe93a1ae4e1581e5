"""What a newcomer meets first: ``fpp-bench demo``, and every command and block of code in
README."""

import json
import re
import shlex
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

import cv2
import pytest
import yaml
from published_trees import hub_of, make_tree

from fpp_ml_bench.cli import main, main_eval
from fpp_ml_bench.cli.demo import METHODS, SAMPLE, steps_in
from fpp_ml_bench.constants import PRESETS
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = {"fpp-bench": main, "fpp-eval": main_eval}


@pytest.fixture(scope="module")
def small():
    """The demo's preset with images of 256 px, so that the test takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "mini", (PRESETS["mini"][0], 256))
        yield


@pytest.fixture(scope="module")
def demo(small, tmp_path_factory):
    """A demo that was stopped while its last method predicted, and then run again: its folder, a
    result of before the second run, and what that run printed on standard output and error."""
    folder = tmp_path_factory.mktemp("demo") / "demo"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fpp_ml_bench.cli.predict.predict_split", _stopped_at_crossed(folder))
        assert main(["demo", "--out", str(folder)]) == 130
    earlier = (folder / "phase.json").read_bytes()
    with redirect_stdout(StringIO()) as printed, redirect_stderr(StringIO()) as steps:
        assert main(["demo", "--out", str(folder)]) == 0
    return folder, earlier, printed.getvalue(), steps.getvalue()


@pytest.fixture(scope="module")
def out(demo):
    return demo[0]


def run(line):
    program, *words = shlex.split(line, comments=True)
    assert PROGRAMS[program](words) == 0, line


def _stopped_at_crossed(folder):
    from fpp_ml_bench.cli.predict import predict_split

    def predict(opened, method, *rest):
        if method.name == "crossed":
            raise KeyboardInterrupt
        return predict_split(opened, method, *rest)

    return predict


@pytest.fixture
def published_hub(tmp_path_factory, monkeypatch):
    """A Hub on the loopback interface that has a dataset of the published layout."""
    tree = make_tree(tmp_path_factory.mktemp("published") / "tree", ("raw",), info=True)
    with hub_of(tree, tmp_path_factory.mktemp("cache"), monkeypatch):
        yield


def test_a_stopped_demo_goes_on_and_prints_what_was_computed(demo):
    out, earlier, printed, steps = demo
    assert (
        out / "phase.json"
    ).read_bytes() == earlier and "kept: fpp-bench reliance phase" in steps
    for method in METHODS:
        result = json.loads((out / f"{method}.json").read_text())
        frames = len(result["submission"]["frames_used"])
        errors = [f"{result['metrics'][key]:.2f}" for key in ("object_mae_mm", "overall_mae_mm")]
        (line,) = [line for line in printed.splitlines() if line.startswith(f"│ {method} ")]
        cells = [cell.strip() for cell in line.split("│")[1:-1]]
        assert (
            cells[:4] == [method, str(frames), *errors]
            and cells[5] == f"{result['reliance']['score']:.2f}"
        )
    for name in ("page/index.html", f"{SAMPLE}.png", f"{SAMPLE}.ply", f"{SAMPLE}.html"):
        assert (out / name).stat().st_size > 0
    commands = [line.strip() for line in printed.splitlines() if line.startswith("  fpp-")]
    assert commands == [step.line for step in steps_in(out)]
    for line in commands[-2:]:  # that of the picture, and that of the page: they run by hand, too
        run(line)


def test_predictions_are_shown_beside_the_frames_that_they_were_made_of(out, tmp_path, capsys):
    show = [
        "show",
        str(out / "mini"),
        SAMPLE,
        "--out",
        str(tmp_path / "shown.png"),
        "--predictions",
    ]
    assert main([*show, str(out / "phase")]) == 0 and main([*show, str(out / "crossed")]) == 2
    assert "test/frame_00 is another now; give the dataset" in capsys.readouterr().err
    assert main(["show", str(out / "mini"), "--sheet", "--predictions", str(out / "phase")]) == 2
    assert "--predictions: expected a SAMPLE" in capsys.readouterr().err


def test_results_of_another_version_are_not_shown(out, capsys, monkeypatch):
    monkeypatch.setattr("fpp_ml_bench.cli.demo.__version__", "0.0.1")
    assert main(["demo", "--out", str(out)]) == 2
    assert "this is 0.0.1; give a new folder by --out" in capsys.readouterr().err


def test_a_command_that_fails_stops_the_demo(tmp_path, capsys):
    (tmp_path / "demo").write_text("a file")
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 2
    assert "stopped at step 1; the same command continues there" in capsys.readouterr().err


def captures_in(folder):
    """What README's lines on an own rig start from: a sequence, poses of a board, a capture,
    captures of an object."""
    sequence = {"steps": 3, "bits_horizontal": 7, "bits_vertical": 7}
    (folder / "true.yaml").write_text(
        yaml.safe_dump({**paper_rig(240).to_dict(), "sequence": sequence})
    )
    run(
        "fpp-bench calibrate --virtual poses --true-rig true.yaml --poses 5 --lens none --out "
        "found.yaml"
    )
    (folder / "poses" / "rig.yaml").rename(folder / "projector.yaml")
    run("fpp-bench build --out lab --rig true.yaml --objects power_drill --workers 1")
    lab = DatasetFolder(folder / "lab")
    for sample, capture in (("power_drill_A0", "scan"), ("power_drill_A0", "scans/drill/front")):
        (folder / capture).mkdir(parents=True)
        for number in range(len(lab.sequence)):
            cv2.imwrite(str(folder / capture / f"{number:02}.png"), lab.frame(sample, number))


def test_every_command_and_block_of_readme_runs(out, published_hub, tmp_path, monkeypatch, capsys):
    """But for its two lines of installation, which CI runs as they are."""
    monkeypatch.chdir(tmp_path)
    Path("demo").symlink_to(out)
    captures_in(tmp_path)
    monkeypatch.setitem(PRESETS, "mini", (("mug", "cork", "power_drill"), 256))
    blocks = re.findall(
        r"^```(bash|python)\n(.*?)^```$", (ROOT / "README.md").read_text(), re.DOTALL | re.MULTILINE
    )
    ran = []
    for language, text in blocks:
        if text.startswith("# mine.py"):
            Path("mine.py").write_text(text)
        elif language == "python":
            exec(compile(text, "README.md", "exec"), {})
        elif "pip install" not in text:
            for line in text.splitlines():
                run(line)
                ran.append(line)
    assert len(blocks) - 2 >= 9 and len(ran) >= 12
    assert {"mine.png", "mine.html", "result.json", "rig.yaml"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert list(DatasetFolder("data/own").splits) and list(DatasetFolder("data/published").splits)
