"""The cells of a table on the page, and the logarithmic scale on which it draws its intervals."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from string import ascii_lowercase

from fpp_ml_bench.evaluation.metrics import RANGE_KEY, RANK_KEY, with_column
from fpp_ml_bench.evaluation.report.html import interval_text, millimetres, percent
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import columns
from fpp_ml_bench.leaderboard.groups import Ranked
from fpp_ml_bench.leaderboard.names import learned_from

OVERALL_KEY = "overall_mae_mm"
ALWAYS, FIRST, MORE = "", "first", "more"
"""When a column is shown: at every width, in windows wider than a phone, and where a reader asks for all columns. These
are its CSS classes."""
SELF_REPORTED_TIME = "self-reported"
_CLIP = 10
"""An interval is drawn down to this part of its mean."""
_STEPS = (1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)
_FEWEST_TICKS = 2


@dataclass(frozen=True)
class Cell:
    """A row's cell: ``text`` with the lines ``small`` below it, and the ``value`` that a click on the column's
    ``title`` sorts by, None for a row without any. ``key`` names the column in the page's address; a column without
    one is not sorted. ``mark``: a letter that the line below the table's title explains."""

    key: str
    title: str
    text: str
    value: float | str | None = None
    small: tuple[str, ...] = ()
    shown: str = MORE
    is_text: bool = False
    mark: str = ""

    @property
    def css(self) -> str:
        """Classes of the cell and of its column's head."""
        return " ".join(filter(None, ("text" if self.is_text else "", self.shown)))


def machines(rows: Sequence[Ranked]) -> dict[str, str]:
    """The machines that ``rows`` were timed on, and a letter for each; no letter where there is one machine."""
    names = sorted({columns.device(row.entry) for row in rows if row.entry.latency_ms is not None})
    letters = [ascii_lowercase[n % 26] * (1 + n // 26) for n in range(len(names))]
    return dict(zip(names, letters if len(names) > 1 else [""], strict=False))


def milliseconds(value: float | None) -> str:
    """A time in ms to three significant digits, a dash when unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def cells(row: Ranked, rows: Sequence[Ranked]) -> list[Cell]:
    """The cells of ``row`` behind its rank and its name, those that are shown first in front; ``rows``: of its table,
    which decide on the columns that there are."""
    entry, about = row.entry, row.entry.row
    error, ends, code = row.value(RANK_KEY), row.interval(RANK_KEY), printable(about.dataset.code)
    ends_text = interval_text(ends) if ends else "-" if error is None else "fewer than two objects"
    disturbed = (about.robustness or {}).get("test")
    found = [
        Cell(RANK_KEY, "Object MAE, mm", millimetres(error), error, shown=ALWAYS),
        Cell("", "95% interval, mm", ends_text, shown=FIRST, is_text=True),
        Cell(OVERALL_KEY, "Overall MAE, mm", millimetres(row.value(OVERALL_KEY)), row.value(OVERALL_KEY), shown=FIRST),
        _time(row, rows),
        Cell(
            "reliance",
            "Phase reliance",
            columns.reliance(entry),
            about.reliance.score if about.reliance else None,
            tuple(filter(None, [columns.reliance_interval(entry).replace(" - ", " to ")])),
            FIRST,
        ),
        Cell(
            "disturbed",
            "Disturbed, mm",
            columns.robustness(entry),
            disturbed.mae_mm if disturbed else None,
            ("{:.1f} to {:.1f}".format(*disturbed.interval),) if disturbed and None not in disturbed.interval else (),
            FIRST,
        ),
        Cell("code", "Code", code, code, is_text=True),
        Cell("frames", "Frames", str(entry.frames), float(entry.frames)),
    ]
    for key, column in zip(("test", "unseen"), columns.PARTS, strict=True):
        part = column.text(row)
        found += [Cell(key, f"{column.title}, mm", part, None if part == "-" else part)] * column.shown_for(rows)
    found += [Cell("ratio", "× trivial", columns.ratio(row), row.ratio)] * columns.RATIO.shown_for(rows)
    share = row.value(RANGE_KEY)
    found += [Cell("range", "Of depth range", percent(share), share)] * columns.RANGE.shown_for(rows)
    if columns.UNCERTAINTY[0].shown_for(rows):
        covered, ause = columns.uncertainty(entry)
        found.append(Cell("covered", "Within stated 95%", percent(covered), covered))
        found.append(Cell("ause", "AUSE, mm", millimetres(ause), ause))
    for metric in with_column(0):
        if not metric.role and metric.key != OVERALL_KEY:
            title = f"{metric.column}, mm" if metric.unit == "mm" else metric.column
            found.append(Cell(metric.key, title, columns.error(metric.key, row), row.value(metric.key)))
    learned = printable(learned_from(about)) or None
    if columns.LEARNED.shown_for(rows):
        found.append(Cell("learned", "Learned from", learned or "-", learned, is_text=True))
    return [*found, Cell("provenance", "Provenance", row.provenance, row.provenance, is_text=True)]


def _time(row: Ranked, rows: Sequence[Ranked]) -> Cell:
    entry, timing = row.entry, row.entry.row.timing
    small = [] if timing is None else [" to ".join(map(milliseconds, (timing.latency_p5_ms, timing.latency_p95_ms)))]
    small += [] if entry.latency_ms is None or entry.time_measured else [SELF_REPORTED_TIME]
    letter = "" if entry.latency_ms is None else machines(rows).get(columns.device(entry), "")
    return Cell("ms", "Time, ms", milliseconds(entry.latency_ms), entry.latency_ms, tuple(small), FIRST, mark=letter)


@dataclass(frozen=True)
class LogScale:
    """From ``low`` to ``high`` mm, logarithmic, the same for all rows of a table."""

    low: float
    high: float

    @classmethod
    def of(cls, rows: Sequence[Ranked]) -> "LogScale":
        """A scale that holds the mean and the interval of each row, as far down as a part of its mean."""
        low, high = [], []
        for row in rows:
            if mean := row.value(RANK_KEY):
                ends = row.interval(RANK_KEY) or (mean, mean)
                low.append(max(ends[0], mean / _CLIP))
                high.append(max(ends[1], mean))
        return cls(min(low, default=1.0) / 1.05, max(high, default=1.0) * 1.05)

    def share(self, value_mm: float) -> float:
        """Where a value stands, from 0 at ``low`` to 1 at ``high``, where those beyond them stand too."""
        if value_mm <= self.low:
            return 0.0
        return min(1.0, math.log(value_mm / self.low) / math.log(self.high / self.low))

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Place and label of powers of ten on the scale; with multiples of them where there are few."""
        for steps in _STEPS:
            inside = list(self._multiples(steps))
            if len(inside) >= _FEWEST_TICKS:
                break
        return [(self.share(value), f"{value:g}") for value in inside]

    def _multiples(self, steps: Sequence[float]) -> Iterator[float]:
        for power in range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1):
            yield from (step * 10.0**power for step in steps if self.low <= step * 10.0**power <= self.high)
