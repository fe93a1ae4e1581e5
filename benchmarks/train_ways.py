"""The two training loops that `train_speed` compares, each in its own process: our engine and a plain PyTorch loop."""

import contextlib
import resource
import statistics
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.baselines.training import DepthTraining, Recipe, load_recipe, open_data, reproducible
from fpp_ml_bench.constants import PUBLISHED_SPLIT_FOLDERS
from fpp_ml_bench.loaders.published import DEPTH, FRINGE, TRAINING, VARIABLES, VARIANT_FOLDERS
from fpp_ml_bench.loaders.training import FringeDepth

ENOUGH_S = 3.0
"""Seconds for which a step is timed, at least three times."""


class Job(NamedTuple):
    """Settings of a process: ``data`` is the dataset for our engine, the exported tree for the plain loop."""

    data: Path
    scratch: Path
    network: str
    size: int
    width: int
    batch: int
    threads: int | None
    loader_workers: int = 0


class Epoch(NamedTuple):
    """Seconds a step, the epoch's mean loss, GiB. ``data`` and ``compute`` are 0 where they were not timed apart."""

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
        self.engine.sampler.epoch += 1
        return self.engine.loader

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
        self.network = networks.build(job.network, width=job.width).to(self.device)
        self.optimizer = torch.optim.RMSprop(self.network.parameters(), lr=1e-4, alpha=0.99, weight_decay=1e-5)
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
    """The published tree's training pairs, one file each: fringe / 255 and individually normalised depth."""

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


def step_seconds(job: Job) -> float | None:
    """Median seconds of the engine's step on random images in place; None where the memory does not suffice."""

    class Nothing:
        source = SimpleNamespace(fingerprint="")
        range_rule = "valid"

        def __len__(self) -> int:
            return job.batch

    training = DepthTraining(recipe_of(job, compiled=False), Nothing(), Nothing(), job.scratch)  # type: ignore[arg-type]
    image = torch.rand(job.batch, 1, job.size, job.size, device=training.accelerator.device)
    rows = torch.arange(job.batch)
    batch = FringeDepth(image, image * (image > 0.9), torch.zeros(job.batch, 2), rows, rows)
    for module in training.objective.modules.values():
        module.train()
    seconds: list[float] = []
    try:
        float(training.step(batch)["loss"])
        while len(seconds) < 3 or (sum(seconds) < ENOUGH_S and len(seconds) < 30):
            started = perf_counter()
            float(training.step(batch)["loss"])
            seconds.append(perf_counter() - started)
    except torch.cuda.OutOfMemoryError:
        return None
    return statistics.median(seconds)
