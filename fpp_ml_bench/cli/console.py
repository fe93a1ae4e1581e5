"""Console output: a progress bar on standard error, numbers with units for tables, and accounts of
skipped work."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console, RenderableType
from rich.text import Text

from fpp_ml_bench.examination.findings import Examination
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.benchmark import benchmark_sentence
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.skipping import Explanation
from fpp_ml_bench.tables import Table, words

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

WIDTH_IN_PIPES = 140


@contextmanager
def progress_bar(
    title: str, total: int, unit: str, shown: bool = True
) -> Iterator[Callable[[int], None]]:
    """Progress over ``total`` steps, each a ``unit``, as `bars`; yields the function that advances
    it. Unless ``shown``, it appears with the first step: before, the work may be refused."""
    from rich.progress import MofNCompleteColumn

    with bars(MofNCompleteColumn(), words(unit)) as progress:
        task = progress.add_task(printable(title), total=total, visible=shown)
        yield lambda steps: progress.update(task, advance=steps, visible=True)


def bars(*columns: "ProgressColumn") -> "Progress":
    """Progress bars on standard error with the time left and further ``columns``."""
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TimeRemainingColumn

    usual = words("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    return Progress(*usual, *columns, console=Console(stderr=True))


def gigabytes(count: float) -> str:
    """A number of bytes as text with a decimal unit, B to GB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def contents(manifest: "Manifest") -> str:
    """What a dataset holds, as text: samples of each split, images and bytes."""
    parts = ", ".join(f"{split} {len(rows)}" for split, rows in manifest.samples.items())
    images = len(manifest.stored_frames) * len(manifest.rows)
    return (
        f"{parts} samples, {images:,} images, "
        f"{gigabytes(sum(file.bytes for file in manifest.files))}"
    )


def millimetres(value: float | None) -> str:
    """A length in mm as text for a table; a dash for None."""
    return "-" if value is None else f"{value:.3f}"


def say_benchmark(manifest: "Manifest") -> None:
    """Print which benchmark a dataset is; a warning on standard error where it should be one and is
    not."""
    as_expected, sentence = benchmark_sentence(manifest)
    print(
        f"benchmark: {sentence}" if as_expected else f"warning: {sentence}",
        file=None if as_expected else sys.stderr,
    )


def say_findings(examination: Examination, where: str = "", notes: bool = True) -> None:
    """Print on standard error what an examination found, with or without ``notes``."""
    for finding in examination.findings:
        level = "note" if finding.severity == "note" else "warning"
        if notes or level == "warning":
            print(f"{level}: {where}{finding}", file=sys.stderr)


def show(*parts: RenderableType) -> None:
    """Print to stdout: plain text of a fixed width into pipes and files, of the width that COLUMNS
    says, and colours only on a terminal."""
    # A name may hold characters that the terminal's encoding lacks; a table with a mark in it beats
    # a traceback.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="replace")
    width = None if sys.stdout.isatty() or "COLUMNS" in os.environ else WIDTH_IN_PIPES
    console = Console(width=width, highlight=False, markup=False, emoji=False)
    for part in parts:
        console.print(part)


def explanation_table(explanation: Explanation) -> Table:
    """What was left out."""
    state = (
        "left out"
        if explanation.skipping
        else "nothing left out (skipping is off); it would have been"
    )
    table = Table(
        "what",
        "unit",
        numbers=("done", "left out", "share", "bytes"),
        title=Text(f"{explanation.command}: {state} ({explanation.subject})"),
        elsewhere="--explain-json FILE",
    )
    for line in explanation.lines:
        counted = f" ({line.counted})" if line.counted else ""
        table.add_row(
            Text(line.what + counted),
            line.unit,
            f"{line.done:,}",
            f"{line.left_out:,}",
            f"{100 * line.share:.1f}%",
            "-" if line.bytes_saved is None else gigabytes(line.bytes_saved),
        )
    return table
