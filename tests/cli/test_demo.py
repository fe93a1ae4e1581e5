"""``fpp-bench demo``: one table of computed numbers, resumed where it stopped, made of public commands."""

import json
import shlex

import pytest

from fpp_ml_bench.cli import main, main_eval
from fpp_ml_bench.cli.demo import METHODS, SAMPLE, steps_in
from fpp_ml_bench.constants import PRESETS


@pytest.fixture(scope="module")
def small():
    """The demo's preset with images of 200 px, so that the test takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "mini", (PRESETS["mini"][0], 200))
        yield


@pytest.fixture(scope="module")
def out(small, tmp_path_factory):
    """A demo that was stopped while its last method predicted, and then run again."""
    folder = tmp_path_factory.mktemp("demo") / "demo"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fpp_ml_bench.cli.predict.predict_split", _stopped_at_crossed(folder))
        assert main(["demo", "--out", str(folder)]) == 130
    return folder


def _stopped_at_crossed(folder):
    from fpp_ml_bench.cli.predict import predict_split

    def predict(opened, method, *rest):
        if method.name == "crossed":
            raise KeyboardInterrupt
        return predict_split(opened, method, *rest)

    return predict


def test_a_stopped_demo_goes_on_and_prints_what_was_computed(out, capsys):
    earlier = (out / "phase.json").read_bytes()
    assert main(["demo", "--out", str(out)]) == 0
    printed, steps = capsys.readouterr()
    assert (out / "phase.json").read_bytes() == earlier and "kept: fpp-bench reliance phase" in steps
    for method in METHODS:
        result = json.loads((out / f"{method}.json").read_text())
        frames = len(result["submission"]["frames_used"])
        errors = [f"{result['metrics'][key]:.2f}" for key in ("object_mae_mm", "overall_mae_mm")]
        (line,) = [line for line in printed.splitlines() if line.startswith(f"│ {method} ")]
        cells = [cell.strip() for cell in line.split("│")[1:-1]]
        assert cells[:4] == [method, str(frames), *errors] and cells[5] == f"{result['reliance']['score']:.2f}"
    for name in ("page/index.html", f"{SAMPLE}.png", f"{SAMPLE}.ply", f"{SAMPLE}.html"):
        assert (out / name).stat().st_size > 0
    commands = [line.strip() for line in printed.splitlines() if line.startswith("  fpp-")]
    assert commands == [shlex.join(step.words) for step in steps_in(out)]
    for line in commands[-2:]:  # that of the picture, and that of the page: they run by hand, too
        program, *words = shlex.split(line)
        assert {"fpp-bench": main, "fpp-eval": main_eval}[program](words) == 0


def test_predictions_are_shown_beside_the_frames_that_they_were_made_of(out, tmp_path, capsys):
    show = ["show", str(out / "mini"), SAMPLE, "--out", str(tmp_path / "shown.png"), "--predictions"]
    assert main([*show, str(out / "phase")]) == 0 and main([*show, str(out / "crossed")]) == 2
    assert "test/frame_00 is another; give that dataset" in capsys.readouterr().err
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
