"""Scoring speed: the whole `fpp-eval` command against two scripts, each as a process of its own.

    python benchmarks/eval_speed.py [--size 960] [--samples 30] [--repeats 7]

- ``fpp-eval PREDICTIONS DATASET --json FILE``: imports, reading, hashing, checking, all scores,
  intervals, table and result file.
- `LOAD`: imports NumPy and loads the predictions and targets, nothing else.
- `PLAIN`: what a careful user writes: loads the same files, checks shapes and values, and computes
  the six headline scores with NumPy boolean masks in float64, averaged over samples.

Both scripts read the targets as .npy files, which is faster than any dataset format. Each round
runs all three, one after the other; times are medians over the rounds, wall time and processor time
(the sum over all cores). The six scores of `PLAIN` are compared with those in the command's result
file. The object covers a tenth of each image, as in the paper's test split.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import TEST_OBJECTS, VIEWS
from fpp_ml_bench.evaluation.metrics import HEADLINE
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import ShardWriter, plan_shards
from fpp_ml_bench.optics.named_rigs import paper_rig

COVER = 0.1
COMMAND = Path(sys.executable).with_name("fpp-eval")
LOAD = """\
import sys
from pathlib import Path
import numpy as np
for folder in sys.argv[1:]:
    for path in sorted(Path(folder).glob("*.npy")):
        np.load(path)
"""
PLAIN = """\
import json, sys
from pathlib import Path
import numpy as np
predictions, targets = map(Path, sys.argv[1:])
scores = []
for path in sorted(predictions.glob("*.npy")):
    prediction, target = np.load(path), np.load(targets / path.name)
    if prediction.shape != target.shape or not np.isfinite(prediction).all():
        sys.exit(f"{path}: wrong shape, or values that are not finite")
    error = prediction.astype(np.float64) - target
    inside = target > 0
    row = []
    for pixels in (np.ones(target.shape, bool), inside, ~inside):
        row += [np.abs(error[pixels]).mean(), np.sqrt((error[pixels] ** 2).mean())]
    scores.append(row)
print(json.dumps(np.mean(scores, axis=0).tolist()))
"""
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


def prepare(data: Path, predictions: Path, targets: Path, size: int, samples: int) -> None:
    """Write a dataset of ``samples`` views, predictions with 2 mm of noise, and the targets as
    .npy."""
    for path in (data, predictions, targets):
        path.mkdir(parents=True)
    names = [(f"{name}_{view}", name, view) for name in TEST_OBJECTS for view in VIEWS][:samples]
    objects: dict[str, list[tuple[str, str, str]]] = {}
    for sample in names:
        objects.setdefault(sample[1], []).append(sample)
    plans, receipts = plan_shards("test", objects), []
    manifest = Manifest(
        "generated", {}, {}, paper_rig(960).to_dict(), (size, size), "single_shot", exact=False
    )
    for number, plan in enumerate(plans):
        rows: list[Row] = []
        for sample, name, view in plan.samples:
            depth = depth_map(size, 100 * number + len(rows))
            noise = np.random.default_rng(len(rows)).normal(0, 2, depth.shape)
            np.save(predictions / f"{sample}.npy", (depth + noise).astype(np.float32))
            np.save(targets / f"{sample}.npy", depth)
            rows.append(Row(sample, name, view, {0: np.zeros(depth.shape, np.uint8)}, depth, None))
        receipts.append(ShardWriter(manifest).write(data, plan, rows))
    Assembly(plans, lambda plan, folder: (), manifest).filled(receipts).write(data)
    (predictions / "submission.yaml").write_text(_DESCRIPTION)


def seconds(command: list[str], bytecode: Path) -> tuple[float, float, str]:
    """Wall time, processor time and output of a whole process. Compiled modules are kept in
    ``bytecode``."""
    environment = {
        key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"
    }
    environment["PYTHONPYCACHEPREFIX"] = str(bytecode)
    started, before = time.perf_counter(), os.times()
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, env=environment)
    after = os.times()
    wall = time.perf_counter() - started
    used = (
        after.children_user + after.children_system - before.children_user - before.children_system
    )
    return wall, used, done.stdout.decode()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=960, help="image height and width in px")
    parser.add_argument("--samples", type=int, default=30, help="samples of the split, at most 30")
    parser.add_argument("--repeats", type=int, default=7, help="rounds")
    args = parser.parse_args()
    if not COMMAND.is_file():
        sys.exit(
            f"expected the command fpp-eval at {COMMAND}; install the package into this environment"
        )
    with tempfile.TemporaryDirectory(prefix="eval-speed-") as folder:
        data, predictions, targets, result, bytecode = (
            str(Path(folder) / name)
            for name in ("data", "predictions", "targets", "result.json", "bytecode")
        )
        prepare(Path(data), Path(predictions), Path(targets), args.size, args.samples)
        commands = {
            "fpp-eval": [str(COMMAND), predictions, data, "--json", result],
            "load": [sys.executable, "-c", LOAD, predictions, targets],
            "plain": [sys.executable, "-c", PLAIN, predictions, targets],
        }
        outputs = {
            name: seconds(command, Path(bytecode))[2] for name, command in commands.items()
        }  # warms up
        rounds = [
            {name: seconds(command, Path(bytecode)) for name, command in commands.items()}
            for _ in range(args.repeats)
        ]
        metrics = json.loads(Path(result).read_text())["metrics"]
    wall, used = (
        {name: statistics.median(times[name][kind] for times in rounds) for name in commands}
        for kind in (0, 1)
    )
    print(f"{args.samples} samples of {args.size}x{args.size} px, median of {args.repeats} rounds")
    print(
        f"fpp-eval, every check and score: {wall['fpp-eval']:.2f} s wall, {used['fpp-eval']:.2f} s "
        f"processor"
    )
    for name, title in (
        ("load", "only loading the same files"),
        ("plain", "the six headline scores in plain NumPy"),
    ):
        print(
            f"{title}: {wall[name]:.2f} s wall, {used[name]:.2f} s processor; fpp-eval takes "
            f"{wall['fpp-eval'] / wall[name]:.1f} times the wall time, "
            f"{used['fpp-eval'] / used[name]:.1f} times the "
            "processor time"
        )
    plain = dict(zip(HEADLINE, json.loads(outputs["plain"]), strict=True))
    difference = max(abs(metrics[key] - plain[key]) / plain[key] for key in HEADLINE)
    print(f"largest relative difference of the six scores: {difference:.0e}")


if __name__ == "__main__":
    main()
