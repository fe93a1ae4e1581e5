"""The lines of a table to reproduce: rows that were measured here, kept as rows of the leaderboard, beside the numbers
that the paper reports.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fpp_ml_bench.baselines import reproduce
from fpp_ml_bench.baselines.reproduce import Folders, Job
from fpp_ml_bench.baselines.training import Recipe, table_rows
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result import Result
from fpp_ml_bench.leaderboard.reported import paper_tables
from fpp_ml_bench.leaderboard.row_file import Row, row_of, write_row
from fpp_ml_bench.leaderboard.rows import Entry, read_entry
from fpp_ml_bench.loaders.storage import DatasetFolder

_NOT_IN_THE_PAPER = {
    "pix2pixhd": "pix2pixHD",
    "hformer": "Hformer",
    "plain": "the image alone",
    "guided": "guided by phase",
    "physics": "re-projection of depth to phase as a loss",
}


def write_measured(result: Result, path: Path) -> None:
    """Write a row that was measured here. Raises SubmissionError."""
    write_row(row_of(result, path), path)


def row_that_holds(path: Path, opened: DatasetFolder, weights_sha256: str) -> Entry | None:
    """The row in ``path`` if it is sound, of this dataset, these weights and today's protocol; else None."""
    return _row_with(path, opened, "weights_sha256", weights_sha256)


def _row_with(path: Path, opened: DatasetFolder, setting: str, value: str) -> Entry | None:
    """The row in ``path`` if it is sound, of this dataset, today's protocol and this value of a setting."""
    if (entry := _sound_row(path)) is None:
        return None
    found = entry.row.protocol_version, entry.row.submission.settings.get(setting)
    return entry if _is_of(entry, opened) and found == (PROTOCOL_VERSION, value) else None


def _is_of(entry: Entry, opened: DatasetFolder) -> bool:
    return entry.row.dataset.content.items() <= opened.content.items()


def check_row_is_of(path: Path, opened: DatasetFolder) -> None:
    """Raises SubmissionError where ``path`` is a row on other data."""
    entry = _sound_row(path)  # an unreadable one is replaced, nothing is lost
    if entry is not None and not _is_of(entry, opened):
        raise SubmissionError(
            f"{path}: is a row on other data ({entry.row.dataset.identity}) than {opened.path} holds; give another "
            "--rows, or move the row away if it is out of date"
        )


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
    scores: Row | reproduce.AllFrames | None
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
        rows = {name: row_that_holds(folders.row(recipe, name), opened, sha256) for name in reproduce.variants(recipe)}
        entry, *_ = rows.values()
        twins = {str(name): twin for name, twin in list(rows.items())[1:] if twin is not None}
        first = None if entry is None else entry.row
        if table != "multi_frame" or len(opened.sequence.config(recipe.frames)) == 1:
            lines.append(Line(row, label, recipe, first, entry, paper_mm, twins))
            continue
        every = reproduce.all_frames_that_hold(folders.all_frames(recipe), opened.fingerprint, sha256)
        lines.append(Line(row, label, recipe, every, entry, paper_mm))
        lines.append(Line(row, f"{label}, its first frame only", recipe, first, entry, None, twins))
    return lines


def _weights_sha256(recipe: Recipe, folders: Folders, opened: DatasetFolder) -> str | None:
    """The weights whose rows are shown: those trained below ``folders``; where no training was begun there, those of
    the main row, if that is of this recipe; else None."""
    weights = reproduce.current_weights(recipe, folders)
    if weights is not None:
        return reproduce.file_sha256(weights)
    if reproduce.state_of(folders.training(recipe)) != "missing":
        return None
    main_row = folders.row(recipe, reproduce.variants(recipe)[0])
    entry = _row_with(main_row, opened, "recipe_digest", recipe.digest)
    sha256 = None if entry is None else entry.row.submission.settings.get("weights_sha256")
    return sha256 if isinstance(sha256, str) else None
