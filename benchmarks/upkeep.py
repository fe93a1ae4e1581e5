"""Upkeep of what the repository shows of the leaderboard: its rows, the list of those that are
vouched for, README's table and the tables of docs/results/robustness.md. Every step is a command of
the package, printed before it runs.

    python benchmarks/upkeep.py rows data/full --work rows-work          every row of that dataset
    python benchmarks/upkeep.py measured leaderboard/rows/phase-horizontal.json reliance phase data/full
    python benchmarks/upkeep.py readme [--check]
    python benchmarks/upkeep.py robustness results
    python benchmarks/upkeep.py commands [--check]

rows: predict, time, score on the test split, and write a row file and its line in
``leaderboard/vouched.txt`` for each method. At 960 px rows are scored against the exact depth,
which is the same whatever is projected, and at 224 px against ``depth``, as the paper's networks
are. A dataset without a training split is the set of unseen objects; its rows are called
``NAME-unseen.json``, and ``--suffix=-hard`` names those of another light. One with crossed fringes
has the methods for them. The same data gives the same scores; times depend on the machine. Phase
reliance and robustness, which other commands measured, stay in the row of a method that has not
changed.

measured: run ``fpp-bench reliance`` or ``fpp-bench robustness`` with ``--into ROW``, and keep the
row vouched for.

readme: write the block between README's markers from the rows; with ``--check`` only say whether it
is up to date.

robustness: the tables and curves of every whole result that holds a block of ``test`` or ``unseen``
(`Robustness`), the least error first. The leaderboard's rows hold it in brief, without the
severities. The tables go between the markers ``<!-- SET:begin -->`` and ``<!-- SET:end -->`` of the
page, and the curves of ``test`` beside it.

commands: write docs/commands.md from the commands themselves; with ``--check`` only say whether it
is up to date.
"""

import argparse
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.robustness.axes import CLEAN, SETS, SetName, corruptions
from fpp_ml_bench.baselines.robustness.run import Measured, draw_curves
from fpp_ml_bench.cli import BENCH, EVAL, Program
from fpp_ml_bench.cli import main as fpp_bench
from fpp_ml_bench.cli import main_eval as fpp_eval
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import FppBenchError, SubmissionError
from fpp_ml_bench.evaluation.metrics import OBJECT_KEY
from fpp_ml_bench.evaluation.protocol import FRAMES_CLASSES, FramesClass
from fpp_ml_bench.evaluation.result.file import read_result
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import Robustness
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard import columns
from fpp_ml_bench.leaderboard.columns import NOT_CHECKED, Column, assumption, device, error
from fpp_ml_bench.leaderboard.page.page import of_one_target
from fpp_ml_bench.leaderboard.ranking import (
    Group,
    Ranked,
    expand,
    is_trivial,
    rank,
    read_entries,
    shipped_rows,
    short_names,
)
from fpp_ml_bench.leaderboard.row_file import row_json, write_row
from fpp_ml_bench.leaderboard.rows import SELF_REPORTED, VOUCHED, Entry, read_entry, vouching_line
from fpp_ml_bench.leaderboard.tables import ranking_table
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import PAPER_PITCH_PX
from fpp_ml_bench.style import millimetres, percent
from fpp_ml_bench.tables import Table, markdown_text

ROOT = Path(__file__).resolve().parent.parent
ROWS, README, ROBUSTNESS = (
    ROOT / "leaderboard" / "rows",
    ROOT / "README.md",
    ROOT / "docs/results/robustness.md",
)
COMMANDS = ROOT / "docs" / "commands.md"
REFUSED, OUTDATED = 2, 1

METHODS = {
    "classical-18-both": "classical --steps 18 --direction both",
    "classical-18-vertical": "classical --steps 18 --direction vertical",
    "classical-18-horizontal": "classical --steps 18 --direction horizontal",
    "classical-09-both": "classical --steps 9 --direction both",
    "classical-09-vertical": "classical --steps 9 --direction vertical",
    "classical-06-vertical": "classical --steps 6 --direction vertical",
    # 18 is not divisible by 4, so these phases are not evenly spaced.
    "classical-04-vertical": "classical --steps 4 --direction vertical",
    "classical-03-vertical": "classical --steps 3 --direction vertical",
    "classical-03-both-fewest": "classical --steps 3 --direction both --fewest",
    "phase-horizontal": "phase --direction horizontal",
    "phase-vertical": "phase --direction vertical",
    "phase-02-horizontal": "phase --frames 2 --direction horizontal",
    "phase-03-horizontal": "phase --frames 3 --direction horizontal",
    "phase-03-vertical": "phase --frames 3 --direction vertical",
    "fringe-net-horizontal": "fringe-net --fringes horizontal",
    "fringe-net-vertical": "fringe-net --fringes vertical",
    "constant-standoff": "constant --at standoff",
    "constant-training-mean": "constant --at training-mean",
    "constant-range-middle": "constant --at range-middle",
    "constant-range-training": "constant --at range-training",
    "nearest": "nearest",
}
"""File name of a row: method and options. The trivial methods that are given the range are scored
by the rules of the paper's networks. The middle of the working range is the standoff, so it is no
row of its own."""
CROSSED = {
    "crossed": "crossed",
    "crossed-03": "crossed --frames 3",
    "fringe-net-crossed": "fringe-net --fringes crossed",
    "fringe-net-crossed-even": "fringe-net --fringes crossed --even-odds",
}
"""The same for datasets with crossed fringes. The trivial methods see no code, so theirs would be
the same rows."""
COARSE = {
    "phase-horizontal-36px": "phase --direction horizontal",
    "fringe-net-horizontal-36px": "fringe-net --fringes horizontal",
}
"""The same for ``--pitch 36 --config single_shot``: the finest single fringe with one period in the
working range, as ``fpp-bench patterns paper --design`` names it."""
BY_NAME = {"crossed-audit": "crossed --audit"}
"""Made only where ``--only`` names it: a benchmark's calibration is right."""
NAMED = METHODS | CROSSED | COARSE | BY_NAME


def run(command: str, *words: object) -> None:
    """Run a command; exit where it fails."""
    arguments = [str(word) for word in words]
    print("$", command, shlex.join(arguments), flush=True)
    status = (fpp_eval if command == "fpp-eval" else fpp_bench)(arguments)
    if status != 0:
        sys.exit(status)


def make_row(
    dataset: Path, work: Path, row: Path, name: str, repeats: int, training: Path | None
) -> None:
    """Predictions, time, result and row of a setting."""
    predictions, result = work / name, work / f"{name}.json"
    method, *options = NAMED[name].split()
    options += ["--training", str(training)] if training is not None and method == "nearest" else []
    settings = [method, dataset, *options]
    run("fpp-bench", "predict", *settings, "--split", "test", "--out", predictions)
    run(
        "fpp-bench",
        "time",
        *settings,
        "--repeats",
        repeats,
        "--into",
        predictions / "submission.yaml",
    )
    target = "depth_exact" if DatasetFolder(dataset).size[0] == FULL_SIZE else "depth"
    mode = "paper" if name.startswith("constant-range") else "standard"
    run("fpp-eval", predictions, dataset, "--target", target, "--mode", mode, "--json", result)
    before = read_entry(row) if row.exists() else None
    run("fpp-bench", "leaderboard", result, "--row", row)
    keep_measured(before, row)
    vouch(row, dataset, name, before)


def keep_measured(before: Entry | None, row: Path) -> None:
    """Write the reliance and robustness of ``before`` into the row again, if it is of the same
    method."""
    if before is None or _method_of(before) != _method_of(read_entry(row)):
        return
    made = read_entry(row).row
    write_row(
        made.model_copy(
            update={key: getattr(before.row, key) for key in ("reliance", "robustness")}
        ),
        row,
    )


def vouch(row: Path, dataset: Path, name: str, before: Entry | None) -> None:
    """The line of the row in the ``vouched.txt`` above it, in place of that of the row before
    it."""
    suffix = row.stem.removeprefix(name)
    words = [
        "python",
        "benchmarks/upkeep.py",
        "rows",
        str(dataset),
        "--work",
        "rows-work",
        "--only",
        name,
    ]
    words += [f"--suffix={suffix}"] if suffix not in ("", "-unseen") else []
    line = vouching_line(read_entry(row).row, row.read_bytes(), "measured", shlex.join(words))
    listed = row.parent.parent / VOUCHED.name
    lines = listed.read_text(encoding="utf-8").splitlines() if listed.is_file() else []
    outdated = "listed by none" if before is None else sha256(row_json(before.row)).hexdigest()
    kept = [other for other in lines if not other.startswith(outdated)]
    write_atomically(listed, "\n".join([*kept, line, ""]).encode())


def write_measured(row: Path, words: Sequence[str]) -> None:
    """Run ``fpp-bench`` with these words and ``--into`` the row, which stays vouched for if it
    was."""
    before = sha256(row.read_bytes()).hexdigest()
    run("fpp-bench", *words, "--into", row)
    listed = row.parent.parent / VOUCHED.name
    after = sha256(row.read_bytes()).hexdigest()
    write_atomically(listed, listed.read_text(encoding="utf-8").replace(before, after).encode())


def _method_of(entry: Entry) -> tuple[object, ...]:
    about = entry.row.submission
    settings = {key: value for key, value in about.settings.items() if key != "threads"}
    return about.method, about.frames_used, about.units, settings, about.name


def filled(path: Path, blocks: Mapping[str, str]) -> str:
    """The text of ``path`` with each block between ``<!-- NAME:begin -->`` and ``<!-- NAME:end
    -->``. SubmissionError where these are not there, each once."""
    try:
        text = path.read_bytes().decode("utf-8")
    except UnicodeDecodeError:
        raise SubmissionError(f"{path} is no UTF-8 text") from None
    for name, block in blocks.items():
        begin, end = f"<!-- {name}:begin -->", f"<!-- {name}:end -->"
        before, _, rest = text.partition(begin)
        between, _, after = rest.partition(end)
        if (
            f"{before}{begin}{between}{end}{after}" != text
            or text.count(begin) != 1
            or text.count(end) != 1
        ):
            raise SubmissionError(
                f"{path}: expected {begin} and below it {end}, each once; put them where it belongs"
            )
        text = f"{before}{begin}\n\n{block}\n{end}{after}"
    return text


SHOWN = 6
"""Methods of one frame that README shows; the page shows them all."""
_MADE_BY = "Made by `python benchmarks/upkeep.py readme` from the files in `leaderboard/rows/`."
_COLUMNS = (
    columns.METHOD,
    Column("Assumes", lambda row: assumption(row.entry.row) or "-", right=False),
    Column(
        "Two-sided MAE, mm (95% interval)",
        lambda row: f"{error(row.rank_key, row)} ({columns.interval(row, between=' to ')})",
    ),
    Column("Object MAE, mm", partial(error, OBJECT_KEY)),
    Column("Overall MAE, mm", partial(error, "overall_mae_mm")),
    Column("Time, ms", partial(columns.time_text, per_second=1000)),
    columns.FRAMES,
    columns.RELIANCE,
    columns.ORDER_FREE,
    columns.ROBUSTNESS,
)


def best_rows(groups: Sequence[Group], frames: FramesClass) -> tuple[Group, list[Ranked]] | None:
    """The table of a class of frames of the first dataset's metric track, against exact depth where
    a row is, and its rows without trivial ones, the least two-sided MAE first. Only rows that the
    maintainers vouch for count, and where there are none, results of this machine; None without
    such a table."""
    of_class = [
        group
        for group in groups
        if group.key.data_title == groups[0].key.data_title
        and group.vouched == groups[0].vouched
        and group.key.frames == frames
        and group.key.track == "metric"
    ]
    for group in of_one_target(of_class)[:1]:
        rows = [
            row
            for row in group.rows
            if row.provenance != SELF_REPORTED
            and not is_trivial(row)
            and (row.entry.vouched or not group.vouched)
            and row.value(row.rank_key) is not None
        ]
        return group, sorted(rows, key=lambda row: (row.value(row.rank_key), row.short_name))
    return None


def readme_rows(groups: Sequence[Group]) -> list[tuple[Group, Ranked]]:
    """What README shows: the `SHOWN` best methods of one frame, and the best classical method with
    its full sequence (`best_rows`)."""
    shown = []
    for frames, count in ((FRAMES_CLASSES[0], SHOWN), (FRAMES_CLASSES[-1], 1)):
        if best := best_rows(groups, frames):
            group, rows = best
            if frames == FRAMES_CLASSES[-1]:
                rows = [row for row in rows if row.entry.row.submission.method == "classical"]
            shown += [(group, row) for row in rows[:count]]
    return shown


def readme_block(groups: Sequence[Group]) -> str:
    """What is between README's markers: a table of `readme_rows`, and a line that says how to read
    it."""
    if not (shown := readme_rows(groups) if groups else []):
        return f"No row yet. {_MADE_BY}\n"
    (group, first), rows = shown[0], [row for _, row in shown]
    machines = sorted(
        {markdown_text(device(row.entry)) for row in rows if row.entry.latency_ms is not None}
    )
    notes = [
        f"{group.key.data_title}: {group.parts}, {sum(part.samples for part in first.objects)} "
        f"samples of "
        f"{len(first.objects)} objects, against {group.key.against}.",
        f"Two-sided MAE: {columns.TWO_SIDED_NOTE}",
        "Assumes: what must be true of the scene beside the rig's calibration.",
        f"Time: median latency of one image on {' or '.join(machines) or 'an unknown machine'}.",
        "Phase reliance: 1 if the depth follows the fringe's phase and nothing else, 0 if it does "
        "not follow it; then "
        "without errors of whole periods. It does not see a bias.",
        "Disturbed: two-sided MAE over disturbed scenes.",
    ]
    reported = (
        [f"\\{NOT_CHECKED}: reported by the row's author."]
        if any(not r.entry.all_checked for r in rows)
        else []
    )
    text = " ".join(notes + reported)
    return (
        "\n".join([*ranking_table("", _COLUMNS, rows).markdown(), "", f"{text} {_MADE_BY}"]) + "\n"
    )


CURVES = "robustness_curves.png"
"""The picture of the test objects, below their tables."""
DRAWN = (
    "fringe-net, 1 crossed",
    "Crossed, 1 frame",
    "Phase, 1 horizontal",
    "Classical 18+Gray, vertical",
)
"""The rows whose curves are drawn: three methods of one frame, and the classical one; more lines
can't be told apart."""
SCORES = ("wrong_share", "confident_share", "coverage")
TITLES = (
    "method",
    "mean, mm",
    "95% interval",
    "clean, mm",
    "ratio",
    "missed",
    "invented",
    "answered, mm",
    "wrong orders",
    "confident errors",
    "coverage",
)
Row = tuple[str, Robustness]


def of_set(name: SetName, results: Sequence[Result]) -> list[Row]:
    """Names and blocks of a set, the least error first."""
    blocks = [
        (result, block) for result in results if (block := (result.robustness or {}).get(name))
    ]
    names = short_names([result.submission for result, _ in blocks])
    found = [
        (f"{short}, {block.size_px} px" if block.size_px != FULL_SIZE else short, block)
        for short, (_, block) in zip(names, blocks, strict=True)
    ]
    return sorted(found, key=lambda row: (row[1].mae_mm, row[0]))


def held_out() -> list[str]:
    """The axes that no training of today draws."""
    return [name for name, axis in corruptions().axes.items() if axis.held_out]


def robustness_tables(rows: Sequence[Row]) -> str:
    """Both tables in Markdown: means over all axes, then each axis by itself."""
    axes = [
        axis
        for axis in corruptions().axes
        if any(axis in block.axes | block.beside for _, block in rows)
    ]
    titles = [*TITLES[1:5], *held_out(), *TITLES[5:]]
    overall, by_axis = Table(TITLES[0], numbers=titles), Table("method", numbers=axes)
    for name, block in rows:
        low, high = block.interval
        interval = "-" if low is None or high is None else f"{low:.1f} to {high:.1f}"
        ratio = "-" if block.ratio is None else f"{block.ratio:.1f}"
        numbers = [f"{block.mae_mm:.1f}", interval, f"{block.clean.mae_mm:.1f}", ratio]
        mask = [percent(block.mean(key), 2) for key in ("unanswered_share", "invented_share")]
        answered = millimetres(block.mean("answered_mae_mm"))
        errors = {
            axis: [one.mae_mm for one in found]
            for axis, found in (block.axes | block.beside).items()
        }
        marks = {axis: "*" if axis in block.drawn else "" for axis in errors}
        apart = [
            f"{sum(errors[axis]) / 5:.1f}{marks[axis]}" if axis in errors else ""
            for axis in held_out()
        ]
        overall.add_row(
            name, *numbers, *apart, *mask, answered, *(percent(block.mean(key)) for key in SCORES)
        )
        by_axis.add_row(
            name,
            *(
                f"{sum(errors[axis]) / 5:.1f}, {errors[axis][-1]:.1f}{marks[axis]}"
                if axis in errors
                else ""
                for axis in axes
            ),
        )
    between = [
        "",
        f"Not in the mean: "
        f"{', '.join(name for name, axis in corruptions().axes.items() if axis.beside)}. "
        "\\*: the lights that the method learned from disturb this too.",
        "",
        "By axis, mean over the five severities and the last one, mm:",
        "",
    ]
    return "\n".join([*overall.markdown(), *between, *by_axis.markdown()]) + "\n"


def curves(rows: Sequence[Row]) -> bytes:
    """The curves of `DRAWN` on the test objects as the page of ``fpp-bench robustness`` draws them;
    PNG."""
    measured = []
    for title, block in sorted(
        (row for row in rows if row[0] in DRAWN), key=lambda row: DRAWN.index(row[0])
    ):
        means = {
            axis: dict(enumerate((s.model_dump() for s in found), 1))
            for axis, found in (block.axes | block.beside).items()
        }
        setup = {"title": title, "set": "test", "quick": False}
        measured.append(Measured(Path(), setup, {CLEAN: {0: block.clean.model_dump()}, **means}))
    return draw_curves(measured)


EXAMPLES = 2
"""Of each command that docs/commands.md shows; the command's help has them all."""
_COMMANDS_HEAD = """\
# Commands

For readers who look for a command. `COMMAND --help` lists all options and examples. Exit status:
0 done, 1 a check failed, 2 bad input or failed, 130 stopped (143 by SIGTERM), 141 nobody reads the output. This page is
made by `python benchmarks/upkeep.py commands`.
"""


def commands_page() -> str:
    """docs/commands.md: each command's usage, sentence and first `EXAMPLES`, by program and
    group."""
    parts = [_COMMANDS_HEAD]
    for program in (BENCH, EVAL):
        for group, commands in program.groups.items():
            parts.append(
                f"## {program.name}: {group}\n"
                if len(program.groups) > 1
                else f"## {program.name}\n"
            )
            for name in commands:
                parts += _command_parts(f"{program.name} {name}", program.command(name))
    return "\n".join(parts)


def _command_parts(name: str, command: Any) -> Iterator[str]:
    if isinstance(command, Program):
        for inner in command.commands:
            yield from _command_parts(f"{name} {inner}", command.command(inner))
        return
    usage = command.usage(command.context_class(command, info_name=name))
    sentence = " ".join(command.help.split("\n\n")[0].split())
    lines = command.examples.splitlines()
    own = [line for line in lines if line.startswith(f"{name} ") or line == name] or lines
    examples = [re.sub(r" {2,}", "  # ", line, count=1) for line in own[:EXAMPLES]]
    yield f"**`{name} {usage}`**: {sentence}\n"
    yield "\n".join(["```bash", *examples, "```", ""])


def parser() -> argparse.ArgumentParser:
    """Of the words after the script's name."""
    summary = __doc__.split("\n\n", 1)[0]
    words = argparse.ArgumentParser(
        description=summary, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    jobs = words.add_subparsers(dest="job", required=True)
    add = jobs.add_parser("rows", help="make rows again").add_argument
    add("dataset", type=Path, help="dataset folder with all frames")
    add("--work", type=Path, required=True, help="new or empty folder for predictions and results")
    add("--out", type=Path, default=ROWS, help="folder for the rows")
    add(
        "--only",
        nargs="+",
        choices=NAMED,
        metavar="NAME",
        help="only these rows",
    )
    add(
        "--suffix",
        help="of the rows' names (default: -unseen for a dataset without a training split)",
    )
    add("--training", type=Path, help="for nearest: the dataset with the training split")
    add("--repeats", type=int, default=40, help="timed runs of each method")
    add = jobs.add_parser("measured", help="measure reliance or robustness of a row").add_argument
    add("row", type=Path, help="row file")
    add("words", nargs=argparse.REMAINDER, help="words of fpp-bench, without --into")
    add = jobs.add_parser("readme", help="write README's table").add_argument
    add("page", type=Path, nargs="?", default=README, help="Markdown with the markers")
    add(
        "--check",
        action="store_true",
        help="write nothing; exit status 1 where it is not up to date",
    )
    add = jobs.add_parser("commands", help="write docs/commands.md").add_argument
    add("page", type=Path, nargs="?", default=COMMANDS, help="Markdown file")
    add(
        "--check",
        action="store_true",
        help="write nothing; exit status 1 where it is not up to date",
    )
    add = jobs.add_parser(
        "robustness", help="write the tables of docs/results/robustness.md"
    ).add_argument
    add("results", type=Path, nargs="+", help="result files, or folders of them")
    add("--page", type=Path, default=ROBUSTNESS, help="Markdown with the markers")
    return words


def _methods_for(rig: Rig) -> Mapping[str, str]:
    """The methods of a benchmark's rig."""
    if rig.crossed is not None:
        return CROSSED
    return METHODS if rig.pitch("horizontal") == PAPER_PITCH_PX else COARSE


def make_rows(args: argparse.Namespace) -> None:
    """Make the rows that ``args`` name; SubmissionError for a folder of earlier work."""
    if args.work.exists() and any(args.work.iterdir()):
        raise SubmissionError(f"{args.work} is not empty")
    args.work.mkdir(parents=True, exist_ok=True)
    args.out.mkdir(parents=True, exist_ok=True)
    opened = DatasetFolder(args.dataset)
    suffix = (
        args.suffix if args.suffix is not None else "" if "train" in opened.splits else "-unseen"
    )
    for name in args.only or _methods_for(opened.rig):
        make_row(
            args.dataset,
            args.work,
            args.out / f"{name}{suffix}.json",
            name,
            args.repeats,
            args.training,
        )


def write_readme(page: Path, groups: Sequence[Group], check: bool) -> int:
    """Write the block of ``groups``; with ``check`` only say whether it is there, by the exit
    status."""
    text = filled(page, {"leaderboard": readme_block(groups)})
    return write_made(page, text, check, "the ranking", "the rows", "readme")


def write_made(page: Path, text: str, check: bool, what: str, source: str, job: str) -> int:
    """Write ``text``, which ``job`` made of ``source``; with ``check`` only say whether the page
    has it, by the exit status."""
    same = page.is_file() and text.encode() == page.read_bytes()
    if check and not same:
        print(
            f"{page}: {what} is not up to date with {source}; don't edit it by hand, run: "
            f"python benchmarks/upkeep.py {job}",
            file=sys.stderr,
        )
        return OUTDATED
    if not same:
        write_atomically(page, text.encode())
    print(f"{page}: {f'{what} is up to date with {source}' if same else 'written'}")
    return 0


def write_robustness(args: argparse.Namespace) -> None:
    """Write the tables into the page and the curves beside it."""
    results = list(map(read_result, expand(args.results)))
    rows = {name: of_set(name, results) for name in SETS}
    blocks = {name: robustness_tables(rows[name]) for name in SETS}
    words = "Error against severity for each axis, a line for each of four methods"
    blocks["test"] += f"\n![{words}](../pictures/{CURVES})\n"
    write_atomically(args.page, filled(args.page, blocks).encode())
    write_atomically(args.page.parent.parent / "pictures" / CURVES, curves(rows["test"]))


def main(words: Sequence[str] | None = None) -> int:
    args = parser().parse_args(words)
    try:
        if args.job == "readme":
            return write_readme(args.page, rank(read_entries(shipped_rows())), args.check)
        if args.job == "commands":
            return write_made(
                args.page, commands_page(), args.check, "the page", "the commands", "commands"
            )
        if args.job == "measured":
            write_measured(args.row, args.words)
        elif args.job == "rows":
            make_rows(args)
        else:
            write_robustness(args)
        return 0
    except (FppBenchError, OSError) as error:
        print(f"upkeep.py: error: {error}", file=sys.stderr)
        return REFUSED


if __name__ == "__main__":
    sys.exit(main())
