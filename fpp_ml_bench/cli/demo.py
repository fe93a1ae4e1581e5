"""``fpp-bench demo``: the whole benchmark in small, by its own public commands."""

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from fpp_ml_bench import __version__
from fpp_ml_bench.cli import BENCH, EVAL, OK, run_program
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.constants import MINI_OBJECTS, TEST_OBJECTS
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.metrics import OBJECT_KEY
from fpp_ml_bench.evaluation.submission.prediction_files import SUBMISSION_FILE
from fpp_ml_bench.leaderboard.columns import assumption
from fpp_ml_bench.leaderboard.rows import Entry, read_entry
from fpp_ml_bench.options import option
from fpp_ml_bench.tables import Table

OBJECTS = tuple(name for name in MINI_OBJECTS if name in TEST_OBJECTS)
SAMPLE = "power_drill_A60"
METHODS = {"classical": "mini", "phase": "mini", "crossed": "mini-crossed"}
"""Each method of the demo, and the dataset that it is run on."""
_FORMS = ".2f", ".2f", ".0f", ".2f"
NOTES = """\
Object MAE: mean error on the object's pixels, against the exact depth. Overall MAE: the same over all pixels.
Time: median of one depth map on one thread of this machine. Frames: images that are captured for a depth map.
Phase reliance: 1, the depth follows the phase of the fringes and nothing else; 0, it does not follow it.
Two objects are too few for a ranking."""


class Step(NamedTuple):
    """A public command as a line of a shell; ``kept`` says whether what it writes is there from an
    earlier run."""

    line: str
    kept: Callable[[], bool] = lambda: False


def steps_in(out: Path) -> Iterator[Step]:
    """The commands of the demo, in their order, with everything they write below ``out``."""
    below = shlex.quote(str(out))
    for name in dict.fromkeys(METHODS.values()):
        rig = " --rig crossed" if name == "mini-crossed" else ""
        # Of a finished dataset it only says so.
        yield Step(
            f"fpp-bench build --out {below}/{name} --preset mini --objects {','.join(OBJECTS)}{rig}"
        )
    for method, name in METHODS.items():
        data, predictions, result = f"{below}/{name}", f"{below}/{method}", f"{below}/{method}.json"
        written = out / f"{method}.json"
        yield Step(
            f"fpp-bench predict {method} {data} --out {predictions}",
            (out / method / SUBMISSION_FILE).is_file,
        )
        yield Step(f"fpp-eval {predictions} --target depth_exact --json {result}", written.is_file)
        yield Step(
            f"fpp-bench reliance {method} {data} --views 1 --into {result}",
            partial(_has_reliance, written),
        )
    results = " ".join(f"{below}/{method}.json" for method in METHODS)
    pictured = " ".join(f"--predictions {below}/{method}" for method in METHODS)
    yield Step(f"fpp-bench leaderboard {results} --page {below}/page {pictured}")
    picture = f"--predictions {below}/crossed --cloud --out {below}/{SAMPLE}.png"
    yield Step(f"fpp-bench show {below}/mini-crossed {SAMPLE} {picture}")


def _has_reliance(result: Path) -> bool:
    return result.is_file() and _entry(result).row.reliance is not None


def _entry(result: Path) -> Entry:
    """The result of a step. Raises `SubmissionError` for one that another version of this package
    made."""
    entry = read_entry(result)
    made_by = entry.row.submission.software.get("fpp_ml_bench")
    if made_by != __version__:
        raise SubmissionError(
            f"{result}: made by version {made_by}, this is {__version__}; give a new folder by "
            f"--out"
        )
    return entry


@command(
    """\
fpp-bench demo
fpp-bench demo --out /tmp/demo
"""
)
def demo(
    *, out: Path = option(Path("demo"), "folder for all that it writes (default: demo)", "DIR")
) -> int:
    """Run the whole benchmark in small: build, predict, score, measure what was read, and show it
    in one table.

    It takes about a minute on two cores. It runs public commands and prints them; a run that was
    stopped continues."""
    started, steps = perf_counter(), list(steps_in(out))
    for number, (line, kept) in enumerate(steps, 1):
        print(
            f"[{number}/{len(steps)}] {'kept: ' if kept() else ''}{line}",
            file=sys.stderr,
            flush=True,
        )
        if kept():
            continue
        program, *words = shlex.split(line)
        with redirect_stdout(StringIO()):
            status = run_program({"fpp-bench": BENCH, "fpp-eval": EVAL}[program], words)
        if status != OK:
            print(
                f"fpp-bench demo: stopped at step {number}; the same command continues there",
                file=sys.stderr,
            )
            return status
    entries = [_entry(out / f"{method}.json") for method in METHODS]
    show(_table(entries))
    written = {
        "page": out / "page/index.html",
        "picture": out / f"{SAMPLE}.png",
        "points": out / f"{SAMPLE}.html",
    }
    assumed = [
        f"{name}: {assumption(entry.row) or 'nothing'}"
        for name, entry in zip(METHODS, entries, strict=True)
    ]
    print(
        NOTES, f"Assumed of the scene. {'; '.join(assumed)}.", "", "Written, to look at:", sep="\n"
    )
    for what, path in written.items():
        print(f"  {what:8}{path}")
    print("\nThe same by hand:", *(f"  {line}" for line, _ in steps), sep="\n")
    print(
        f"\n{perf_counter() - started:.0f} s. Next: a method of yours, your predictions, your rig "
        f"(README.md)."
    )
    return OK


def _table(entries: list[Entry]) -> Table:
    numbers = "Frames", "Object MAE, mm", "Overall MAE, mm", "Time, ms", "Phase reliance"
    data = entries[0].row.dataset
    title = f"{data.samples} views of {' and '.join(OBJECTS)}, {data.size[1]} x {data.size[0]} px"
    table = Table("Method", numbers=numbers, title=title)
    for entry in entries:
        row = entry.row
        reliance = None if row.reliance is None else row.reliance.score
        values = entry.value(OBJECT_KEY), row.metrics.overall_mae_mm, entry.latency_ms, reliance
        cells = (
            "-" if value is None else format(value, form)
            for value, form in zip(values, _FORMS, strict=True)
        )
        table.add_row(row.submission.method, str(entry.frames), *cells)
    return table
