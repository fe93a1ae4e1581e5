"""The columns of the leaderboard's tables: what a cell says of a row, and where a column is
shown."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from fpp_ml_bench.baselines.method import Assumption
from fpp_ml_bench.baselines.registry import methods
from fpp_ml_bench.evaluation.metrics import (
    METRICS,
    OBJECT_KEY,
    RANGE_KEY,
    RANKED,
    WIDE,
    WIDEST,
    with_column,
)
from fpp_ml_bench.evaluation.report.terminal import score_text
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.ranking import Ranked
from fpp_ml_bench.leaderboard.row_file import Row, RowUncertainty, processor
from fpp_ml_bench.leaderboard.rows import TEST, UNSEEN, Entry
from fpp_ml_bench.style import millimetres, percent, three_digits

NOT_CHECKED = "*"
NOT_MEASURED = "not measured"
RANK_NOTE = (
    "Rank range: ranks that the paired tests can't exclude. A sign-flip test compares each pair of "
    "rows object by "
    "object; two rows differ where p is at most 5% after Holm's correction over all pairs of the "
    "table. The first rank "
    "is 1 + the number of better rows, the last is the number of ranked rows minus that of the "
    "worse rows."
)
RATIO_NOTE = (
    "x trivial: object MAE divided by that of the best trivial method (a constant depth, or the "
    "depth of the most "
    "similar training image) that is given no more of the ground truth than the methods of the "
    "table. "
    "Of depth range: object MAE divided by the depth range of each sample's object."
)
TRUST_NOTE = (
    "(4): not ranked, because no maintainer vouches for the row; 1 + the number of ranked rows "
    "with a smaller error. "
    f"{NOT_CHECKED}: time, phase reliance or robustness as the row's author reports it, not "
    f"measured here."
)
TWO_SIDED_NOTE = (
    "Every object pixel counts with its error, or with the charge where it has no answer, and "
    "every background pixel "
    "with an answer counts with the charge. The sum is divided by the object's pixels; the charge "
    "is half the depth of "
    "the rig's working range, 300 mm for the benchmarks."
)
NOTE = (
    f"Errors in mm, mean over samples; 95% interval from a bootstrap over objects. Two-sided MAE: "
    f"{TWO_SIDED_NOTE} "
    f"{RANK_NOTE} {TRUST_NOTE} {RATIO_NOTE}"
)
MIDDLE = 100
"""Where a terminal is too narrow, columns of a larger number are left out first."""
ONLY_IN_FILES = 1_000_000
_DEVICE_WIDTH, _LONGEST_NAME = 40, 90


@dataclass(frozen=True)
class Column:
    """``text`` makes the cell; ``right``: aligned to the right, as numbers are. Where a terminal is
    too narrow, columns of the largest ``from_width`` are left out first. A table has it where
    ``present`` holds of any row. ``key``: the score that it shows."""

    title: str
    text: Callable[[Ranked], str]
    right: bool = True
    from_width: int = 0
    present: Callable[[Ranked], bool] = lambda row: True
    key: str = ""

    def shown_for(self, rows: Sequence[Ranked]) -> bool:
        """Whether a table of ``rows`` has it."""
        return any(map(self.present, rows))


def columns(sort: str) -> list[Column]:
    """Columns of a ranking by ``sort``; a key without a column gets its own, and that of the errors
    its interval."""
    shown = {metric.key: metric.column for metric in with_column(WIDEST)}
    if sort in METRICS:
        own = sort.removesuffix("_mm").replace("_", " ")
        shown = shown if sort in shown else {sort: own, **shown}
    errors = []
    for key, title in shown.items():
        of_key, width = partial(error, key), 0 if key == sort else METRICS[key].column_from
        column = _sparse(title, of_key, width) if METRICS[key].charged else Column(title, of_key)
        errors.append(replace(column, from_width=width, key=key))
        if key == sort and key in RANKED:
            ends = partial(interval, between="-", key=sort)
            errors.append(Column("95% interval", ends, from_width=MIDDLE))
        if key == OBJECT_KEY:
            errors += [*PARTS, RATIO, RANGE]
    return [
        RANK,
        METHOD,
        CODE,
        *errors,
        Column("s/sample", time_text),
        FRAMES,
        RELIANCE,
        ORDER_FREE,
        ROBUSTNESS,
        RIGS,
        *UNCERTAINTY,
        PROVENANCE,
        LEARNED,
        Column("Assumes", lambda row: assumption(row.entry.row) or "-", False, WIDEST),
        Column("Timed on", lambda row: device(row.entry), False, WIDEST),
        Column(
            "Full name", lambda row: printable(row.entry.name, _LONGEST_NAME), False, ONLY_IN_FILES
        ),
    ]


def error(key: str, row: Ranked) -> str:
    return score_text(key, row.value(key))


def error_on(benchmark: str, row: Ranked) -> str:
    """What the row is ranked by on its part of ``benchmark``, `TEST` or `UNSEEN`; a dash without
    any."""
    part = row.on(benchmark)
    return "-" if part is None else millimetres(part.value(row.rank_key))


def interval(row: Ranked, between: str, key: str | None = None) -> str:
    """The ends of the 95% interval of ``key``, by default what the row is ranked by."""
    return between.join(map(millimetres, row.interval(key or row.rank_key) or ())) or "-"


def ratio(row: Ranked) -> str:
    """The row's object MAE over that of the best trivial row, to two significant digits."""
    return (
        "-" if row.ratio is None else f"{row.ratio:.2g}" if row.ratio < 10 else f"{row.ratio:.0f}"
    )


def uncertainty(entry: Entry) -> RowUncertainty:
    """What was scored of a stated uncertainty; all None where there is none."""
    return entry.row.uncertainty or RowUncertainty()


def surest(entry: Entry) -> str:
    """MAE and RMSE of the surest 95% of the object's pixels; a dash where they are unknown."""
    block = uncertainty(entry)
    known = block.sure_mae_mm is not None
    return f"{millimetres(block.sure_mae_mm)} / {millimetres(block.sure_rmse_mm)}" if known else "-"


def time_text(row: Ranked, per_second: float = 1.0) -> str:
    """The time of an image in seconds, or in another unit, to three significant digits."""
    value = row.entry.value("seconds_per_sample")
    mark = "" if row.entry.time_measured else NOT_CHECKED
    return "-" if value is None else f"{three_digits(per_second * value)}{mark}"


def reliance(entry: Entry) -> str:
    """The phase-reliance score with two decimals."""
    block = entry.row.reliance
    return NOT_MEASURED if block is None else _measured(entry, block.score, 2)


def order_free(entry: Entry) -> str:
    """The same without whole periods; a dash where the answer is not in mm."""
    score = None if entry.row.reliance is None else entry.row.reliance.order_free_score
    return "-" if score is None else _measured(entry, score, 2)


def robustness(entry: Entry) -> str:
    """Mean two-sided MAE over the disturbed scenes of the test set, mm with one decimal."""
    block = (entry.row.robustness or {}).get("test")
    return NOT_MEASURED if block is None else _measured(entry, block.mae_mm, 1)


def rigs(entry: Entry) -> str:
    """Mean two-sided MAE on the track of rigs in the paper's light, per mille of the standoff; how
    many rigs have no answer."""
    block = entry.row.rigs
    if block is None:
        return "-"
    scores = next(iter(block.mean.values()))
    refused = sum(name.endswith(scores.light) for name in block.refused)
    without = f" ({refused} refused)" if refused else ""
    return f"{_measured(entry, scores.per_mille, 1)}{without}"


def _measured(entry: Entry, value: float, decimals: int) -> str:
    """With a mark behind what only its author measured."""
    return f"{value:.{decimals}f}{'' if entry.all_checked else NOT_CHECKED}"


def reliance_interval(entry: Entry) -> str:
    """The ends of its interval; empty without any."""
    low, high = entry.row.reliance.interval if entry.row.reliance else (None, None)
    return "" if low is None or high is None else f"{low:.2f} - {high:.2f}"


def device(entry: Entry) -> str:
    """What the time was taken on: the GPU where there is one, else the CPU and its cores; a dash
    when unknown."""
    hardware = entry.row.hardware
    return (
        "-" if hardware is None else printable(hardware.gpu or processor(hardware), _DEVICE_WIDTH)
    )


_TRUTH_NAMES = {"range": "depth range", "mask": "object mask", "order": "fringe order"}


def given_truth(track: str) -> str:
    """The ground truth of the scored samples that the methods of a track are given; empty for
    ``metric``.

    >>> given_truth("oracle range + order")
    "the test sample's depth range and fringe order"
    """
    things = [
        _TRUTH_NAMES[word]
        for word in track.removeprefix("oracle ").split(" + ")
        if word in _TRUTH_NAMES
    ]
    if not things:
        return ""
    return "the test sample's " + " and ".join(filter(None, (", ".join(things[:-1]), things[-1])))


def _assumption(row: Row) -> Assumption | None:
    method = methods().get(row.submission.method)
    return None if method is None else method.assumption(row.submission.settings)


def assumption(row: Row) -> str:
    """In a few words; empty where a method assumes nothing of the scene, or is not of this
    package."""
    assumed = _assumption(row)
    return "" if assumed is None else assumed.words


def assumption_sentences(row: Row) -> str:
    """For the row's own page: what the method assumes, and what it was given of the samples that it
    is scored on."""
    given = given_truth(row.track)
    assumed = _assumption(row)
    return " ".join(
        [*([assumed.sentence] if assumed else []), *([f"Given {given}."] if given else [])]
    )


def learned_from(row: Row) -> str:
    """What data the method learned from, as its submission says; empty where it does not say."""
    said = row.submission.learned_from
    return "" if said is None else str(said.data)


def _sparse(
    title: str, text: Callable[[Ranked], str], from_width: int = 0, right: bool = True
) -> Column:
    """A column of tables in which any row has more than a dash."""
    return Column(title, text, right, from_width, lambda row: text(row) != "-")


RANK = _sparse("Rank", lambda row: row.ranks)
CODE = Column(
    "Code", lambda row: printable(row.entry.row.dataset.code, _DEVICE_WIDTH), False, MIDDLE
)
METHOD = Column("Method", lambda row: printable(row.short_name), False)
FRAMES = Column("Frames", lambda row: str(row.entry.frames))
PARTS = tuple(
    Column(title, partial(error_on, part), True, MIDDLE, lambda row: row.on(UNSEEN) is not None)
    for title, part in (("On test", TEST), ("On unseen", UNSEEN))
)
"""Both errors of a row that joins the two sets."""
RANGE = _sparse("Of depth range", partial(error, RANGE_KEY), MIDDLE)
RATIO = _sparse("x trivial", ratio)
RELIANCE = Column("Phase reliance", lambda row: reliance(row.entry), from_width=WIDE)
ORDER_FREE = Column("Without whole periods", lambda row: order_free(row.entry), from_width=WIDE)
RIGS = _sparse("Any rig, per mille", lambda row: rigs(row.entry), WIDEST)
ROBUSTNESS = Column("Disturbed, mm", lambda row: robustness(row.entry), from_width=WIDEST)
UNCERTAINTY = (
    _sparse("In 95%", lambda row: percent(uncertainty(row.entry).within_95_share), WIDEST),
    _sparse("AUSE", lambda row: millimetres(uncertainty(row.entry).ause_mae_mm), WIDEST),
    _sparse("Surest 95%", lambda row: surest(row.entry), WIDEST),
)
LEARNED = _sparse(
    "Learned from", lambda row: learned_from(row.entry.row) or "-", WIDEST, right=False
)
PROVENANCE = Column("Provenance", lambda row: row.provenance, False, MIDDLE)
