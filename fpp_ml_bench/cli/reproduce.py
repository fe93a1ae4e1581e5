"""``fpp-bench reproduce``: the paper's tables and its further directions, trained and scored here."""

import sys
from datetime import datetime
from pathlib import Path

from fpp_ml_bench.baselines import reproduce
from fpp_ml_bench.baselines.training import PRESETS, TABLES, table_rows
from fpp_ml_bench.cli import CHECK_FAILED, OK
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.options import MINUTES, command, command_line
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import reproduced
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry
from fpp_ml_bench.options import argument, did_you_mean, option
from fpp_ml_bench.tables import Table

ALL = "all"
EMPTY_BECAUSE = {
    "cpu": "a training takes 2 to 8 minutes on two cores; cpu-long has these networks, trained to their ends",
    "cpu-long": "a training takes half an hour to two hours on a core",
    "paper": "a training needs a GPU (weeks without), and none was at hand",
}


@command(
    """\
fpp-bench reproduce --list
fpp-bench reproduce normalization                      the small preset: 224 px, for a laptop
fpp-bench reproduce loss/hybrid_l1_0.7 --preset cpu-long      one row, to the paper's stopping rule
fpp-bench reproduce all --only-missing                 every table; up-to-date rows are kept
fpp-bench reproduce loss --preset paper --minutes 10   the paper's own settings, on a GPU, in pieces
"""
)
def reproduce_tables(
    *,
    table: str | None = argument(f"{', '.join(TABLES)} or {ALL}; or one row, like loss/l1", "TABLE", None),
    dataset: Path | None = argument("dataset, built when missing (default: data/cpu224 or data/full)", "DATASET", None),
    preset: str = option(
        "cpu",
        "cpu: 224 px, narrow networks, 8 epochs (default); cpu-long: the same until the rate is at its minimum; paper: "
        "960 px and full width, needs a GPU",
        choices=PRESETS,
    ),
    out: Path = option(Path("runs"), "trainings, predictions and tables go below DIR/PRESET (default: runs)", "DIR"),
    rows: Path | None = option(None, "leaderboard rows (default: OUT/PRESET/rows)", "DIR"),
    only_missing: bool = option(
        False,
        "keep rows that are up to date with the dataset and the weights; without it, all rows are made again. Finished "
        "trainings are always kept",
    ),
    minutes: float | None = option(
        None,
        "stop before an epoch that would exceed M minutes, everything saved (exit status 1); the same command "
        "continues",
        "M",
        parse=MINUTES,
    ),
    anyway: bool = option(False, "train preset paper even without a GPU"),
    listed: bool = option(False, "show rows, recipes and their state, and stop", flag="--list"),
) -> int:
    """Train, predict, time and score the rows of the paper's tables, and show them beside its numbers.

    Does what is missing. Raises FppBenchError where a step can't be done or a training failed."""
    below = out / preset
    folders = reproduce.Folders(preset, below, below / "rows" if rows is None else rows)
    name, slash, row = (table or ALL).partition("/")
    tables = TABLES if name == ALL else (name,)
    if slash and row not in table_rows(name):
        raise RecipeError(f"{name} has no row {printable(row)!r}; {did_you_mean(row, table_rows(name))}")
    if listed:
        _list(tables, folders)
        return OK
    if table is None:
        raise RecipeError(f"expected a table: {', '.join(TABLES)} or {ALL}; --list shows their rows")

    def report(line: str) -> None:  # with the time, where the engine's progress is too
        print(f"{datetime.now():%H:%M:%S} {line}", file=sys.stderr, flush=True)

    again = command_line(without=("only_missing",), more=("--only-missing",))
    options = (dataset, only_missing, minutes, anyway)
    asked = reproduce.ReproduceSettings(tables, folders, again, reproduced, *options, report, row=row)
    outcome = reproduce.reproduce(asked)
    for name, path in zip(tables, outcome.tables, strict=True):
        lines = reproduced.table_lines(name, outcome.jobs, folders, outcome.opened)
        show(reproduced.table_rich(name, lines, preset), reproduced.conclusion(name, lines))
        print(f"Written: {path}")
    if outcome.failed:
        each = "\n".join(f"  {name}: {why}" for name, why in outcome.failed.items())
        raise TrainingError(f"{len(outcome.failed)} of {len(outcome.jobs)} rows could not be made:\n{each}")
    if outcome.stopped is not None:
        print(f"Stopped at {outcome.stopped} after {minutes:g} minutes. Continue with: {again}")
        return CHECK_FAILED
    return OK


def _list(tables: tuple[str, ...], folders: reproduce.Folders) -> None:
    jobs = reproduce.planned(tables, folders.preset)
    titles = "Row", "Training", "State", "Rows written", "Published: object MAE"
    first_out = "Rows written", "Published: object MAE", "Training"
    table = Table(*titles, first_out=first_out, title=f"preset {folders.preset}, {folders.runs}")
    empty = 0
    for job in jobs:
        row_files = [folders.row(job.recipe, depth_range) for depth_range in reproduce.variants(job.recipe)]
        written = f"{sum(path.is_file() for path in row_files)} of {len(row_files)}"
        published = _published(SHIPPED_ROWS / row_files[0].name)
        empty += len(job.rows) if published is None else 0
        state = reproduce.state_of(folders.training(job.recipe))
        table.add_row("\n".join(job.rows), job.recipe.name, state, written, published or "-")
    show(table)
    rows = sum(len(job.rows) for job in jobs)
    print(f"{len(jobs)} trainings fill {rows} rows; {rows - empty} of them come with the package.")
    if empty:
        print(f"The other {empty} are not measured yet: {EMPTY_BECAUSE[folders.preset]}.")


def _published(path: Path) -> str | None:
    """The error of the row that comes with the package, with the version of its benchmark; None where there is none."""
    if not path.is_file():
        return None
    row = read_entry(path).row
    benchmark, error_mm = row.dataset.benchmark, row.metrics.object_mae_mm
    data = "an earlier build" if benchmark is None else f"version {benchmark.version}"
    return f"{'-' if error_mm is None else f'{error_mm:.1f} mm'}, {data}"
