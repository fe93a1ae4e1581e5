"""The leaderboard's columns, once for terminal and Markdown: a title, and the cell of an entry as plain text."""

from collections.abc import Callable
from dataclasses import dataclass

from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.evaluation.report import millimetres, percent, seconds
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.groups import TOLD, Ranked, assumption
from fpp_ml_bench.leaderboard.paper import PaperRow, PaperTable
from fpp_ml_bench.leaderboard.rows import Entry

DEVICE_WIDTH = 40
SELF_REPORTED = "*"
NOT_MEASURED = "not measured"
RANK_NOTE = (
    "Rank: the best and the worst that the 95% intervals allow. Best: 1 + the rows whose whole interval is better; "
    "worst: all rows minus those whose whole interval is worse."
)
NOTE = (
    f"Errors in mm, mean over samples; 95% interval from a bootstrap over objects. {RANK_NOTE} {SELF_REPORTED} time as "
    "reported by its author, not measured here."
)


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell; ``right``: aligned to the right, as numbers are. A terminal of fewer than ``from_width``
    characters leaves the column out."""

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
        ends = row.entry.interval(key)
        return "-" if ends is None else "-".join(millimetres(end) for end in ends)

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
"""Characters of a terminal from which on more columns fit."""
ONLY_IN_FILES = 1_000_000
_LONGEST_NAME = 90
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
    """Columns of a ranking by ``sort``; a key without a column gets its own."""
    shown = list(_TITLES)
    if sort not in shown and sort not in _ALWAYS_SORTABLE:
        shown.insert(0, sort)
    titled = {key: _TITLES.get(key, (key.removesuffix("_mm").replace("_", " "), 0)) for key in shown}
    return [
        Column("Rank", lambda row: row.ranks),
        Column("Method", lambda row: printable(row.short_name), right=False),
        *(
            column
            for key, (title, from_width) in titled.items()
            for column in _with_interval(key, title, sort, from_width)
        ),
        Column("s/sample", _time),
        Column("Frames", lambda row: str(row.entry.frames)),
        Column("Phase reliance", lambda row: reliance(row.entry), from_width=WIDE),
        Column("Provenance", lambda row: row.entry.provenance, right=False, from_width=MIDDLE),
        Column("Assumes", lambda row: assumption(row.entry.result) or "-", right=False, from_width=WIDEST),
        Column("Timed on", lambda row: device(row.entry), right=False, from_width=WIDEST),
        Column("Full name", lambda row: printable(row.entry.name, _LONGEST_NAME), False, ONLY_IN_FILES),
    ]


def _with_interval(key: str, title: str, sort: str, from_width: int) -> list[Column]:
    """The column of ``key``; beside the key that the rows are ranked by, the column of its interval."""
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


def paper_note(paper: PaperTable) -> str:
    """Below a table of the paper: other data, and what the methods of its tracks were told."""
    tracks = sorted({row.track for row in paper.rows})
    told = [f"{track}: told {TOLD[track]}." for track in tracks if TOLD[track]]
    return " ".join(["Other data, not ranked with the rows above.", *told])
