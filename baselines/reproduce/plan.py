"""The work for a table of the paper: which trainings fill which of its rows, the paths of their
files, and the dataset, which is built where it is missing and is the same for every row of a run.
Rows that resolve to one recipe (``normalization/individual``, ``loss/rmse``,
``multi_frame/frame0``) are one training and one row of the leaderboard. Some rows are trained with
several seeds. Under cross-validation a row is trained once for each part of the objects.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.training.recipe import SEED, Recipe, further_seeds, load_recipe
from fpp_ml_bench.constants import FULL_SIZE, OBJECTS
from fpp_ml_bench.errors import DatasetError, RecipeError
from fpp_ml_bench.loaders.render.builder import build as build_dataset
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.manifest import MANIFEST
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.named_rigs import paper_rig

Report = Callable[[str], object]
RUNS = Path("runs")
FOLDS = "folds"
"""The table of a cross-validation."""
FOLD_ROWS = ("loss/rmse", "loss/hybrid_l1_0.7", "architecture/resunet")
"""What is cross-validated where no row is named."""


@dataclass(frozen=True)
class Job:
    """A training, and the ``rows`` of the tables that its scores fill, by name (``loss/rmse``)."""

    recipe: Recipe
    rows: tuple[str, ...]

    @property
    def has_scores(self) -> bool:
        """Whether it has `Scores` beside its rows: of a cross-validation, or of every frame that it
        learned from, as in the paper (Section 5.4)."""
        return self.recipe.fold is not None or any(
            row.startswith("multi_frame/") for row in self.rows
        )


@dataclass(frozen=True)
class Folders:
    """Paths below ``runs`` (``runs/<preset>``); ``rows`` takes the row files."""

    preset: str
    runs: Path
    rows: Path

    def training(self, recipe: Recipe) -> Path:
        return self.runs / recipe.name

    def row(self, recipe: Recipe) -> Path:
        return self.rows / f"{self.preset}-{recipe.name}.json"

    def scores(self, recipe: Recipe) -> Path:
        # Not in the folder of the rows: there every .json is a row.
        return self.rows.with_name("scores") / f"{self.preset}-{recipe.name}.json"

    def table(self, table: str) -> Path:
        return self.runs / f"{table}.md"


def planned(names: Sequence[str], preset: str, folds: int | None = None) -> list[Job]:
    """The trainings of the rows ``names``, each once: UNets first, and further seeds last.
    ``folds``: of a cross-validation with so many parts. Raises RecipeError for an unknown row, an
    unsound recipe, or two recipes that differ under one name."""
    jobs: dict[str, Job] = {}
    for name in names:
        recipe = load_recipe(name, preset)
        changes: list[dict[str, Any]] = [{}, *({"seed": seed} for seed in further_seeds(recipe))]
        if folds is not None:
            changes = [{"fold": (part, folds)} for part in range(folds)]
        for change in changes:
            changed = recipe.model_copy(update=change)
            job = jobs.get(changed.name, Job(changed, ()))
            if job.recipe.digest != changed.digest:
                raise RecipeError(
                    f"{job.rows[0]} and {name} differ in "
                    f"{differing(job.recipe.to_dict(), changed.to_dict())}, "
                    f"but both are called {changed.name}; give one of them a different name"
                )
            jobs[changed.name] = Job(changed, (*job.rows, name))
    return sorted(
        jobs.values(), key=lambda job: (job.recipe.seed != SEED, job.recipe.network != "unet")
    )


def differing(first: dict, second: dict, words: str = "{} and {}") -> str:
    """The settings in which two recipes differ, with both values."""
    keys = [key for key in {**first, **second} if first.get(key) != second.get(key)]
    return ", ".join(f"{key} ({words.format(first.get(key), second.get(key))})" for key in keys)


def default_folder(preset: str, size: int) -> Path:
    """``data/full`` for the benchmark's own size, else named after preset and size, like
    ``data/small224``."""
    return Path("data") / ("full" if size == FULL_SIZE else f"{preset}{size}")


def open_dataset(
    folder: Path | None, jobs: list[Job], folders: Folders, report: Report
) -> DatasetFolder:
    """The dataset in ``folder`` (default: see `default_folder`), built there first where there is
    none: all 50 objects and 52 frames, which every table shares. Raises DatasetError for a dataset
    of another image size than the preset's, or without a frame that a row needs; BuildError where
    it can't be built."""
    sizes = {job.recipe.size: job.recipe.name for job in jobs}
    if len(sizes) != 1:
        raise RecipeError(
            f"expected one image size for all rows, got {sizes}; reproduce the tables one by one"
        )
    (size,) = sizes
    folder = default_folder(folders.preset, size) if folder is None else folder
    if not (folder / MANIFEST).is_file():
        report(f"{folder}: building {len(OBJECTS)} objects at {size} px, all frames")
        build_dataset(folder, BuildSettings(rig=paper_rig(size), objects=OBJECTS), usable_cores())
    opened = DatasetFolder(folder)
    command = (
        f"fpp-bench build --out DIR --preset full{'' if size == FULL_SIZE else f' --size {size}'}"
    )
    if opened.size != (size, size):
        height, width = opened.size
        raise DatasetError(
            f"{folder}: expected images of {size} x {size} px, which preset {folders.preset} "
            f"trains on, got {width} x "
            f"{height}; give another --data, or none to have it built, or build it: {command}"
        )
    for job in jobs:
        if job.recipe.frames not in opened.configs:
            raise DatasetError(
                f"{folder}: {job.rows[0]} needs the frames of {job.recipe.frames}, stored are "
                f"those of "
                f"{', '.join(opened.configs)}; build it with all frames: {command}"
            )
    return opened
