"""The leaderboard as a static page: ``index.html``, ``data.json``, and a page for each submission.

The page works from disk and from any web server and loads no other file. The same rows give the same bytes.
"""

import hashlib
import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report import escaped, page
from fpp_ml_bench.evaluation.result import result_json
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard.export import table_json
from fpp_ml_bench.leaderboard.groups import LEGACY_NOTE, TOLD, Group
from fpp_ml_bench.leaderboard.page.objects import objects_table
from fpp_ml_bench.leaderboard.page.scatter import front_rows, scatter_html
from fpp_ml_bench.leaderboard.page.submission_page import submission_page
from fpp_ml_bench.leaderboard.page.table import badge, machines, ranking_table
from fpp_ml_bench.leaderboard.page.text import INTRODUCTION, SCATTER_KEY, paper_section, reading_section
from fpp_ml_bench.leaderboard.page.tradeoff_section import tradeoff_section
from fpp_ml_bench.leaderboard.paper import PaperTable
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT
from fpp_ml_bench.leaderboard.rows import MEANING, Entry
from fpp_ml_bench.leaderboard.tradeoff import Tradeoff

INDEX, DATA, SUBMISSIONS = "index.html", "data.json", "submissions"
_HERE = Path(__file__).resolve().parent
_OWN_PAGES = re.compile(r"[a-z0-9-]+-[0-9a-f]{12}\.html")
_FRAME_LIMITS = (1, 2, 12, 25)


def write_page(
    groups: Sequence[Group], papers: Sequence[PaperTable], out: Path, tradeoff: Tradeoff | None = None
) -> list[Path]:
    """Write the page of ``groups`` (ranked by `DEFAULT_SORT`), the paper's tables and a trade-off into folder ``out``.

    Returns the files written. Removes pages of submissions that are no longer ranked, and nothing else. Raises
    SubmissionError where a file can't be written.
    """
    files = page_files(groups, papers, tradeoff)
    try:
        (out / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomically(out / name, content)
        for path in (out / SUBMISSIONS).iterdir():
            if _OWN_PAGES.fullmatch(path.name) and f"{SUBMISSIONS}/{path.name}" not in files:
                path.unlink()
    except OSError as error:
        raise SubmissionError(f"{printable(str(out), 500)} can't be written: {error.strerror}") from None
    return [out / name for name in files]


def page_files(
    groups: Sequence[Group], papers: Sequence[PaperTable], tradeoff: Tradeoff | None = None
) -> dict[str, bytes]:
    """Relative name -> content of every file of the page."""
    style, script = (_HERE / "page.css").read_text("utf-8"), (_HERE / "page.js").read_text("utf-8")
    slugs = {id(row.entry): slug(row.entry) for group in groups for row in group.rows}
    settings = tradeoff_section(tradeoff)
    body = _header(groups, bool(settings)) + '<main id="main">\n' + _filters(groups)
    body += "".join(_group_section(group, slugs, number) for number, group in enumerate(groups))
    if not groups:
        body += "<section><h2>No submission yet</h2><p>A row is one JSON file: see below how to add it.</p></section>\n"
    body += settings + paper_section(papers) + reading_section() + "</main>\n"
    about = "Ranking of single-shot fringe projection profilometry: depth error with intervals, run time and captures."
    index = page("FPP-ML-Bench leaderboard", body, style, script, about)
    files = {INDEX: index, DATA: table_json(groups, papers, DEFAULT_SORT)}
    for group in groups:
        for row in group.rows:
            files[f"{SUBMISSIONS}/{slugs[id(row.entry)]}.html"] = submission_page(group, row, style)
    return {name: text.encode("utf-8") for name, text in files.items()}


def slug(entry: Entry) -> str:
    """Name of an entry's page: letters and digits of its own name, and the start of its content's SHA-256."""
    plain = re.sub(r"[^a-z0-9]+", "-", entry.name[:60].casefold()).strip("-") or "submission"
    return f"{plain}-{hashlib.sha256(result_json(entry.result)).hexdigest()[:12]}"


def _header(groups: Sequence[Group], tradeoff: bool) -> str:
    """Title and links: a line for each dataset with its rankings and their number of rows, and a line for the rest."""
    lines = []
    numbered = list(enumerate(groups))
    for data, members in groupby(numbered, key=lambda pair: pair[1].key.data_title):
        of_data = list(members)
        targets = {group.key.against for _, group in of_data}
        links = []
        for number, group in of_data:
            target = f", {group.key.against}" if len(targets) > 1 else ""
            split = f", {group.key.split} split" if group.key.split != "test" else ""
            links.append(_link(f"#s{number}", f"{group.key.track}{target}{split}", len(group.rows)))
        lines.append(f"<b>{escaped(data)}:</b> {' · '.join(links)}")
    rest = [("#tradeoff", "all settings against time")] if tradeoff else []
    rest += [("#paper", "paper's tables"), ("#reading", "how to read this"), (DATA, "JSON")]
    lines.append("<b>More:</b> " + " · ".join(_link(address, text) for address, text in rest))
    items = "".join(f"<li>{line}</li>" for line in lines)
    return f'<header>{INTRODUCTION}<nav aria-label="Sections"><ul class="links">{items}</ul></nav></header>\n'


def _link(address: str, text: str, rows: int | None = None) -> str:
    count = "" if rows is None else f" ({rows})"
    return f'<span><a href="{address}">{escaped(text)}</a>{count}</span>'


def _filters(groups: Sequence[Group]) -> str:
    """Filters for all tables. The script shows them: without it they would do nothing."""
    if not groups:
        return ""
    present = {row.entry.provenance for group in groups for row in group.rows}
    boxes = "".join(
        f'<label><input type="checkbox" name="provenance" value="{escaped(provenance)}" checked> '
        f"{badge(provenance)}</label>"
        for provenance in MEANING
        if provenance in present
    )
    frames = "".join(
        f'<option value="{limit}">{"1, single shot" if limit == 1 else f"at most {limit}"}</option>'
        for limit in _FRAME_LIMITS
    )
    return (
        '<form class="filters" id="filters" hidden><label>Method <input type="search" id="q" maxlength="100" '
        'placeholder="name, method or machine" autocomplete="off"></label>'
        f'<label>Frames <select id="frames"><option value="">any number</option>{frames}</select></label>'
        f"<fieldset><legend>Provenance</legend>{boxes}</fieldset>"
        '<button type="reset">Show all</button></form>\n'
    )


def _group_section(group: Group, slugs: dict[int, str], number: int) -> str:
    key = group.key
    objects = {part.object for row in group.rows for part in row.entry.result.per_object}
    samples = group.rows[0].entry.result.dataset.samples
    timed = f"; timed on {' and '.join(machines(group))}" if machines(group) else ""
    about = (
        f"Dataset {group.dataset_name} ({key.fingerprint[:8]}), {samples} samples of {len(objects)} objects; protocol "
        f"{key.protocol_version}, edge band {key.edge_band_px} px{timed}"
    )
    told = f"<p>These methods were told {TOLD[key.track]}.</p>" if TOLD[key.track] else ""
    legacy = f'<p class="small">{LEGACY_NOTE}</p>' if key.is_legacy else ""
    front = ", ".join(escaped(row.short_name) for row in front_rows(group)) or "no row yet"
    pictures = scatter_html(group, slugs, 860, 430, "wide") + scatter_html(group, slugs, 360, 380, "narrow")
    return (
        f'<section id="s{number}"><h2 id="g{number}">{escaped(key.title)}</h2>'
        f'<p class="soft small">{escaped(about, 500)}</p>{told}{legacy}{ranking_table(group, slugs, number)}'
        f"<figure>{pictures}<figcaption>{SCATTER_KEY} On the front: {front}.</figcaption></figure>"
        f"{objects_table(group, slugs)}</section>\n"
    )
