"""What a model reads: ``fpp-bench diagnose`` probes it, ``fpp-bench reliance`` measures how far it follows the fringe's
phase."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.progress import Progress
from rich.text import Text

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.diagnostics.counterfactual import measure as measure_reliance
from fpp_ml_bench.baselines.diagnostics.probe import (
    JSON_FILE,
    PROBES,
    REPORT_FILE,
    Probe,
    ProbeSettings,
    checked_names,
)
from fpp_ml_bench.baselines.diagnostics.probe import diagnose as run_diagnosis
from fpp_ml_bench.baselines.diagnostics.scenes import chosen_samples
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import COUNT, command, command_line, names, value
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.evaluation.result.parts import PART_TITLES, Reliance
from fpp_ml_bench.leaderboard.rows import check_same_method, read_entry, write_block
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table


class DiagnoseCommand(MethodCommand):
    """A command whose options are also those of the methods without a network that is probed layer by layer."""

    def methods(self, words: Sequence[str]) -> dict[str, type[Method]]:
        return registry.methods()


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
        "weights that come with the package, a .safetensors file, one of the methods below, or your own method or "
        "torch module as file.py:Class or file.py:factory; that file is executed",
        "MODEL",
    ),
    dataset: Path = argument("dataset folder, of the model's image size", "DATASET"),
    out: Path = option(REQUIRED, "index.html and diagnose.json go here", "DIR"),
    probe: tuple[str, ...] = option(
        (), f"run only this probe; can be repeated: {', '.join(PROBES)} (default: all)", "NAME", many=True
    ),
    samples: int | None = option(
        None, "most samples of a split, taken evenly (default: the probe's)", "N", parse=COUNT
    ),
    seeds: int | None = option(None, "repeats of what depends on random numbers (default: 2)", "N", parse=COUNT),
    frame: int | None = option(None, "number of a network's input frame (default: its first)", "N"),
    units: Literal["mm", "m", "normalised"] | None = option(
        None,
        "output of your own module: depth in mm, in m, or normalised to the sample's range (default)",
    ),
    quick: bool = option(False, "a short run for a first look; its numbers are not reliable"),
    layers: tuple[str, ...] | None = option(
        None, "layers to probe, comma separated (default: the model's own)", "A,B", parse=names
    ),
    threads: int | None = option(None, "threads (default: every core)", "N", parse=COUNT),
    options: dict[str, Any],
) -> None:
    """Diagnose a network or method with the paper's probes and further ones; writes an HTML report and a JSON file.

    Raises FppBenchError for what can't be diagnosed."""
    from fpp_ml_bench.baselines.diagnostics.subjects import subject as subject_of

    probe_names = checked_names(probe)
    opened = DatasetFolder(dataset)
    subject = subject_of(model, opened, layers, units, frame, threads or usable_cores(), options)
    probing = ProbeSettings(samples, seeds, quick)
    again = re.sub(r" --threads[ =]\S+", "", command_line())
    with Progress(console=Console(stderr=True)) as bars:

        def progress(probe: Probe) -> Callable[[int, int, str], None]:
            task = bars.add_task(probe.title, total=None)
            return lambda done, total, activity: bars.update(
                task, completed=done, total=total, description=f"{probe.title}: {activity}"
            )

        results = run_diagnosis(subject, opened, probe_names, probing, out, progress, again)
    table = Table("Probe", "Summary", numbers=("Seconds",), title=Text(subject.title))
    for probed in results:
        text = f"not run: {probed.finding.skipped}" if probed.finding.skipped else probed.finding.summary
        table.add_row(probed.probe.name, Text(text), "reused" if probed.reused else f"{probed.seconds:.1f}")
    show(table)
    print(f"Written: {out / REPORT_FILE}\nWritten: {out / JSON_FILE}")


@command(
    """\
fpp-bench reliance classical data/cpu224
fpp-bench reliance phase data/cpu224 --direction vertical
fpp-bench reliance unet-individual-rmse data/cpu224 --range oracle --into result.json
""",
    MethodCommand,
)
def reliance(
    *,
    chosen: MethodSettings,
    dataset: Path = argument("dataset folder; scenes are made from its test objects", "DATASET"),
    views: int = option(
        2,
        "samples of each test object, 1 to 6 (default: 2)",
        "N",
        parse=value("1 to 6, an object has six views", int, lambda views: 1 <= views <= 6),
    ),
    into: Path | None = option(
        None, "write the score into this result or leaderboard row of the same method (.json)", "FILE"
    ),
    json: Path | None = option(None, "write the score and its parts to this file; - is standard output", "FILE"),
) -> None:
    """Measure phase reliance: does the predicted depth follow the fringe's phase, or the object's outline?

    A file that can't take the score raises FppBenchError before measuring."""
    opened = DatasetFolder(dataset)
    method = chosen.load(opened)
    entry = None if into is None else read_entry(into)
    if entry is not None:
        check_same_method(entry, method)
    samples = chosen_samples(opened, "test", views)
    with progress_bar(f"reliance of {chosen.name}", len(samples), "samples") as advance:
        # Called before each sample, so the first call is for none.
        measured, _ = measure_reliance(method, opened, samples, lambda done, total, sample: advance(min(done, 1)))
        advance(1)
    if json is not None:
        write_json(measured.model_dump(mode="json"), json)
    if entry is not None:
        write_block(entry, measured)
    moved = [value for key, value in measured.parts if not key.startswith("answered")]
    if any(moved):
        show(_reliance_table(method.title, measured))
    else:
        print(
            f"{method.title}: gives the same answer whatever phase, light and outline of {measured.samples} samples "
            "are, so it reads nothing of them. Phase reliance 0."
        )


def _reliance_table(title: str, reliance: Reliance) -> Table:
    heading = Text(f"{title}: {reliance.samples} samples of {reliance.objects} objects")
    table = Table("", numbers=("value",), title=heading)
    low, high = reliance.interval
    interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    table.add_row("phase reliance, 0 to 1", f"{reliance.score:.3f}{interval}")
    if reliance.order_free_score is not None:
        table.add_row("  without whole periods", f"{reliance.order_free_score:.3f}")
    for key, words in PART_TITLES.items():
        value = getattr(reliance.parts, key)
        if value is not None:
            table.add_row(words, f"{value:.3f}")
    return table
