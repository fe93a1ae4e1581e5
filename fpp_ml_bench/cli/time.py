"""``fpp-bench time``: what a method costs in milliseconds, memory, parameters and captures."""

import argparse
import json
from pathlib import Path
from typing import Any

from fpp_ml_bench import baselines
from fpp_ml_bench.cli import SPLITS, count
from fpp_ml_bench.cli.method_options import METHOD_HELP, add_method_options, chosen_method
from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation import result
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import limit_threads

SUMMARY = "Measure a method's latency at batch 1, throughput, memory, parameters and frames, on a named machine."
EXAMPLES = (
    "fpp-bench time classical data/mini",
    "fpp-bench time classical data/mini --steps 4 --direction vertical --batch 8 --json timing.json",
    "fpp-bench time unet.safetensors data/mini --range predicted --threads 2",
    "fpp-bench time classical data/mini --into predictions/submission.yaml --into result.json",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("method", metavar="METHOD", help=METHOD_HELP)
    add("dataset", type=Path, metavar="DATASET", help="dataset folder")
    add("--split", default="test", choices=SPLITS, help="default: test")
    add("--batch", type=count(), default=4, metavar="N", help="images a batch (default: 4)")
    add("--repeats", type=count(), default=20, metavar="N", help="timed runs (default: 20)")
    add("--json", type=Path, metavar="FILE", help="write the timing here")
    add(
        "--into",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="put it into this submission.yaml or result file of the same method; may be given again",
    )
    add_method_options(parser)


def run(args: argparse.Namespace) -> int:
    from fpp_ml_bench.cli.console import progress_bar, show

    limit_threads(args.threads)
    opened = storage.DatasetFolder(args.dataset)
    method = chosen_method(args, opened)
    for path in args.into:
        baselines.check_target(path, method)
    if args.json is not None and not args.json.absolute().parent.is_dir():
        raise SubmissionError(f"--json {args.json}: the folder {args.json.parent} does not exist; make it first")
    with progress_bar(f"timing {args.method}", args.repeats, "images") as advance:
        timing = baselines.time_method(opened, method, args.split, args.batch, args.repeats, advance)
    if args.json is not None:
        content = {"name": method.title, "method": method.name, "settings": dict(method.settings)}
        text = json.dumps({**content, "timing": timing.model_dump(mode="json")}, indent=1, allow_nan=False)
        write_atomically(args.json, (text + "\n").encode("utf-8"))
    for path in args.into:
        baselines.write_timing(path, timing)
    show(_table(method.title, timing))
    for path in (*([args.json] if args.json else []), *args.into):
        print(f"Written: {path}")
    return 0


def _table(title: str, timing: "result.Timing") -> Any:
    from rich.table import Table
    from rich.text import Text

    def mib(value: float | None) -> str:
        return "unknown" if value is None else f"{value:,.0f} MiB"

    (height, width), machine = timing.image_size, timing.hardware
    table = Table("", show_header=False, title=Text(f"{title}, measured here"), title_justify="left")
    table.add_column(justify="right", overflow="fold")
    ways = "at once" if timing.batched else "one after another"
    for name, value in (
        ("latency at batch 1, median", f"{timing.latency_median_ms:.4g} ms"),
        ("  5th to 95th percentile", f"{timing.latency_p5_ms:.4g} to {timing.latency_p95_ms:.4g} ms"),
        ("  runs", f"{timing.repeats}, images of {width}x{height} px"),
        (f"throughput at batch {timing.batch}", f"{timing.throughput_per_s:.4g} images/s, {ways}"),
        ("frames needed", str(timing.frames)),
        ("parameters", f"{timing.parameters:,}"),
        ("memory one image adds", mib(timing.working_memory_mib)),
        ("peak memory of the process", mib(timing.peak_memory_mib)),
        *([("peak GPU memory", mib(timing.gpu_memory_mib))] if timing.gpu_memory_mib is not None else []),
        ("device", timing.device),
        ("machine", f"{machine.gpu or 'no GPU'}; {machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB"),
    ):
        table.add_row(name, Text(value))
    return table
