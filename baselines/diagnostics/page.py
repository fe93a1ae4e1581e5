"""The report as an HTML page with embedded pictures, which loads nothing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Finding, Table
from fpp_ml_bench.evaluation.report import data_uri, escaped, page

REPORT_FILE = "index.html"
_TEXT = 4000
_STYLE = """
.drawn img { display: block; width: 100%; min-width: 34rem; background: #fff; border-radius: 6px; }
.question { font-style: italic; color: var(--soft); }
figure + .scroll, .scroll + .scroll { margin-top: 1.25rem; }
ul.short { padding-left: 1.1rem; max-width: 46rem; }
ul.short li { margin: .5rem 0; }
"""


def report_page(context: Mapping[str, Any], findings: Sequence[tuple[str, Finding]], folder: Path) -> str:
    """The report: a section for each finding with its question and its pictures from ``folder``.

    ``context`` is what `diagnosis` stores about subject, dataset, settings and machine.
    """
    subject, dataset = context["subject"], context["dataset"]
    height, width = dataset["size"]
    frames = subject["frames_used"]
    frames_text = f"frame {frames[0]}" if len(frames) == 1 else f"{len(frames)} frames"
    lines = (
        f"{subject['title']}; {frames_text} per sample, {subject['direction']} fringes",
        f"{dataset['name']} ({dataset['fingerprint'][:8]}), {sum(dataset['samples'].values())} samples of {width} x "
        f"{height} px",
    )
    intro = "".join(f'<p class="soft">{escaped(line, _TEXT)}</p>' for line in lines)
    short = "".join(
        f'<li><a href="#{escaped(finding.probe)}">{escaped(finding.title)}</a>: '
        f"{escaped(finding.skipped or finding.summary, _TEXT)}</li>"
        for _, finding in findings
    )
    sections = "".join(_section(question, finding, folder) for question, finding in findings)
    body = (
        f"<header><h1>What did {escaped(subject['name'])} read?</h1>{intro}</header>\n"
        f'<main id="main">\n<section><h2>In short</h2><ul class="short">{short}</ul></section>\n'
        f"{sections}{_provenance(context)}</main>\n"
    )
    return page(f"{subject['name']}: diagnosis", body, _STYLE, description=f"What {subject['name']} read")


def _section(question: str, finding: Finding, folder: Path) -> str:
    head = (
        f'<section id="{escaped(finding.probe)}"><h2>{escaped(finding.title)}</h2>'
        f'<p class="question">{escaped(question, 500)}</p>'
    )
    if finding.skipped is not None:
        return f"{head}<p>Not run: {escaped(finding.skipped, _TEXT)}</p></section>\n"
    figures = "".join(_figure(figure, folder) for figure in finding.figures)
    tables = "".join(table_html(table) for table in finding.tables)
    return f"{head}<p>{escaped(finding.summary, _TEXT)}</p>{figures}{tables}</section>\n"


def _figure(figure: Figure, folder: Path) -> str:
    address = data_uri((folder / figure.file).read_bytes())
    return (
        f'<figure><div class="scroll drawn" tabindex="0" role="region" aria-label="{escaped(figure.title)}">'
        f'<img src="{address}" alt="{escaped(figure.alt, 500)}"></div><figcaption>{escaped(figure.title, 500)}'
        "</figcaption></figure>"
    )


def table_html(table: Table) -> str:
    """An HTML table that scrolls sideways where it is wide."""
    head = "".join(
        f'<th scope="col"{_class(place == 0)}>{escaped(title)}</th>' for place, title in enumerate(table.header)
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f'<th scope="row">{cell_text(cell)}</th>' if place == 0 else f"<td>{cell_text(cell)}</td>"
            for place, cell in enumerate(row)
        )
        + "</tr>"
        for row in table.rows
    )
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="{escaped(table.title)}"><table class="dense">'
        f"<caption>{escaped(table.title, 500)}</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>{rows}</tbody></table></div>"
    )


def cell_text(cell: Cell) -> str:
    """A cell as HTML: floats with four significant digits, a dash for None."""
    if cell is None:
        return "-"
    return escaped(f"{cell:.4g}" if isinstance(cell, float) else cell, 500)


def _class(text: bool) -> str:
    return ' class="text"' if text else ""


def _provenance(context: Mapping[str, Any]) -> str:
    settings = ", ".join(f"{name} {value}" for name, value in context["settings"].items() if value is not None)
    software = ", ".join(f"{name} {value}" for name, value in context["software"].items())
    hardware = context["hardware"]
    command = f"<pre><code>{escaped(context['command'], _TEXT)}</code></pre>" if context["command"] else ""
    lines = (
        f"Settings: {settings}. Layers: {', '.join(context['subject']['layers']) or 'none'}.",
        f"{software}; {hardware['cpu']}, {hardware['cores']} cores.",
        "All values are in diagnose.json beside this page.",
    )
    paragraphs = "".join(f'<p class="soft small">{escaped(line, _TEXT)}</p>' for line in lines)
    return f"<section><h2>How this was made</h2>{command}{paragraphs}</section>\n"
