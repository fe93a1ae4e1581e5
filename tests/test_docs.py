"""Docs name only files and modules that are there."""

import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted(
    {*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "evaluation/PROTOCOL.md"} - {ROOT / "CHANGELOG.md"}
)
TO_BE_WRITTEN = {"leaderboard/rows/my-method.json", "leaderboard/rows/NAME.json"}
TOP = "fpp_ml_bench|loaders|evaluation|baselines|leaderboard|tests|benchmarks|docs"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_files_and_modules_are_there(page):
    text = page.read_text(encoding="utf-8")
    for name in set(re.findall(rf"(?<![\w/.-])((?:{TOP})/[\w/.-]*[\w/])", text)) - TO_BE_WRITTEN:
        assert (ROOT / name).exists(), name
    for link in set(re.findall(r"\]\(([^):#]+)(?:#[^)]*)?\)", text)):
        assert (page.parent / link).exists(), link
    for name in set(re.findall(r"fpp_ml_bench(?:\.\w+)+", text)):
        parts = name.split(".")
        for count in range(len(parts), 0, -1):
            try:
                found = import_module(".".join(parts[:count]))
            except ModuleNotFoundError:
                continue
            for part in parts[count:]:
                found = getattr(found, part)
            break


def test_tables_are_those_of_the_rows(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from reliance_rows import table
    from robustness_tables import PAGE, filled, rows_in

    from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry

    entries = [read_entry(path) for path in sorted(SHIPPED_ROWS.glob("*.json"))]
    assert (ROOT / "docs/tables/reliance.md").read_text(encoding="utf-8") == table(entries)

    text = PAGE.read_text(encoding="utf-8")
    assert filled(text, rows_in(entries)) == text
    with pytest.raises(ValueError, match="markers <!-- test:begin -->"):
        filled("a page without them", {"test": []})
