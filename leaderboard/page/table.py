"""The ranking as an HTML table: a button in each header, and sortable values beside the text of the cells."""

from collections.abc import Callable
from dataclasses import dataclass

from fpp_ml_bench.evaluation.report import escaped, interval_text, millimetres
from fpp_ml_bench.leaderboard.columns import NOT_MEASURED, RANK_NOTE, device, reliance, reliance_interval
from fpp_ml_bench.leaderboard.groups import Group, Ranked, assumption
from fpp_ml_bench.leaderboard.page.scatter import ERROR, provenance_class

_PLOT_WIDTH, _PLOT_HEIGHT = 150, 18


@dataclass(frozen=True)
class _Column:
    """``cell`` makes its HTML, ``value`` what it sorts by (text or a number; None comes last in both directions)."""

    key: str
    title: str
    cell: Callable[[Ranked], str]
    value: Callable[[Ranked], str | float | None]
    text: bool = False
    sortable: bool = True

    @property
    def css(self) -> str:
        return ' class="text"' if self.text else ""


def milliseconds(value: float | None) -> str:
    """A time in ms to three significant digits, a dash when unknown."""
    if value is None:
        return "-"
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _metric(key: str, title: str) -> _Column:
    return _Column(key, title, lambda row: millimetres(row.entry.value(key)), lambda row: row.entry.value(key))


def _time(row: Ranked) -> str:
    entry, timing = row.entry, row.entry.result.timing
    if entry.latency_ms is None:
        return "-"
    spread = ""
    if timing is not None:
        spread = f"<small>{milliseconds(timing.latency_p5_ms)} to {milliseconds(timing.latency_p95_ms)}</small>"
    mark = "" if entry.time_measured else '<small class="p-self-reported">self-reported</small>'
    return f"{milliseconds(entry.latency_ms)}{spread}{mark}"


def machines(group: Group) -> list[str]:
    """What the times of ``group`` were taken on, sorted."""
    return sorted({device(row.entry) for row in group.rows if row.entry.latency_ms is not None})


def _reliance(row: Ranked) -> str:
    if row.entry.reliance is None:
        return f'<span class="soft small">{NOT_MEASURED}</span>'
    interval = reliance_interval(row.entry)
    return reliance(row.entry) + (f"<small>{interval.replace(' - ', ' to ')}</small>" if interval else "")


def badge(provenance: str) -> str:
    """A provenance in words, with a colour beside it."""
    return f'<span class="badge {provenance_class(provenance)}">{escaped(provenance)}</span>'


def _columns(slugs: dict[int, str], plot: Callable[[Ranked], str], several_machines: bool) -> list[_Column]:
    def method(row: Ranked) -> str:
        link = f"submissions/{slugs[id(row.entry)]}.html"
        words = assumption(row.entry.result)
        below = f"<small>{escaped(words)}</small>" if words else ""
        return f'<a href="{link}" title="{escaped(row.entry.name)}">{escaped(row.short_name)}</a>{below}'

    def time(row: Ranked) -> str:
        return _time(row) + (f"<small>{escaped(device(row.entry))}</small>" if several_machines else "")

    return [
        _Column("rank", "Rank", lambda row: row.ranks, lambda row: row.best_rank + row.worst_rank / 10_000),
        _Column("name", "Method", method, lambda row: row.short_name.casefold(), text=True),
        _metric(ERROR, "Object MAE, mm"),
        _Column("interval", "95% interval, mm", plot, lambda row: None, text=True, sortable=False),
        _metric("object_rmse_mm", "Object RMSE, mm"),
        _metric("overall_mae_mm", "Overall MAE, mm"),
        _Column("ms", "Time, ms", time, lambda row: row.entry.latency_ms),
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
    """The table of ``group``, its rows in ranking order, and below it what a rank is. ``number``: of the table on the
    page."""
    columns = _columns(slugs, _interval_plot(group), len(machines(group)) > 1)
    head = "".join(_header(column) for column in columns)
    body = "".join(_row(row, columns, slugs) for row in group.rows)
    caption = "Best first; select a column's title to sort by it"
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-labelledby="g{number}">'
        f'<table class="ranking" id="t{number}"><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}</tbody></table></div>\n"
        f'<p class="soft small">{RANK_NOTE}</p>'
        f'<p class="soft small count" role="status" id="c{number}"></p>'
    )


def _header(column: _Column) -> str:
    if not column.sortable:
        return f'<th scope="col"{column.css}>{column.title}</th>'
    order = ' aria-sort="ascending"' if column.key == ERROR else ""
    button = f'<button type="button" data-key="{column.key}">{column.title}</button>'
    return f'<th scope="col"{column.css}{order}>{button}</th>'


def _row(row: Ranked, columns: list[_Column], slugs: dict[int, str]) -> str:
    cells = []
    for column in columns:
        value = column.value(row)
        data = f' data-v="{escaped(value if isinstance(value, str) else repr(value))}"' if value is not None else ""
        kind, scope = ("th", ' scope="row"') if column.key == "name" else ("td", "")
        cells.append(f"<{kind}{scope}{column.css}{data}>{column.cell(row)}</{kind}>")
    entry = row.entry
    words = f"{entry.name} {row.short_name} {entry.result.submission.method} {device(entry)}"
    return (
        f'<tr id="{slugs[id(entry)]}" data-search="{escaped(words.casefold(), 700)}" '
        f'data-provenance="{escaped(entry.provenance)}" data-frames="{entry.frames}">{"".join(cells)}</tr>\n'
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
