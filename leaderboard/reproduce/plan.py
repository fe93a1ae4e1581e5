"""The work for a table of the paper: which trainings fill which of its rows, and the paths of their files.

Rows that resolve to one recipe (``normalization/individual``, ``loss/rmse`` and ``multi_frame/frame0``) are a single
training and a single row of the leaderboard.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from fpp_ml_bench.baselines.training import Recipe, load_recipe, table_rows
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.leaderboard.paper import paper_tables

RUNS = Path("runs")
_NOT_IN_THE_PAPER = {"hformer": "Hformer"}


@dataclass(frozen=True)
class Place:
    """A row of a table; ``errors_mm``: the paper's errors by the keys of `HEADLINE`, None where it reports none."""

    table: str
    row: str
    label: str
    errors_mm: dict[str, float] | None = field(hash=False)
    pairs: int | None

    @property
    def recipe_name(self) -> str:
        return f"{self.table}/{self.row}"


@dataclass(frozen=True)
class Job:
    """A training, and the ``places`` in the tables that its scores fill."""

    recipe: Recipe
    places: tuple[Place, ...]

    @property
    def all_frames(self) -> bool:
        """Whether the paper scores this training on more frames than the first (Section 5.4)."""
        return any(place.table == "multi_frame" for place in self.places)


@dataclass(frozen=True)
class Variant:
    """A way to use a trained network: the end of its row file's name, and the depth range that turns its output into mm
    (see `fpp_ml_bench.baselines.networks.network_method.NetworkMethod`)."""

    suffix: str
    depth_range: Literal["oracle", "predicted", "mean"] | None


METRIC, ORACLE = Variant("", None), Variant("", "oracle")
PREDICTED, MEAN = Variant("-range-predicted", "predicted"), Variant("-range-mean", "mean")


def variants(recipe: Recipe) -> tuple[Variant, ...]:
    """The rows that a training gives. Individual normalisation is told the test sample's range, as in the paper; its
    metric twins are not. With the background removed the object's mask is given anyway, and there are no twins."""
    if recipe.normalisation != "individual":
        return (METRIC,)
    return (ORACLE,) if recipe.background_removed else (ORACLE, PREDICTED, MEAN)


@dataclass(frozen=True)
class Folders:
    """Paths below ``runs`` (``runs/<preset>``); ``rows`` takes the row files."""

    preset: str
    runs: Path
    rows: Path

    @property
    def dataset_record(self) -> Path:
        """File that records the dataset of all trainings and scores in this folder."""
        return self.runs / "dataset.json"

    def training(self, recipe: Recipe) -> Path:
        return self.runs / recipe.name

    def weights(self, recipe: Recipe) -> Path:
        """Best weights, with range heads where the normalisation needs them: the file to ship."""
        return self.runs / "weights" / f"{recipe.name}.safetensors"

    def row_name(self, recipe: Recipe, variant: Variant) -> str:
        return f"{self.preset}-{recipe.name}{variant.suffix}"

    def row(self, recipe: Recipe, variant: Variant) -> Path:
        return self.rows / f"{self.row_name(recipe, variant)}.json"

    def all_frames(self, recipe: Recipe) -> Path:
        # Not in the folder of the rows: there every .json is a row.
        return self.runs / "all-frames" / f"{self.preset}-{recipe.name}-all-frames.json"

    def result(self, name: str) -> Path:
        return self.runs / "results" / f"{name}.json"

    def predictions(self, name: str) -> Path:
        return self.runs / "predictions" / name

    def table(self, table: str) -> Path:
        return self.runs / f"{table}.md"


def places(table: str) -> tuple[Place, ...]:
    """Rows of a table in the recipes' order, each with the paper's numbers. RecipeError for an unknown table."""
    reported = {row.row: row for row in paper_tables()[table].rows} if table in paper_tables() else {}
    rows = []
    for name in table_rows(table):
        row = reported.get(name)
        rows.append(
            Place(table, name, _NOT_IN_THE_PAPER.get(name, name), None, None)
            if row is None
            else Place(table, name, row.label, row.errors_mm, row.test_samples)
        )
    return tuple(rows)


def planned(tables: Sequence[str], preset: str) -> list[Job]:
    """The trainings of ``tables``, each once, in the order of their first row.

    Raises RecipeError for an unknown table, an unsound recipe, or two recipes that differ under one name.
    """
    jobs: dict[str, Job] = {}
    for place in (place for table in tables for place in places(table)):
        recipe = load_recipe(place.recipe_name, preset)
        job = jobs.get(recipe.name)
        if job is not None and job.recipe.digest != recipe.digest:
            raise RecipeError(
                f"{job.places[0].recipe_name} and {place.recipe_name} differ in {differing(job.recipe, recipe)}, "
                f"but both are called {recipe.name}; give one of them a different name"
            )
        jobs[recipe.name] = Job(recipe, (*(job.places if job else ()), place))
    return list(jobs.values())


def differing(first: Recipe, second: Recipe) -> str:
    """The settings in which two recipes differ, with both values."""
    a, b = first.to_dict(), second.to_dict()
    keys = [key for key in {**a, **b} if a.get(key) != b.get(key)]
    return ", ".join(f"{key} ({a.get(key)} and {b.get(key)})" for key in keys)


def common_size(jobs: Iterable[Job]) -> int:
    """Image width and height in px that all ``jobs`` train on. RecipeError where they differ."""
    sizes = {job.recipe.size: job.recipe.name for job in jobs}
    if len(sizes) != 1:
        raise RecipeError(f"expected one image size for all rows, got {sizes}; reproduce the tables one by one")
    return next(iter(sizes))
