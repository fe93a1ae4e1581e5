"""``fpp-bench reproduce``: the paper's tables and its further directions, trained and scored here."""

from __future__ import annotations

import argparse
import shlex
import sys
from datetime import datetime
from pathlib import Path

from fpp_ml_bench.baselines import reproduce
from fpp_ml_bench.baselines.training import PRESETS, TABLES
from fpp_ml_bench.errors import RecipeError, TrainingError
from fpp_ml_bench.files import printable

SUMMARY = "Train, predict, time and score the rows of the paper's tables, and show them beside its numbers."
EXAMPLES = (
    "fpp-bench reproduce --list",
    "fpp-bench reproduce normalization                      the small preset: 224 px, for a laptop",
    "fpp-bench reproduce loss/hybrid_l1_0.7 --preset cpu-long      one row, to the paper's stopping rule",
    "fpp-bench reproduce all --only-missing                 every table; up-to-date rows are kept",
    "fpp-bench reproduce loss --preset paper --minutes 10   the paper's own settings, on a GPU, in pieces",
)
ALL = "all"
EMPTY_BECAUSE = {
    "cpu": "a training takes 2 to 8 minutes on two cores; cpu-long has these networks, trained to their ends",
    "cpu-long": "a training takes half an hour to two hours on a core",
    "paper": "a training needs a GPU (weeks without), and none was at hand",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("table", nargs="?", metavar="TABLE", help=f"{', '.join(TABLES)} or {ALL}; or one row, like loss/l1")
    add(
        "--preset",
        choices=PRESETS,
        default="cpu",
        help="cpu: 224 px, narrow networks, 8 epochs (default); cpu-long: the same until the rate is at its minimum; "
        "paper: 960 px and full width, needs a GPU",
    )
    add("--data", type=Path, metavar="DIR", help="dataset, built when missing (default: data/cpu224 or data/full)")
    add(
        "--runs",
        type=Path,
        default=Path("runs"),
        metavar="DIR",
        help="trainings, predictions and tables go below DIR/PRESET (default: runs)",
    )
    add("--rows", type=Path, metavar="DIR", help="leaderboard rows (default: RUNS/PRESET/rows)")
    add(
        "--only-missing",
        action="store_true",
        help="keep rows that are up to date with the dataset and the weights; without it, all rows are made "
        "again. Finished trainings are always kept",
    )
    add(
        "--minutes",
        type=_minutes,
        metavar="M",
        help="stop before an epoch that would exceed M minutes, everything saved (exit status 1); the same command "
        "continues",
    )
    add("--anyway", action="store_true", help="train preset paper even without a GPU")
    add("--list", action="store_true", help="show rows, recipes and their state, and stop")


def _minutes(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected minutes above 0, got {text!r}")
    return value


def run(args: argparse.Namespace) -> int:
    """Do what is missing, print the tables. Raises FppBenchError where a step can't be done or a training failed."""
    from fpp_ml_bench.baselines.training import table_rows
    from fpp_ml_bench.cli import CHECK_FAILED, OK
    from fpp_ml_bench.cli.console import show

    below = args.runs / args.preset
    folders = reproduce.Folders(args.preset, below, below / "rows" if args.rows is None else args.rows)
    table, slash, row = (args.table or ALL).partition("/")
    tables = TABLES if table == ALL else (table,)
    if slash and row not in table_rows(table):
        raise RecipeError(f"{table} has no row {printable(row)!r}; it has {', '.join(table_rows(table))}")
    if args.list:
        _list(tables, folders)
        return OK
    if args.table is None:
        raise RecipeError(f"expected a table: {', '.join(TABLES)} or {ALL}; --list shows their rows")
    from fpp_ml_bench.leaderboard import reproduced

    def report(line: str) -> None:  # with the time, where the engine's progress is too
        print(f"{datetime.now():%H:%M:%S} {line}", file=sys.stderr, flush=True)

    command, options = _command(args), (args.data, args.only_missing, args.minutes, args.anyway)
    settings = reproduce.ReproduceSettings(tables, folders, command, reproduced, *options, report, row=row)
    outcome = reproduce.reproduce(settings)
    for table, path in zip(tables, outcome.tables, strict=True):
        lines = reproduced.table_lines(table, outcome.jobs, folders, outcome.opened)
        show(reproduced.table_rich(table, lines, args.preset), reproduced.conclusion(table, lines))
        print(f"Written: {path}")
    if outcome.failed:
        each = "\n".join(f"  {name}: {why}" for name, why in outcome.failed.items())
        raise TrainingError(f"{len(outcome.failed)} of {len(outcome.jobs)} rows could not be made:\n{each}")
    if outcome.stopped is not None:
        print(f"Stopped at {outcome.stopped} after {args.minutes:g} minutes. Continue with: {command}")
        return CHECK_FAILED
    return OK


def _command(args: argparse.Namespace) -> str:
    """The command that continues where this run stops, keeping its results."""
    words = ["fpp-bench", "reproduce", args.table, "--preset", args.preset]
    for option, value in (("--data", args.data), ("--rows", args.rows)):
        words += [] if value is None else [option, str(value)]
    words += [] if args.runs == Path("runs") else ["--runs", str(args.runs)]
    words += ["--only-missing", *([] if args.minutes is None else ["--minutes", f"{args.minutes:g}"])]
    words += ["--anyway"] if args.anyway else []
    return shlex.join(words)


def _list(tables: tuple[str, ...], folders: reproduce.Folders) -> None:
    from fpp_ml_bench.cli.console import show
    from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS
    from fpp_ml_bench.tables import Table

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
    from fpp_ml_bench.leaderboard.rows import read_entry

    if not path.is_file():
        return None
    row = read_entry(path).row
    benchmark, error_mm = row.dataset.benchmark, row.metrics.object_mae_mm
    data = "an earlier build" if benchmark is None else f"version {benchmark.version}"
    return f"{'-' if error_mm is None else f'{error_mm:.1f} mm'}, {data}"
