"""``fpp-bench train``: one recipe, one weights file; and ``fpp-bench reproduce``: the paper's
tables and its further directions, trained and scored here."""

import re
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.reproduce.plan import Folders, planned
from fpp_ml_bench.baselines.training.recipe import PRESETS, TABLES, load_recipe, table_rows
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.methods import MethodCommand
from fpp_ml_bench.cli.options import AT_LEAST_ONE, MINUTES, command, command_line, whole
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import REQUIRED, argument, did_you_mean, nearest, option
from fpp_ml_bench.tables import Table


class TrainCommand(MethodCommand):
    """A command whose options are also those of the trainings that methods have."""

    part = "Training"


@command(
    """\
fpp-bench train loss/hybrid_l1_0.7 data/small224 --out runs/mine
fpp-bench train fringe-net --out runs/fringe-net      wrapped phase and mask; it renders its own views
fpp-bench train fringe-net --seed 1 --minutes 60 --out runs/another      in pieces; the same command goes on
fpp-bench train mine.yaml data/full --preset paper --out runs/big --minutes 10     in pieces
accelerate launch -m fpp_ml_bench train mine.yaml data/full --preset paper --out runs/big      several GPUs
fpp-bench predict runs/mine/weights.safetensors data/small224 --out predictions
""",
    TrainCommand,
)
def train(
    *,
    recipe: str = argument(
        "a name like loss/l1 (fpp-bench reproduce --list), a .yaml, or one of the methods below",
        "RECIPE",
    ),
    dataset: Path | None = argument(
        "dataset folder, of the preset's image size (those methods: none)", "DATASET", None
    ),
    out: Path = option(REQUIRED, "new folder, or that of a training to resume", "DIR"),
    preset: str = option(
        PRESETS[0], f"what a shipped recipe is scaled to (default: {PRESETS[0]})", choices=PRESETS
    ),
    minutes: float | None = option(
        None,
        "stop before an epoch that would not finish in time, everything saved",
        "M",
        parse=MINUTES,
    ),
    options: dict[str, Any],
) -> int:
    """Train one recipe, a shipped one or a YAML file of yours, into a weights file that predict
    takes.

    Raises FppBenchError where that can't be done."""
    from fpp_ml_bench.baselines.training.depth_training import train as train_recipe

    methods = registry.methods()
    if recipe in methods or registry.FILE_MARK in recipe:
        method = registry.find(recipe).method
        if method.Training is None:
            learned = ", ".join(name for name, other in methods.items() if other.Training)
            raise RecipeError(
                f"{recipe}: there is nothing to train; methods with a training: {learned}"
            )
        if dataset is not None:
            raise RecipeError(
                f"{dataset}: {recipe} renders what it learns from, and takes none; leave it out"
            )
        import cv2

        cv2.setNumThreads(1)
        finished = method.train(method.Training(**options), out, minutes)
        return OK if finished else CHECK_FAILED
    if not Path(recipe).exists() and nearest(recipe, methods):
        raise RecipeError(f"no recipe {recipe!r}; {did_you_mean(recipe, methods)}")
    if dataset is None:
        raise RecipeError(f"{recipe}: expected a dataset folder to train on, got none")
    from accelerate import PartialState

    resolved = load_recipe(recipe, preset)
    trained = train_recipe(resolved, dataset, out, minutes=minutes)
    if not PartialState().is_main_process:
        return OK if trained.finished else CHECK_FAILED
    if not trained.finished:
        print(
            f"{out}: stopped after {trained.epochs} epochs, everything saved; run the same command "
            f"to resume"
        )
        return CHECK_FAILED
    epochs = f"epoch {trained.best_epoch} of {trained.epochs}"
    print(f"{trained.weights}: {resolved.title}, {epochs}, {trained.seconds:.0f} s")
    print(f"curve: {trained.curve}")
    print(f"next: fpp-bench predict {trained.weights} {dataset} --out predictions")
    return OK


ALL = "all"
PARTS = whole(3, 50)
EMPTY_BECAUSE = {
    "small": "a training takes 7 to 40 minutes on a core",
    "paper": "a training needs a GPU (weeks without), and none was at hand",
}


@command(
    """\
fpp-bench reproduce --list
fpp-bench reproduce normalization                      the small preset: 224 px, for a laptop
fpp-bench reproduce loss/hybrid_l1_0.7 --train         one row, trained here although its weights come with the package
fpp-bench reproduce all --only-missing                 every table; up-to-date rows are kept
fpp-bench reproduce --folds 5                          UNets and ResUNet over all 50 objects, each left out once
fpp-bench reproduce loss --preset paper --minutes 10   the paper's own settings, on a GPU, in pieces
"""
)
def reproduce_tables(
    *,
    table: str | None = argument(
        f"{', '.join(TABLES)} or {ALL}; or one row, like loss/l1", "TABLE", None
    ),
    dataset: Path | None = argument(
        "dataset, built when missing (default: data/small224 or data/full)", "DATASET", None
    ),
    preset: str = option(
        PRESETS[0],
        "small: 224 px, narrow networks, 48 epochs (default); paper: 960 px and full width, needs "
        "a GPU",
        choices=PRESETS,
    ),
    out: Path = option(
        Path("runs"), "trainings, predictions and tables go below DIR/PRESET (default: runs)", "DIR"
    ),
    rows: Path | None = option(None, "leaderboard rows (default: OUT/PRESET/rows)", "DIR"),
    only_missing: bool = option(
        False,
        "keep rows that are up to date with the dataset and the recipe, and train nothing for "
        "them; without it, all "
        "rows are made again. Finished trainings are always kept",
    ),
    from_scratch: bool = option(
        False, "train even where weights come with the package", flag="--train"
    ),
    folds: int | None = option(
        None,
        "cross-validate instead: train each row of TABLE (default: RMSE, hybrid L1 0.7 and "
        "ResUNet) N times, each "
        "without a part of all objects, and score it on that part",
        "N",
        parse=PARTS,
    ),
    workers: int | None = option(
        None,
        "trainings beside each other, one core each (default: all cores; 1 with a GPU)",
        "N",
        parse=AT_LEAST_ONE,
    ),
    minutes: float | None = option(
        None,
        "stop trainings before an epoch that would exceed M minutes, everything saved, and score "
        "what is at its end "
        "(exit status 1); the same command continues",
        "M",
        parse=MINUTES,
    ),
    anyway: bool = option(False, "train preset paper even without a GPU"),
    listed: bool = option(False, "show rows, recipes and their state, and stop", flag="--list"),
) -> int:
    """Train, predict, time and score the rows of the paper's tables, and show them beside its
    numbers.

    Does what is missing. Raises FppBenchError where a step can't be done or a training failed."""
    from fpp_ml_bench.baselines.reproduce.work import ReproduceSettings
    from fpp_ml_bench.baselines.reproduce.work import reproduce as run_reproduce

    below = out / preset
    folders = Folders(preset, below, below / "rows" if rows is None else rows)
    name, slash, row = (table or ALL).partition("/")
    tables = TABLES if name == ALL else (name,)
    if slash and row not in table_rows(name):
        raise RecipeError(
            f"{name} has no row {printable(row)!r}; {did_you_mean(row, table_rows(name))}"
        )
    if listed:
        _list(tables, folders)
        return OK
    if table is None and folds is None:
        raise RecipeError(
            f"expected a table: {', '.join(TABLES)} or {ALL}; --list shows their rows"
        )
    import torch  # which --help and --list do without

    from fpp_ml_bench.leaderboard import reproduced

    def report(line: str) -> None:  # with the time, where the engine's progress is too
        print(f"{datetime.now():%H:%M:%S} {line}", file=sys.stderr, flush=True)

    again = command_line()
    if "--preset" not in again:
        again = re.sub(r"(?= --)|$", f" --preset {preset}", again, count=1)
    if not only_missing:
        again = re.sub(r"--preset[ =]\S+", r"\g<0> --only-missing", again, count=1)
    if workers is None:
        workers = 1 if torch.cuda.is_available() else usable_cores()
    outcome = run_reproduce(
        ReproduceSettings(
            tables,
            folders,
            again,
            reproduced,
            dataset,
            only_missing=only_missing,
            minutes=minutes,
            anyway=anyway,
            report=report,
            row=row,
            from_scratch=from_scratch,
            workers=workers,
            folds=folds,
        )
    )
    for path in outcome.tables:
        lines = reproduced.table_lines(path.stem, outcome.jobs, folders, outcome.opened)
        show(
            reproduced.line_table(path.stem, lines, preset),
            reproduced.conclusion(path.stem, lines),
        )
        print(f"Written: {path}")
    if outcome.failed:
        each = "\n".join(f"  {name}: {why}" for name, why in outcome.failed.items())
        raise TrainingError(
            f"{len(outcome.failed)} of {len(outcome.jobs)} rows could not be made:\n{each}"
        )
    if outcome.stopped is not None:
        print(
            f"Stopped after {minutes:g} minutes; the first that is not at its end: "
            f"{outcome.stopped}."
        )
        print(f"Continue with: {again}")
        return CHECK_FAILED
    return OK


def _list(tables: tuple[str, ...], folders: "Folders") -> None:
    from fpp_ml_bench.baselines.reproduce.work import state_of

    jobs = planned(
        [f"{table}/{row}" for table in tables for row in table_rows(table)], folders.preset
    )
    titles = "Row", "Training", "State", "Row written", "Published: object MAE"
    first_out = "Row written", "Published: object MAE", "Training"
    table = Table(*titles, first_out=first_out, title=f"preset {folders.preset}, {folders.runs}")
    empty = 0
    for job in jobs:
        row_file = folders.row(job.recipe)
        written = "yes" if row_file.is_file() else "no"
        published = _published(SHIPPED_ROWS / row_file.name)
        empty += published is None
        state = state_of(folders.training(job.recipe))
        table.add_row("\n".join(job.rows), job.recipe.name, state, written, published or "-")
    show(table)
    rows = len({row for job in jobs for row in job.rows})
    print(
        f"{len(jobs)} trainings fill {rows} rows; the rows of {len(jobs) - empty} trainings come "
        f"with the package."
    )
    if empty:
        print(f"Those of the other {empty} are not measured yet: {EMPTY_BECAUSE[folders.preset]}.")


def _published(path: Path) -> str | None:
    """The error of the row that comes with the package, with the version of its benchmark; None
    where there is none."""
    if not path.is_file():
        return None
    row = read_entry(path).row
    benchmark, error_mm = row.dataset.benchmark, row.metrics.object_mae_mm
    data = "an earlier build" if benchmark is None else f"version {benchmark.version}"
    return f"{'-' if error_mm is None else f'{error_mm:.1f} mm'}, {data}"
