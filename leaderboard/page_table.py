"""The ranking as an HTML table: real headers with a button each, sortable values beside what is shown."""

from collections.abc import Callable
from dataclasses import dataclass

from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.report_html import escaped
from fpp_ml_bench.evaluation.report_scores import interval_text
from fpp_ml_bench.leaderboard.columns import NAME_WIDTH, NOT_MEASURED, device, reliance, reliance_interval
from fpp_ml_bench.leaderboard.page_scatter import ERROR, provenance_class
from fpp_ml_bench.leaderboard.ranking import Group, Ranked

_PLOT_WIDTH, _PLOT_HEIGHT = 150, 18
LONGEST_NAME = 200


@dataclass(frozen=True)
class _Column:
    """``cell`` makes its HTML, ``value`` what it sorts by (text or a number; None comes last either way)."""

    key: str
    title: str
    cell: Callable[[Ranked], str]
    value: Callable[[Ranked], str | float | None]
    text: bool = False
    secondary: bool = False
    sortable: bool = True


def milliseconds(value: float | None) -> str:
    """A time in ms to three significant digits, a dash when unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _metric(key: str, title: str, secondary: bool = False) -> _Column:
    return _Column(
        key, title, lambda row: millimetres(row.entry.value(key)), lambda row: row.entry.value(key), secondary=secondary
    )


def _time(row: Ranked) -> str:
    entry, timing = row.entry, row.entry.result.timing
    if entry.latency_ms is None:
        return "-"
    spread = ""
    if timing is not None:
        spread = f"<small>{milliseconds(timing.latency_p5_ms)} to {milliseconds(timing.latency_p95_ms)}</small>"
    mark = "" if entry.time_measured else '<small class="p-self-reported">self-reported</small>'
    return f"{milliseconds(entry.latency_ms)}{spread}{mark}"


def _reliance(row: Ranked) -> str:
    if row.entry.reliance is None:
        return f'<span class="soft small">{NOT_MEASURED}</span>'
    interval = reliance_interval(row.entry)
    return reliance(row.entry) + (f"<small>{interval.replace(' - ', ' to ')}</small>" if interval else "")


def badge(provenance: str) -> str:
    """A provenance in words, with a colour beside it."""
    return f'<span class="badge {provenance_class(provenance)}">{escaped(provenance)}</span>'


def _columns(slugs: dict[int, str], plot: Callable[[Ranked], str]) -> list[_Column]:
    def method(row: Ranked) -> str:
        shown = escaped(row.entry.name, LONGEST_NAME)
        return (
            f'<a href="submissions/{slugs[id(row.entry)]}.html">{shown}</a><small>{escaped(device(row.entry))}</small>'
        )

    return [
        _Column("rank", "Rank", lambda row: str(row.rank), lambda row: float(row.rank)),
        _Column("name", "Method", method, lambda row: row.entry.name[:NAME_WIDTH].casefold(), text=True),
        _metric(ERROR, "Object MAE, mm"),
        _Column("interval", "95% interval, mm", plot, lambda row: None, text=True, sortable=False),
        _metric("object_rmse_mm", "Object RMSE, mm", secondary=True),
        _metric("overall_mae_mm", "Overall MAE, mm", secondary=True),
        _Column("ms", "Time, ms", _time, lambda row: row.entry.latency_ms),
        _Column("frames", "Frames", lambda row: str(row.entry.frames), lambda row: float(row.entry.frames)),
        _Column(
            "reliance", "Phase reliance", _reliance,
            lambda row: None if row.entry.reliance is None else row.entry.reliance.score,
        ),
        _Column(
            "provenance", "Provenance", lambda row: badge(row.entry.provenance), lambda row: row.entry.provenance,
            text=True,
        ),
    ]  # fmt: skip


def ranking_table(group: Group, slugs: dict[int, str], number: int) -> str:
    """The table of ``group``, its rows in ranking order; ``number`` tells the page's tables apart."""
    columns = _columns(slugs, _interval_plot(group))
    head = "".join(_header(column) for column in columns)
    body = "".join(_row(row, columns, slugs) for row in group.rows)
    caption = "Best first; select a column's title to sort by it"
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-labelledby="g{number}">'
        f'<table class="ranking" id="t{number}"><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n"
        f'<p class="soft small count" role="status" id="c{number}"></p>'
    )


def _header(column: _Column) -> str:
    classes = " ".join(name for name, on in (("text", column.text), ("secondary", column.secondary)) if on)
    marked = f' class="{classes}"' if classes else ""
    if not column.sortable:
        return f'<th scope="col"{marked}>{column.title}</th>'
    order = ' aria-sort="ascending"' if column.key == "rank" else ""
    return f'<th scope="col"{marked}{order}><button type="button" data-key="{column.key}">{column.title}</button></th>'


def _row(row: Ranked, columns: list[_Column], slugs: dict[int, str]) -> str:
    cells = []
    for column in columns:
        value = column.value(row)
        data = f' data-v="{escaped(value if isinstance(value, str) else repr(value))}"' if value is not None else ""
        classes = " ".join(name for name, on in (("text", column.text), ("secondary", column.secondary)) if on)
        marked = f' class="{classes}"' if classes else ""
        kind, scope = ("th", ' scope="row"') if column.key == "name" else ("td", "")
        cells.append(f"<{kind}{scope}{marked}{data}>{column.cell(row)}</{kind}>")
    entry = row.entry
    search = escaped(f"{entry.name} {entry.result.submission.method} {device(entry)}".casefold(), 500)
    return (
        f'<tr id="{slugs[id(entry)]}" data-search="{search}" data-provenance="{escaped(entry.provenance)}" '
        f'data-frames="{entry.frames}">{"".join(cells)}</tr>\n'
    )


def _interval_plot(group: Group) -> Callable[[Ranked], str]:
    """Each row's interval and mean on one scale from 0 to the largest of the group, and its ends in words."""
    ends = [end for row in group.rows for end in row.entry.interval(ERROR) or ()]
    values = [value for row in group.rows if (value := row.entry.value(ERROR)) is not None]
    highest = max([*ends, *values], default=0.0)

    def at(value: float) -> float:
        return 4 + (_PLOT_WIDTH - 8) * (value / highest if highest else 0.0)

    def plot(row: Ranked) -> str:
        value, interval = row.entry.value(ERROR), row.entry.interval(ERROR)
        if value is None:
            return "-"
        middle = _PLOT_HEIGHT / 2
        line = ""
        if interval is not None:
            line = f'<path class="span" d="M{at(interval[0]):.1f} {middle}H{at(interval[1]):.1f}"/>'
        words = interval_text(interval) if interval is not None else "fewer than two objects"
        return (
            f'<svg class="interval" viewBox="0 0 {_PLOT_WIDTH} {_PLOT_HEIGHT}" width="{_PLOT_WIDTH}" '
            f'height="{_PLOT_HEIGHT}" aria-hidden="true"><path class="axis" d="M4 {middle}H{_PLOT_WIDTH - 4}"/>{line}'
            f'<circle cx="{at(value):.1f}" cy="{middle}" r="3.5"/></svg><small>{words}</small>'
        )

    return plot
