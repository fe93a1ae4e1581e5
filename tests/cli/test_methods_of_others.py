"""Methods by classes alone: one of a stranger's file goes through every command, and every built-in
one under another name."""

import json
import re
from pathlib import Path

import pytest

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.cli import main
from fpp_ml_bench.cli import main_eval as evaluate

pytestmark = pytest.mark.long

README = Path(__file__).resolve().parents[2] / "README.md"


def of_readme() -> str:
    """The method that README shows."""
    (code,) = re.findall(r"```python\n# mine\.py\n(.*?)```", README.read_text(), re.DOTALL)
    return code


@pytest.fixture(scope="module")
def work(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("others")
    (folder / "mine.py").write_text(of_readme())
    built = [
        "build",
        "--out",
        str(folder / "data"),
        "--objects",
        "cork,mug,power_drill",
        "--size",
        "192",
    ]
    # A fringe of as many image px as the shipped networks learned from, so that no image is
    # enlarged.
    assert main([*built, "--pitch", "90", "--workers", "1"]) == 0
    return folder


def test_the_method_of_readme_goes_through_every_command(work, monkeypatch, capsys):
    monkeypatch.chdir(work)
    assert len(of_readme().splitlines()) <= 16
    assert main(["predict", "mine.py:Mine", "data", "--out", "predictions"]) == 0
    assert evaluate(["predictions", "--target", "depth_exact", "--json", "result.json"]) == 0
    assert main(["time", "mine.py:Mine", "data", "--repeats", "2", "--into", "result.json"]) == 0
    assert main(["reliance", "mine.py:Mine", "data", "--views", "1", "--into", "result.json"]) == 0
    measured = [
        "--axes",
        "ambient-light",
        "--quick",
        "--size",
        "192",
        "--out",
        "robust",
        "--no-cache",
    ]
    assert main(["robustness", "mine.py:Mine", *measured]) == 0
    assert (
        main(["tradeoff", "data", "--method", "mine.py:Mine", "--quick", "--out", "tradeoff"]) == 0
    )
    assert (
        main(
            [
                "diagnose",
                "mine.py:Mine",
                "data",
                "--quick",
                "--probe",
                "counterfactual",
                "--out",
                "report",
            ]
        )
        == 0
    )
    assert main(["leaderboard", "result.json", "--json", "ranking.json"]) == 0
    result = json.loads(Path("result.json").read_text())
    assert (
        result["submission"]["method"] == "mine"
        and result["reliance"]
        and result["submission"]["timing"]
    )
    assert "mine" in Path("ranking.json").read_text()


def test_every_built_in_method_under_another_name(work, monkeypatch, capsys):
    """No file but its own knows a method's name."""
    monkeypatch.chdir(work)
    methods = list(registry.methods().values())
    for method in methods:
        monkeypatch.setattr(method, "name", f"new-{method.name}")
    assert list(registry.methods()) == [method.name for method in methods]
    for method in methods:
        out = f"renamed/{method.name}"
        assert main(["predict", method.name, "data", "--out", out]) == 0, capsys.readouterr().err
        assert evaluate([out, "--target", "depth_exact", "--json", f"{method.name}.json"]) == 0
        assert (
            json.loads(Path(f"{method.name}.json").read_text())["submission"]["method"]
            == method.name
        )
    axis = [
        "--axes",
        "ambient-light",
        "--quick",
        "--size",
        "256",
        "--out",
        "robust-new",
        "--no-cache",
    ]
    assert main(["robustness", "new-crossed", *axis]) == 0
    assert main(["predict", "new-phas", "data", "--out", "none"]) == 2
    assert "did you mean 'new-phase'?" in capsys.readouterr().err
    assert main(["predict", "phase", "data", "--out", "none"]) == 2
    results = [str(path) for path in sorted(Path().glob("new-*.json"))]
    assert main(["leaderboard", *results, "--json", "renamed.json"]) == 0
