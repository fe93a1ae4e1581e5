"""A training step of our engine against the plain loop a lab would write, in the same run.

    python benchmarks/train_speed.py [--size PX] [--width N] [--network unet] [--batch 4] [--objects 8] [--epochs 5]
    python benchmarks/train_speed.py --quick

At the paper's scale on a GPU (960 px, width 64), at the cpu preset's on a processor (224 px, width
8).

Both train the same network from the same weights with RMSE and RMSprop on the same images, which it
builds and exports itself (``fpp-bench build``, ``fpp-bench export --mat``), each in its own
process, in turns, epoch by epoch.

- ours: the engine itself (`fpp_ml_bench.baselines.training.engine`) on the memory-mapped Arrow
  files; on a GPU with bfloat16, channels_last and torch.compile as the paper's preset says, on a
  processor in float32.
- plain: torch's ``Dataset`` and ``DataLoader`` over PNG (cv2) and .mat (scipy), torch's default
  settings, float32, ``loss.item()`` after every step. With ``--loader-workers N`` once more with
  that many reading processes.
- ours, in torch's default layout: what channels_last gains.

"epoch" is the time of whole epochs without synchronisation, in ms a step; the ratio is taken of it.
"data" and "compute" come from further epochs, in which the GPU is synchronised after each part.
Medians over epochs without the first, which compiles and fills caches. "loss" is that of the last
epoch and shows that both learn alike. "GiB" is the GPU's peak of allocated memory, or the process's
peak on a CPU.
"""

import argparse
import contextlib
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import torch
from torch.utils.data import DataLoader, Dataset

from fpp_ml_bench.baselines.networks.model import build as build_network
from fpp_ml_bench.baselines.training.depth_training import DepthTraining, open_data
from fpp_ml_bench.baselines.training.engine import reproducible
from fpp_ml_bench.baselines.training.recipe import Recipe, load_recipe
from fpp_ml_bench.constants import OBJECTS, PUBLISHED_SPLIT_FOLDERS, VALIDATION_OBJECTS, split_of
from fpp_ml_bench.loaders.published.tree import DEPTH, FRINGE, TRAINING, VARIABLES, VARIANT_FOLDERS
from fpp_ml_bench.loaders.training import FringeDepth, FringeDepthDataset
from fpp_ml_bench.machine import describe_hardware

GPU, CPU = {"size": 960, "width": 64}, {"size": 224, "width": 8}
QUICK = {"size": 224, "width": 8, "objects": 2, "epochs": 2}


class Job(NamedTuple):
    """Settings of a process: ``data`` is the dataset for our engine, the exported tree for the
    plain loop."""

    data: Path
    scratch: Path
    network: str
    size: int
    width: int
    batch: int
    threads: int | None
    loader_workers: int = 0


class Epoch(NamedTuple):
    """Seconds a step, the epoch's mean loss, GiB. ``data`` and ``compute`` are 0 where they were
    not timed apart."""

    step: float
    data: float
    compute: float
    loss: float
    memory_gib: float


class Ours:
    """The engine: its loader and its step."""

    def __init__(self, job: Job) -> None:
        recipe = recipe_of(job, compiled=torch.cuda.is_available())
        surround(job)
        self.engine = DepthTraining(recipe, *open_data(recipe, job.data), job.scratch / "ours")
        for module in self.engine.objective.modules.values():
            module.train()

    def batches(self) -> Iterable[Any]:
        return self.engine.batches()

    def step(self, batch: FringeDepth) -> torch.Tensor:
        return self.engine.step(batch)["loss"]


class Contiguous(Ours):
    """The engine with its networks in torch's default layout."""

    def __init__(self, job: Job) -> None:
        super().__init__(job._replace(scratch=job.scratch / "contiguous"))
        for module in self.engine.bare.values():
            module.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]


class Plain:
    """A plain PyTorch loop: RMSprop, default settings, the loss read after every step."""

    def __init__(self, job: Job) -> None:
        torch.manual_seed(42)
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self.network = build_network(job.network, width=job.width).to(self.device)
        self.optimizer = torch.optim.RMSprop(
            self.network.parameters(), lr=1e-4, alpha=0.99, weight_decay=1e-5
        )
        self.loader: DataLoader = DataLoader(
            PngAndMat(job.data), batch_size=job.batch, shuffle=True, num_workers=job.loader_workers
        )

    def batches(self) -> Iterable[Any]:
        return ((fringe.to(self.device), depth.to(self.device)) for fringe, depth in self.loader)

    def step(self, batch: Any) -> float:
        fringe, depth = batch
        self.optimizer.zero_grad()
        loss = torch.sqrt(torch.mean((self.network(fringe) - depth) ** 2) + 1e-8)
        loss.backward()
        self.optimizer.step()
        return loss.item()


class PngAndMat(Dataset[tuple[torch.Tensor, torch.Tensor]]):
    """The published tree's training pairs, one file each: fringe / 255 and individually normalised
    depth."""

    def __init__(self, tree: Path) -> None:
        split = tree / TRAINING / VARIANT_FOLDERS["individual"] / PUBLISHED_SPLIT_FOLDERS["train"]
        self.fringes = sorted((split / FRINGE).glob("*.png"))
        self.depths = [split / DEPTH / f"{path.stem}.mat" for path in self.fringes]

    def __len__(self) -> int:
        return len(self.fringes)

    def __getitem__(self, index: int) -> tuple[Any, Any]:
        import cv2
        import scipy.io

        image = cv2.imread(str(self.fringes[index]), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise OSError(f"{self.fringes[index]}: no readable PNG")
        fringe = image.astype("float32") / 255
        depth = scipy.io.loadmat(self.depths[index])[VARIABLES["individual"]].astype("float32")
        return torch.from_numpy(fringe)[None], torch.from_numpy(depth)[None]


def recipe_of(job: Job, compiled: bool) -> Recipe:
    """The paper's base recipe at the job's scale; bfloat16 on a GPU only."""
    return load_recipe("base", "paper").model_copy(
        update={
            "network": job.network,
            "width": job.width,
            "size": job.size,
            "batch": job.batch,
            "compile": compiled,
            "precision": "bf16" if torch.cuda.is_available() else "fp32",
        }
    )


_surroundings = contextlib.ExitStack()
"""Never closed: the engine's settings stay in force until the process ends."""


def surround(job: Job) -> None:
    """Apply to this process the settings that the engine applies around a training."""
    _set_threads(job)
    _surroundings.enter_context(reproducible(recipe_of(job, compiled=False).precision))


def _set_threads(job: Job) -> None:
    if job.threads is not None:
        torch.set_num_threads(job.threads)


_loop: Ours | Plain


def start(kind: type[Ours] | type[Plain], job: Job) -> None:
    """Start a training in this process."""
    global _loop
    _set_threads(job)
    _loop = kind(job)


def run_epoch(apart: bool) -> Epoch:
    """One pass over the data; ``apart`` waits for the GPU between data and compute."""

    def wait() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    data, compute, losses = 0.0, 0.0, []
    wait()
    started = perf_counter()
    batches = iter(_loop.batches())
    while True:
        before = perf_counter()
        batch = next(batches, None)
        if apart:
            wait()
        middle = perf_counter()
        data += middle - before
        if batch is None:
            break
        losses.append(_loop.step(batch))
        if apart:
            wait()
        compute += perf_counter() - middle
    wait()
    seconds = perf_counter() - started
    if torch.cuda.is_available():
        peak = torch.cuda.max_memory_allocated()
    else:
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    steps, loss = len(losses), statistics.mean(map(float, losses))
    return Epoch(seconds / steps, apart * data / steps, apart * compute / steps, loss, peak / 2**30)


def make_data(scratch: Path, size: int, count: int) -> tuple[Path, Path]:
    """The same samples as a dataset folder and as the published tree: ``count`` training objects of
    six views."""
    training = [name for name in OBJECTS if split_of(name) == "train"][:count]
    objects = ",".join([*training, VALIDATION_OBJECTS[0]])
    dataset, tree = scratch / "dataset", scratch / "tree"
    command = [sys.executable, "-m", "fpp_ml_bench"]
    root = Path(__file__).resolve().parent.parent
    for arguments in (
        [
            "build",
            "--out",
            dataset,
            "--size",
            size,
            "--objects",
            objects,
            "--config",
            "single_shot",
        ],
        ["export", dataset, "--out", tree, "--mat"],
    ):
        completed = subprocess.run(
            [*command, *map(str, arguments)], cwd=root, capture_output=True, text=True
        )
        if completed.returncode:
            raise SystemExit(f"fpp-bench {arguments[0]} failed:\n{completed.stderr}")
    return dataset, tree


def check_same(dataset: Path, tree: Path) -> None:
    """Raise `SystemExit` unless both read the same numbers."""
    ours, plain = FringeDepthDataset(dataset, "train", range_rule="object"), PngAndMat(tree)
    names = {path.stem: index for index, path in enumerate(plain.fringes)}
    if len(ours) != len(plain):
        raise SystemExit(
            f"the dataset holds {len(ours)} training pairs, the exported tree {len(plain)}"
        )
    for index, sample in enumerate(ours.samples):
        pair, (fringe, depth) = ours[index], plain[names[sample]]
        if not (
            torch.allclose(pair.fringe, fringe, atol=1e-6)
            and torch.allclose(pair.depth, depth, atol=1e-6)
        ):
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
    columns = "".join(
        f"{column:>10s}" for column in ("epoch", "data", "compute", "loss", "GiB", "faster")
    )
    print(f"\n{'ms a step':34s}{columns}")
    first = median(whole[0], "step")
    for (name, *_), epochs, parts in zip(loops, whole, apart, strict=True):
        step, data, compute = (
            median(epochs, "step"),
            median(parts, "data"),
            median(parts, "compute"),
        )
        print(
            f"{name:34s}{1e3 * step:10.1f}{1e3 * data:10.1f}{1e3 * compute:10.1f}{parts[-1].loss:10.4f}"
            f"{parts[-1].memory_gib:10.2f}{first / step:9.2f}x"
        )


def process(initializer: Callable[..., None], *arguments: Any) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(1, get_context("spawn"), initializer, arguments)


def median(epochs: list[Epoch], part: str) -> float:
    return statistics.median(getattr(epoch, part) for epoch in epochs)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--network", choices=("unet", "resunet", "hformer"), default="unet")
    parser.add_argument(
        "--size", type=int, help="image width and height in px (default: 960, or 224 without a GPU)"
    )
    parser.add_argument(
        "--width", type=int, help="width of the network (default: 64, or 8 without a GPU)"
    )
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument(
        "--objects", type=int, default=8, help="training objects, six pairs each (default: 8)"
    )
    parser.add_argument(
        "--epochs", type=int, default=5, help="epochs measured of each kind (default: 5)"
    )
    parser.add_argument(
        "--threads", type=int, help="of torch on the processor (default: torch's own)"
    )
    parser.add_argument(
        "--loader-workers", type=int, default=0, help="also a plain loop with N reading processes"
    )
    parser.add_argument("--quick", action="store_true", help=f"rough, in a minute: {QUICK}")
    args = parser.parse_args()
    scale = GPU if torch.cuda.is_available() else CPU
    options = {name: value for name, value in vars(args).items() if value is not None}
    vars(args).update({**scale, **options, **(QUICK if args.quick else {})})

    machine = describe_hardware()
    where = (
        torch.cuda.get_device_name()
        if torch.cuda.is_available()
        else f"{machine.cpu}, {machine.cores} cores"
    )
    print(f"{where}; torch {torch.__version__}, {args.threads or torch.get_num_threads()} threads")
    print(f"{args.network} of width {args.width}, {args.size} px, batches of {args.batch}")
    with tempfile.TemporaryDirectory(dir=Path.cwd()) as scratch:
        compare(args, Path(scratch))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
