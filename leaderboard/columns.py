"""The columns of the leaderboard's tables: what a cell says of a row, and where a column is shown."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from fpp_ml_bench.evaluation.metrics import METRICS, RANGE_KEY, RANK_KEY, WIDE, WIDEST, with_column
from fpp_ml_bench.evaluation.report.terminal import score_text
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.groups import TEST, UNSEEN, Ranked
from fpp_ml_bench.leaderboard.names import assumption, learned_from
from fpp_ml_bench.leaderboard.row_file import processor
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.style import millimetres, percent, three_digits

NOT_CHECKED = "*"
NOT_MEASURED = "not measured"
RANK_NOTE = (
    "Rank range: ranks that the paired tests can't exclude. A sign-flip test compares each pair of rows object by "
    "object; two rows differ where p is at most 5% after Holm's correction over all pairs of the table. The first rank "
    "is 1 + the number of better rows, the last is the number of ranked rows minus that of the worse rows."
)
RATIO_NOTE = (
    "x trivial: object MAE divided by that of the best trivial method (a constant depth, or the depth of the most "
    "similar training image) that is given no more of the ground truth than the methods of the table. "
    "Of depth range: object MAE divided by the depth range of each sample's object."
)
TRUST_NOTE = (
    "(4): not ranked, because no maintainer vouches for the row; 1 + the number of ranked rows with a smaller error. "
    f"{NOT_CHECKED}: time, phase reliance or robustness as the row's author reports it, not measured here."
)
NOTE = (
    f"Errors in mm, mean over samples; 95% interval from a bootstrap over objects. {RANK_NOTE} {TRUST_NOTE} "
    f"{RATIO_NOTE}"
)
MIDDLE = 100
"""Where a terminal is too narrow, columns of a larger number are left out first."""
ONLY_IN_FILES = 1_000_000
_DEVICE_WIDTH, _LONGEST_NAME = 40, 90


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell; ``right``: aligned to the right, as numbers are. Where a terminal is too narrow, columns
    of the largest ``from_width`` are left out first. A table has it where ``present`` holds of any row."""

    title: str
    text: Callable[[Ranked], str]
    right: bool = True
    from_width: int = 0
    present: Callable[[Ranked], bool] = lambda row: True

    def shown_for(self, rows: Sequence[Ranked]) -> bool:
        """Whether a table of ``rows`` has it."""
        return any(map(self.present, rows))


def columns(sort: str) -> list[Column]:
    """Columns of a ranking by ``sort``; a key without a column gets its own, and that of the errors its interval."""
    shown = {metric.key: metric.column for metric in with_column(WIDEST)}
    if sort in METRICS:
        own = sort.removesuffix("_mm").replace("_", " ")
        shown = shown if sort in shown else {sort: own, **shown}
    errors = []
    for key, title in shown.items():
        errors.append(Column(title, partial(error, key), from_width=0 if key == sort else METRICS[key].column_from))
        if key == sort and METRICS[key].headline:
            ends = partial(interval, between="-", key=sort)
            errors.append(Column("95% interval", ends, from_width=MIDDLE))
        if key == RANK_KEY:
            errors += [*PARTS, RATIO, RANGE]
    return [
        RANK,
        METHOD,
        CODE,
        *errors,
        Column("s/sample", _seconds),
        FRAMES,
        RELIANCE,
        ROBUSTNESS,
        *UNCERTAINTY,
        PROVENANCE,
        LEARNED,
        Column("Assumes", lambda row: assumption(row.entry.row) or "-", False, WIDEST),
        Column("Timed on", lambda row: device(row.entry), False, WIDEST),
        Column("Full name", lambda row: printable(row.entry.name, _LONGEST_NAME), False, ONLY_IN_FILES),
    ]


def error(key: str, row: Ranked) -> str:
    return score_text(key, row.value(key))


def error_on(benchmark: str, row: Ranked) -> str:
    """Object MAE on the part of the row that is of ``benchmark``, `TEST` or `UNSEEN`; a dash without any."""
    part = row.on(benchmark)
    return "-" if part is None else millimetres(part.value(RANK_KEY))


def interval(row: Ranked, between: str, key: str = RANK_KEY) -> str:
    return between.join(map(millimetres, row.interval(key) or ())) or "-"


def ratio(row: Ranked) -> str:
    """The row's object MAE over that of the best trivial row, to two significant digits."""
    return "-" if row.ratio is None else f"{row.ratio:.2g}" if row.ratio < 10 else f"{row.ratio:.0f}"


def uncertainty(entry: Entry) -> tuple[float | None, float | None]:
    """`RowUncertainty` as two values; None where no uncertainty was scored."""
    block = entry.row.uncertainty
    return (None, None) if block is None else (block.within_95_share, block.ause_mae_mm)


def _seconds(row: Ranked) -> str:
    value = row.entry.value("seconds_per_sample")
    return three_digits(value) + (NOT_CHECKED if value is not None and not row.entry.time_measured else "")


def milliseconds_text(row: Ranked) -> str:
    ms = row.entry.latency_ms
    return "-" if ms is None else f"{ms:.3g}{'' if row.entry.time_measured else NOT_CHECKED}"


def reliance(entry: Entry) -> str:
    """The phase-reliance score with two decimals."""
    measured = entry.row.reliance
    return NOT_MEASURED if measured is None else f"{measured.score:.2f}{_mark(entry)}"


def _mark(entry: Entry) -> str:
    """Behind what only its author measured."""
    return "" if entry.all_checked else NOT_CHECKED


def reliance_interval(entry: Entry) -> str:
    """The ends of its interval; empty without any."""
    low, high = entry.row.reliance.interval if entry.row.reliance else (None, None)
    return "" if low is None or high is None else f"{low:.2f} - {high:.2f}"


def robustness(entry: Entry) -> str:
    """Mean error over the disturbed scenes of the test set, mm with one decimal."""
    measured = (entry.row.robustness or {}).get("test")
    return NOT_MEASURED if measured is None else f"{measured.mae_mm:.1f}{_mark(entry)}"


def device(entry: Entry) -> str:
    """What the time was taken on: the GPU where there is one, else the CPU and its cores; a dash when unknown."""
    hardware = entry.row.hardware
    return "-" if hardware is None else printable(hardware.gpu or processor(hardware), _DEVICE_WIDTH)


def _states_uncertainty(row: Ranked) -> bool:
    return uncertainty(row.entry) != (None, None)


RANK = Column("Rank", lambda row: row.ranks, present=lambda row: row.best_rank is not None)
CODE = Column("Code", lambda row: printable(row.entry.row.dataset.code, _DEVICE_WIDTH), False, MIDDLE)
METHOD = Column("Method", lambda row: printable(row.short_name), False)
FRAMES = Column("Frames", lambda row: str(row.entry.frames))
PARTS = tuple(
    Column(title, partial(error_on, part), True, MIDDLE, lambda row: row.on(UNSEEN) is not None)
    for title, part in (("On test", TEST), ("On unseen", UNSEEN))
)
"""Both errors of a row that joins the two sets."""
RANGE = Column("Of depth range", partial(error, RANGE_KEY), True, MIDDLE, lambda row: row.value(RANGE_KEY) is not None)
RATIO = Column("x trivial", ratio, present=lambda row: row.ratio is not None)
RELIANCE = Column("Phase reliance", lambda row: reliance(row.entry), True, WIDE)
ROBUSTNESS = Column("Disturbed, mm", lambda row: robustness(row.entry), True, WIDEST)
UNCERTAINTY = (
    Column("In 95%", lambda row: percent(uncertainty(row.entry)[0]), True, WIDEST, _states_uncertainty),
    Column("AUSE", lambda row: millimetres(uncertainty(row.entry)[1]), True, WIDEST, _states_uncertainty),
)
LEARNED = Column(
    "Learned from",
    lambda row: learned_from(row.entry.row) or "-",
    False,
    WIDEST,
    lambda row: bool(learned_from(row.entry.row)),
)
PROVENANCE = Column("Provenance", lambda row: row.provenance, False, MIDDLE)
