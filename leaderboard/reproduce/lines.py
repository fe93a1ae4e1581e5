"""The lines of a reproduced table: what was measured here for each row of the paper's, read from the row files."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from fpp_ml_bench.baselines.training import Recipe
from fpp_ml_bench.evaluation.protocol import HEADLINE
from fpp_ml_bench.leaderboard.reproduce.frames import AllFrames, all_frames_that_hold
from fpp_ml_bench.leaderboard.reproduce.plan import MEAN, PREDICTED, Folders, Job, Place, places, variants
from fpp_ml_bench.leaderboard.reproduce.row import file_sha256, row_that_holds
from fpp_ml_bench.leaderboard.reproduce.train_row import current_weights
from fpp_ml_bench.leaderboard.rows import Entry
from fpp_ml_bench.loaders.storage import DatasetFolder

MAIN_KEY = "object_mae_mm"


@dataclass(frozen=True)
class Scored:
    """The six errors in mm by the keys of `HEADLINE`, the 95% interval of the object MAE, and each sample's own:
    sample to (object, object MAE in mm)."""

    errors_mm: dict[str, float | None]
    interval_mm: tuple[float, float] | None
    samples: dict[str, tuple[str, float | None]]


@dataclass(frozen=True)
class Line:
    """A line of a table. ``scored`` and ``entry`` are None where nothing has been measured; ``twins`` maps a twin's
    suffix to its row. ``paper_mm`` are the paper's errors by the keys of `HEADLINE`, None where it reports none."""

    place: Place
    recipe: Recipe
    label: str
    scored: Scored | None
    entry: Entry | None
    paper_mm: dict[str, float] | None
    twins: dict[str, Entry] = field(default_factory=dict)

    @property
    def compared(self) -> bool:
        """Whether the line has both our numbers and the paper's."""
        return self.scored is not None and self.paper_mm is not None


def table_lines(table: str, jobs: Sequence[Job], folders: Folders, opened: DatasetFolder) -> list[Line]:
    """Lines of ``table`` in the paper's order. Rows of other weights or another dataset are left empty.

    Where the paper scores every frame (multi-frame), a training's first line does too, and a second line is its row in
    the leaderboard: the first frame only, without a number of the paper.
    """
    owners = {place: job for job in jobs for place in job.places}
    return [line for place in places(table) for line in _lines_of(place, owners[place], folders, opened)]


def _lines_of(place: Place, job: Job, folders: Folders, opened: DatasetFolder) -> list[Line]:
    recipe, weights = job.recipe, current_weights(job.recipe, folders)
    if weights is None:
        return [Line(place, recipe, place.label, None, None, place.errors_mm)]
    sha256 = file_sha256(weights)
    main, *twin_variants = variants(recipe)
    entries = {
        variant: row_that_holds(folders.row(recipe, variant), opened, sha256) for variant in (main, *twin_variants)
    }
    entry = entries[main]
    twins = {twin.suffix: row for twin in (PREDICTED, MEAN) if (row := entries.get(twin)) is not None}
    first = None if entry is None else scored_entry(entry)
    several = len(opened.sequence.config(recipe.data_config)) > 1
    if place.table != "multi_frame" or not several:
        return [Line(place, recipe, place.label, first, entry, place.errors_mm, twins)]
    all_frames = all_frames_that_hold(folders.all_frames(recipe), opened.fingerprint, sha256)
    return [
        Line(
            place,
            recipe,
            place.label,
            None if all_frames is None else scored_frames(all_frames),
            entry,
            place.errors_mm,
        ),
        Line(place, recipe, f"{place.label}, its first frame only", first, entry, None, twins),
    ]


def scored_entry(entry: Entry) -> Scored:
    """Scores of a row of the leaderboard."""
    result = entry.result
    return Scored(
        {key: getattr(result.metrics, key) for key in HEADLINE},
        result.intervals.of(MAIN_KEY),
        {row.sample: (row.object, row.object_mae_mm) for row in result.per_sample},
    )


def scored_frames(all_frames: AllFrames) -> Scored:
    """Scores over all frames."""
    return Scored(
        {key: getattr(all_frames.metrics, key) for key in HEADLINE},
        all_frames.intervals.of(MAIN_KEY),
        {row.sample: (row.object, row.metrics.object_mae_mm) for row in all_frames.per_sample},
    )
