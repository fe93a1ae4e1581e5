"""What the documentation shows of the leaderboard's rows, and whether it is that of today's rows.

    python benchmarks/shown_rows.py [--check]

- Pictures in ``docs/pictures``: ``leaderboard.png``, the first screen of the page by chromium, and
  ``charge.png``, the two-sided MAE of the methods of one frame against what a missed or invented
  pixel costs. Each holds the hash of the rows that it shows.
- Tables between ``<!-- rows: NAME NAME; KEY KEY -->`` and ``<!-- end of rows -->``: a line for each
  row file, a column for each score, with ``frames`` and ``time_ms`` among them.
- Figures in sentences are links: ``[2.4](../../leaderboard/rows/crossed.json "object_mae_mm")``;
  several are separated by a slash between blanks, in the text and in the title.

With ``--check`` nothing is made: what is older than its row is listed, and the exit status is 1.
Figures in sentences are listed in any case, since only their author can mend them.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from hashlib import sha256
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from upkeep import best_rows

from fpp_ml_bench.evaluation.metrics import METRICS
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.page.page import write_page
from fpp_ml_bench.leaderboard.ranking import (
    Group,
    Ranked,
    rank,
    read_entries,
    shipped_rows,
    short_names,
)
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, Entry, read_entry
from fpp_ml_bench.leaderboard.tables import chosen_tables
from fpp_ml_bench.style import LINE, LINE_COLOURS, panels, styled, three_digits, with_legend
from fpp_ml_bench.tables import Table

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
SCREEN, CHARGE = PICTURES / "leaderboard.png", PICTURES / "charge.png"
ROWS_KEY = "rows"
_TABLE = re.compile(
    r"(<!-- rows: ([\w .-]+); ([\w ]+) -->)\n(?:.*?)(<!-- end of rows -->)", re.DOTALL
)
_FIGURE = re.compile(r"\[([\d./ ]+)\]\([./]*leaderboard/rows/([\w.-]+)\.json \"([\w/ ]+)\"\)")
CHARGES_MM = np.geomspace(3, 3000, 61)
CURVES = 8
"""Methods whose curves are drawn, the least error first; more lines can't be told apart."""


def rows_hash() -> str:
    """Of all rows that ship with the package."""
    return sha256(
        "".join(sha256(path.read_bytes()).hexdigest() for path in sorted(shipped_rows())).encode()
    ).hexdigest()


def first_screen() -> bytes:
    """The page's first screen, PNG. Raises CalledProcessError and FileNotFoundError where there is
    no chromium."""
    with tempfile.TemporaryDirectory() as folder:
        index, *_ = write_page(
            rank(read_entries(shipped_rows())), chosen_tables(None), Path(folder, "page")
        )
        words = [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--window-size=1440,900",
        ]
        shot = Path(folder, "shot.png")
        subprocess.run(
            [*words, f"--screenshot={shot}", index.resolve().as_uri()],
            check=True,
            capture_output=True,
        )
        return shot.read_bytes()


def by_charge(group: Group, row: Ranked, charge_mm: np.ndarray) -> np.ndarray:
    """The two-sided MAE of a row at other charges, in mm: it is linear in them."""
    error, missing, invented = (
        row.value(key) or 0.0
        for key in ("two_sided_mae_mm", "object_missing_share", "invented_share")
    )
    charged = missing + invented
    return error - (group.key.charge_mm or 0.0) * charged + charge_mm * charged


@styled
def charge_curves() -> bytes:
    """Two-sided MAE against the charge, PNG."""
    best = best_rows(rank(read_entries(shipped_rows())), FRAMES_CLASSES[0])
    if best is None:
        raise SystemExit("no row of one frame to draw")
    group, rows = best
    drawn, (panel,) = panels(["One frame, two-sided MAE against the charge"], 1, 7.0, 4.2)
    for number, row in enumerate(rows[:CURVES]):
        errors = by_charge(group, row, CHARGES_MM)
        style = ("-", "--")[number // len(LINE_COLOURS) % 2]
        panel.plot(
            CHARGES_MM,
            errors,
            style,
            color=LINE_COLOURS[number % len(LINE_COLOURS)],
            label=row.short_name,
            **LINE,
        )
    panel.axvline(group.key.charge_mm or 0.0, linestyle=":", color="0.5", label="the leaderboard's")
    panel.set(
        xscale="log",
        yscale="log",
        xlabel="charge for a missed or invented pixel, mm",
        ylabel="two-sided MAE, mm",
    )
    return with_legend(drawn, 3)


def marked(png: bytes) -> bytes:
    """The picture with the hash of the rows in it."""
    info, out = PngInfo(), BytesIO()
    info.add_text(ROWS_KEY, rows_hash())
    with Image.open(BytesIO(png)) as image:
        image.save(out, "PNG", pnginfo=info, optimize=True)
    return out.getvalue()


def older_pictures() -> list[str]:
    """A line for each picture that is not of today's rows."""
    lines = []
    for path in (SCREEN, CHARGE):
        with Image.open(path) as image:
            if image.info.get(ROWS_KEY) != rows_hash():
                lines.append(f"{path.relative_to(ROOT)}: older than the rows")
    return lines


OTHERS = {"frames": "Frames", "time_ms": "Time, ms", "memory_mib": "Memory, MiB"}
"""What a table may show of a row beside its scores."""


def value_of(entry: Entry, key: str) -> float:
    """A score of a row, or one of `OTHERS`. KeyError for what it does not have."""
    timing = entry.row.submission.timing
    others = {
        "frames": float(entry.frames),
        "time_ms": entry.latency_ms,
        "memory_mib": timing.working_memory_mib if timing else None,
    }
    value = others[key] if key in others else entry.value(key)
    if value is None:
        raise KeyError(key)
    return 100 * value if key.endswith("_share") else value


def title_of(key: str) -> str:
    if key in OTHERS:
        return OTHERS[key]
    return f"{METRICS[key].title}, {'%' if key.endswith('_share') else 'mm'}"


def rows_table(names: Sequence[str], keys: Sequence[str]) -> str:
    """The Markdown between the markers."""
    entries = [read_entry(SHIPPED_ROWS / f"{name}.json") for name in names]
    shown = Table("Method", numbers=[title_of(key) for key in keys])
    for entry, short in zip(
        entries, short_names([entry.row.submission for entry in entries]), strict=True
    ):
        shown.add_row(short, *(three_digits(value_of(entry, key)) for key in keys))
    return "\n".join(["", *shown.markdown(), ""])


def with_tables(page: str) -> str:
    """The text of a page with its tables made again."""
    return _TABLE.sub(
        lambda found: f"{found[1]}\n{rows_table(found[2].split(), found[3].split())}\n{found[4]}",
        page,
    )


def wrong_figures(page: str) -> list[str]:
    """A line for each figure of a page that is not its row's, rounded to the digits that are
    shown."""
    lines = []
    for texts, name, keys in _FIGURE.findall(page):
        entry = read_entry(SHIPPED_ROWS / f"{name}.json")
        shown, wanted = texts.split(" / "), keys.split(" / ")
        rounded = [
            f"{value_of(entry, key):.{len(text.partition('.')[2])}f}"
            for key, text in zip(wanted, shown, strict=False)
        ]
        if rounded != shown:
            lines.append(f"{texts} of {name}: the row has {' / '.join(rounded)}")
    return lines


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--check", action="store_true", help="make nothing; exit status 1 where something is older"
    )
    check, found = parser.parse_args(words).check, []
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        before = path.read_text(encoding="utf-8")
        after = with_tables(before)
        if check and after != before:
            found.append(f"{path.relative_to(ROOT)}: a table is older than its rows")
        elif after != before:
            write_atomically(path, after.encode())
        found += [f"{path.relative_to(ROOT)}: {line}" for line in wrong_figures(after)]
    if check:
        found += older_pictures()
    else:
        for path, make in ((SCREEN, first_screen), (CHARGE, charge_curves)):
            write_atomically(path, marked(make()))
    print("\n".join(found or ["everything shown is of the rows"]))
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
