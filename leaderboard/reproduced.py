"""A table of `fpp-bench reproduce`: rows that were measured here, kept as rows of the leaderboard, beside the numbers
that the paper reports; which of the paper's orderings hold; and the page of it all, in Markdown and for a terminal.

An ordering *holds* where the paired difference has the paper's sign and its 95% interval leaves 0 out, is *reversed*
where it has the opposite sign and leaves 0 out, and is *not decided* by these objects otherwise. The interval is
that of `fpp-eval compare`: differences sample by sample, resampled over objects.
"""

import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Literal

from fpp_ml_bench.baselines.reproduce.plan import Folders, Job, variants
from fpp_ml_bench.baselines.reproduce.work import (
    MAIN_KEY,
    AllFrames,
    Outcome,
    ReproduceSettings,
    all_frames_that_hold,
    current_weights,
    file_sha256,
    state_of,
)
from fpp_ml_bench.baselines.training.recipe import Recipe, table_rows
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.report.comparison import Difference, paired_difference
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.leaderboard.columns import device
from fpp_ml_bench.leaderboard.row_file import Row, row_of, view_means, write_row
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, MEASURED_HERE, Entry, read_entry
from fpp_ml_bench.leaderboard.tables import PAPER_DEPTHS, paper_tables
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import percent, three_digits
from fpp_ml_bench.tables import Table, markdown_text

_NOT_IN_THE_PAPER = {
    "pix2pixhd": "pix2pixHD",
    "hformer": "Hformer",
    "plain": "the image alone",
    "guided": "guided by phase",
    "physics": "re-projection of depth to phase as a loss",
}
_TITLES = {"further": "Further directions of the paper (UNet, global normalisation, RMSE loss, frame 0)"}
"""Of the tables that the paper does not have."""
_TRACKS_DIFFER = "*"


def write_measured(result: Result, path: Path) -> None:
    """Write a row that was measured here. Raises SubmissionError."""
    write_row(row_of(result, path), path)


def row_that_holds(path: Path, opened: DatasetFolder, value: str, setting: str = "weights_sha256") -> Entry | None:
    """The row in ``path`` if it is sound, of this dataset, and of a submission with this ``value`` of a ``setting``;
    else None."""
    entry = _sound_row(path)
    holds = entry is not None and _is_of(entry, opened) and entry.row.submission.settings.get(setting) == value
    return entry if holds else None


def check_row_is_of(path: Path, opened: DatasetFolder) -> None:
    """Raises SubmissionError where ``path`` is a row on other data."""
    entry = _sound_row(path)  # an unreadable one is replaced, nothing is lost
    if entry is not None and not _is_of(entry, opened):
        raise SubmissionError(
            f"{path}: is a row on other data ({entry.row.dataset.identity}) than {opened.path} holds; give another "
            "--rows, or move the row away if it is out of date"
        )


def _is_of(entry: Entry, opened: DatasetFolder) -> bool:
    return entry.row.dataset.content.items() <= opened.content.items()


def _sound_row(path: Path) -> Entry | None:
    try:
        return read_entry(path) if path.is_file() else None
    except SubmissionError:
        return None


@dataclass(frozen=True)
class Line:
    """A line of a table. ``scores``, those of the row or over all frames, and ``entry`` are None where nothing
    has been measured; ``twins``: rows by depth range; ``paper_mm``: the paper's errors by the keys of `HEADLINE`, None
    where it reports none."""

    row: str
    label: str
    recipe: Recipe
    scores: Row | AllFrames | None
    entry: Entry | None
    paper_mm: dict[str, float] | None
    twins: dict[str, Entry] = field(default_factory=dict)


def table_lines(table: str, jobs: Sequence[Job], folders: Folders, opened: DatasetFolder) -> list[Line]:
    """Lines of ``table`` in the paper's order. Rows of other weights or another dataset are left empty. Where a
    training was not begun below ``folders``, its rows may be of another machine: those of the same recipe are shown.
    Where the paper scores every frame (multi-frame), a training's first line does too, and a second line is its row in
    the leaderboard: the first frame only, without a number of the paper."""
    reported = {row.row: row for row in paper_tables()[table].rows} if table in paper_tables() else {}
    recipes = {name: job.recipe for job in jobs for name in job.rows}
    lines = []
    for row in table_rows(table):
        recipe, paper = recipes[f"{table}/{row}"], reported.get(row)
        label, paper_mm = (paper.label, paper.errors_mm) if paper else (_NOT_IN_THE_PAPER.get(row, row), None)
        sha256 = _weights_sha256(recipe, folders, opened)
        if sha256 is None:
            lines.append(Line(row, label, recipe, None, None, paper_mm))
            continue
        rows = {name: row_that_holds(folders.row(recipe, name), opened, sha256) for name in variants(recipe)}
        entry, *_ = rows.values()
        twins = {str(name): twin for name, twin in list(rows.items())[1:] if twin is not None}
        first = None if entry is None else entry.row
        if table != "multi_frame" or len(opened.sequence.config(recipe.frames)) == 1:
            lines.append(Line(row, label, recipe, first, entry, paper_mm, twins))
            continue
        every = all_frames_that_hold(folders.all_frames(recipe), opened.fingerprint, sha256)
        lines.append(Line(row, label, recipe, every, entry, paper_mm))
        lines.append(Line(row, f"{label}, its first frame only", recipe, first, entry, None, twins))
    return lines


def _weights_sha256(recipe: Recipe, folders: Folders, opened: DatasetFolder) -> str | None:
    """The weights whose rows are shown: those trained below ``folders``; where no training was begun there, those of
    the main row, if that is of this recipe; else None."""
    weights = current_weights(recipe, folders)
    if weights is not None:
        return file_sha256(weights)
    if state_of(folders.training(recipe)) != "missing":
        return None
    main_row = folders.row(recipe, variants(recipe)[0])
    entry = row_that_holds(main_row, opened, recipe.digest, "recipe_digest")
    sha256 = None if entry is None else entry.row.submission.settings.get("weights_sha256")
    return sha256 if isinstance(sha256, str) else None


@dataclass(frozen=True)
class Ordering:
    """The paper reports a smaller object MAE for ``better`` than for ``worse``, by ``paper_gap_mm``; ``here``: worse
    minus better. ``same_track`` is False where the rows were given different ground truth of the samples."""

    better: str
    worse: str
    paper_gap_mm: float
    here: Difference
    same_track: bool

    @property
    def verdict(self) -> Literal["holds", "not decided", "reversed"]:
        if not self.here.distinguishable:
            return "not decided"
        return "holds" if (self.here.mean_mm or 0) > 0 else "reversed"


def orderings(lines: Sequence[Line]) -> list[Ordering]:
    """Every pair of measured lines whose numbers in the paper differ, the paper's best first."""
    compared = [
        (line.paper_mm[MAIN_KEY], line) for line in lines if line.scores is not None and line.paper_mm is not None
    ]
    judged = []
    for (better_mm, better), (worse_mm, worse) in combinations(sorted(compared, key=lambda c: c[0]), 2):
        here = _difference(worse, better)
        if worse_mm > better_mm and here.samples:
            tracks = {line.entry.row.track for line in (better, worse) if line.entry is not None}
            judged.append(Ordering(better.label, worse.label, worse_mm - better_mm, here, len(tracks) == 1))
    return judged


def _difference(line: Line, other: Line) -> Difference:
    """Object MAE of ``line`` minus that of ``other`` over the samples of both."""
    first, second = _errors(line), _errors(other)
    gaps = [
        (name, statistics.fmean(views) - statistics.fmean(second[name]))
        for name, views in first.items()
        if name in second
        for _ in views
    ]
    return paired_difference([gap for _, gap in gaps], [name for name, _ in gaps])


def _errors(line: Line) -> dict[str, list[float]]:
    """Object MAE of the views of each object; of a row, their mean for each view."""
    scores, errors = line.scores, dict[str, list[float]]()
    if isinstance(scores, AllFrames):
        views = [(sample.object, sample.metrics.object_mae_mm) for sample in scores.per_sample]
    else:
        views = list(view_means(scores.per_object, MAIN_KEY)) if scores is not None else []
    for name, mae_mm in views:
        if mae_mm is not None:
            errors.setdefault(name, []).append(mae_mm)
    return errors


def conclusion(table: str, lines: Sequence[Line]) -> str:
    """What the lines say, in a sentence: how many of the paper's orderings hold, or, in a table that the paper does not
    have, how far each line is from the first; "" where that is not known."""
    if table in paper_tables():
        return orderings_sentence(orderings(lines))
    said = []
    for line in lines[1:]:
        here = _difference(line, lines[0])
        if here.samples:
            ends = f" (95% interval over {here.objects} objects {_between(here)})" if here.interval else ""
            said.append(f"{line.label} {here.mean_mm:+.2f} mm{ends}")
    return f"Object MAE against {lines[0].label}, sample by sample: {'; '.join(said)}." if said else ""


def _between(difference: Difference) -> str:
    """Both ends of its interval, with their signs; a dash where there is none."""
    return "-" if difference.interval is None else " to ".join(f"{end:+.2f}" for end in difference.interval)


def orderings_sentence(judged: Sequence[Ordering]) -> str:
    """How many of the paper's orderings hold, by the intervals of the paired differences, in a sentence."""
    if not judged:
        return "No two rows of the paper's have been measured here yet, so none of its orderings can be judged."
    count = Counter(ordering.verdict for ordering in judged)
    objects = max(ordering.here.objects for ordering in judged)
    return (
        f"The paper's pairwise orderings by object MAE, {len(judged)} among the rows measured here: {count['holds']} "
        f"hold, {count['reversed']} reversed, {count['not decided']} not decided by {objects} objects (the 95% "
        "interval of the paired difference holds 0)."
    )


def _cells(line: Line, preset: str) -> dict[str, str]:
    """Each cell by the title of its column: a dash where nothing is known, errors with the paper's two decimals."""
    entry, scores = line.entry, line.scores
    here = scores.metrics.model_dump() if scores else None
    interval = scores.intervals.of(MAIN_KEY) if scores else None
    settings = entry.row.submission.settings if entry else {}
    timing, latency_ms = (entry.row.timing, entry.latency_ms) if entry else (None, None)
    cells = {"Row": line.label, "Track": entry.row.track if entry else "-"}
    for pixels in ("object", "overall", "background"):
        title = f"{pixels.capitalize()} MAE / RMSE"
        cells[f"{title}, {MEASURED_HERE}, {preset} preset"] = _pair(here, pixels)
        if pixels == "object":
            ends = " - ".join(map(_mm, interval)) if interval else "-"
            cells[f"95% interval of the object MAE, {MEASURED_HERE}"] = ends
        cells[f"{title}, {BY_THE_PAPER}"] = _pair(line.paper_mm, pixels)
    for name, title in (("predicted", "Range predicted"), ("mean", "Range of the training mean")):
        cells[f"{title}: object MAE / of its measured pixels / missing pixels, {MEASURED_HERE}"] = _twin(line, name)
    return {
        **cells,
        "Parameters": _count(timing and timing.parameters),
        "Epochs": _count(settings.get("epochs_trained")),
        "Training, s": _count(settings.get("training_seconds")),
        "Latency, ms": three_digits(latency_ms),
    }


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _count(value: object) -> str:
    return f"{value:,.0f}" if isinstance(value, int | float) else "-"


def _pair(errors_mm: Mapping[str, float] | None, pixels: str) -> str:
    """MAE and RMSE."""
    return "-" if errors_mm is None else " / ".join(_mm(errors_mm[f"{pixels}_{kind}_mm"]) for kind in ("mae", "rmse"))


def _twin(line: Line, depth_range: str) -> str:
    """Object MAE, the MAE over the pixels that the twin measured, and the share of missing pixels."""
    entry = line.twins.get(depth_range)
    if entry is None:
        return "-"
    errors = [_mm(entry.value(key)) for key in (MAIN_KEY, "object_valid_mae_mm")]
    return " / ".join([*errors, percent(entry.value("object_missing_share"))])


def line_table(table: str, lines: Sequence[Line], preset: str) -> Table:
    """The lines as a table. One that the paper does not have has no empty columns."""
    title = _TITLES[table] if table in _TITLES else paper_tables()[table].title
    rows = [_cells(line, preset) for line in lines]
    shown = [name for name in rows[0] if table in paper_tables() or {row[name] for row in rows} != {"-"}]
    return Table.of(title, [{name: row[name] for name in shown} for row in rows], elsewhere="the page below")


def write_table(table: str, settings: ReproduceSettings, outcome: Outcome) -> Path:
    """Write the page of a table from the rows that there are; its path. SubmissionError where it can't be written."""
    folders = settings.folders
    lines = table_lines(table, outcome.jobs, folders, outcome.opened)
    command = settings.command.replace(f"{table}/{settings.row}", table, 1) if settings.row else settings.command
    text = table_markdown(table, lines, folders.preset, command, outcome.failed)
    write_file(text.encode("utf-8"), folders.table(table))
    return folders.table(table)


def table_markdown(table: str, lines: Sequence[Line], preset: str, command: str, failed: dict[str, str]) -> str:
    """The page of a table as Markdown. ``command`` makes it again; ``failed`` maps a recipe's name to its error."""
    shown = line_table(table, lines, preset)
    parts = [
        f"# {markdown_text(str(shown.title))}",
        "",
        f"Made by `{command}`. Errors in mm, mean over samples.",
        *_about(lines, table in paper_tables()),
        "",
        *shown.markdown(),
        "",
        *_missing(lines, command, failed),
        *_twins_explained(lines),
        *(_orderings(orderings(lines)) if table in paper_tables() else [conclusion(table, lines)]),
    ]
    return "\n".join(parts).rstrip("\n") + "\n"


def _about(lines: Sequence[Line], in_the_paper: bool) -> list[str]:
    entry = next((line.entry for line in lines if line.entry is not None), None)
    if entry is None:
        return []
    data = entry.row.dataset
    height, width = data.size
    objects = len(entry.row.per_object)
    here = (
        f"{MEASURED_HERE.capitalize()}: {data.split} split of {markdown_text(data.name)} ({data.truth[:8]}), "
        f"{data.samples} samples of {objects} objects, {width} x {height} px, against decoded depth; times on "
        f"{markdown_text(_devices(lines))}."
    )
    paper = (
        f" {BY_THE_PAPER.capitalize()}: its own data at 960 x 960 px, its authors' code; the two are shown beside each "
        "other, not ranked together. Rows of the oracle range track were given the test samples' depth range, here as "
        f"in the paper, and score the background in units of that range. {PAPER_DEPTHS}"
    )
    return ["", here + paper if in_the_paper else here]


def _devices(lines: Sequence[Line]) -> str:
    """Where the rows were timed, with their labels where that differs."""
    labels: dict[str, list[str]] = {}
    for line in lines:
        if line.entry is not None:
            labels.setdefault(device(line.entry), []).append(line.label)
    return "; ".join(name if len(labels) == 1 else f"{name} ({', '.join(rows)})" for name, rows in labels.items())


def _missing(lines: Sequence[Line], command: str, failed: dict[str, str]) -> list[str]:
    empty = [line for line in lines if line.scores is None]
    if not empty:
        return []
    why = [(line.label, failed[line.recipe.name]) for line in empty if line.recipe.name in failed]
    reasons = [f"- {markdown_text(label)}: {markdown_text(reason)}" for label, reason in why]
    names = ", ".join(dict.fromkeys(line.row for line in empty))
    return [f"Not measured here: {markdown_text(names)}. To fill: `{command}`", *reasons, ""]


def _twins_explained(lines: Sequence[Line]) -> list[str]:
    twins = (
        "The two columns on the range are metric twins of an oracle-range row: the same network's output, brought to "
        "mm with a range predicted by a small head from the image, or with the mean range of the training samples. The "
        "difference between their object MAE and the row's own is what the oracle gave: the range, and also the mask, "
        "because a twin must find the object itself, and an object pixel that it misses costs its whole depth."
    )
    removed = "With the background removed the input shows the test sample's object mask; no twins there."
    parts = [twins, ""] if any(line.twins for line in lines) else []
    return parts + ([removed, ""] if any(line.recipe.background_removed for line in lines) else [])


def _orderings(judged: Sequence[Ordering]) -> list[str]:
    parts = ["## The paper's orderings", "", orderings_sentence(judged), ""]
    if not judged:
        return parts
    rows = [
        {
            "Better in the paper": ordering.better,
            "Worse in the paper": ordering.worse + ("" if ordering.same_track else f" {_TRACKS_DIFFER}"),
            f"Worse minus better, mm, {BY_THE_PAPER}": f"{ordering.paper_gap_mm:+.2f}",
            f"Worse minus better, mm, {MEASURED_HERE}": f"{ordering.here.mean_mm:+.2f}",
            "95% interval": _between(ordering.here),
            "Here": ordering.verdict,
        }
        for ordering in judged
    ]
    parts += [*Table.of("", rows, (0, 1, 5)).markdown(), ""]
    parts += ["Differences sample by sample; intervals by bootstrap over objects."]
    if not all(ordering.same_track for ordering in judged):
        difference = "one of the two was given the test sample's range, which is part of the difference."
        parts += ["", f"\\{_TRACKS_DIFFER} of different tracks: {difference}"]
    return parts
