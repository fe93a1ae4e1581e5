"""``--explain`` and ``--no-skip`` of build, predict and fpp-eval: which work was left out, as a table and as JSON."""

import argparse
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.skipping import Explanation, skipping, skipping_enabled


def add_explain_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--explain``, ``--explain-json`` and ``--no-skip``."""
    add = parser.add_argument_group("skipped work").add_argument
    add("--explain", action="store_true", help="print which work was left out and what that saved (takes a moment)")
    add("--explain-json", type=Path, metavar="FILE", help="write the same as JSON into FILE; implies --explain")
    add("--no-skip", action="store_true", help="leave no work out: slower, the results are the same bit by bit")


@contextmanager
def as_asked(args: argparse.Namespace) -> Iterator[None]:
    """Switch skipping as the arguments say; raises, before any work, for a JSON file that can't be written."""
    path = args.explain_json
    if path is not None and (path.is_dir() or not path.absolute().parent.is_dir()):
        raise FppBenchError(f"--explain-json {path}: expected a file in an existing folder; create the folder first")
    with skipping(skipping_enabled() and not args.no_skip):
        yield


def explain(args: argparse.Namespace, account: Callable[[], Explanation]) -> None:
    """Print the account as a table with the rules for the seconds below, and write it as JSON, as the arguments say."""
    if not (args.explain or args.explain_json):
        return
    explanation = account()
    from rich.text import Text

    from fpp_ml_bench.cli.console import gigabytes, show
    from fpp_ml_bench.tables import Table

    state = "left out" if explanation.skipping else "nothing left out (skipping is off); it would have been"
    rules = list(dict.fromkeys(line.rule for line in explanation.lines))
    table = Table(
        "what",
        "unit",
        numbers=("done", "left out", "share", "bytes", "seconds"),
        title=Text(f"{explanation.command}: {state} ({explanation.subject})"),
        elsewhere="--explain-json FILE",
        caption=Text("\n".join(f"[{number}] {rule}" for number, rule in enumerate(rules, 1))),
    )
    for line in explanation.lines:
        saved = line.seconds_saved
        seconds = "-" if saved is None else f"{saved:,.2g}" if abs(saved) < 10 else f"{saved:,.0f}"
        table.add_row(
            Text(line.what),
            line.unit,
            f"{line.done:,}",
            f"{line.left_out:,}",
            f"{100 * line.share:.1f}%",
            "-" if line.bytes_saved is None else gigabytes(line.bytes_saved),
            Text(f"{seconds} [{rules.index(line.rule) + 1}]"),
        )
    show(table)
    if args.explain_json is not None:
        text = json.dumps(explanation.to_dict(), indent=1, allow_nan=False)
        write_atomically(args.explain_json, (text + "\n").encode("utf-8"))
        print(f"Written: {args.explain_json}")
