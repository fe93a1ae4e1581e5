"""``fpp-bench diagnose``: does a model read fringes or shapes? An HTML report."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from rich import progress as bar
from rich.console import Console
from rich.text import Text

from fpp_ml_bench.baselines import diagnostics, registry
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.cli.methods import MethodCommand, OfMethods
from fpp_ml_bench.cli.options import COUNT, command, command_line, names
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table


class DiagnoseCommand(MethodCommand):
    """A command whose options are also those of the methods without a network that is probed layer by layer."""

    def methods(self, words: Sequence[str]) -> list[type[Method]]:
        return list(registry.methods().values())


@command(
    """\
fpp-bench diagnose unet-individual-rmse data/cpu224 --out report
fpp-bench diagnose unet-individual-rmse data/cpu224 --probe grad-cam --out report   adds to the report
fpp-bench diagnose phase data/cpu224 --out report-phase
fpp-bench diagnose runs/mine.safetensors data/cpu224 --layers enc1,bottleneck,dec1 --quick --out look
fpp-bench diagnose my_net.py:make data/cpu224 --units mm --layers encoder,decoder.2 --out report-mine
""",
    DiagnoseCommand,
)
def diagnose(
    *,
    model: str = argument(
        "weights that come with the package, a .safetensors file, a method (classical, phase, ...), or your own torch "
        "module as file.py:factory; that file is executed",
        "MODEL",
    ),
    dataset: Path = argument("dataset folder, of the model's image size", "DATASET"),
    out: Path = option(REQUIRED, "index.html and diagnose.json go here", "DIR"),
    probe: tuple[str, ...] = option(
        (), f"run only this probe; can be repeated: {', '.join(diagnostics.PROBES)} (default: all)", "NAME", many=True
    ),
    samples: int | None = option(
        None, "most samples of a split, taken evenly (default: the probe's)", "N", parse=COUNT
    ),
    seeds: int | None = option(None, "repeats of what depends on random numbers (default: 2)", "N", parse=COUNT),
    frame: int | None = option(None, "number of a network's input frame (default: its first)", "N"),
    units: Literal["mm", "m", "normalised"] | None = option(
        None,
        "output of your own module: depth in mm, in m, or normalised to the sample's range (default)",
        choices=("mm", "m", "normalised"),
    ),
    quick: bool = option(False, "a short run for a first look; its numbers are not reliable"),
    layers: tuple[str, ...] | None = option(
        None, "layers to probe, comma separated (default: the model's own)", "A,B", parse=names
    ),
    threads: int | None = option(None, "threads (default: every core)", "N", parse=COUNT),
    options: OfMethods,
) -> None:
    """Diagnose a network or method with the paper's probes and further ones; writes an HTML report and a JSON file.

    Raises FppBenchError for what can't be diagnosed."""
    probe_names = diagnostics.checked_names(probe)
    opened = storage.DatasetFolder(dataset)
    method = registry.methods().get(model, registry.network_method())
    of_method = options.of(method, model)
    subject = diagnostics.subject(model, opened, layers, units, frame, threads or usable_cores(), of_method)
    probing = diagnostics.ProbeSettings(samples, seeds, quick)
    again = command_line(without=("threads",))
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

        results = diagnostics.diagnose(subject, opened, probe_names, probing, out, progress, again)
    table = Table("Probe", "Summary", numbers=("Seconds",), title=Text(subject.title))
    for result in results:
        text = f"not run: {result.finding.skipped}" if result.finding.skipped else result.finding.summary
        table.add_row(result.probe.name, Text(text), "reused" if result.reused else f"{result.seconds:.1f}")
    show(table)
    print(f"Written: {out / diagnostics.REPORT_FILE}\nWritten: {out / diagnostics.JSON_FILE}")
