"""Make the leaderboard's own rows again: predict, time, score, and write a row file for each method.

    fpp-bench build data/full --preset full
    python benchmarks/make_rows.py data/full --work rows-work
    fpp-bench build data/unseen --preset unseen
    python benchmarks/make_rows.py data/unseen --work rows-unseen --training data/full
    fpp-bench build data/crossed --preset full --rig crossed
    python benchmarks/make_rows.py data/crossed --work rows-crossed
    fpp-bench build data/crossed-hard --preset test --rig crossed --light hard
    python benchmarks/make_rows.py data/crossed-hard --work rows-crossed-hard --suffix=-hard
    fpp-bench build data/hard --preset test --light hard
    python benchmarks/make_rows.py data/hard --work rows-hard --suffix=-hard --only phase-net-horizontal ...
    fpp-bench build data/cpu224 --preset full --size 224
    python benchmarks/make_rows.py data/cpu224 --work rows-224 --suffix=-224 --only constant-range-middle ...
    fpp-bench leaderboard --readme README.md
    fpp-bench leaderboard --page page

A dataset without a training split is the set of unseen objects; its rows are called ``NAME-unseen.json``. One with
crossed fringes has the methods for them.

Every step is a command of the package, printed before it runs. The same data gives the same scores; times depend on the
machine. Phase reliance and robustness, which other commands measured, stay in the row of a method that has not changed.

Rows are scored on the test split, at 960 px against the exact depth, which is the same whatever is projected, and at
224 px against ``depth``, as the paper's networks are. Each row gets its line in ``leaderboard/vouched.txt``.
"""

import argparse
import shlex
import sys
from hashlib import sha256
from pathlib import Path

from fpp_ml_bench.cli import main as fpp_bench
from fpp_ml_bench.cli.evaluate import main as fpp_eval
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.row_file import row_json, write_row
from fpp_ml_bench.leaderboard.rows import VOUCHED, Entry, read_entry, vouching_line
from fpp_ml_bench.loaders.storage import DatasetFolder

ROWS = Path(__file__).resolve().parent.parent / "leaderboard" / "rows"
CLASSICAL = (
    (18, "both"),
    (18, "vertical"),
    (18, "horizontal"),
    (9, "both"),
    (9, "vertical"),
    (6, "vertical"),
    (4, "vertical"),
    (3, "vertical"),
)
"""Steps and directions of the classical method; 18 is divisible by all but 4, so the 4 phases are not evenly spaced."""
SEVERAL_FRAMES = ((2, "horizontal"), (3, "horizontal"), (3, "vertical"))
"""Frames and direction of the phase route with more than one frame."""
METHODS: dict[str, tuple[object, ...]] = {
    **{
        f"classical-{n:02d}-{direction}": ("classical", "--steps", n, "--direction", direction)
        for n, direction in CLASSICAL
    },
    "classical-net-03-vertical": ("classical-net",),
    **{f"phase-{direction}": ("phase", "--direction", direction) for direction in ("horizontal", "vertical")},
    **{
        f"phase-{n:02d}-{direction}": ("phase", "--frames", n, "--direction", direction)
        for n, direction in SEVERAL_FRAMES
    },
    **{
        f"phase-net{suffix}-{direction}": ("phase-net", "--direction", direction, *words)
        for suffix, words in {"": (), "-any": ("--albedo", "any")}.items()
        for direction in ("horizontal", "vertical")
    },
    "constant-standoff": ("constant", "--at", "standoff"),
    "constant-training-mean": ("constant", "--at", "training-mean"),
    "nearest": ("nearest",),
    "constant-range-middle": ("constant", "--at", "range-middle"),
    "constant-range-training": ("constant", "--at", "range-training"),
    "classical-03-both-fewest": ("classical", "--steps", 3, "--direction", "both", "--fewest"),
}
"""File name of a row: method and options. The trivial methods that are told the range are scored by the rules of the
paper's networks. The middle of the working range is the standoff, so it is no row of its own."""


CROSSED: dict[str, tuple[object, ...]] = {
    "crossed": ("crossed",),
    "crossed-03": ("crossed", "--frames", 3),
    "crossed-net": ("crossed-net",),
}
"""The same for datasets with crossed fringes. The trivial methods see no code, so theirs would be the same rows."""


def run(command: str, *words: object) -> None:
    """Run a command; exit where it fails."""
    arguments = [str(word) for word in words]
    print("$", command, shlex.join(arguments), flush=True)
    status = (fpp_eval if command == "fpp-eval" else fpp_bench)(arguments)
    if status != 0:
        sys.exit(status)


def make_row(dataset: Path, work: Path, row: Path, name: str, repeats: int, training: Path | None) -> None:
    """Predictions, time, result and row of a setting."""
    predictions, result = work / name, work / f"{name}.json"
    method, *options = (METHODS | CROSSED)[name]
    options += ["--training", training] if training is not None and method == "nearest" else []
    settings = [method, dataset, *options]
    run("fpp-bench", "predict", *settings, "--split", "test", "--out", predictions)
    run("fpp-bench", "time", *settings, "--repeats", repeats, "--into", predictions / "submission.yaml")
    target = "depth_exact" if DatasetFolder(dataset).size[0] == FULL_SIZE else "depth"
    mode = "paper" if name.startswith("constant-range") else "standard"
    run("fpp-eval", predictions, dataset, "--target", target, "--mode", mode, "--json", result)
    before = read_entry(row) if row.exists() else None
    run("fpp-bench", "leaderboard", result, "--row", row)
    keep_measured(before, row)
    vouch(row, dataset, name, before)


def keep_measured(before: Entry | None, row: Path) -> None:
    """Write the reliance and robustness of ``before`` into the row again, if it is of the same method."""
    if before is None or _method_of(before) != _method_of(read_entry(row)):
        return
    made = read_entry(row).row
    write_row(made.model_copy(update={key: getattr(before.row, key) for key in ("reliance", "robustness")}), row)


def vouch(row: Path, dataset: Path, name: str, before: Entry | None) -> None:
    """The line of the row in the ``vouched.txt`` above it, in place of that of the row before it."""
    suffix = row.stem.removeprefix(name)
    words = ["python", "benchmarks/make_rows.py", dataset, "--work", "rows-work", "--only", name]
    words += [f"--suffix={suffix}"] if suffix not in ("", "-unseen") else []
    line = vouching_line(read_entry(row).row, row.read_bytes(), "measured", shlex.join(map(str, words)))
    listed = row.parent.parent / VOUCHED.name
    lines = listed.read_text(encoding="utf-8").splitlines() if listed.is_file() else []
    outdated = "listed by none" if before is None else sha256(row_json(before.row)).hexdigest()
    kept = [other for other in lines if not other.startswith(outdated)]
    write_atomically(listed, "\n".join([*kept, line, ""]).encode())


def _method_of(entry: Entry) -> tuple[object, ...]:
    about = entry.row.submission
    settings = {key: value for key, value in about.settings.items() if key != "threads"}
    return about.method, about.frames_used, about.units, settings


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n", 1)[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="dataset folder with all frames")
    parser.add_argument("--work", type=Path, required=True, help="new or empty folder for predictions and results")
    parser.add_argument("--out", type=Path, default=ROWS, help="folder for the rows")
    parser.add_argument("--only", nargs="+", choices=METHODS | CROSSED, metavar="NAME", help="only these rows")
    parser.add_argument("--suffix", help="of the rows' names (default: -unseen for a dataset without a training split)")
    parser.add_argument("--training", type=Path, help="for nearest: the dataset with the training split")
    parser.add_argument("--repeats", type=int, default=40, help="timed runs of each method")
    args = parser.parse_args()
    if args.work.exists() and any(args.work.iterdir()):
        parser.error(f"{args.work} is not empty")
    args.work.mkdir(parents=True, exist_ok=True)
    args.out.mkdir(parents=True, exist_ok=True)
    opened = DatasetFolder(args.dataset)
    suffix = args.suffix if args.suffix is not None else "" if "train" in opened.splits else "-unseen"
    for name in args.only or (METHODS if opened.rig.crossed is None else CROSSED):
        row = args.out / f"{name}{suffix}.json"
        make_row(args.dataset, args.work, row, name, args.repeats, args.training)


if __name__ == "__main__":
    main()
