"""``fpp-bench diagnose``: does a model read fringes or shapes? An HTML report."""

import argparse
import shlex
from pathlib import Path

from rich import progress as bar
from rich.console import Console
from rich.text import Text

from fpp_ml_bench.baselines import diagnostics
from fpp_ml_bench.cli import count
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import limit_threads, usable_cores
from fpp_ml_bench.tables import Table

SUMMARY = (
    "Diagnose a network or method with the paper's probes and further ones; writes an HTML report and a JSON file."
)
EXAMPLES = (
    "fpp-bench diagnose unet-individual-rmse data/cpu224 --out report",
    "fpp-bench diagnose unet-individual-rmse data/cpu224 --probe grad-cam --out report   adds to the report",
    "fpp-bench diagnose phase data/cpu224 --out report-phase",
    "fpp-bench diagnose runs/mine.safetensors data/cpu224 --layers enc1 bottleneck dec1 --quick --out look",
    "fpp-bench diagnose my_net.py:make data/cpu224 --units mm --layers encoder decoder.2 --out report-mine",
)
UNITS = ("mm", "m", "normalised")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    parser.add_argument(
        "model",
        metavar="MODEL",
        help="weights that come with the package, a .safetensors file, a method (classical, phase, ...), or your own "
        "torch module as file.py:factory; that file is executed",
    )
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder, of the model's image size")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="index.html and diagnose.json go here")
    parser.add_argument(
        "--probe",
        action="append",
        default=[],
        metavar="NAME",
        help=f"run only this probe; can be repeated: {', '.join(diagnostics.PROBES)} (default: all)",
    )
    text = "most samples of a split, taken evenly (default: the probe's)"
    parser.add_argument("--samples", type=count(), metavar="N", help=text)
    text = "repeats of what depends on random numbers (default: 2)"
    parser.add_argument("--seeds", type=count(), metavar="N", help=text)
    text = "a short run for a first look; its numbers are not reliable"
    parser.add_argument("--quick", action="store_true", help=text)
    parser.add_argument("--layers", nargs="+", metavar="NAME", help="layers to probe (default: the model's own)")
    parser.add_argument("--frame", type=int, metavar="N", help="number of a network's input frame (default: its first)")
    parser.add_argument("--threads", type=count(), metavar="N", help="threads (default: every core)")
    parser.add_argument(
        "--units",
        choices=UNITS,
        help="output of your own module: depth in mm, in m, or normalised to the sample's range (default)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the probes, write the report, print the summaries. Raises FppBenchError for what can't be diagnosed."""
    threads = args.threads or usable_cores()
    limit_threads(threads)  # before NumPy is loaded
    probe_names = diagnostics.checked_names(args.probe)
    dataset = storage.DatasetFolder(args.dataset)
    model = diagnostics.subject(args.model, dataset, args.layers, args.units, args.frame, threads)
    settings = diagnostics.ProbeSettings(args.samples, args.seeds, args.quick)
    columns = (
        bar.TextColumn("{task.description}"),
        bar.BarColumn(),
        bar.TaskProgressColumn(),
        bar.TimeElapsedColumn(),
        bar.TimeRemainingColumn(),
    )
    with bar.Progress(*columns, console=Console(stderr=True)) as bars:

        def progress(probe: "diagnostics.Probe") -> "diagnostics.Progress":
            task = bars.add_task(probe.title, total=None)
            return lambda done, total, activity: bars.update(
                task, completed=done, total=total, description=f"{probe.title}: {activity}"
            )

        results = diagnostics.diagnose(model, dataset, probe_names, settings, args.out, progress, _command(args))
    table = Table("Probe", "Summary", numbers=("Seconds",), title=Text(model.title))
    for result in results:
        text = f"not run: {result.finding.skipped}" if result.finding.skipped else result.finding.summary
        table.add_row(result.probe.name, Text(text), "reused" if result.reused else f"{result.seconds:.1f}")
    show(table)
    print(f"Written: {args.out / diagnostics.REPORT_FILE}\nWritten: {args.out / diagnostics.JSON_FILE}")
    return 0


def _command(args: argparse.Namespace) -> str:
    """The command that makes the same report, without the machine's settings."""
    words = ["fpp-bench", "diagnose", args.model, str(args.dataset), "--out", str(args.out)]
    options = [("probe", name) for name in args.probe]
    options += [(name, getattr(args, name)) for name in ("samples", "seeds", "frame", "units")]
    words += [word for name, value in options if value is not None for word in (f"--{name}", str(value))]
    words += ["--quick"] if args.quick else []
    words += ["--layers", *args.layers] if args.layers else []
    return shlex.join(words)
