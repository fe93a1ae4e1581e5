"""Scoring speed: the whole command against a bare script that only loads, and the kernel against boolean masking.

    python benchmarks/eval_speed.py [--size 960] [--samples 30] [--repeats 7]

1. `fpp-eval` (everything: imports, reading, hashing, checking, all scores, intervals, table) on 30 samples, against a
   Python script that starts, imports NumPy and ``np.load``s the same predictions and targets. Wall time of whole
   processes and their processor time, run alternately; the ratio is of medians. Two processors are needed for what
   runs beside one another.
2. The headline scores of one sample (MAE and RMSE over the three pixel sets), against plain NumPy boolean masking of
   the three sets, in one process; medians. The numbers are compared as well.

The object covers a tenth of each image, as in the paper's test split.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.acceleration import numba_enabled
from fpp_ml_bench.constants import TEST_OBJECTS, VIEWS
from fpp_ml_bench.evaluation.scores import headline_scores, score_sample
from fpp_ml_bench.frames import PAPER_SEQUENCE
from fpp_ml_bench.loaders.manifest import Manifest, ShardFile
from fpp_ml_bench.loaders.shards import Row, ShardWriter, plan_shards
from fpp_ml_bench.rig import paper_rig

ROOT = Path(__file__).resolve().parent.parent
COVER = 0.1
_COMMAND = "import sys; sys.path.insert(0, sys.argv.pop(1)); from fpp_ml_bench.commands.evaluate import main; main()"
_BARE = "import sys, numpy as np\nfor name in sys.argv[1:]: np.load(name)"
_DESCRIPTION = """\
name: Noise of 2 mm
method: benchmark
units: mm
frames_used: [0]
uses_ground_truth_range: false
seconds_per_sample: null
"""


def depth_map(size: int, seed: int) -> NDArray[np.float32]:
    """A tilted disk with a step in it on an empty background, float32 (size, size) in mm."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:size, :size]
    row, column = rng.uniform(0.4, 0.6, 2) * size
    inside = (rows - row) ** 2 + (columns - column) ** 2 < COVER / np.pi * size * size
    depth = 1800.0 + 0.05 * (columns - column) + 60.0 * (rows > row)
    return np.where(inside, depth, 0.0).astype(np.float32)


def prepare(folder: Path, size: int, samples: int) -> tuple[list[str], list[str]]:
    """Write a dataset, predictions and the targets as .npy; arguments of the command and of the bare script."""
    data, predictions, targets = folder / "data", folder / "predictions", folder / "targets"
    for path in (data / ".build", predictions, targets):
        path.mkdir(parents=True)
    names = [(f"{name}_{view}", name, view) for name in TEST_OBJECTS for view in VIEWS][:samples]
    objects: dict[str, list[tuple[str, str, str]]] = {}
    for sample in names:
        objects.setdefault(sample[1], []).append(sample)
    shards: list[ShardFile] = []
    described: list[dict[str, Any]] = []
    for plan in plan_shards("test", objects):
        rows: list[Row] = []
        for sample, name, view in plan.samples:
            depth = depth_map(size, len(described) + len(rows))
            noise = np.random.default_rng(len(rows)).normal(0, 2, depth.shape)
            np.save(predictions / f"{sample}.npy", (depth + noise).astype(np.float32))
            np.save(targets / f"{sample}.npy", depth)
            rows.append(Row(sample, name, view, {0: np.zeros(depth.shape, np.uint8)}, depth, None))
        written, about = ShardWriter(
            data, data / ".build", plan, PAPER_SEQUENCE, "single_shot", False, (size, size)
        ).write(rows)
        shards += written
        described += about
    (data / ".build").rmdir()
    Manifest(
        origin="generated", generator={}, settings={}, rig=paper_rig(960).to_dict(), size=(size, size),
        stored="single_shot", exact=False, samples={"test": described}, shards=shards,
    ).write(data)  # fmt: skip
    (predictions / "submission.yaml").write_text(_DESCRIPTION)
    command = [sys.executable, "-c", _COMMAND, str(ROOT), str(predictions), "--dataset", str(data)]
    loaded = [str(path) for place in (predictions, targets) for path in sorted(place.glob("*.npy"))]
    return [*command, "--json", str(folder / "result.json")], [sys.executable, "-c", _BARE, *loaded]


def seconds(command: list[str], bytecode: Path) -> tuple[float, float]:
    """Wall and processor time of a whole process. Compiled modules are kept in ``bytecode``, as when installed."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(bytecode)
    started, before = time.perf_counter(), os.times()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, env=environment)
    after = os.times()
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - started, used


def plain_scores(prediction: NDArray, target: NDArray) -> list[float]:
    """The six headline scores as one writes them with NumPy: a difference in float64 and a mask a set."""
    error = prediction.astype(np.float64) - target
    inside = target > 0
    found = []
    for pixels in (np.ones(target.shape, bool), inside, ~inside):
        found += [np.abs(error[pixels]).mean(), np.sqrt((error[pixels] ** 2).mean())]
    return found


def kernel_scores(prediction: NDArray, target: NDArray) -> list[float]:
    """The same six, from the package's kernel."""
    parts = headline_scores(prediction, target, compiled=numba_enabled())
    return [value for stats in parts for value in (stats.mae_mm or 0.0, stats.rmse_mm or 0.0)]


def milliseconds(run: Callable[[], object], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - started)
    return 1000 * statistics.median(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=960, help="image height and width in px")
    parser.add_argument("--samples", type=int, default=30, help="samples of the split, at most 30")
    parser.add_argument("--repeats", type=int, default=7, help="runs of each")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="eval-speed-") as folder:
        command, bare = prepare(Path(folder), args.size, args.samples)
        kept = Path(folder) / "bytecode"
        for warm in (command, bare):
            seconds(warm, kept)
        pairs = [(seconds(command, kept), seconds(bare, kept)) for _ in range(args.repeats)]
    about = f"whole command, {args.samples} samples of {args.size}x{args.size}"
    for place, kind in enumerate(("wall", "processor")):
        ours, theirs = (statistics.median(pair[side][place] for pair in pairs) for side in (0, 1))
        aim = " (target: at most 3)" if kind == "wall" else " (does not depend on how busy the machine is)"
        print(
            f"{about}, {kind} time: {ours:.2f} s, start and load alone {theirs:.2f} s: {ours / theirs:.1f} times{aim}"
        )
    target = depth_map(args.size, 0)
    prediction = (target + np.random.default_rng(0).normal(0, 2, target.shape)).astype(np.float32)
    one, two = kernel_scores(prediction, target), plain_scores(prediction, target)
    apart = max(abs(a - b) / b for a, b in zip(one, two, strict=True))
    runs = 10 * args.repeats
    ours, theirs = (milliseconds(partial(f, prediction, target), runs) for f in (kernel_scores, plain_scores))
    everything = milliseconds(lambda: score_sample(prediction, target), runs)
    kind = "compiled" if numba_enabled() else "NumPy"
    print(f"headline scores of one sample: kernel ({kind}) {ours:.2f} ms, masking {theirs:.2f} ms: "
          f"{theirs / ours:.1f} times as fast (target: at least 10); largest difference {apart:.0e}")  # fmt: skip
    print(f"every score of one sample (edges, bands, order statistics): {everything:.2f} ms")


if __name__ == "__main__":
    main()
