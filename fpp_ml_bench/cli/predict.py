"""``fpp-bench predict`` and ``fpp-bench time``: run a method over a split, and measure what it
costs."""

import sys
from pathlib import Path

from rich.table import Table
from rich.text import Text

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.run import explain_predict, predict_split
from fpp_ml_bench.baselines.timing import (
    check_same_method,
    check_target,
    time_method,
    write_timing,
)
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import COUNT, SPLITS, Explain, command, new_file
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.evaluation.result.parts import Timing
from fpp_ml_bench.evaluation.submission.description import read_submission
from fpp_ml_bench.evaluation.submission.prediction_files import REFUSED_FILE, SUBMISSION_FILE
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.storage.manifest import datasets_below
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.remote import RemoteFolder, place, working_copy


@command(
    """\
fpp-bench predict classical data/mini --split test --out predictions
fpp-bench predict classical data/mini --split test --steps 4 --direction vertical --out predictions-4
fpp-bench predict unet.safetensors data/mini --out predictions-unet
fpp-bench predict phase data/mini --frames 3 --out predictions-3
fpp-bench predict phase data/mini --error-mm 3 --out predictions-fewest     frames chosen scene by scene
fpp-bench predict mine.py:Mine data/mini --out predictions-mine             a method of yours
fpp-bench predict crossed data/rigs --out predictions-rigs                  all rigs of a track
fpp-eval predictions --target depth_exact --json result.json
""",
    MethodCommand,
)
def predict(
    *,
    chosen: MethodSettings,
    dataset: Path = argument("dataset folder, or a folder of datasets", "DATASET"),
    split: str = option("test", "default: test", choices=SPLITS),
    out: Path | RemoteFolder = option(
        REQUIRED,
        "new or empty folder, or a URL, written at the end; a run that was stopped continues",
        "DIR",
        parse=place,
    ),
    account: Explain,
) -> None:
    """Run a method over a split and write predictions that fpp-eval scores."""
    if datasets := datasets_below(dataset):
        _predict_all(chosen, datasets, split, out)
        print(f"next: fpp-eval {out} {dataset} --json rigs.json")
        return
    opened = DatasetFolder(dataset)
    method = chosen.load(opened)
    if method.caution:
        print(f"{chosen.name}: {method.caution}", file=sys.stderr)
    opened = opened.without_truth()  # the method can look at its caller
    samples = len(opened.samples(split))
    bar = progress_bar(f"{chosen.name}, {split}", samples, "samples", shown=False)
    with working_copy(out) as (folder, _), bar as advance:
        seconds = predict_split(opened, method, split, folder, advance)
    print(f"{out}: {_predicted(method, samples, seconds)}")
    how = f"{_scoring(method, opened)} --json result.json"
    if isinstance(out, Path):
        print(f"next: fpp-eval {out}{how}")
    else:
        print(f"next: copy {out} to a disk, then: fpp-eval COPY {dataset}{how}")
    account.say(lambda: explain_predict(opened, method, split))


def _predicted(method: Method, samples: int, seconds: float) -> str:
    frames = "1 frame" if len(method.frames_used) == 1 else f"{len(method.frames_used)} frames"
    return (
        f"{samples} predictions by {method.title}; {frames} and {seconds:.3f} s a sample (median)"
    )


def _predict_all(
    chosen: MethodSettings, datasets: dict[str, Path], split: str, out: Path | RemoteFolder
) -> None:
    """Predict each of ``datasets`` into a folder of its name, finished ones kept. Where the method
    can't be for the rig, the folder says so. Raises `SubmissionError` for predictions of another
    method there."""
    _ = chosen.method  # an unknown method is refused by no rig
    opened = {name: DatasetFolder(place) for name, place in datasets.items()}
    samples = sum(len(dataset.samples(split)) for dataset in opened.values())
    said = {}
    bar = progress_bar(f"{chosen.name}, {split}", samples, "samples", shown=False)
    with working_copy(out) as (below, save), bar as advance:
        for name, dataset in opened.items():
            count, folder = len(dataset.samples(split)), below / name
            try:
                method = chosen.load(dataset)
            except PredictionError as refusal:
                folder.mkdir(parents=True, exist_ok=True)
                write_atomically(folder / REFUSED_FILE, f"{refusal}\n".encode())
                said[name] = f"refused: {refusal}"
                advance(count)
                continue
            if (folder / SUBMISSION_FILE).is_file():
                check_same_method(folder, read_submission(folder), method)
                said[name] = f"{count} predictions, complete already"
                advance(count)
                continue
            seconds = predict_split(dataset.without_truth(), method, split, folder, advance)
            said[name] = _predicted(method, count, seconds)
            save()
    for name, words in said.items():
        print(f"{out / name}: {words}")


def _scoring(method: Method, opened: "DatasetFolder") -> str:
    """Options of fpp-eval that make the method's row: a network is scored against the decoded depth
    that it learnt from, but against that depth the process that made it would score 0."""
    target = method.target if opened.has_exact else "depth"
    mode = "" if method.mode == "standard" else f" --mode {method.mode}"
    return mode + ("" if target == "depth" else f" --target {target}")


@command(
    """\
fpp-bench time classical data/mini
fpp-bench time classical data/mini --steps 4 --direction vertical --batch 8 --json timing.json
fpp-bench time unet.safetensors data/mini --threads 2
fpp-bench time classical data/mini --into predictions/submission.yaml --into result.json
""",
    MethodCommand,
)
def time(
    *,
    chosen: MethodSettings,
    dataset: Path = argument("dataset folder", "DATASET"),
    split: str = option("test", "default: test", choices=SPLITS),
    batch: int = option(4, "images a batch (default: 4)", "N", parse=COUNT),
    repeats: int = option(20, "timed runs (default: 20)", "N", parse=COUNT),
    json: Path | None = option(
        None, "write the timing here; - is standard output", "FILE", parse=new_file
    ),
    into: tuple[Path, ...] = option(
        (),
        "put it into this submission.yaml or result file of the same method; may be given again",
        "FILE",
        many=True,
    ),
) -> None:
    """Measure a method's latency at batch 1, throughput, memory, parameters and frames, on a named
    machine."""
    opened = DatasetFolder(dataset)
    method = chosen.load(opened)
    opened = opened.without_truth()
    for path in into:
        check_target(path, method)
    with progress_bar(f"timing {chosen.name}", repeats, "images") as advance:
        timing = time_method(opened, method, split, batch, repeats, advance)
    if json is not None:
        content = {"name": method.title, "method": method.name, "settings": dict(method.settings)}
        write_json({**content, "timing": timing.model_dump(mode="json")}, json)
    for path in into:
        write_timing(path, timing)
    show(_timing_table(method.title, timing))
    for path in (*([json] if json else []), *into):
        print(f"Written: {path}")


def _timing_table(title: str, timing: Timing) -> Table:
    def mib(value: float | None) -> str:
        return "unknown" if value is None else f"{value:,.0f} MiB"

    (height, width), machine = timing.image_size, timing.hardware
    table = Table(
        "", show_header=False, title=Text(f"{title}, measured here"), title_justify="left"
    )
    table.add_column(justify="right", overflow="fold")
    ways = "at once" if timing.batched else "one after another"
    rows = {
        "latency at batch 1, median": f"{timing.latency_median_ms:.4g} ms",
        "  5th to 95th percentile": f"{timing.latency_p5_ms:.4g} to {timing.latency_p95_ms:.4g} ms",
        "  runs": f"{timing.repeats}, images of {width}x{height} px",
        f"throughput at batch {timing.batch}": f"{timing.throughput_per_s:.4g} images/s, {ways}",
        "frames needed": str(timing.frames),
        "parameters": f"{timing.parameters:,}",
        "memory one image adds": mib(timing.working_memory_mib),
        "peak memory of the process": mib(timing.peak_memory_mib),
        "peak GPU memory": "" if timing.gpu_memory_mib is None else mib(timing.gpu_memory_mib),
        "device": timing.device,
        "machine": f"{machine.gpu or 'no GPU'}; {machine.cpu}, {machine.cores} cores, {machine.memory_gib} GiB",
    }
    for name, value in rows.items():
        if value:
            table.add_row(name, Text(value))
    return table
