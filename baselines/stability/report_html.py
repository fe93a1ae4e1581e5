"""The stability page: failures, heat maps, and a table of every case with the derivation of its bound."""

from collections.abc import Mapping, Sequence
from typing import Any

from fpp_ml_bench.baselines.stability.case import Verdict, parameter_text
from fpp_ml_bench.baselines.stability.heat import LEVELS, families, figure, level
from fpp_ml_bench.baselines.stability.run import Row
from fpp_ml_bench.evaluation.report import escaped, page

_LONG = 400

_STYLE = (
    "".join(f".cell.{name} {{ background: {colour}; }}\n" for name, _, colour in LEVELS)
    + """
.cells { display: flex; flex-wrap: wrap; gap: 2px; }
.cell { width: 1.05rem; height: 1.05rem; border-radius: 3px; flex: none; }
.cell.fail { outline: 2px solid #7d0c15; }
.heat td { vertical-align: middle; padding-top: .2rem; padding-bottom: .2rem; }
.heat tbody th { width: 19rem; font-weight: 400; }
@media (max-width: 46rem) { .heat tbody th { width: 9rem; font-size: .8125rem; padding-left: 0; } }
.key { display: flex; flex-wrap: wrap; gap: .25rem 1.25rem; list-style: none; padding: 0; margin: .75rem 0; }
.key li { display: flex; align-items: center; gap: .4rem; }
details { margin: .5rem 0; }
summary { cursor: pointer; padding: .25rem 0; }
td.verdict { white-space: nowrap; }
td.FAIL { color: #d1242f; font-weight: 600; }
.about { margin: .25rem 0 .75rem; }
"""
)


def report_page(rows: Sequence[Row], content: Mapping[str, Any]) -> str:
    """The page as HTML without external resources."""
    failed = [row for row in rows if row.verdict is Verdict.FAIL]
    total = content["summary"]["all"]
    verdict = (
        "No case fails." if not failed else f"{len(failed)} of {total['cases']} cases FAIL; they are listed first."
    )
    machine = content["environment"]
    intro = (
        f"<p>{verdict} {total['within']} of {total['cases']} cases are within the error that theory predicts, "
        f"{total['flagged']} are correctly refused or masked. {total['cpu_seconds']:.0f} s of "
        "processor time.</p>"
        '<p class="soft">Each square is an ill-conditioned or extreme case: computed by the benchmark, compared with a '
        "reference of higher precision or a closed form, and with a bound from theory. Point at a square to see it."
        "</p>"
        f'<p class="soft small">{escaped(machine_line(machine), 300)}</p>'
    )
    body = (
        f'<header><h1>Numerical stability</h1>{intro}</header>\n<main id="main">\n{_failures(failed)}'
        f"<section><h2>Heat maps</h2>{_key()}{_heat(rows)}</section>\n{_tables(rows)}</main>\n"
    )
    return page("Numerical stability", body, style=_STYLE)


def machine_line(machine: Mapping[str, Any]) -> str:
    """Processor and versions, in a line."""
    hardware = machine.get("hardware", {})
    parts = [f"{hardware.get('cpu', 'unknown processor')}, {hardware.get('cores', '?')} cores"]
    parts += [f"Python {machine.get('python', '?')}"]
    parts += [f"{name} {version}" for name, version in machine.get("packages", {}).items()]
    return ", ".join(parts)


def _key() -> str:
    items = (f'<li><span class="cell {name}"></span>{escaped(meaning)}</li>' for name, meaning, _ in LEVELS)
    return f'<ul class="key small">{"".join(items)}</ul>'


def _row_text(row: Row) -> str:
    outcome = row.outcome
    if outcome.error is None:
        result = outcome.note
    else:
        result = f"error {figure(outcome.error)} {row.case.unit}, bound {figure(outcome.bound)}"
        result += f", {outcome.flagged:.0%} masked" if outcome.flagged else ""
    return f"{row.case.name}: {row.verdict.value}, {result}"


def _heat(rows: Sequence[Row]) -> str:
    parts = []
    for group, kinds in families(rows).items():
        lines = []
        for family, members in kinds.items():
            cells = "".join(
                f'<span class="cell {level(row)}" title="{escaped(_row_text(row), _LONG)}"></span>' for row in members
            )
            counted = ", ".join(
                f"{sum(row.verdict is verdict for row in members)} {verdict.value}"
                for verdict in Verdict
                if any(row.verdict is verdict for row in members)
            )
            label = escaped(f"{family}: {counted}", _LONG)
            cells = f'<div class="cells" role="img" aria-label="{label}">{cells}</div>'
            lines.append(f'<tr><th scope="row">{escaped(family)}</th><td class="text">{cells}</td></tr>')
        parts.append(f'<h3>{escaped(group)}</h3><table class="heat dense"><tbody>{"".join(lines)}</tbody></table>')
    return "".join(parts)


def _failures(failed: Sequence[Row]) -> str:
    if not failed:
        return ""
    items = "".join(f"<li>{escaped(row.case.name, _LONG)}: {escaped(row.against, _LONG)}</li>" for row in failed)
    return f"<section><h2>What fails</h2><ul>{items}</ul></section>\n"


def _tables(rows: Sequence[Row]) -> str:
    parts = []
    for group, kinds in families(rows).items():
        inner = "".join(_family(family, members) for family, members in kinds.items())
        parts.append(f"<section><h2>{escaped(group)}: every case</h2>{inner}</section>\n")
    return "".join(parts)


def _family(name: str, members: Sequence[Row]) -> str:
    case = members[0].case
    description = (
        f'<p class="about small">Computes {escaped(case.computes, _LONG)}; compared with '
        f"{escaped(case.reference, _LONG)}. Bound: {escaped(case.predicts, _LONG)}.</p>"
    )
    keys = list(case.parameters)
    head = "".join(f'<th scope="col">{escaped(key)}</th>' for key in keys)
    head += f'<th scope="col">error ({escaped(case.unit)})</th><th scope="col">bound</th>'
    head += '<th scope="col">error / bound</th><th scope="col">masked</th><th scope="col">condition</th>'
    head += '<th scope="col" class="text">verdict</th>'
    lines = "".join(_line(row, keys) for row in members)
    table = f'<table class="dense small"><thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>'
    opened = " open" if any(row.verdict is Verdict.FAIL for row in members) else ""
    worst = max((row.outcome.ratio for row in members if row.outcome.ratio is not None), default=None)
    title = f'{escaped(name)} <span class="soft small">({len(members)}; largest error / bound {figure(worst)})</span>'
    return f'<details{opened}><summary>{title}</summary>{description}<div class="scroll">{table}</div></details>'


def _line(row: Row, keys: Sequence[str]) -> str:
    outcome = row.outcome
    cells = "".join(f"<td>{escaped(parameter_text(row.case.parameters[key]))}</td>" for key in keys)
    bound = None if outcome.error is None else outcome.bound
    for value in (outcome.error, bound, outcome.ratio):
        cells += f"<td>{figure(value)}</td>"
    cells += f"<td>{outcome.flagged:.0%}</td><td>{figure(outcome.condition)}</td>"
    why = row.against or (outcome.note if outcome.error is None else "")
    why = f"<small>{escaped(why, 90)}</small>" if why else ""
    return f'<tr>{cells}<td class="text verdict {row.verdict.value}">{row.verdict.value}{why}</td></tr>'
