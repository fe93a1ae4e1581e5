"""The leaderboard's columns, once for terminal and Markdown: a title, and the cell of an entry as plain text."""

from collections.abc import Callable
from dataclasses import dataclass

from fpp_ml_bench.evaluation.numbers import millimetres, percent, seconds
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.leaderboard.paper import PaperRow
from fpp_ml_bench.leaderboard.ranking import Ranked
from fpp_ml_bench.leaderboard.rows import Entry

NAME_WIDTH = 90
DEVICE_WIDTH = 40
SELF_REPORTED = "*"
NOT_MEASURED = "not measured"
NOTE = (
    "Errors in mm, mean over samples; 95% interval from a bootstrap over objects. Rank: 1 and the number of methods "
    f"whose whole interval is better. {SELF_REPORTED} time as reported by its author, not measured here."
)


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell; numbers stand on the right. Narrower than ``from_width`` characters, it is left out."""

    title: str
    text: Callable[[Ranked], str]
    right: bool = True
    from_width: int = 0


def _metric(key: str) -> Callable[[Ranked], str]:
    return lambda row: (percent if key.endswith("_share") else millimetres)(row.entry.value(key))


def _time(row: Ranked) -> str:
    value = row.entry.value("seconds_per_sample")
    return seconds(value) + (SELF_REPORTED if value is not None and not row.entry.time_measured else "")


def _interval(key: str) -> Callable[[Ranked], str]:
    def text(row: Ranked) -> str:
        found = row.entry.interval(key)
        return "-" if found is None else "-".join(millimetres(end) for end in found)

    return text


def reliance(entry: Entry) -> str:
    """The phase-reliance score with two decimals."""
    return NOT_MEASURED if entry.reliance is None else f"{entry.reliance.score:.2f}"


def reliance_interval(entry: Entry) -> str:
    """The ends of its interval; empty without any."""
    low, high = (None, None) if entry.reliance is None else entry.reliance.interval
    return "" if low is None or high is None else f"{low:.2f} - {high:.2f}"


def device(entry: Entry) -> str:
    """What the time was taken on: the GPU where there is one, else the CPU and its cores; a dash when unknown."""
    timing = entry.result.timing
    hardware = timing.hardware if timing is not None else entry.result.submission.hardware
    if hardware is None:
        return "-"
    cores = "1 core" if hardware.cores == 1 else f"{hardware.cores} cores"
    return printable(hardware.gpu or f"{hardware.cpu}, {cores}", DEVICE_WIDTH)


MIDDLE, WIDE, WIDEST = 100, 140, 170
"""Characters from which on more columns fit."""
_TITLES = {
    "object_mae_mm": ("Object MAE", 0),
    "object_rmse_mm": ("Object RMSE", 0),
    "overall_mae_mm": ("Overall MAE", 0),
    "background_mae_mm": ("Backgr. MAE", WIDE),
    "object_missing_share": ("Missing", WIDE),
    "object_interior_mae_mm": ("Interior MAE", WIDEST),
    "object_edge_mae_mm": ("Edge MAE", WIDEST),
}
_ALWAYS_SORTABLE = ("seconds_per_sample", "frames_used")


def columns(sort: str) -> list[Column]:
    """Columns of a ranking by ``sort``; a key that has no column of its own gets one."""
    shown = list(_TITLES)
    if sort not in shown and sort not in _ALWAYS_SORTABLE:
        shown.insert(0, sort)
    titled = {key: _TITLES.get(key, (key.removesuffix("_mm").replace("_", " "), 0)) for key in shown}
    return [
        Column("#", lambda row: str(row.rank)),
        Column("Method", lambda row: printable(row.entry.name, NAME_WIDTH), right=False),
        *(
            column
            for key, (title, from_width) in titled.items()
            for column in _with_interval(key, title, sort, from_width)
        ),
        Column("s/sample", _time),
        Column("Frames", lambda row: str(row.entry.frames)),
        Column("Phase reliance", lambda row: reliance(row.entry), from_width=WIDE),
        Column("Provenance", lambda row: row.entry.provenance, right=False, from_width=MIDDLE),
        Column("Timed on", lambda row: device(row.entry), right=False, from_width=WIDEST),
    ]


def _with_interval(key: str, title: str, sort: str, from_width: int) -> list[Column]:
    """The column of ``key``, and that of its interval beside the one that is ranked by."""
    column = Column(title, _metric(key), from_width=0 if key == sort else from_width)
    return [column, Column("95% interval", _interval(key), from_width=MIDDLE)] if key == sort in HEADLINE else [column]


PAPER_TITLES = (
    "Row", "Track", "Test samples", "Object MAE", "Object RMSE", "Overall MAE", "Overall RMSE", "Backgr. MAE",
    "Backgr. RMSE",
)  # fmt: skip


def paper_cells(row: PaperRow) -> list[str]:
    """Cells under `PAPER_TITLES`, errors with the paper's two decimals."""
    keys = (f"{pixels}_{error}_mm" for pixels in ("object", "overall", "background") for error in ("mae", "rmse"))
    return [row.label, row.track, str(row.test_samples), *(f"{row.errors_mm[key]:.2f}" for key in keys)]
