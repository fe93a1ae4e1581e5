"""A table of `fpp-bench reproduce`: rows that were measured here, kept as rows of the leaderboard,
beside the numbers that the paper reports and the best trivial method; which of the paper's
orderings hold; and the page of it all, in Markdown and for a terminal.

An ordering *holds* or is *reversed* where the objects decide it: the sign-flip test of the paired
differences, with Holm's correction over the pairs of the table, tells the rows apart, and the 95%
interval over objects, and over the seeds with which both rows were trained (`interval_over_seeds`),
leaves 0 out. Else it is only *seen*, or *seen reversed*: the mean over these objects goes that way.
The test split's five, fewer than `FEWEST_OBJECTS`, decide none.
"""

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

from fpp_ml_bench.baselines.registry import methods
from fpp_ml_bench.baselines.reproduce.plan import FOLDS, Folders, Job
from fpp_ml_bench.baselines.reproduce.scores import (
    BINS_MM,
    MAIN_KEY,
    OVERALL_KEY,
    Scores,
    constant_scores,
    joined,
    scores_that_hold,
)
from fpp_ml_bench.baselines.reproduce.work import (
    MISSING,
    Outcome,
    ReproduceSettings,
    current_weights,
    file_sha256,
    state_of,
)
from fpp_ml_bench.baselines.training.recipe import SEED, Recipe, about_preset, table_rows
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import RANGE_KEY
from fpp_ml_bench.evaluation.protocol import Track
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.score.uncertainty import (
    FEWEST_OBJECTS,
    SIGNIFICANT,
    Interval,
    holm,
    interval_over_seeds,
    sign_flip_p,
)
from fpp_ml_bench.leaderboard.columns import device
from fpp_ml_bench.leaderboard.ranking import given_words
from fpp_ml_bench.leaderboard.row_file import Row, row_of, write_row
from fpp_ml_bench.leaderboard.rows import (
    BY_THE_PAPER,
    MEASURED_HERE,
    SHIPPED_ROWS,
    Entry,
    read_entry,
)
from fpp_ml_bench.leaderboard.tables import PAPER_DEPTHS, ReportedRow, paper_tables
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.style import panels, percent, styled, three_digits, with_legend
from fpp_ml_bench.tables import Table, markdown_text

_NOT_IN_THE_PAPER = {
    "pix2pixhd": "pix2pixHD",
    "hformer": "Hformer",
    "plain": "the image alone",
    "guided": "guided by phase",
    "physics": "re-projection of depth to phase as a loss",
}
_TITLES = {
    "further": "Further directions of the paper (UNet, global normalisation, RMSE loss, frame 0)",
    FOLDS: "Cross-validation over all objects",
}
"""Of the tables that the paper does not have."""
_TRACKS_DIFFER, _EACH_SEED = "*", "Object MAE of each seed"
Errors = Mapping[str, float | None]


def write_measured(result: Result, path: Path) -> None:
    """Write a row that was measured here. Raises SubmissionError."""
    write_row(row_of(result, path), path)


def row_that_holds(
    path: Path, opened: DatasetFolder, value: str, setting: str = "weights_sha256"
) -> Entry | None:
    """The row in ``path`` if it is sound, of this dataset, and of a submission with this ``value``
    of a ``setting``; else None."""
    entry = _sound_row(path)
    holds = (
        entry is not None
        and _is_of(entry, opened)
        and entry.row.submission.settings.get(setting) == value
    )
    return entry if holds else None


def check_row_is_of(path: Path, opened: DatasetFolder) -> None:
    """Raises SubmissionError where ``path`` is a row on other data."""
    entry = _sound_row(path)  # an unreadable one is replaced, nothing is lost
    if entry is not None and not _is_of(entry, opened):
        raise SubmissionError(
            f"{path}: is a row on other data ({entry.row.dataset.identity}) than {opened.path} "
            f"holds; give another "
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
    """A line of a table. ``found``: the row of each seed, the recipe's own first, or its scores
    where they are of every frame or of a cross-validation; empty where nothing has been measured.
    ``entry``: the row of the recipe's own seed; ``paper_mm``: the paper's errors by the keys of
    `HEADLINE`, None where it reports none; ``recipe``: None of a trivial method."""

    row: str
    label: str
    recipe: Recipe | None
    found: Mapping[int, Row | Scores]
    entry: Entry | None
    paper_mm: Mapping[str, float] | None = None

    @property
    def track(self) -> str:
        """Of its row, or of the rows that its recipe would have; a dash without either."""
        if self.entry is not None or self.recipe is None:
            return "-" if self.entry is None else self.entry.row.track
        given = ["range"] * (self.recipe.normalisation == "individual") + [
            "mask"
        ] * self.recipe.background_removed
        return f"oracle {' + '.join(given)}" if given else "metric"

    def error(self, key: str) -> float | None:
        """A score, mean over the seeds; None where it is unknown."""
        values = [_errors(result).get(key) for result in self.found.values()]
        known = [value for value in values if value is not None]
        return statistics.fmean(known) if known else None

    @property
    def by_seed(self) -> dict[int, dict[str, float]]:
        """The object MAE in mm of each object, for each seed."""
        return {seed: _by_object(result) for seed, result in self.found.items()}


def _errors(result: Row | Scores) -> Errors:
    return result.errors if isinstance(result, Scores) else result.metrics.model_dump()


def _by_object(result: Row | Scores) -> dict[str, float]:
    if isinstance(result, Scores):
        return dict(result.per_object)
    return {
        part.object: value
        for part in result.per_object
        if (value := getattr(part, MAIN_KEY)) is not None
    }


def _reported(table: str) -> dict[str, ReportedRow]:
    return {row.row: row for row in paper_tables()[table].rows} if table in paper_tables() else {}


def table_lines(
    table: str, jobs: Sequence[Job], folders: Folders, opened: DatasetFolder
) -> list[Line]:
    """Lines of ``table`` in the paper's order, below those of trivial methods. Rows of other
    weights or another dataset are left empty. Where a training was not begun below ``folders``, its
    rows may be of another machine: those of the same recipe are shown. Where the paper scores every
    frame (multi-frame), a training's first line does too, and a second line is its row in the
    leaderboard: the first frame only, without a number of the paper."""
    if table == FOLDS:
        return _fold_lines(jobs, folders, opened)
    reported, lines = _reported(table), []
    for row in table_rows(table):
        recipes = [job.recipe for job in jobs if f"{table}/{row}" in job.rows]
        recipe, paper = recipes[0], reported.get(row)
        label, paper_mm = (
            (paper.label, paper.errors_mm) if paper else (_NOT_IN_THE_PAPER.get(row, row), None)
        )
        weights = {
            training.seed: _weights_sha256(training, folders, opened) for training in recipes
        }
        entries = {
            training.seed: held
            for training in recipes
            if (sha256 := weights[training.seed]) is not None
            if (held := row_that_holds(folders.row(training), opened, sha256)) is not None
        }
        entry = entries.get(recipe.seed)
        by_seed = {seed: held.row for seed, held in entries.items()} if entry is not None else {}
        if table != "multi_frame" or recipe.frames == "single_shot" or weights[recipe.seed] is None:
            lines.append(Line(row, label, recipe, by_seed, entry, paper_mm))
            continue
        every = scores_that_hold(
            folders.scores(recipe), opened.fingerprint, recipe, weights[recipe.seed]
        )
        lines.append(
            Line(row, label, recipe, {recipe.seed: every} if every else {}, entry, paper_mm)
        )
        lines.append(Line(row, f"{label}, its first frame only", recipe, by_seed, entry))
    return [
        *_trivial_lines({line.entry.row.track for line in lines if line.entry is not None}, opened),
        *lines,
    ]


def _trivial_lines(tracks: set[Track], opened: DatasetFolder) -> list[Line]:
    """A line for the best trivial method of each of ``tracks``: of those that come with the
    package, were scored on these data, and are given no more of the ground truth."""
    entries = [
        entry
        for entry in map(read_entry, sorted(SHIPPED_ROWS.glob("*.json")) if tracks else ())
        if _is_of(entry, opened)
        and entry.all_checked
        and getattr(methods().get(entry.row.submission.method), "trivial", False)
    ]
    best = {}
    for track in sorted(tracks):
        known = [entry for entry in entries if given_words(entry.row.track) <= given_words(track)]
        if known:
            entry = min(known, key=lambda entry: entry.value(MAIN_KEY) or 0.0)
            best[entry.path.stem] = Line(
                entry.path.stem, f"{entry.name} (trivial)", None, {0: entry.row}, entry
            )
    return list(best.values())


def _fold_lines(jobs: Sequence[Job], folders: Folders, opened: DatasetFolder) -> list[Line]:
    """The rows of a cross-validation, over the objects of the parts that all of them were trained
    for, below the best constant share of the given range, chosen on the training objects of each
    part."""
    recipes_of = [job.recipe for job in jobs]
    held = {
        recipe.name: scores_that_hold(folders.scores(recipe), opened.fingerprint, recipe)
        for recipe in recipes_of
    }
    names = dict.fromkeys(row for job in jobs for row in job.rows)
    parts = {recipe.fold for recipe in recipes_of} - {
        recipe.fold for recipe in recipes_of if held[recipe.name] is None
    }
    lines = []
    for name in names:
        table, _, row = name.partition("/")
        paper = _reported(table).get(row)
        recipes = [job.recipe for job in jobs if name in job.rows]
        scores = [
            part_scores
            for recipe in recipes
            if recipe.fold in parts and (part_scores := held[recipe.name]) is not None
        ]
        by_seed = {recipes[0].seed: joined(scores)} if scores else {}
        label, paper_mm = (f"{paper.label} ({table})", paper.errors_mm) if paper else (name, None)
        lines.append(Line(name, label, recipes[0], by_seed, None, paper_mm))
    constants = [
        constant_scores(opened, part) for part in sorted(part for part in parts if part is not None)
    ]
    if constants and any(recipe.normalisation == "individual" for recipe in recipes_of):
        label = "best constant in the given range (trivial)"
        lines.insert(0, Line("constant", label, None, {0: joined(constants)}, None))
    return lines


def _weights_sha256(recipe: Recipe, folders: Folders, opened: DatasetFolder) -> str | None:
    """The weights whose rows are shown: those trained below ``folders``; where no training was
    begun there, those of the row, if that is of this recipe; else None."""
    weights = current_weights(recipe, folders)
    if weights is not None:
        return file_sha256(weights)
    if state_of(folders.training(recipe)) != MISSING:
        return None
    entry = row_that_holds(folders.row(recipe), opened, recipe.digest, "recipe_digest")
    sha256 = None if entry is None else entry.row.submission.settings.get("weights_sha256")
    return sha256 if isinstance(sha256, str) else None


@dataclass(frozen=True)
class Gap:
    """Mean difference in object MAE, mm, its 95% interval, how many objects and seeds it is over,
    and the p value of the sign-flip test over objects."""

    mean_mm: float
    interval: Interval | None
    objects: int
    seeds: int
    p: float

    @property
    def between(self) -> str:
        """Both ends of the interval, with their signs; a dash where there is none."""
        return "-" if self.interval is None else " to ".join(f"{end:+.2f}" for end in self.interval)


@dataclass(frozen=True)
class Ordering:
    """The paper reports a smaller object MAE for ``better`` than for ``worse``, by
    ``paper_gap_mm``; ``here``: worse minus better; ``p_holm``: its p value after Holm's correction.
    ``same_track`` is False where the rows were given different ground truth of the samples."""

    better: str
    worse: str
    paper_gap_mm: float
    here: Gap
    p_holm: float
    same_track: bool

    @property
    def verdict(self) -> Literal["holds", "reversed", "seen", "seen reversed"]:
        ends = self.here.interval
        if ends is not None and not ends[0] <= 0 <= ends[1] and self.p_holm <= SIGNIFICANT:
            return "holds" if self.here.mean_mm > 0 else "reversed"
        return "seen" if self.here.mean_mm > 0 else "seen reversed"


def orderings(lines: Sequence[Line]) -> list[Ordering]:
    """Every pair of measured lines whose numbers in the paper differ, the paper's best first."""
    compared = [
        (line.paper_mm[MAIN_KEY], line)
        for line in lines
        if line.found and line.paper_mm is not None
    ]
    pairs = [
        (better, worse, worse_mm - better_mm, here)
        for (better_mm, better), (worse_mm, worse) in combinations(
            sorted(compared, key=lambda c: c[0]), 2
        )
        if worse_mm > better_mm and (here := gap(worse, better)) is not None
    ]
    return [
        Ordering(better.label, worse.label, paper_gap_mm, here, p_holm, better.track == worse.track)
        for (better, worse, paper_gap_mm, here), p_holm in zip(
            pairs, holm([here.p for *_, here in pairs]), strict=True
        )
    ]


def gap(line: Line, other: Line) -> Gap | None:
    """Object MAE of ``line`` minus that of ``other``, over the objects and seeds of both; None
    without any."""
    first, second = line.by_seed, other.by_seed
    seeds = [seed for seed in first if seed in second]
    names = [
        name for name in (first[seeds[0]] if seeds else ()) if all(name in second[s] for s in seeds)
    ]
    if not names:
        return None
    gaps = [{name: first[seed][name] - second[seed][name] for name in names} for seed in seeds]
    of_object = [statistics.fmean(of_seed[name] for of_seed in gaps) for name in names]
    mean_mm, interval = statistics.fmean(of_object), interval_over_seeds(gaps)
    return Gap(mean_mm, interval, len(names), len(seeds), sign_flip_p(of_object))


def conclusion(table: str, lines: Sequence[Line]) -> str:
    """What the lines say, in a sentence: how many of the paper's orderings hold, or, in a table
    that the paper does not have, how far each line is from the first; "" where that is not
    known."""
    lines = [line for line in lines if line.recipe is not None]
    if table in paper_tables() or table == FOLDS:
        return orderings_sentence(orderings(lines))
    said = []
    for line in lines[1:]:
        if here := gap(line, lines[0]):
            ends = (
                f" (95% interval over {here.objects} objects {here.between})"
                if here.interval
                else ""
            )
            said.append(f"{line.label} {here.mean_mm:+.2f} mm{ends}")
    return (
        f"Object MAE against {lines[0].label}, sample by sample: {'; '.join(said)}." if said else ""
    )


def orderings_sentence(judged: Sequence[Ordering]) -> str:
    """How many of the paper's orderings the objects decide, and which way the others go in the
    mean."""
    if not judged:
        return (
            "No two rows of the paper's have been measured here yet, so none of its orderings can "
            "be judged."
        )
    count = Counter(ordering.verdict for ordering in judged)
    objects = max(ordering.here.objects for ordering in judged)
    few = (
        f" Fewer than {FEWEST_OBJECTS} objects can decide none." if objects < FEWEST_OBJECTS else ""
    )
    return (
        f"The paper's pairwise orderings by object MAE, {len(judged)} among the rows measured "
        f"here. Decided by "
        f"{objects} objects, with Holm's correction: {count['holds']} hold, {count['reversed']} "
        f"reversed. Only seen in "
        f"the mean over them: {count['seen']} as in the paper, {count['seen reversed']} "
        f"reversed.{few}"
    )


def _cells(line: Line, preset: str) -> dict[str, str]:
    """Each cell by the title of its column: a dash where nothing is known, errors with the paper's
    two decimals."""
    entry, by_seed = line.entry, line.by_seed
    here = _pair if line.found else lambda error, pixels: "-"
    ends = interval_over_seeds(list(by_seed.values()))
    settings = entry.row.submission.settings if entry else {}
    timing, latency_ms = (entry.row.timing, entry.latency_ms) if entry else (None, None)
    cells = {"Row": line.label, "Track": line.track}
    paper = line.paper_mm or {}
    for pixels in ("object", "overall", "background"):
        title = f"{pixels.capitalize()} MAE / RMSE"
        cells[f"{title}, {MEASURED_HERE}, {preset} preset"] = here(line.error, pixels)
        if pixels == "object":
            interval = " - ".join(map(_mm, ends)) if ends else "-"
            cells[f"95% interval of the object MAE, {MEASURED_HERE}"] = interval
            each = [_mm(statistics.fmean(errors.values())) for errors in by_seed.values()]
            cells[_EACH_SEED] = ", ".join(each) if len(each) > 1 else "-"
            cells["Of depth range"] = percent(line.error(RANGE_KEY))
        cells[f"{title}, {BY_THE_PAPER}"] = _pair(paper.get, pixels) if paper else "-"
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
    return f"{value:,.0f}" if isinstance(value, int | float) and value else "-"


def _pair(error: Callable[[str], float | None], pixels: str) -> str:
    """MAE and RMSE."""
    return " / ".join(_mm(error(f"{pixels}_{kind}_mm")) for kind in ("mae", "rmse"))


def line_table(table: str, lines: Sequence[Line], preset: str) -> Table:
    """The lines as a table. One that the paper does not have has no empty columns."""
    title = _TITLES.get(table) or paper_tables()[table].title
    rows = [_cells(line, preset) for line in lines]
    optional = (_EACH_SEED,) if table in paper_tables() else tuple(rows[0])
    shown = [
        name for name in rows[0] if name not in optional or {row[name] for row in rows} != {"-"}
    ]
    return Table.of(
        title, [{name: row[name] for name in shown} for row in rows], elsewhere="the page below"
    )


def write_table(table: str, settings: ReproduceSettings, outcome: Outcome) -> Path:
    """Write the page of a table from the rows that there are; its path. Histograms of the
    multi-frame table are beside it. SubmissionError where it can't be written."""
    folders, path = settings.folders, settings.folders.table(table)
    lines = table_lines(table, outcome.jobs, folders, outcome.opened)
    command = (
        settings.command.replace(f"{table}/{settings.row}", table, 1)
        if settings.row
        else settings.command
    )
    text = table_markdown(table, lines, folders.preset, command, outcome.failed)
    counted = {
        f"{job.recipe.frames}: {scores.pairs} pairs": scores
        for job in outcome.jobs
        if table == "multi_frame" and job.has_scores and job.recipe.seed == SEED
        if (weights := _weights_sha256(job.recipe, folders, outcome.opened))
        if (
            scores := scores_that_hold(
                folders.scores(job.recipe), outcome.opened.fingerprint, job.recipe, weights
            )
        )
        if scores.counts
    }
    if counted:
        write_file(draw_histograms(counted), path.with_suffix(".png"))
        text += f"\n![Histograms of the errors of the pairs of view and frame]({table}.png)\n"
    write_file(text.encode("utf-8"), path)
    return path


@styled
def draw_histograms(counted: Mapping[str, Scores]) -> bytes:
    """A panel for each row: the share of its pairs by overall MAE, as in the paper's figures, and
    object MAE; PNG."""
    drawn, panels_of = panels(list(counted), 3, 3.0, 2.2)
    for axes, scores in zip(panels_of, counted.values(), strict=True):
        for key, label, fill in (
            (OVERALL_KEY, "overall MAE", True),
            (MAIN_KEY, "object MAE", False),
        ):
            shares = [100 * count / scores.pairs for count in scores.counts[key]]
            axes.stairs(shares, BINS_MM, fill=fill, label=label, linewidth=1.2)
        axes.set(xscale="log", xlabel="mm", ylabel="% of pairs")
    return with_legend(drawn, 2)


def table_markdown(
    table: str, lines: Sequence[Line], preset: str, command: str, failed: dict[str, str]
) -> str:
    """The page of a table as Markdown. ``command`` makes it again; ``failed`` maps a recipe's name
    to its error."""
    shown = line_table(table, lines, preset)
    parts = [
        f"# {markdown_text(str(shown.title))}",
        "",
        f"Made by `{command}`. {about_preset(preset)} Errors in mm, mean over samples (and seeds).",
        *_about(lines, table in paper_tables()),
        "",
        *shown.markdown(),
        "",
        *_missing(lines, command, failed),
        *(
            _orderings(orderings(lines))
            if table in paper_tables() or table == FOLDS
            else [conclusion(table, lines)]
        ),
    ]
    return "\n".join(parts).rstrip("\n") + "\n"


def _about(lines: Sequence[Line], in_the_paper: bool) -> list[str]:
    entry = next(
        (line.entry for line in lines if line.entry is not None and line.recipe is not None), None
    )
    if entry is None:
        return []
    data = entry.row.dataset
    height, width = data.size
    objects = len(entry.row.per_object)
    here = (
        f"{MEASURED_HERE.capitalize()}: {data.split} split of {markdown_text(data.name)} "
        f"({data.truth[:8]}), "
        f"{data.samples} samples of {objects} objects, {width} x {height} px, against decoded "
        f"depth; times on "
        f"{markdown_text(_devices(lines))}."
    )
    paper = (
        f" {BY_THE_PAPER.capitalize()}: its own data at 960 x 960 px, its authors' code; the two "
        f"are shown beside each "
        "other, not ranked together. Rows of the oracle range track were given the test samples' "
        "depth range, here as "
        f"in the paper, and score the background in units of that range. {PAPER_DEPTHS}"
    )
    return ["", here + paper if in_the_paper else here]


def _devices(lines: Sequence[Line]) -> str:
    """Where the rows were timed, with their labels where that differs."""
    labels: dict[str, list[str]] = {}
    for line in lines:
        if line.entry is not None:
            labels.setdefault(device(line.entry), []).append(line.label)
    return "; ".join(
        name if len(labels) == 1 else f"{name} ({', '.join(rows)})" for name, rows in labels.items()
    )


def _missing(lines: Sequence[Line], command: str, failed: dict[str, str]) -> list[str]:
    empty = [line for line in lines if not line.found]
    if not empty:
        return []
    why = [
        (line.label, failed[line.recipe.name])
        for line in empty
        if line.recipe and line.recipe.name in failed
    ]
    reasons = [f"- {markdown_text(label)}: {markdown_text(reason)}" for label, reason in why]
    names = ", ".join(dict.fromkeys(line.row for line in empty))
    return [f"Not measured here: {markdown_text(names)}. To fill: `{command}`", *reasons, ""]


def _orderings(judged: Sequence[Ordering]) -> list[str]:
    parts = ["## The paper's orderings", "", orderings_sentence(judged), ""]
    if not judged:
        return parts
    rows = [
        {
            "Better in the paper": ordering.better,
            "Worse in the paper": ordering.worse
            + ("" if ordering.same_track else f" {_TRACKS_DIFFER}"),
            f"Worse minus better, mm, {BY_THE_PAPER}": f"{ordering.paper_gap_mm:+.2f}",
            f"Worse minus better, mm, {MEASURED_HERE}": f"{ordering.here.mean_mm:+.2f}",
            "95% interval": ordering.here.between,
            "p, Holm": three_digits(ordering.p_holm),
            "Seeds": str(ordering.here.seeds),
            "Here": ordering.verdict,
        }
        for ordering in judged
    ]
    parts += [*Table.of("", rows, (0, 1, 7)).markdown(), ""]
    how = (
        "intervals by bootstrap over objects and the seeds that both rows have; p by sign flips of "
        "the objects'"
    )
    parts += [
        f"Differences object by object; {how} differences, with Holm's correction over these pairs."
    ]
    if not all(ordering.same_track for ordering in judged):
        difference = (
            "one of the two was given the test sample's range, which is part of the difference."
        )
        parts += ["", f"\\{_TRACKS_DIFFER} of different tracks: {difference}"]
    return parts
