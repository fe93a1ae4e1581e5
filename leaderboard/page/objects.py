"""Object by object: the same submissions against each object, darker where the error is larger."""

import math

from fpp_ml_bench.evaluation.report import escaped, millimetres
from fpp_ml_bench.leaderboard.groups import Group
from fpp_ml_bench.leaderboard.page.scatter import ERROR

_SHADES = 6


def objects_table(group: Group, slugs: dict[int, str]) -> str:
    """A table of object MAE in mm, mean over an object's views: submissions down, objects across."""
    objects = sorted({part.object for row in group.rows for part in row.entry.result.per_object})
    values = {
        (id(row.entry), part.object): getattr(part.metrics, ERROR)
        for row in group.rows
        for part in row.entry.result.per_object
    }
    errors = [value for value in values.values() if value]
    head = "".join(f'<th scope="col">{escaped(name.replace("_", " "), 60)}</th>' for name in objects)
    lines = []
    for row in group.rows:
        cells = "".join(_cell(values.get((id(row.entry), name)), errors) for name in objects)
        lines.append(
            f'<tr data-of="{slugs[id(row.entry)]}"><th scope="row">{escaped(row.short_name)}</th>{cells}</tr>\n'
        )
    return (
        '<details><summary>Object by object</summary><div class="scroll" tabindex="0" role="region" '
        'aria-label="Object by object"><table class="objects"><caption>Object MAE in mm, mean over the views '
        "of an object; darker is a larger error</caption>"
        f'<thead><tr><th scope="col" class="text">Method</th>{head}</tr></thead>\n<tbody>\n{"".join(lines)}</tbody>'
        "</table></div></details>"
    )


def _cell(value: float | None, errors: list[float]) -> str:
    """``errors``: all errors above 0 of the table, for the shade."""
    if value is None or not errors:
        return f"<td>{millimetres(value)}</td>"
    low, high = math.log(min(errors)), math.log(max(errors))
    share = 0.0 if value == 0 or high == low else (math.log(value) - low) / (high - low)
    return f'<td class="shade{min(_SHADES - 1, int(share * _SHADES))}">{millimetres(value)}</td>'
