"""``--explain`` and ``--no-skip`` of build, predict and fpp-eval: which work was left out, as a table and as JSON."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.skipping import skipping, skipping_enabled

if TYPE_CHECKING:
    from rich.table import Table

    from fpp_ml_bench.skipping import Explanation


def add_explain_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--explain``, ``--explain-json`` and ``--no-skip``."""
    group = parser.add_argument_group("skipped work")
    group.add_argument(
        "--explain", action="store_true", help="print which work was left out and what that saved (takes a moment)"
    )
    group.add_argument(
        "--explain-json", type=Path, metavar="FILE", help="write the same as JSON into FILE; implies --explain"
    )
    group.add_argument(
        "--no-skip", action="store_true", help="leave no work out: slower, the results are the same bit by bit"
    )


@contextmanager
def as_asked(args: argparse.Namespace) -> Iterator[None]:
    """Switch skipping as the arguments say; raises, before any work, for a JSON file that can't be written."""
    path = args.explain_json
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise FppBenchError(f"--explain-json {path}: expected a file in an existing folder; create the folder first")
    with skipping(skipping_enabled() and not args.no_skip):
        yield


def explain(args: argparse.Namespace, account: "Callable[[], Explanation]") -> None:
    """Print the account, and write it as JSON, as the arguments say."""
    if not (args.explain or args.explain_json):
        return
    explanation = account()
    from rich.console import Console

    Console().print(explanation_table(explanation))
    if args.explain_json is not None:
        import json

        from fpp_ml_bench.files import write_atomically

        text = json.dumps(explanation.to_dict(), indent=1, allow_nan=False)
        write_atomically(args.explain_json, (text + "\n").encode("utf-8"))
        print(f"Written: {args.explain_json}")


def explanation_table(explanation: "Explanation") -> "Table":
    """The account as a table, with the rules for the seconds below."""
    from rich.table import Table
    from rich.text import Text

    from fpp_ml_bench.cli.console import gigabytes

    state = "left out" if explanation.skipping else "nothing left out (skipping is off); it would have been"
    rules = list(dict.fromkeys(line.rule for line in explanation.lines))
    notes = "\n".join(f"[{number}] {rule}" for number, rule in enumerate(rules, 1))
    table = Table(title=Text(f"{explanation.command}: {state} ({explanation.subject})"), title_justify="left",
                  caption=Text(notes), caption_justify="left")  # fmt: skip
    for name in ("what", "unit"):
        table.add_column(name)
    for name in ("done", "left out", "share", "bytes", "seconds"):
        table.add_column(name, justify="right")
    for line in explanation.lines:
        seconds = (
            "-"
            if line.seconds_saved is None
            else f"{line.seconds_saved:,.2g}"
            if abs(line.seconds_saved) < 10
            else f"{line.seconds_saved:,.0f}"
        )
        table.add_row(
            Text(line.what), line.unit, f"{line.done:,}", f"{line.left_out:,}", f"{100 * line.share:.1f}%",
            "-" if line.bytes_saved is None else gigabytes(line.bytes_saved),
            Text(f"{seconds} [{rules.index(line.rule) + 1}]"),
        )  # fmt: skip
    return table
