"""The output of a run: JSON with every case, an HTML page, and a picture of the heat maps."""

import io
import json
import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.stability.cases import Row, Verdict, parameter_text
from fpp_ml_bench.evaluation.report.html import data_uri, page, render
from fpp_ml_bench.evaluation.result.file import environment
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.machine import numba_enabled

_LIMITS = 1e-3, 0.1, 0.5
LEVELS = {
    "error 0": "#dff1ea",
    "error under 1/1000 of its bound": "#b5dfcf",
    "1/1000 to 1/10 of the bound": "#74bf9f",
    "1/10 to 1/2 of the bound": "#2f9470",
    "1/2 to the whole bound": "#0b6b50",
    "correctly refused or masked": "#b9c0c8",
    "FAIL": "#d1242f",
}
"""What a square of the heat maps says, and its colour."""
_DPI, _SQUARE_PX, _LINE_PX = 90, 15, 19
_ACROSS, _LABEL, _COLUMN, _KEY = 24, 15.5, 40.0, 2.0
"""Squares in a line; widths of its label and of a column of groups in squares, height of the key in lines."""
_FILLED = 0.86, 0.84
"""Share of its place that a square fills, across and down."""
_STYLE = """
img.heat { max-width: none; display: block; background: #fff; border-radius: 4px; }
details { margin: .5rem 0; }
summary { cursor: pointer; padding: .25rem 0; }
td.verdict { white-space: nowrap; }
td.FAIL { color: #d1242f; font-weight: 600; }
.about { margin: .25rem 0 .75rem; }
"""


def number(value: Any) -> Any:
    """A value for JSON; NaN and infinity by name."""
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def short(value: float | None) -> str:
    """A number for a table."""
    return "-" if value is None else f"{value:.2g}"


def families(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """Rows by group and family, in the order in which they ran."""
    grouped: dict[str, dict[str, list[Row]]] = {}
    for row in rows:
        grouped.setdefault(row.case.group, {}).setdefault(row.case.family, []).append(row)
    return grouped


def largest_ratio(rows: Iterable[Row]) -> float | None:
    """The largest error / bound, None where nothing was computed."""
    return max((row.outcome.ratio for row in rows if row.outcome.ratio is not None), default=None)


def summary(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """By group, and under "all": cases per verdict, the largest error / bound, and processor time."""
    groups: dict[str, dict[str, Any]] = {}
    for group in [*dict.fromkeys(row.case.group for row in rows), "all"]:
        part = [row for row in rows if group in (row.case.group, "all")]
        verdicts = {verdict.value: sum(row.verdict is verdict for row in part) for verdict in Verdict}
        cpu_s = round(sum(row.cpu_seconds for row in part), 2)
        ratio = number(largest_ratio(part))
        groups[group] = {"cases": len(part), **verdicts, "largest_ratio": ratio, "cpu_seconds": cpu_s}
    return groups


def row_content(row: Row) -> dict[str, Any]:
    """A case as JSON values."""
    names = ("group", "family", "parameters", "computes", "reference", "predicts", "unit", "expects")
    content = {name: getattr(row.case, name) for name in names}
    content["parameters"] = {key: number(value) for key, value in row.case.parameters.items()}
    content["verdict"] = row.verdict.value
    content |= {name: number(getattr(row.outcome, name)) for name in ("error", "bound", "ratio")}
    content |= {"flagged_share": row.outcome.flagged, "condition": number(row.outcome.condition)}
    return {**content, "note": row.outcome.note, "against": row.against, "cpu_seconds": round(row.cpu_seconds, 3)}


def document(rows: Sequence[Row]) -> dict[str, Any]:
    """The whole run as JSON values."""
    return {
        "schema_version": "1.0.0",
        "summary": summary(rows),
        "compiled_decoder": numba_enabled(),
        "environment": environment().model_dump(mode="json"),
        "cases": [row_content(row) for row in rows],
    }


def square_of(row: Row) -> tuple[str, str]:
    """Colour of a case's square, and the case and its result in a line."""
    outcome, result = row.outcome, row.outcome.note
    *within, refused, failed = LEVELS.values()
    colour = failed if row.verdict is Verdict.FAIL else refused
    if row.verdict is Verdict.WITHIN:
        colour = within[1 + bisect_right(_LIMITS, outcome.ratio) if outcome.ratio else 0]
    if outcome.error is not None:
        result = f"error {short(outcome.error)} {row.case.unit}, bound {short(outcome.bound)}"
        result += f", {outcome.flagged:.0%} masked" if outcome.flagged else ""
    return colour, f"{row.case.name}: {row.verdict.value}, {result}"


def heat_maps(rows: Sequence[Row]) -> tuple[bytes, list[tuple[str, str]]]:
    """The heat maps as PNG: two columns of groups, a line per family, a square per case; and for an HTML image map each
    square's corners in px and its text."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Rectangle

    grouped = families(rows)
    lines = {group: 2 + sum(-(-len(part) // _ACROSS) for part in kinds.values()) for group, kinds in grouped.items()}
    figure = Figure(dpi=_DPI, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    squares, ends = [], [_KEY, _KEY]  # the line where each column goes on
    for group, kinds in grouped.items():
        # The left column until it holds half.
        column = int(ends[0] - _KEY + lines[group] / 2 > sum(lines.values()) / 2)
        left, y = column * _COLUMN + 0.3, ends[column]
        axes.text(left, y + 1.0, group, fontsize=11, fontweight="bold", va="center")
        y += 1.6
        for family, members in kinds.items():
            axes.text(left + _LABEL - 0.4, y + 0.5, family, fontsize=8, va="center", ha="right", color="#333333")
            for place, row in enumerate(members):
                down, across = divmod(place, _ACROSS)
                corner, (colour, text) = (left + _LABEL + across, y + down), square_of(row)
                axes.add_patch(Rectangle(corner, *_FILLED, color=colour, lw=0))
                opposite = corner[0] + _FILLED[0], corner[1] + _FILLED[1]
                pixels = (f"{px * _SQUARE_PX:.0f},{line * _LINE_PX:.0f}" for px, line in (corner, opposite))
                squares.append((",".join(pixels), text))
            y += down + 1
        ends[column] = y + 0.4
    axes.set_xlim(0, 2 * _COLUMN)
    axes.set_ylim(max(ends), 0)
    axes.axis("off")
    figure.set_size_inches(2 * _COLUMN * _SQUARE_PX / _DPI, max(ends) * _LINE_PX / _DPI)
    key = [Patch(color=colour, label=meaning) for meaning, colour in LEVELS.items()]
    figure.legend(handles=key, ncols=4, fontsize=8, frameon=False, loc="upper center")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue(), squares


def write_report(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write the page (HTML without external resources), the data and the picture into ``folder``, which is made; their
    paths. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    content, (picture, squares) = document(rows), heat_maps(rows)
    machine, hardware = content["environment"], content["environment"]["hardware"]
    about = [hardware["cpu"], f"{hardware['cores']} cores", f"Python {machine['python']}"]
    about += [f"{name} {version}" for name, version in machine["packages"].items()]
    body = render(
        __package__,
        "stability.html",
        total=content["summary"]["all"],
        machine=", ".join(about),
        squares=squares,
        failed=[row for row in rows if row.verdict is Verdict.FAIL],
        picture=data_uri(picture),
        families=families(rows),
        short=short,
        parameter_text=parameter_text,
        largest_ratio=largest_ratio,
        counts=lambda members: Counter(row.verdict.value for row in members),
    )
    files = {
        folder / "index.html": page("Numerical stability", body, style=_STYLE).encode("utf-8"),
        folder / "stability.json": (json.dumps(content, indent=1, allow_nan=False) + "\n").encode("utf-8"),
        folder / "stability.png": picture,
    }
    for path, data in files.items():
        write_atomically(path, data)
    return list(files)
