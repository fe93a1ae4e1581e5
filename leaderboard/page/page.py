"""The leaderboard as a static page: ``index.html``, the data as JSON and CSV, and a page for each submission, with
samples of the predictions that it was scored from where they are at hand.

The page works from disk and from any web server and loads no other file. The same rows give the same bytes.
"""

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fpp_ml_bench.baselines.tradeoff.measure import Tradeoff
from fpp_ml_bench.errors import CaptureError, DatasetError, FppBenchError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE, METRICS, RANGE_KEY, with_column
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES
from fpp_ml_bench.evaluation.report.report_page import SampleMaps, chosen_samples, sample_maps
from fpp_ml_bench.evaluation.report.terminal import score_text
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import PART_TITLES
from fpp_ml_bench.evaluation.score.uncertainty import FEWEST_OBJECTS
from fpp_ml_bench.files import printable, write_atomically
from fpp_ml_bench.leaderboard import columns, tables
from fpp_ml_bench.leaderboard.columns import assumption, assumption_sentences, given_truth, learned_from
from fpp_ml_bench.leaderboard.page.sections import CLASS_COLOURS, blocks, tradeoff_section
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT, Group, Ranked, more_than_trivial
from fpp_ml_bench.leaderboard.row_file import Row
from fpp_ml_bench.leaderboard.rows import MEANING, Entry, read_scored
from fpp_ml_bench.leaderboard.tables import ReportedTable, table_csv, table_json
from fpp_ml_bench.loaders.captures.exports import camera_points
from fpp_ml_bench.loaders.cloud import cloud_html
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import interval_text, page

INDEX, DATA, TABLE, SUBMISSIONS, CLOUD = "index.html", "data.json", "data.csv", "submissions", "-cloud.html"
_HERE, _PACKAGE = Path(__file__).resolve().parent, "fpp_ml_bench.leaderboard.page"
_OWN_PAGES = re.compile(r"[a-z0-9-]+-[0-9a-f]{12}(-cloud)?\.html")
NOT_SAID = "not said"


PLACES = "Median", "Worst"
"""The samples that are shown; where there are too few for that, the only one."""


@dataclass(frozen=True)
class Samples:
    """The samples that are shown, and the page of the first prediction as a point cloud; ``cloud`` is None where the
    prediction has no depth, or the dataset no camera of its size."""

    shown: list[SampleMaps]
    cloud: bytes | None


def write_page(
    groups: Sequence[Group],
    papers: Sequence[ReportedTable],
    out: Path,
    tradeoff: Tradeoff | None = None,
    samples: Mapping[str, Samples] = MappingProxyType({}),
) -> list[Path]:
    """Write the page of ``groups`` (ranked by `DEFAULT_SORT`), the paper's tables and a trade-off into folder ``out``;
    returns the files. ``samples``: `predicted_samples` of the rows. Removes pages of submissions that are no
    longer ranked, and nothing else. SubmissionError where a file can't be written."""
    files = page_files(groups, papers, tradeoff, samples)
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
    groups: Sequence[Group],
    papers: Sequence[ReportedTable],
    run: Tradeoff | None = None,
    samples: Mapping[str, Samples] = MappingProxyType({}),
) -> dict[str, bytes]:
    """Relative name -> content of every file of the page. Tables of trivial rows alone are in the data files only."""
    data = {DATA: table_json(groups, papers, DEFAULT_SORT), TABLE: table_csv(groups)}
    groups = more_than_trivial(groups)
    style = (_HERE / "page.css").read_text("utf-8")
    slugs = {id(row.entry): slug(row.entry) for group in groups for row in group.rows}
    rows = [(group, row) for group in groups for row in group.rows]
    shared = {"meaning": MEANING, "learned_from": learned_from}
    filters: dict[str, tuple[str, list[str]]] = {
        "class": ("Class", [name for name in FRAMES_CLASSES if any(group.key.frames == name for group in groups)]),
        "track": ("Track", sorted({group.key.track for group in groups})),
        "learned": ("Learned from", sorted({learned_from(row.entry.row) or NOT_SAID for _, row in rows})),
    }
    present = {row.provenance for _, row in rows}
    others = [metric for metric in with_column(0) if not metric.role and metric.key != "overall_mae_mm"]
    index = page(
        _PACKAGE,
        "index.html",
        "FPP-ML-Bench leaderboard",
        style,
        (_HERE / "page.js").read_text("utf-8"),
        "Ranking of single-shot fringe projection profilometry: depth error with intervals, run time and captures.",
        **shared,
        columns=columns,
        range_key=RANGE_KEY,
        errors=[(m.key, f"{m.column}, mm" if m.unit == "mm" else m.column) for m in others],
        given_truth=given_truth,
        assumption=assumption,
        search=_search,
        slug=lambda entry: slugs[id(entry)],
        blocks=blocks(groups, slugs),
        tradeoff=tradeoff_section(run),
        provenances=[name for name in MEANING if name in present],
        colours=CLASS_COLOURS,
        not_said=NOT_SAID,
        fewest=FEWEST_OBJECTS,
        filters={name: (title, values) for name, (title, values) in filters.items() if len(values) > 1},
        papers=[(f"{p.title}, mm", tables.paper_table(p), p.note) for p in papers],
    )
    files = {INDEX: index} | {name: text.encode("utf-8") for name, text in data.items()}
    for group, row in rows:
        own, name = samples.get(row.entry.row.result_sha256), slugs[id(row.entry)]
        title, values = f"{row.entry.name}: FPP-ML-Bench", shared | _submission(group, row)
        text = page(_PACKAGE, "submission.html", title, style, **values, samples=own, slug=name)
        files[f"{SUBMISSIONS}/{name}.html"] = text
        if own is not None and own.cloud is not None:
            files[f"{SUBMISSIONS}/{name}{CLOUD}"] = own.cloud
    return files


def _submission(group: Group, row: Ranked) -> dict[str, Any]:
    """What the template needs for the page of ``row``."""
    about = row.entry.row
    parts = [about] if row.unseen is None else [about, row.unseen.row]
    bars = [(mean, name) for name, mean in row.object_means(DEFAULT_SORT).items()]
    changes = about.reliance.parts if about.reliance else None
    changed = [(words, getattr(changes, key)) for key, words in PART_TITLES.items()] if changes else []
    return {
        "row": row,
        "group": group,
        "rows": len(group.ranked),
        "assumption_sentences": assumption_sentences,
        "columns": columns,
        "scored": [(_data_words(part), _score_cells(part)) for part in parts],
        "bars": sorted(bars, key=lambda bar: (-bar[0], bar[1])),
        "longest_mm": max(bars, default=(0.0, ""))[0],
        "parts": [(words, f"{value:.2f}") for words, value in changed if value is not None],
    }


def _data_words(row: Row) -> str:
    benchmark = row.dataset.known
    return f"{row.dataset.name if benchmark is None else benchmark.title}, {row.dataset.split} split"


def _score_cells(row: Row) -> list[tuple[str, str, str]]:
    """Each mean in words, its value, and its interval."""
    cells = []
    for key in (*HEADLINE, *(key for key in METRICS if key not in HEADLINE)):
        if (value := getattr(row.metrics, key)) is not None:
            title = key.removesuffix("_mm").replace("_", " ")
            cells.append((title, score_text(key, value), interval_text(row.intervals.of(key))))
    return cells


def slug(entry: Entry) -> str:
    """Name of an entry's page: letters and digits of its own name, and the start of its content's SHA-256."""
    plain = re.sub(r"[^a-z0-9]+", "-", entry.name[:60].casefold()).strip("-") or "submission"
    return f"{plain}-{hashlib.sha256(entry.row.model_dump_json().encode()).hexdigest()[:12]}"


def _search(row: Ranked) -> str:
    """What the search field finds a row by."""
    words = row.entry.name, row.short_name, row.entry.row.submission.method, columns.device(row.entry)
    return " ".join(words).casefold()


def predicted_samples(entries: Sequence[Entry], folders: Sequence[tuple[Path, DatasetFolder]]) -> dict[str, Samples]:
    """The samples of every folder of predictions, each with its dataset, by `Row.result_sha256` of the entries that
    were scored from it. Row files name no samples, so only results have them. Raises SubmissionError for a folder that
    no result was scored from, and says why."""
    results = [entry for entry in entries if folders and not entry.is_row_file]
    scored = {entry.row.result_sha256: read_scored(entry.path) for entry in results}
    found: dict[str, Samples] = {}
    for folder, dataset in folders:
        why: FppBenchError | str = "row files name no samples; give the result of fpp-eval"
        of_folder = {}
        for digest, result in scored.items():
            try:
                if isinstance(result, Result):
                    of_folder[digest] = _samples(result, folder, dataset)
            except (DatasetError, PredictionError) as error:
                why = error
        if not of_folder:
            raise SubmissionError(f"{printable(str(folder), 500)}: no given result was scored from it ({why})")
        found |= of_folder
    return found


def _samples(result: Result, folder: Path, dataset: DatasetFolder) -> Samples:
    chosen = chosen_samples(result.per_sample)
    shown = list(sample_maps(result, dataset, folder, [c for c in chosen if c[0] in PLACES] or chosen[:1]))
    if not shown or result.mode != "standard":  # no sample has an object; depths of another mode may lack an offset
        return Samples(shown, None)
    try:
        points_mm, there = camera_points(shown[0].prediction_mm, dataset.rig.camera)
    except CaptureError:
        return Samples(shown, None)
    return Samples(
        shown, cloud_html(f"{result.submission.name}: {shown[0].row.sample}", points_mm, shown[0].fringe[there])
    )
