"""The tables and curves of FPP-C in docs/robustness.md, made of whole result files.

    fpp-bench robustness phase --out robustness --into results/phase.json
    python benchmarks/robustness_tables.py results

Every result that holds a block of ``test`` or ``unseen`` (`Robustness` in result.json) is shown, the least error first.
The leaderboard's rows hold it in brief, without the severities. Between the markers ``<!-- SET:begin -->`` and
``<!-- SET:end -->`` of the page nothing is kept; the pictures are written beside it.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from fpp_ml_bench.baselines.robustness import CLEAN, SETS, Measured, SetName, corruptions, draw_curves
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.report import percent
from fpp_ml_bench.evaluation.result import Result, Robustness, read_result
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.names import short_names
from fpp_ml_bench.leaderboard.ranking import expand
from fpp_ml_bench.leaderboard.tables import markdown_rows, markdown_text

PAGE = Path(__file__).resolve().parent.parent / "docs" / "robustness.md"
PICTURES = {"test": "pictures/robustness_curves.png", "unseen": "pictures/robustness_curves_unseen.png"}
ALT = {
    "test": "Error against severity for each axis, a line for each method",
    "unseen": "Error against severity for each axis on the unseen set",
}
SCORES = ("wrong_share", "unanswered_share", "confident_share", "coverage")
TITLES = (
    "method",
    "mean, mm",
    "95% interval",
    "clean, mm",
    "ratio",
    "wrong orders",
    "unanswered",
    "confident errors",
    "coverage",
)
Row = tuple[str, Robustness]


def rows_in(results: Iterable[Result]) -> dict[SetName, list[Row]]:
    """Names and blocks of each set, the least error first."""
    results = list(results)
    return {name: _of_set(name, results) for name in SETS}


def _of_set(name: SetName, results: Sequence[Result]) -> list[Row]:
    blocks = [(result, block) for result in results if (block := (result.robustness or {}).get(name))]
    names = short_names([result.submission for result, _ in blocks])
    found = [
        (f"{short}, {block.size_px} px" if block.size_px != FULL_SIZE else short, block)
        for short, (_, block) in zip(names, blocks, strict=True)
    ]
    return sorted(found, key=lambda row: (row[1].mae_mm, row[0]))


def tables(rows: Sequence[Row]) -> Iterable[str]:
    """The lines of both tables: means over all axes, then each axis by itself."""
    overall, by_axis = [], []
    axes = [axis for axis in corruptions().axes if any(axis in block.axes for _, block in rows)]
    for name, block in rows:
        low, high = block.interval
        interval = "-" if low is None or high is None else f"{low:.1f} to {high:.1f}"
        ratio = "-" if block.ratio is None else f"{block.ratio:.1f}"
        numbers = [f"{block.mae_mm:.1f}", interval, f"{block.clean.mae_mm:.1f}", ratio]
        overall.append([markdown_text(name), *numbers, *(percent(block.mean(key)) for key in SCORES)])
        means = []
        for axis in axes:
            errors = [scores.mae_mm for scores in block.axes.get(axis, [])]
            means.append(f"{sum(errors) / len(errors):.1f}, {errors[-1]:.1f}" if errors else "")
        by_axis.append([markdown_text(name), *means])
    yield from markdown_rows(TITLES, [False] + [True] * (len(TITLES) - 1), overall)
    yield from ("", "By axis, mean over the five severities and the last one, mm:", "")
    yield from markdown_rows(("method", *axes), [False] + [True] * len(axes), by_axis)


def curves(name: SetName, rows: Sequence[Row]) -> bytes:
    """The rows' curves as the page of ``fpp-bench robustness`` draws them; PNG."""
    measured = []
    for title, block in rows:
        means = {axis: dict(enumerate((s.model_dump() for s in found), 1)) for axis, found in block.axes.items()}
        setup = {"title": title, "set": name, "quick": False}
        measured.append(Measured(Path(), setup, {CLEAN: {0: block.clean.model_dump()}, **means}))
    return draw_curves(measured)


def filled(text: str, rows: Mapping[SetName, Sequence[Row]]) -> str:
    """``text`` with the tables and pictures of each set between its markers. ValueError without them."""
    for name, of_set in rows.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        before, opened, rest = text.partition(begin)
        _, closed, after = rest.partition(end)
        if not opened or not closed:
            raise ValueError(f"expected the markers {begin} and {end}; put them where the tables belong")
        picture = f"![{ALT[name]}]({PICTURES[name]})"
        text = before + "\n".join([begin, "", *tables(of_set), "", picture, "", end]) + after
    return text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("results", type=Path, nargs="+", help="result files, or folders of them")
    parser.add_argument("--page", type=Path, default=PAGE, help="Markdown with the markers")
    args = parser.parse_args()
    try:
        rows = rows_in(map(read_result, expand(args.results)))
        text = filled(args.page.read_text(encoding="utf-8"), rows)
    except (FppBenchError, OSError, ValueError) as error:
        print(f"{args.page}: {error}", file=sys.stderr)
        return 2
    write_atomically(args.page, text.encode("utf-8"))
    for name in SETS:
        write_atomically(args.page.parent / PICTURES[name], curves(name, rows[name]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
