"""Packaging: every package folder is installed, and the checkout works as the current folder
too."""

import ast
import os
import re
import runpy
import subprocess
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import lock
import pytest
import setuptools
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import fpp_ml_bench
from fpp_ml_bench.cli import COMMANDS, EVAL, EXTRAS

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parent.parent
SUBPACKAGES = ("loaders", "evaluation", "baselines", "leaderboard")


def _pyproject() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def _package_folders() -> dict[str, str]:
    """Installed name -> folder of every package in the checkout."""
    folders = {}
    for top, prefix in (
        ("fpp_ml_bench", "fpp_ml_bench"),
        *((subpackage, f"fpp_ml_bench.{subpackage}") for subpackage in SUBPACKAGES),
    ):
        for init in sorted((ROOT / top).rglob("__init__.py")):
            parts = init.parent.relative_to(ROOT / top).parts
            folders[".".join((prefix, *parts))] = "/".join((top, *parts))
    return folders


def _of_setup(monkeypatch) -> dict:
    """What setup.py gives setuptools."""
    given: dict = {}
    monkeypatch.setattr(setuptools, "setup", lambda **arguments: given.update(arguments))
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"))
    return given


def test_every_package_folder_is_installed(monkeypatch):
    assert sorted(_of_setup(monkeypatch)["packages"]) == sorted(_package_folders())


def test_packages_come_from_their_folders(monkeypatch):
    mapping = _of_setup(monkeypatch)["package_dir"]
    for name, folder in _package_folders().items():
        parent = max((p for p in mapping if name == p or name.startswith(p + ".")), key=len)
        inner = name[len(parent) :].strip(".").replace(".", "/")
        assert "/".join(filter(None, (mapping[parent], inner))) == folder


def test_every_data_file_is_installed():
    """Files beside the modules are in the wheel; the rows' pictures, 9 MB, are not."""
    data = _pyproject()["tool"]["setuptools"]["package-data"]
    left = []
    for name, folder in _package_folders().items():
        patterns = data.get(name, ())
        inner = [
            ROOT / other for other in _package_folders().values() if other.startswith(f"{folder}/")
        ]
        for file in sorted((ROOT / folder).rglob("*")):
            if not file.is_file() or any(file.is_relative_to(other) for other in inner):
                continue
            listed = any(file.relative_to(ROOT / folder).match(p) for p in patterns)
            if not listed and file.suffix not in (".py", ".pyc", ".png", ".nbi", ".nbc"):
                left.append(file)
    assert left == []


def test_checkout_as_current_folder_brings_its_own_subpackages_and_nothing_else():
    names = [f"fpp_ml_bench.{name}" for name in (*SUBPACKAGES, "tests", "benchmarks")]
    code = f"from importlib.util import find_spec as find\nfor name in {names}:\n"
    found = _python("-c", f"{code}    print(getattr(find(name), 'origin', None))").split()
    own = [str(ROOT / subpackage / "__init__.py") for subpackage in SUBPACKAGES]
    assert found == [*own, "None", "None"]


def _python(*words: str) -> str:
    """What Python prints in the checkout."""
    return subprocess.run(
        [sys.executable, *words], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def test_module_run_is_the_command():
    assert _python("-m", "fpp_ml_bench", "--version").startswith("fpp-ml-bench ")


def test_dependencies_flow_one_way():
    """core <- loaders <- evaluation <- baselines <- leaderboard; only the commands import all of
    them."""
    order = ("fpp_ml_bench", *SUBPACKAGES)
    for path, module in _imports():
        top, *inner = path.relative_to(ROOT).parts
        doors = {"cli", "__init__.py", "__main__.py", "api.py"}
        if top == "fpp_ml_bench" and inner[0] in doors:
            continue
        for later_package in order[order.index(top) + 1 :]:
            assert f"fpp_ml_bench.{later_package}." not in f"{module}.", path


def _imports():
    """Each module of the package, and what it imports, with all dots."""
    for top in ("fpp_ml_bench", *SUBPACKAGES):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    yield from ((path, alias.name) for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    yield from ((path, f"{node.module}.{alias.name}") for alias in node.names)


def test_the_project_refers_to_no_outside_folder():
    # tmp: of CI, where other tests make and remove folders meanwhile
    elsewhere = {".git", ".venv", "build", "tmp"}
    for folder, inner, names in os.walk(ROOT):
        inner[:] = [name for name in inner if name not in elsewhere]
        for path in (Path(folder, name) for name in names):
            if path.suffix in (".py", ".md", ".toml", ".yaml", ".txt"):
                assert "../" + "shared" not in path.read_text(encoding="utf-8"), path


WITHOUT_EXTRAS = """
import sys
from fpp_ml_bench.cli import EXTRAS, main
from fpp_ml_bench.cli import main_eval as evaluate
for library in sum(EXTRAS.values(), ()):
    sys.modules[library] = None  # as if it were not installed
words = sys.argv[1:]
sys.exit(evaluate(words[1:]) if words[0] == "fpp-eval" else main(words))
"""


@pytest.mark.parametrize(
    ("words", "library", "extra"),
    [
        ("train loss/l1 DATA --out run", "(torch|accelerate)", "train"),
        ("predict fringe-net DATA --out predictions", "torch", "train"),
        ("tradeoff DATA --quick --out tradeoff", "safetensors", "train"),
        ("diagnose unet-individual-rmse DATA --quick --out report", "torch", "train"),
        ("build --out more --objects cork --size 176 --cluster 127.0.0.1:1", "ray", "cluster"),
        ("stability --quick --out out", "(mpmath|torch)", "(diagnose|train)"),
    ],
)
def test_a_missing_library_is_answered_with_its_extra(tiny, tmp_path, words, library, extra):
    command = [sys.executable, "-c", WITHOUT_EXTRAS, *words.replace("DATA", str(tiny)).split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert re.search(
        rf"this needs {library}, which is not installed; pip install 'fpp-ml-bench\[{extra}\]'",
        done.stderr,
    )


def test_every_extra_lists_its_libraries():
    extras = _pyproject()["project"]["optional-dependencies"]
    for extra, libraries in EXTRAS.items():
        assert set(libraries) <= {re.split(r"[>=\[]", line)[0] for line in extras[extra]}


def test_every_imported_library_is_a_dependency():
    """What the package imports is of the standard library, a base dependency, or of an extra that
    `EXTRAS` names."""
    project = _pyproject()["project"]
    names = {"yaml": "pyyaml", "PIL": "pillow", "cv2": "opencv-contrib-python-headless"}
    base = {re.split(r"[>=\[]", line)[0].lower() for line in project["dependencies"]}
    imported = {module.partition(".")[0] for _, module in _imports()}
    of_type_checkers = {"_typeshed"}  # its import runs in no interpreter
    known = {*sys.stdlib_module_names, *of_type_checkers, "fpp_ml_bench"}
    outside = imported - known - set(sum(EXTRAS.values(), ()))
    needed = {names.get(name, name).lower().replace("_", "-") for name in outside}
    assert needed <= base, needed - base
    assert base <= needed, "a dependency that nothing imports"


def test_ci_runs_every_command_without_extras():
    """The script that CI runs in an environment without extras runs every command, not just its
    help."""
    script = (ROOT / ".ci/without_extras").read_text()
    for name in set(COMMANDS) - {
        "publish",
        "demo",
    }:  # one needs the network, CI runs the other in the same environment
        assert re.search(rf"^ *(needs \w+ )?fpp-bench {name} ", script, flags=re.MULTILINE), name
    for name in EVAL.commands:
        assert f"fpp-eval {name} " in script
    steps = (ROOT / ".ci/run").read_text()
    assert ".ci/without_extras" in steps and '"$work/clean/bin/fpp-bench" demo' in steps


def test_constraints_pin_what_every_extra_brings():
    """Of packages that are installed, also what they need in turn."""
    project = _pyproject()["project"]
    lines = [
        line.split("#")[0].strip() for line in (ROOT / "constraints.txt").read_text().splitlines()
    ]
    pins = {
        canonicalize_name(name): version
        for name, version in (line.split("==") for line in lines if line)
    }
    waiting = [
        Requirement(text)
        for texts in (project["dependencies"], *project["optional-dependencies"].values())
        for text in texts
    ]
    seen, problems = set(), []
    while waiting:
        requirement = waiting.pop()
        name = canonicalize_name(requirement.name)
        if name == project["name"] or (name, *sorted(requirement.extras)) in seen:
            continue
        seen.add((name, *sorted(requirement.extras)))
        if name not in pins or not requirement.specifier.contains(pins[name], prereleases=True):
            problems.append(f"{requirement}: {pins.get(name, 'not pinned')}")
        with suppress(metadata.PackageNotFoundError):
            extras = requirement.extras or {""}
            for needed in map(Requirement, metadata.requires(name) or ()):
                if needed.marker is None or any(
                    needed.marker.evaluate({"extra": extra}) for extra in extras
                ):
                    waiting.append(needed)
    assert not problems


def test_constraints_are_those_of_the_lock_file():
    assert (
        lock.constraints((ROOT / "pylock.toml").read_text())
        == (ROOT / "constraints.txt").read_text()
    )
    packages = tomllib.loads((ROOT / "pylock.toml").read_text())["packages"]
    for package in packages:
        files = [*package.get("wheels", ()), *filter(None, [package.get("sdist")])]
        assert files and all(file["hashes"]["sha256"] for file in files), package["name"]
        assert all(file["url"].startswith("https://") for file in files), package["name"]
    names = {package["name"] for package in packages}
    assert "opencv-contrib-python-headless" in names and "opencv-contrib-python" not in names


def test_one_version_and_one_date_of_the_release():
    project = _pyproject()["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    preferred = citation["preferred-citation"]["version"]
    assert {citation["version"], preferred, project["version"]} == {fpp_ml_bench.__version__}
    assert citation["date-released"] == fpp_ml_bench.RELEASED
    changelog = (ROOT / "CHANGELOG.md").read_text()
    title = f"## {fpp_ml_bench.__version__} - {fpp_ml_bench.RELEASED}\n"
    assert title in changelog and len(changelog.splitlines()) <= 80
