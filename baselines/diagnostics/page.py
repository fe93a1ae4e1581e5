"""The report as one HTML page that carries its pictures in itself and loads nothing."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.diagnostics.probe import Cell, Figure, Finding, Table
from fpp_ml_bench.evaluation.report_html import data_uri, escaped, page

REPORT_FILE = "index.html"
_TEXT = 4000
_STYLE = """
.drawn img { display: block; width: 100%; min-width: 34rem; background: #fff; border-radius: 6px; }
.asked { font-style: italic; color: var(--soft); }
figure + .scroll, .scroll + .scroll { margin-top: 1.25rem; }
ul.short { padding-left: 1.1rem; max-width: 46rem; }
ul.short li { margin: .5rem 0; }
"""


def report_page(about: Mapping[str, Any], found: Sequence[tuple[str, Finding]], folder: Path) -> str:
    """The page on a subject ``about`` which is known what `diagnosis` writes; each finding with its question, pictures
    from ``folder``."""
    subject, dataset = about["subject"], about["dataset"]
    height, width = dataset["size"]
    frames = subject["frames_used"]
    taken = f"frame {frames[0]}" if len(frames) == 1 else f"{len(frames)} frames"
    lines = (
        f"{subject['title']}; {taken} a sample, {subject['direction']} fringes",
        f"{dataset['name']} ({dataset['fingerprint'][:8]}), {sum(dataset['samples'].values())} samples of {width} x "
        f"{height} px",
    )
    intro = "".join(f'<p class="soft">{escaped(line, _TEXT)}</p>' for line in lines)
    short = "".join(
        f'<li><a href="#{escaped(one.probe)}">{escaped(one.title)}</a>: '
        f"{escaped(one.skipped or one.summary, _TEXT)}</li>"
        for _, one in found
    )
    body = (
        f"<header><h1>What did {escaped(subject['name'])} read?</h1>{intro}</header>\n"
        f'<main id="main">\n<section><h2>In short</h2><ul class="short">{short}</ul></section>\n'
        f"{''.join(_section(question, one, folder) for question, one in found)}{_made(about)}</main>\n"
    )
    return page(f"{subject['name']}: diagnosis", body, _STYLE, description=f"What {subject['name']} read")


def _section(question: str, one: Finding, folder: Path) -> str:
    head = (
        f'<section id="{escaped(one.probe)}"><h2>{escaped(one.title)}</h2><p class="asked">{escaped(question, 500)}</p>'
    )
    if one.skipped is not None:
        return f"{head}<p>Not asked: {escaped(one.skipped, _TEXT)}</p></section>\n"
    drawn = "".join(_figure(figure, folder) for figure in one.figures)
    listed = "".join(table_html(table) for table in one.tables)
    return f"{head}<p>{escaped(one.summary, _TEXT)}</p>{drawn}{listed}</section>\n"


def _figure(figure: Figure, folder: Path) -> str:
    address = data_uri((folder / figure.file).read_bytes())
    return (
        f'<figure><div class="scroll drawn" tabindex="0" role="region" aria-label="{escaped(figure.title)}">'
        f'<img src="{address}" alt="{escaped(figure.alt, 500)}"></div><figcaption>{escaped(figure.title, 500)}'
        "</figcaption></figure>"
    )


def table_html(table: Table) -> str:
    """A table that scrolls sideways where it is wide."""
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


def _made(about: Mapping[str, Any]) -> str:
    settings = ", ".join(f"{name} {value}" for name, value in about["settings"].items() if value is not None)
    software = ", ".join(f"{name} {value}" for name, value in about["software"].items())
    machine = about["hardware"]
    command = f"<pre><code>{escaped(about['command'], _TEXT)}</code></pre>" if about["command"] else ""
    lines = (
        f"Settings: {settings}. Layers: {', '.join(about['subject']['layers']) or 'none'}.",
        f"{software}; {machine['cpu']}, {machine['cores']} cores.",
        "All values are in diagnose.json beside this page.",
    )
    said = "".join(f'<p class="soft small">{escaped(line, _TEXT)}</p>' for line in lines)
    return f"<section><h2>How this was made</h2>{command}{said}</section>\n"
