"""``fpp-bench leaderboard``: rank result files, and show the paper's rows apart."""

from pathlib import Path

from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.evaluate import scored_data
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import METRICS, OBJECT_KEY, RANK_KEY, sort_keys
from fpp_ml_bench.evaluation.result.file import write_file
from fpp_ml_bench.leaderboard.page.page import predicted_samples, write_page
from fpp_ml_bench.leaderboard.ranking import discover, expand, read_entries, shipped_rows
from fpp_ml_bench.leaderboard.ranking import rank as rank_files
from fpp_ml_bench.leaderboard.row_file import write_row
from fpp_ml_bench.leaderboard.rows import read_entry, vouching_line
from fpp_ml_bench.leaderboard.tables import (
    chosen_tables,
    group_tables,
    paper_rich_tables,
    table_csv,
    table_json,
)
from fpp_ml_bench.leaderboard.tables import markdown as board_markdown
from fpp_ml_bench.options import argument, option

_SORTED = tuple(dict.fromkeys((*METRICS, *sort_keys())))
"""Also those that the ranking refuses, since a method could lead by answering few pixels."""
_TABLES = (
    "normalization",
    "background_removed",
    "multi_frame",
    "loss",
    "architecture",
    "oracle_order",
    "all",
    "none",
)


@command(
    """\
fpp-bench leaderboard result.json second.json
fpp-bench leaderboard results/ --sort object_rmse_mm --markdown table.md
fpp-bench leaderboard --pairs --paper none
fpp-bench leaderboard --csv leaderboard.csv
fpp-bench leaderboard --paper loss
fpp-bench leaderboard --page page
fpp-bench leaderboard result.json --page page --predictions predictions
fpp-bench leaderboard result.json --row leaderboard/rows/mine.json
"""
)
def rank(
    *,
    results: tuple[Path, ...] = argument(
        "result files, or folders of them (default: the rows shipped with the package, "
        "./result*.json and "
        "./results/*.json)",
        "RESULT.json",
        (),
        many=True,
    ),
    sort: str = option(
        RANK_KEY,
        f"what to rank by (default: {RANK_KEY}, and {OBJECT_KEY} by the paper's rules): "
        f"{', '.join(sort_keys())}",
        "KEY",
        choices=_SORTED,
    ),
    markdown: Path | None = option(None, "also write the tables as Markdown", "FILE"),
    json: Path | None = option(
        None,
        "also write the ranking as JSON, with the tests of all pairs; - is standard output",
        "FILE",
    ),
    csv: Path | None = option(None, "also write a line for each row, with all digits", "FILE"),
    pairs: bool = option(
        False, "also print every pair of ranked rows: difference, interval, p value, who is behind"
    ),
    paper: str | None = option(
        None,
        f"tables of the paper and of others: {', '.join(_TABLES)} (default: architecture, "
        f"normalization, oracle_order, "
        "in the terminal only where no results are named)",
        "TABLE",
        choices=_TABLES,
    ),
    out: Path | None = option(
        None,
        "write the static page of the shipped rows, or of those given: index.html and a page for "
        "each submission",
        "DIR",
        flag="--page",
    ),
    predictions: tuple[Path, ...] = option(
        (),
        "with --page: a folder of predictions that a named result was scored from; the row's own "
        "page then shows the "
        "median and the worst sample, and a point cloud; repeatable",
        "FOLDER",
        parse=Path,
        many=True,
    ),
    row_file: Path | None = option(
        None,
        "make a row file for the leaderboard of the given result, and print what a maintainer adds "
        "to "
        "leaderboard/vouched.txt to vouch for it",
        "FILE",
        flag="--row",
    ),
) -> None:
    """Rank result files: error and run time side by side, as a table and a static page.

    Raises SubmissionError naming a file that is not valid."""
    if predictions and out is None:
        raise SubmissionError("--predictions adds pictures to a page; give it with --page DIR")
    if out is not None and sort != RANK_KEY:
        raise SubmissionError(
            f"--page is by {RANK_KEY}, and a click sorts it otherwise; leave out --sort"
        )
    if row_file is not None:
        if len(results) != 1:
            raise SubmissionError(f"--row makes a row of one result, {len(results)} were given")
        row = read_entry(results[0]).row
        data = write_row(row, row_file)
        print(
            f"{row_file}: {len(data):,} bytes, self-reported until a maintainer adds to "
            f"leaderboard/vouched.txt:"
        )
        print(vouching_line(row, data, "measured", "THE COMMAND THAT MAKES IT AGAIN"))
        return
    # A page holds the shipped rows or the named files, never results that happen to be in the
    # current folder.
    unnamed = discover(Path.cwd()) if out is None else shipped_rows()
    entries = read_entries(expand(results) if results else unnamed)
    groups, papers = rank_files(entries, sort), chosen_tables(paper)
    for path, text in ((markdown, board_markdown), (json, table_json)):
        if path is not None:
            write_file(text(groups, papers).encode("utf-8"), path)
    if csv is not None:
        write_file(table_csv(groups).encode("utf-8"), csv)
    if out is not None:
        sources = [(folder, scored_data(folder, None, None)[0]) for folder in predictions]
        written = write_page(groups, papers, out, predicted_samples(entries, sources))
        print(f"{out}: {len(written)} files; open {written[0]}")
        return
    not_shown = len(papers) if results and paper is None else 0
    tables = group_tables(groups, pairs)
    show(*tables, *paper_rich_tables(papers[not_shown:]))
    if not_shown:
        print(
            f"Not shown: {not_shown} tables that others reported on other data (--paper all), and "
            f"the "
            f"leaderboard's own {len(shipped_rows())} rows (fpp-bench leaderboard without a file)."
        )
