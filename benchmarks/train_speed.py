"""A training step of our engine against the plain loop a lab would write, and what a step costs, in the same run.

    python benchmarks/train_speed.py [--size PX] [--width N] [--network unet] [--batch 4] [--objects 8] [--epochs 5]
    python benchmarks/train_speed.py --quick

At the paper's scale on a GPU (960 px, width 64), at the cpu preset's on a processor (224 px, width 8).

Both train the same network from the same weights with RMSE and RMSprop on the same images, which it builds and exports
itself (``fpp-bench build``, ``fpp-bench export --mat``), each in its own process, in turns, epoch by epoch.

- ours: the engine itself (`fpp_ml_bench.baselines.training.engine`) on the memory-mapped Arrow files; on a GPU with
  bfloat16, channels_last and torch.compile as the paper's preset says, on a processor in float32.
- plain: torch's ``Dataset`` and ``DataLoader`` over PNG (cv2) and .mat (scipy), torch's default settings, float32,
  ``loss.item()`` after every step. With ``--loader-workers N`` once more with that many reading processes.
- ours, in torch's default layout: what channels_last gains.

"epoch" is the time of whole epochs without synchronisation, in ms a step; the ratio is taken of it. "data" and
"compute" come from further epochs, in which the GPU is synchronised after each part. Medians over epochs without the
first, which compiles and fills caches. "loss" is that of the last epoch and shows that both learn alike. "GiB" is the
GPU's peak of allocated memory, or the process's peak on a CPU.

The table is the engine's step alone, on random images already in place and without torch.compile.
"""

import argparse
import contextlib
import itertools
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch
from train_ways import Contiguous, Epoch, Job, Ours, Plain, PngAndMat, run_epoch, start, step_seconds, surround

from fpp_ml_bench.constants import OBJECTS, VALIDATION_OBJECTS, split_of
from fpp_ml_bench.loaders.training import FringeDepthDataset
from fpp_ml_bench.machine import describe_hardware

TABLE = {"width": (8, 16, 32), "size": (160, 224, 320), "batch": (1, 2, 4, 8)}
QUICK_TABLE = {"width": (8, 16), "size": (160, 224), "batch": (1, 4)}
GPU, CPU = {"size": 960, "width": 64}, {"size": 224, "width": 8}
QUICK = {"size": 224, "width": 8, "objects": 2, "epochs": 2}


def make_data(scratch: Path, size: int, count: int) -> tuple[Path, Path]:
    """The same samples as a dataset folder and as the published tree: ``count`` training objects of six views."""
    training = [name for name in OBJECTS if split_of(name) == "train"][:count]
    objects = ",".join([*training, VALIDATION_OBJECTS[0]])
    dataset, tree = scratch / "dataset", scratch / "tree"
    command = [sys.executable, "-m", "fpp_ml_bench"]
    root = Path(__file__).resolve().parent.parent
    for arguments in (
        ["build", "--out", dataset, "--size", size, "--objects", objects, "--config", "single_shot"],
        ["export", dataset, "--out", tree, "--mat"],
    ):
        completed = subprocess.run([*command, *map(str, arguments)], cwd=root, capture_output=True, text=True)
        if completed.returncode:
            raise SystemExit(f"fpp-bench {arguments[0]} failed:\n{completed.stderr}")
    return dataset, tree


def check_same(dataset: Path, tree: Path) -> None:
    """Raise `SystemExit` unless both read the same numbers."""
    ours, plain = FringeDepthDataset(dataset, "train", range_rule="object"), PngAndMat(tree)
    names = {path.stem: index for index, path in enumerate(plain.fringes)}
    if len(ours) != len(plain):
        raise SystemExit(f"the dataset holds {len(ours)} training pairs, the exported tree {len(plain)}")
    for index, sample in enumerate(ours.samples):
        pair, (fringe, depth) = ours[index], plain[names[sample]]
        if not (torch.allclose(pair.fringe, fringe, atol=1e-6) and torch.allclose(pair.depth, depth, atol=1e-6)):
            raise SystemExit(f"{sample}: the two ways read different numbers")


def compare(args: argparse.Namespace, scratch: Path) -> None:
    dataset, tree = make_data(scratch, args.size, args.objects)
    check_same(dataset, tree)
    job = Job(dataset, scratch, args.network, args.size, args.width, args.batch, args.threads)
    loops: list[tuple[str, type[Ours] | type[Plain], Job]] = [
        ("plain loop, PNG + .mat", Plain, job._replace(data=tree))
    ]
    if args.loader_workers:
        name = f"plain loop, {args.loader_workers} reading processes"
        loops.append((name, Plain, job._replace(data=tree, loader_workers=args.loader_workers)))
    loops += [("ours, in torch's default layout", Contiguous, job), ("ours", Ours, job)]
    whole: list[list[Epoch]] = [[] for _ in loops]
    apart: list[list[Epoch]] = [[] for _ in loops]
    with contextlib.ExitStack() as stack:
        pools = [stack.enter_context(process(start, kind, task)) for _, kind, task in loops]
        for records, split in [(None, False), *[(whole, False), (apart, True)] * args.epochs]:
            for index, pool in enumerate(pools):
                epoch = pool.submit(run_epoch, split).result()
                if records is not None:
                    records[index].append(epoch)
    columns = "".join(f"{column:>10s}" for column in ("epoch", "data", "compute", "loss", "GiB", "faster"))
    print(f"\n{'ms a step':34s}{columns}")
    first = median(whole[0], "step")
    for (name, *_), epochs, parts in zip(loops, whole, apart, strict=True):
        step, data, compute = median(epochs, "step"), median(parts, "data"), median(parts, "compute")
        print(
            f"{name:34s}{1e3 * step:10.1f}{1e3 * data:10.1f}{1e3 * compute:10.1f}{parts[-1].loss:10.4f}"
            f"{parts[-1].memory_gib:10.2f}{first / step:9.2f}x"
        )


def tabulate(args: argparse.Namespace, scratch: Path) -> None:
    axes = QUICK_TABLE if args.quick else TABLE
    job = Job(scratch, scratch, args.network, 0, 0, 0, args.threads)
    print(f"\nThe engine's step, {args.network}: ms, and ms an image\n")
    print(f"{'width':>5s} {'size':>5s}" + "".join(f"{f'batch {batch}':>20s}" for batch in axes["batch"]))
    with process(surround, job) as pool:
        for width, size in itertools.product(axes["width"], axes["size"]):
            cells = []
            for batch in axes["batch"]:
                seconds = pool.submit(step_seconds, job._replace(width=width, size=size, batch=batch)).result()
                cells.append("no memory" if seconds is None else f"{1e3 * seconds:.1f} ({1e3 * seconds / batch:.1f})")
            print(f"{width:5d} {size:5d}" + "".join(f"{cell:>20s}" for cell in cells), flush=True)


def process(initializer: Callable[..., None], *arguments: Any) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, get_context("spawn"), initializer, arguments)


def median(epochs: list[Epoch], part: str) -> float:
    return statistics.median(getattr(epoch, part) for epoch in epochs)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=("unet", "resunet", "hformer"), default="unet")
    parser.add_argument("--size", type=int, help="image width and height in px (default: 960, or 224 without a GPU)")
    parser.add_argument("--width", type=int, help="width of the network (default: 64, or 8 without a GPU)")
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--objects", type=int, default=8, help="training objects, six pairs each (default: 8)")
    parser.add_argument("--epochs", type=int, default=5, help="epochs measured of each kind (default: 5)")
    parser.add_argument("--threads", type=int, help="of torch on the processor (default: torch's own)")
    parser.add_argument("--loader-workers", type=int, default=0, help="also a plain loop with N reading processes")
    parser.add_argument("--no-table", action="store_true", help="leave out the table of step costs")
    parser.add_argument("--quick", action="store_true", help=f"rough, in a minute or two: {QUICK}, a small table")
    args = parser.parse_args()
    scale = GPU if torch.cuda.is_available() else CPU
    options = {name: value for name, value in vars(args).items() if value is not None}
    vars(args).update({**scale, **options, **(QUICK if args.quick else {})})

    machine = describe_hardware()
    where = torch.cuda.get_device_name() if torch.cuda.is_available() else f"{machine.cpu}, {machine.cores} cores"
    print(f"{where}; torch {torch.__version__}, {args.threads or torch.get_num_threads()} threads")
    print(f"{args.network} of width {args.width}, {args.size} px, batches of {args.batch}")
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch:
        compare(args, Path(scratch))
        if not args.no_table:
            tabulate(args, Path(scratch))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
