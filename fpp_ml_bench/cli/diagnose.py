"""What a model reads and what breaks it: ``fpp-bench diagnose`` probes it, ``fpp-bench reliance``
measures how far it follows the fringe's phase, ``fpp-bench robustness`` how its error grows when
the scene is disturbed, axis by axis."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.text import Text

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.diagnostics.counterfactual import measure as measure_reliance
from fpp_ml_bench.baselines.diagnostics.probe import (
    JSON_FILE,
    PROBES,
    REPORT_FILE,
    Probe,
    ProbeSettings,
)
from fpp_ml_bench.baselines.diagnostics.probe import diagnose as run_diagnosis
from fpp_ml_bench.baselines.diagnostics.scenes import chosen_samples
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.robustness.axes import CACHE, CLEAN, SETS, Condition, severity_means
from fpp_ml_bench.baselines.robustness.run import Setup, View, write_page
from fpp_ml_bench.baselines.robustness.run import measure as measure_robustness
from fpp_ml_bench.baselines.robustness.run import robustness as robustness_block
from fpp_ml_bench.baselines.timing import check_same_method
from fpp_ml_bench.cli.console import bars, progress_bar, show
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import COUNT, Pool, command, command_line, names, new_file, value
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.evaluation.result.parts import Reliance
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.rows import read_entry, write_block
from fpp_ml_bench.loaders.render.builder import assembly_of
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AnySequence
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.remote import RemoteFolder, place, working_copy
from fpp_ml_bench.style import millimetres, percent
from fpp_ml_bench.tables import Table


class DiagnoseCommand(MethodCommand):
    """A command whose options are also those of the methods without a network that is probed layer
    by layer."""

    def methods(self, words: Sequence[str]) -> dict[str, type[Method]]:
        return registry.methods()


@command(
    """\
fpp-bench diagnose unet-individual-rmse data/small224 --out report
fpp-bench diagnose unet-individual-rmse data/small224 --probe grad-cam --out report   adds to the report
fpp-bench diagnose phase data/small224 --out report-phase
fpp-bench diagnose runs/mine.safetensors data/small224 --layers enc1,bottleneck,dec1 --quick --out look
fpp-bench diagnose my_net.py:make data/small224 --units mm --layers encoder,decoder.2 --out report-mine
""",
    DiagnoseCommand,
)
def diagnose(
    *,
    model: str = argument(
        "weights that come with the package, a .safetensors file, one of the methods below, or "
        "your own method or "
        "torch module as file.py:Class or file.py:factory; that file is executed",
        "MODEL",
    ),
    dataset: Path = argument("dataset folder, of the model's image size", "DATASET"),
    out: Path = option(REQUIRED, "index.html and diagnose.json go here", "DIR"),
    probe: tuple[str, ...] = option(
        tuple(PROBES),
        f"run only this probe; can be repeated: {', '.join(PROBES)} (default: all)",
        "NAME",
        choices=PROBES,
        many=True,
    ),
    samples: int | None = option(
        None, "most samples of a split, taken evenly (default: the probe's)", "N", parse=COUNT
    ),
    seeds: int | None = option(
        None, "repeats of what depends on random numbers (default: 2)", "N", parse=COUNT
    ),
    frame: int | None = option(None, "number of a network's input frame (default: its first)", "N"),
    units: Literal["mm", "m", "normalised"] | None = option(
        None,
        "output of your own module: depth in mm, in m, or normalised to the sample's range "
        "(default)",
    ),
    quick: bool = option(False, "a short run for a first look; its numbers are not reliable"),
    layers: tuple[str, ...] | None = option(
        None, "layers to probe, comma separated (default: the model's own)", "A,B", parse=names
    ),
    threads: int | None = option(None, "threads (default: every core)", "N", parse=COUNT),
    options: dict[str, Any],
) -> None:
    """Diagnose a network or method with the paper's probes and further ones; writes an HTML report
    and a JSON file.

    Raises FppBenchError for what can't be diagnosed."""
    from fpp_ml_bench.baselines.diagnostics.subjects import subject as subject_of

    opened = DatasetFolder(dataset)
    subject = subject_of(model, opened, layers, units, frame, threads or usable_cores(), options)
    probing = ProbeSettings(samples, seeds, quick)
    again = re.sub(r" --threads[ =]\S+", "", command_line())
    with bars() as shown:

        def progress(probe: Probe) -> Callable[[int, int, str], None]:
            task = shown.add_task(probe.title, total=None)
            return lambda done, total, activity: shown.update(
                task,
                completed=done,
                total=total,
                description=printable(f"{probe.title}: {activity}"),
            )

        results = run_diagnosis(subject, opened, probe, probing, out, progress, again)
    table = Table("Probe", "Summary", numbers=("Seconds",), title=Text(subject.title))
    for probed in results:
        text = (
            f"not run: {probed.finding.skipped}"
            if probed.finding.skipped
            else probed.finding.summary
        )
        table.add_row(
            probed.probe.name, Text(text), "reused" if probed.reused else f"{probed.seconds:.1f}"
        )
    show(table)
    print(f"Written: {out / REPORT_FILE}\nWritten: {out / JSON_FILE}")


@command(
    """\
fpp-bench reliance classical data/small224
fpp-bench reliance phase data/small224 --direction vertical
fpp-bench reliance unet-individual-rmse data/small224 --into result.json
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
        None,
        "write the score into this result or leaderboard row of the same method (.json)",
        "FILE",
    ),
    json: Path | None = option(
        None,
        "write the score and its parts to this file; - is standard output",
        "FILE",
        parse=new_file,
    ),
) -> None:
    """Measure phase reliance: does the predicted depth follow the fringe's phase, or the object's
    outline?

    A file that can't take the score raises FppBenchError before measuring."""
    opened = DatasetFolder(dataset)
    method = chosen.load(opened)
    entry = None if into is None else read_entry(into)
    if entry is not None:
        check_same_method(entry.path, entry.row.submission, method)
    samples = chosen_samples(opened, "test", views)
    with progress_bar(f"reliance of {chosen.name}", len(samples), "samples") as advance:
        # Called before each sample, so the first call is for none.
        measured, _ = measure_reliance(
            method, opened, samples, lambda done, total, sample: advance(min(done, 1))
        )
        advance(1)
    if json is not None:
        write_json(measured.model_dump(mode="json"), json)
    if entry is not None:
        write_block(entry, measured)
    moved = [value for key, value in measured.parts if not key.startswith("answered")]
    if any(moved):
        show(_reliance_table(method.title, measured))
        print(_verdict(measured))
    else:
        print(
            f"{method.title}: gives the same answer whatever phase, light and outline of "
            f"{measured.samples} samples "
            "are, so it reads nothing of them. Phase reliance 0."
        )


FOLLOWS, HARDLY = 0.75, 0.25
"""Scores from which a method follows the phase, and below which it hardly does: quarters of the
scale, for words alone."""


def _verdict(reliance: Reliance) -> str:
    """The score in a sentence."""
    within = reliance.score if reliance.order_free_score is None else reliance.order_free_score
    if reliance.score >= FOLLOWS:
        return "The depth follows the fringe's phase, and its whole periods do, too."
    if within >= FOLLOWS:
        return (
            "The depth follows the phase within a period; which period it is in comes from "
            "something else: brightness, outline or a prior."
        )
    if within < HARDLY:
        return "The depth hardly follows the phase: it comes from outline, light or a prior."
    return "The depth follows the phase in part, and in part outline, light or a prior."


def _reliance_table(title: str, reliance: Reliance) -> Table:
    heading = Text(f"{title}: {reliance.samples} samples of {reliance.objects} objects")
    table = Table("", numbers=("value",), title=heading)
    low, high = reliance.interval
    interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    table.add_row("phase reliance, 0 to 1", f"{reliance.score:.3f}{interval}")
    if reliance.order_free_score is not None:
        table.add_row("  without whole periods", f"{reliance.order_free_score:.3f}")
    for words, part in reliance.parts.titled().items():
        if part is not None:
            table.add_row(words, f"{part:.3f}")
    return table


@command(
    """\
fpp-bench robustness phase --quick --out robustness                    a look, some minutes
fpp-bench robustness phase --out robustness                            the test set, resumable axis by axis
fpp-bench robustness classical --steps 6 --set unseen --axes motion,gloss --out robustness-unseen
fpp-bench robustness fringe-net --out robustness --into leaderboard/rows/fringe-net-horizontal.json
fpp-bench robustness unet-global-rmse --size 224 --out robustness-224
fpp-bench robustness phase --out s3://bucket/robustness --cluster ray://head:10001
""",
    MethodCommand,
)
def robust(
    *,
    chosen: MethodSettings,
    pool: Pool,
    out: Path | RemoteFolder = option(
        REQUIRED,
        "folder of measurements: each method has its own below it, and one page shows all; or a "
        "URL",
        "DIR",
        parse=place,
    ),
    axes: tuple[str, ...] = option(
        (), "only these axes (default: all that apply to the method)", "A,B", parse=names
    ),
    objects: Literal["test", "unseen"] = option("test", "objects (default: test)", flag="--set"),
    size: int = option(FULL_SIZE, f"image size (default: {FULL_SIZE})", "PX"),
    quick: bool = option(False, "one view of each object and three severities, for a look"),
    into: Path | None = option(
        None,
        "write the block into this result or row of the same method (.json); needs all axes",
        "FILE",
    ),
    cache: Path | None = option(
        None,
        "rendered frames, at most 10 GB (default: the user's cache folder; with --cluster none)",
        "DIR",
    ),
    no_cache: bool = option(False, "render every frame anew, keep none"),
) -> None:
    """Measure what breaks a method: scenes disturbed axis by axis, at five severities each, in the
    image formation.

    A file that can't take the block raises FppBenchError before measuring."""
    workers = pool.processes
    if into is not None and (axes or quick):
        raise PredictionError("--into: needs all axes and severities; leave out --axes and --quick")
    rig = chosen.method.scenes_rig(chosen.options)
    settings = Condition(CLEAN, 0, SETS[objects], size, rig).settings
    method = chosen.load(Scenes.of(settings), warn=False)
    entry = None if into is None else read_entry(into)
    if entry is not None:
        check_same_method(entry.path, entry.row.submission, method)
    setup = Setup(method, objects, size, quick)
    # The nodes of a cluster have folders of their own, which nobody would keep small.
    cache = None if no_cache else cache or (None if pool.cluster else CACHE)
    views = sum(
        len(c.objects) * len(setup.views)
        for axis in setup.axes(axes)
        for c in setup.conditions(axis)
    )
    with working_copy(out) as (below, save):
        folder = below / slug(setup)
        with progress_bar(f"{chosen.name}, {objects}", views, "views") as advance:
            rows = measure_robustness(
                setup, folder, axes, workers, cache, advance, pool.cluster, save
            )
        page = f"{out}/{write_page(below).name}"
    if entry is not None:
        write_block(entry, robustness_block(setup, rows))
    show(_table(setup, rows))
    print(f"{page}: curves of all methods measured there")


class Scenes(NamedTuple):
    """What a method is chosen for, in place of a dataset: the scenes are rendered when they are
    needed."""

    path: Path
    rig: Rig
    size: tuple[int, int]
    sequence: AnySequence
    manifest: Manifest

    @classmethod
    def of(cls, settings: BuildSettings) -> "Scenes":
        """The scenes that ``settings`` would build."""
        rig, manifest = settings.rig, assembly_of(settings).manifest
        return cls(Path("the robustness scenes"), rig, manifest.size, rig.sequence, manifest)


def slug(setup: Setup) -> str:
    """Name of a measurement's folder."""
    plain = re.sub(r"[^a-z0-9]+", "-", setup.method.title.casefold()).strip("-")[:80]
    return f"{plain}-{setup.set_name}-{setup.size}{'-quick' if setup.quick else ''}"


def _table(setup: Setup, rows: dict[str, list[View]]) -> Table:
    """Errors by axis, clean and at each severity; shares at the last severity."""
    severities = (0, *setup.severities)
    columns = [f"severity {severity}" if severity else "clean" for severity in severities]
    columns += ["wrong orders", "missed", "invented", "answered, mm", "confident errors"]
    table = Table("axis", numbers=columns, title=f"{setup.method.title}: two-sided MAE in mm")
    for axis, views in rows.items():
        means = severity_means(views)
        last = means[max(means)]
        cells = [
            millimetres(means[severity]["mae_mm"]) if severity in means else ""
            for severity in severities
        ]
        shares = [
            percent(last[key], 2) for key in ("wrong_share", "unanswered_share", "invented_share")
        ]
        table.add_row(
            axis,
            *cells,
            *shares,
            millimetres(last["answered_mae_mm"]),
            percent(last["confident_share"]),
        )
    return table
