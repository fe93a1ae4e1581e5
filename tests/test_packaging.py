"""Packaging: every package folder is installed, and the checkout works as the current folder too."""

import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SUBPACKAGES = ("loaders", "evaluation", "baselines", "leaderboard")


def _setuptools() -> dict:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]


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


def test_every_package_folder_is_installed():
    assert sorted(_setuptools()["packages"]) == sorted(_package_folders())


def test_packages_come_from_their_folders():
    mapping = _setuptools()["package-dir"]
    for name, folder in _package_folders().items():
        parent = max((p for p in mapping if name == p or name.startswith(p + ".")), key=len)
        inner = name[len(parent) :].strip(".").replace(".", "/")
        assert "/".join(filter(None, (mapping[parent], inner))) == folder


def test_checkout_as_current_folder_brings_its_own_subpackages():
    code = "import fpp_ml_bench, importlib\n" + "".join(
        f"print(importlib.import_module('fpp_ml_bench.{subpackage}').__file__)\n" for subpackage in SUBPACKAGES
    )
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    assert printed == [str(ROOT / subpackage / "__init__.py") for subpackage in SUBPACKAGES]


def test_module_run_is_the_command():
    done = subprocess.run([sys.executable, "-m", "fpp_ml_bench", "--version"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("fpp-ml-bench ")


def test_dependencies_flow_one_way():
    """core <- loaders <- evaluation <- baselines <- leaderboard; only the commands import all of them."""
    order = ("core", *SUBPACKAGES)
    for top in ("fpp_ml_bench", *SUBPACKAGES):
        position = order.index("core" if top == "fpp_ml_bench" else top)
        for path in (ROOT / top).rglob("*.py"):
            relative = path.relative_to(ROOT).parts
            if relative[:2] == ("fpp_ml_bench", "cli") or (
                path.name in ("__init__.py", "__main__.py") and position == 0
            ):
                continue
            text = path.read_text()
            for later_package in order[position + 1 :]:
                assert f"fpp_ml_bench.{later_package}" not in text or _only_in_prose(text, later_package), (
                    f"{path} imports {later_package}"
                )


def _only_in_prose(text: str, subpackage: str) -> bool:
    return not any(
        line.strip().startswith((f"from fpp_ml_bench.{subpackage}", f"import fpp_ml_bench.{subpackage}"))
        for line in text.splitlines()
    )


def test_the_project_refers_to_no_outside_folder():
    for path in ROOT.rglob("*"):
        if path.suffix in (".py", ".md", ".toml", ".yaml", ".txt") and not {".git", ".venv", "build"} & set(path.parts):
            assert "../" + "shared" not in path.read_text(encoding="utf-8"), path
