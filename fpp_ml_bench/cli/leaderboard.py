"""``fpp-bench leaderboard``: rank result files, and show the paper's rows apart."""

import sys
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench import leaderboard
from fpp_ml_bench.baselines import tradeoff
from fpp_ml_bench.cli import CHECK_FAILED
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import result
from fpp_ml_bench.evaluation.protocol import METRICS
from fpp_ml_bench.leaderboard import page
from fpp_ml_bench.options import argument, option

_TABLES = ("normalization", "background_removed", "multi_frame", "loss", "architecture", "oracle_order", "all", "none")


@dataclass(frozen=True, kw_only=True)
class LeaderboardSettings:
    """Settings of `rank`."""

    results: tuple[Path, ...] = argument(
        "result files, or folders of them (default: the rows shipped with the package, ./result*.json and "
        "./results/*.json)",
        "RESULT.json",
        (),
        many=True,
    )
    sort: str = option(
        "object_mae_mm",
        f"what to rank by (default: object_mae_mm): seconds_per_sample, frames_used, {', '.join(METRICS)}",
        "KEY",
        choices=(*METRICS, "seconds_per_sample", "frames_used"),
    )
    markdown: Path | None = option(None, "also write the tables as Markdown", "FILE")
    json: Path | None = option(
        None, "also write the ranking as JSON, with the tests of all pairs; - is standard output", "FILE"
    )
    csv: Path | None = option(None, "also write a line for each row, with all digits", "FILE")
    pairs: bool = option(False, "also print every pair of ranked rows: difference, interval, p value, who is behind")
    paper: str | None = option(
        None,
        f"tables of the paper and of others: {', '.join(_TABLES)} (default: architecture, normalization, oracle_order, "
        "in the terminal only where no results are named)",
        "TABLE",
        choices=_TABLES,
    )
    page: Path | None = option(
        None,
        "write the static page of the shipped rows, or of those given: index.html and a page for each submission",
        "DIR",
    )
    tradeoff: Path | None = option(
        None,
        "with --page: the tradeoff.json to show on it (default, for the shipped rows: the file that ships)",
        "FILE",
    )
    readme: Path | None = option(
        None,
        "write the ranking between the leaderboard markers of this file, from the rows shipped with the package",
        "FILE",
    )
    check: bool = option(False, "with --readme: write nothing; exit status 1 when the block is not up to date")
    row: Path | None = option(
        None,
        "make a row file for the leaderboard of the given result, and print what a maintainer adds to "
        "leaderboard/vouched.txt to vouch for it",
        "FILE",
    )


@command(
    """\
fpp-bench leaderboard result.json second.json
fpp-bench leaderboard results/ --sort object_rmse_mm --markdown table.md
fpp-bench leaderboard --pairs --paper none
fpp-bench leaderboard --csv leaderboard.csv
fpp-bench leaderboard --paper loss
fpp-bench leaderboard --page page
fpp-bench leaderboard --readme README.md --check
fpp-bench leaderboard result.json --row leaderboard/rows/mine.json
"""
)
def rank(settings: LeaderboardSettings) -> int | None:
    """Rank result files: error and run time side by side, as a table, a static page and a block for README.

    Raises SubmissionError naming a file that is not valid."""
    named, out, sort = settings.results, settings.page, settings.sort
    if settings.check and settings.readme is None:
        raise SubmissionError("--check checks a README; give it with --readme FILE")
    if settings.tradeoff is not None and out is None:
        raise SubmissionError("--tradeoff adds settings to a page; give it with --page DIR")
    if out is not None and sort != "object_mae_mm":
        raise SubmissionError("--page is by object_mae_mm, and a click sorts it otherwise; leave out --sort")
    if settings.row is not None and settings.readme is None:
        if len(named) != 1:
            raise SubmissionError(f"--row makes a row of one result, {len(named)} were given")
        row = leaderboard.read_entry(named[0]).row
        data = leaderboard.write_row(row, settings.row)
        print(f"{settings.row}: {len(data):,} bytes, self-reported until a maintainer adds to leaderboard/vouched.txt:")
        print(leaderboard.vouching_line(row, data, "measured", "THE COMMAND THAT MAKES IT AGAIN"))
        return None
    # Page and README hold the shipped rows or the named files, never results that happen to be in the current folder.
    published = out is not None or settings.readme is not None
    unnamed = leaderboard.shipped_rows() if published else leaderboard.discover(Path.cwd())
    entries = leaderboard.read_entries(leaderboard.expand(named) if named else unnamed)
    if settings.readme is not None:
        same = leaderboard.update_readme(settings.readme, leaderboard.rank(entries), settings.check)
        if settings.check and not same:
            print(
                f"{settings.readme}: the ranking is not up to date with the rows; don't edit it by hand, run: "
                f"fpp-bench leaderboard --readme {settings.readme}",
                file=sys.stderr,
            )
            return CHECK_FAILED
        print(f"{settings.readme}: {'the ranking is up to date with the rows' if same else 'written'}")
        return None
    groups, papers = leaderboard.rank(entries, sort), leaderboard.chosen_tables(settings.paper)
    for path, text in ((settings.markdown, leaderboard.markdown), (settings.json, leaderboard.table_json)):
        if path is not None:
            result.write_file(text(groups, papers, sort).encode("utf-8"), path)
    if settings.csv is not None:
        result.write_file(leaderboard.table_csv(groups).encode("utf-8"), settings.csv)
    if out is not None:
        shipped = None if named else tradeoff.shipped_tradeoff()
        measured = shipped if settings.tradeoff is None else tradeoff.read_tradeoff(settings.tradeoff)
        written = page.write_page(groups, papers, out, measured)
        print(f"{out}: {len(written)} files; open {written[0]}")
        return None
    not_shown = len(papers) if named and settings.paper is None else 0
    tables = leaderboard.group_tables(groups, sort, settings.pairs)
    show(*tables, *leaderboard.paper_rich_tables(papers[not_shown:]))
    if not_shown:
        print(
            f"Not shown: {not_shown} tables that others reported on other data (--paper all), and the "
            f"leaderboard's own {len(leaderboard.shipped_rows())} rows (fpp-bench leaderboard without a file)."
        )
    return None
