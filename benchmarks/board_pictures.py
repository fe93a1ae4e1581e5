"""The pictures of the leaderboard in the documentation, and whether they are those of today's rows.

    python benchmarks/board_pictures.py [--check]

``docs/pictures/leaderboard.png`` is the first screen of the page (by chromium), ``docs/pictures/charge.png`` the
two-sided MAE of the methods of one frame against what a missed or invented pixel costs. Each holds the hash of the rows
that it shows, so a picture that is older than its rows is found: with ``--check`` nothing is made, and the exit status
is 1 where one is.
"""

import argparse
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

from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.page.page import of_one_target, write_page
from fpp_ml_bench.leaderboard.ranking import Group, Ranked, is_trivial, rank, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.tables import chosen_tables
from fpp_ml_bench.style import LINE, LINE_COLOURS, panels, styled, with_legend

ROOT = Path(__file__).resolve().parent.parent
PICTURES = ROOT / "docs" / "pictures"
SCREEN, CHARGE = PICTURES / "leaderboard.png", PICTURES / "charge.png"
ROWS_KEY = "rows"
CHARGES_MM = np.geomspace(3, 3000, 61)
CURVES = 8
"""Methods whose curves are drawn, the least error first; more lines can't be told apart."""


def rows_hash() -> str:
    """Of all rows that ship with the package."""
    return sha256(
        "".join(sha256(path.read_bytes()).hexdigest() for path in sorted(shipped_rows())).encode()
    ).hexdigest()


def first_screen() -> bytes:
    """The page's first screen, PNG. Raises CalledProcessError and FileNotFoundError where there is no chromium."""
    with tempfile.TemporaryDirectory() as folder:
        index, *_ = write_page(rank(read_entries(shipped_rows())), chosen_tables(None), Path(folder, "page"))
        words = [
            "chromium",
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--hide-scrollbars",
            "--window-size=1440,900",
        ]
        shot = Path(folder, "shot.png")
        subprocess.run([*words, f"--screenshot={shot}", index.resolve().as_uri()], check=True, capture_output=True)
        return shot.read_bytes()


def of_one_frame(groups: Sequence[Group]) -> tuple[Group, list[Ranked]]:
    """The first table of one frame on the metric track, and its rows without trivial ones, the least error first."""
    groups = [group for group in groups if group.key.data_title == groups[0].key.data_title and group.vouched]
    of_class = [group for group in groups if group.key.frames == FRAMES_CLASSES[0] and group.key.track == "metric"]
    group = of_one_target(of_class)[0]
    rows = [row for row in group.rows if not is_trivial(row) and row.value(row.rank_key) is not None]
    return group, sorted(rows, key=lambda row: (row.value(row.rank_key), row.short_name))


def by_charge(group: Group, row: Ranked, charge_mm: np.ndarray) -> np.ndarray:
    """The two-sided MAE of a row at other charges, in mm: it is linear in them."""
    error, missing, invented = (
        row.value(key) or 0.0 for key in ("two_sided_mae_mm", "object_missing_share", "invented_share")
    )
    charged = missing + invented
    return error - (group.key.charge_mm or 0.0) * charged + charge_mm * charged


@styled
def charge_curves() -> bytes:
    """Two-sided MAE against the charge, PNG."""
    group, rows = of_one_frame(rank(read_entries(shipped_rows())))
    drawn, (panel,) = panels(["One frame, two-sided MAE against the charge"], 1, 7.0, 4.2)
    for number, row in enumerate(rows[:CURVES]):
        errors = by_charge(group, row, CHARGES_MM)
        style = ("-", "--")[number // len(LINE_COLOURS) % 2]
        panel.plot(
            CHARGES_MM, errors, style, color=LINE_COLOURS[number % len(LINE_COLOURS)], label=row.short_name, **LINE
        )
    panel.axvline(group.key.charge_mm or 0.0, linestyle=":", color="0.5", label="the leaderboard's")
    panel.set(
        xscale="log", yscale="log", xlabel="charge for a missed or invented pixel, mm", ylabel="two-sided MAE, mm"
    )
    return with_legend(drawn, 3)


def marked(png: bytes) -> bytes:
    """The picture with the hash of the rows in it."""
    info, out = PngInfo(), BytesIO()
    info.add_text(ROWS_KEY, rows_hash())
    with Image.open(BytesIO(png)) as image:
        image.save(out, "PNG", pnginfo=info, optimize=True)
    return out.getvalue()


def outdated() -> list[str]:
    """A line for each picture that is not of today's rows."""
    lines = []
    for path in (SCREEN, CHARGE):
        with Image.open(path) as image:
            if image.info.get(ROWS_KEY) != rows_hash():
                lines.append(
                    f"{path.relative_to(ROOT)} is older than the rows; run: python benchmarks/board_pictures.py"
                )
    return lines


def main(words: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--check", action="store_true", help="make nothing; exit status 1 where one is older than the rows"
    )
    if parser.parse_args(words).check:
        found = outdated()
        print("\n".join(found or ["the pictures are those of the rows"]))
        return bool(found)
    for path, make in ((SCREEN, first_screen), (CHARGE, charge_curves)):
        write_atomically(path, marked(make()))
        print(f"{path}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
