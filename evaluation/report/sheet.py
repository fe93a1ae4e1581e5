"""One picture of a submission: its best, median and worst sample, five panels each; for the leaderboard's page."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report.figures import Panel, colour_table
from fpp_ml_bench.evaluation.report.html import palette_png
from fpp_ml_bench.evaluation.report.report_page import ReportedDataset, chosen_panels
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.files import printable, write_atomically

TILE_PX, GAP_PX = 160, 8
PLACES = ("Best", "Median", "Worst")
_MAPS = ("gray", "viridis", "magma", "coolwarm")
_LEVELS = 63
"""Colours per map: four maps and the transparent index fit into a PNG's palette of 256."""


def write_sheet(result: Result, dataset: ReportedDataset, predictions_folder: str | Path, path: Path) -> None:
    """Write the sheet as PNG. Raises what `fpp_ml_bench.evaluation.report.report_page.write_report` raises."""
    rows = [panels for title, _, panels in chosen_panels(result, dataset, Path(predictions_folder)) if title in PLACES]
    try:
        write_atomically(path, sheet_png(rows))
    except OSError as error:
        raise SubmissionError(f"{printable(str(path), 500)} can't be written: {error.strerror}") from None


def sheet_png(rows: list[list[Panel]]) -> bytes:
    """Panels in rows and columns as one PNG."""
    tables = [colour_table(name, _LEVELS)[1:] for name in _MAPS]
    palette = np.zeros((256, 3), np.uint8)
    palette[1 : 1 + _LEVELS * len(_MAPS)] = np.vstack(tables)
    lines = [np.hstack([_tile(panel) for panel in panels]) for panels in rows]
    sheet = np.vstack(lines) if lines else np.zeros((TILE_PX, TILE_PX), np.uint8)
    return palette_png(sheet[: sheet.shape[0] - GAP_PX, : sheet.shape[1] - GAP_PX], palette)


def _tile(panel: Panel) -> NDArray[np.uint8]:
    """The panel's indices into the common palette at the tile's size, with the gap right of it and below.

    Pixels are left out or repeated, never averaged.
    """
    height, width = panel.indices.shape
    side = max(height, width)
    rows, columns = (np.arange(n * TILE_PX // side) * side // TILE_PX for n in (height, width))
    small = panel.indices[np.ix_(rows, columns)]
    levels = 1 + (small.astype(np.int64) - 1) * _LEVELS // 255 + _LEVELS * _MAPS.index(panel.colours)
    tile = np.zeros((TILE_PX + GAP_PX, TILE_PX + GAP_PX), np.uint8)
    tile[: small.shape[0], : small.shape[1]] = np.where(small > 0, levels, 0)
    return tile
