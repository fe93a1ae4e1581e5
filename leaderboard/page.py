"""The leaderboard as a static page: ``index.html``, ``data.json``, and a page for each submission.

It works from disk and from any web server, loads nothing from anywhere, and the same rows give the same bytes.
"""

import hashlib
import re
from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report_html import escaped, page
from fpp_ml_bench.evaluation.result_io import result_json
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.leaderboard.export import table_json
from fpp_ml_bench.leaderboard.page_objects import objects_table
from fpp_ml_bench.leaderboard.page_scatter import front_rows, scatter_svg
from fpp_ml_bench.leaderboard.page_submission import submission_page
from fpp_ml_bench.leaderboard.page_table import badge, ranking_table
from fpp_ml_bench.leaderboard.page_text import INTRODUCTION, SCATTER_KEY, paper_section, reading_section
from fpp_ml_bench.leaderboard.page_tradeoff import tradeoff_section
from fpp_ml_bench.leaderboard.paper import PaperTable
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT, Group
from fpp_ml_bench.leaderboard.rows import MEANING, Entry
from fpp_ml_bench.leaderboard.tradeoff_points import Tradeoff
from fpp_ml_bench.loaders.manifest import write_atomically

INDEX, DATA, SUBMISSIONS = "index.html", "data.json", "submissions"
_HERE = Path(__file__).resolve().parent
_OURS = re.compile(r"[a-z0-9-]+-[0-9a-f]{12}\.html")
GIVEN = {
    "metric": "",
    "oracle mask": "the object mask",
    "oracle range": "the depth range",
    "oracle range + mask": "the depth range and the object mask",
}
_FRAME_LIMITS = (1, 2, 12, 25)


def write_page(
    groups: Sequence[Group], papers: Sequence[PaperTable], out: Path, tradeoff: Tradeoff | None = None
) -> list[Path]:
    """Write the page of ``groups`` (ranked by `DEFAULT_SORT`), the paper's tables and a trade-off into folder ``out``.

    Returns the files written. Pages of submissions that are no longer in it are removed, nothing else is. Raises
    SubmissionError where a file can't be written.
    """
    files = page_files(groups, papers, tradeoff)
    try:
        (out / SUBMISSIONS).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_atomically(out / name, content)
        for path in (out / SUBMISSIONS).iterdir():
            if _OURS.fullmatch(path.name) and f"{SUBMISSIONS}/{path.name}" not in files:
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
        body += "<section><h2>No submission yet</h2><p>The first one is one JSON file away: see below.</p></section>\n"
    body += settings + paper_section(papers) + reading_section() + "</main>\n"
    about = "Ranking of single-shot fringe projection profilometry: depth error with intervals, run time and captures."
    index = page("FPP-ML-Bench leaderboard", body, style, script, about)
    files = {INDEX: index, DATA: table_json(groups, papers, DEFAULT_SORT)}
    for group in groups:
        for row in group.rows:
            files[f"{SUBMISSIONS}/{slugs[id(row.entry)]}.html"] = submission_page(group, row, style)
    return {name: text.encode("utf-8") for name, text in files.items()}


def slug(entry: Entry) -> str:
    """Name of an entry's page: its own name as far as it is harmless, and the start of its content's SHA-256."""
    plain = re.sub(r"[^a-z0-9]+", "-", entry.name[:60].casefold()).strip("-") or "submission"
    return f"{plain}-{hashlib.sha256(result_json(entry.result)).hexdigest()[:12]}"


def _header(groups: Sequence[Group], tradeoff: bool) -> str:
    links = [(f"#s{number}", _heading(group)) for number, group in enumerate(groups)]
    links += [("#tradeoff", "Every setting against time")] if tradeoff else []
    links += [("#paper", "Reported by the paper"), ("#reading", "How to read this"), (DATA, "All figures as JSON")]
    items = "".join(f'<li><a href="{address}">{escaped(text)}</a></li>' for address, text in links)
    return f'<header>{INTRODUCTION}<nav aria-label="Sections"><ul class="links">{items}</ul></nav></header>\n'


def _heading(group: Group) -> str:
    height, width = group.key.size
    track = group.key.track[0].upper() + group.key.track[1:]
    against = "exact depth" if group.key.target == "depth_exact" else "decoded depth"
    return f"{track} track: {group.key.split} split, {width} x {height} px, against {against}"


def _filters(groups: Sequence[Group]) -> str:
    """One set of filters for every table; shown by the script only, for without it they would do nothing."""
    if not groups:
        return ""
    present = [p for p in MEANING if any(row.entry.provenance == p for group in groups for row in group.rows)]
    boxes = "".join(
        f'<label><input type="checkbox" name="provenance" value="{escaped(p)}" checked> {badge(p)}</label>'
        for p in present
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
    data = f"{group.dataset_name} ({group.key.fingerprint[:8]}), protocol {group.key.protocol_version}"
    objects = {part.object for row in group.rows for part in row.entry.result.per_object}
    given = GIVEN[group.key.track]
    oracle = f"<p>These methods were given {given} of the very samples they are scored on.</p>" if given else ""
    mode = "" if group.key.mode == "standard" else f"; mode {group.key.mode}"
    samples = group.rows[0].entry.result.dataset.samples
    front = ", ".join(escaped(row.entry.name, 80) for row in front_rows(group)) or "nobody yet"
    return (
        f'<section id="s{number}"><h2 id="g{number}">{escaped(_heading(group))}</h2>'
        f'<p class="soft small">{escaped(data, 300)}{escaped(mode)}; {samples} samples of {len(objects)} objects; '
        f"edge band {group.key.edge_band_px} px</p>{oracle}"
        f"{ranking_table(group, slugs, number)}"
        f"<figure>{scatter_svg(group, slugs, 860, 430, 'wide')}{scatter_svg(group, slugs, 360, 380, 'narrow')}"
        f"<figcaption>{SCATTER_KEY} On the front: {front}.</figcaption></figure>"
        f"{objects_table(group, slugs)}</section>\n"
    )
