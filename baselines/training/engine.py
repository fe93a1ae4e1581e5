"""The training loop of all networks, on the devices that `accelerate` finds, or that ``accelerate
launch`` gives it; a batch of the recipe is that of one process.

After each interval (an epoch, or a number of steps) the folder holds all that is needed to resume:
the checkpoint, a safetensors file, never a pickle, of networks, optimisers and history; and the
log. On one processor type and number of threads the same recipe and data give the same bits on the
CPU, stopped and resumed or not.
"""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.state import AcceleratorState
from accelerate.utils import broadcast_object_list, gather_object, set_seed
from pydantic import TypeAdapter
from rich import progress as bar
from rich.console import Console
from torch import Tensor, nn
from torch.optim import Optimizer

from fpp_ml_bench.baselines.networks.base import tiny_floats_are_zero
from fpp_ml_bench.baselines.training.weights import Family, file_bytes, read_file
from fpp_ml_bench.errors import TrainingError, WeightsError
from fpp_ml_bench.files import (
    LOCK_FILE,
    cause_of,
    exclusive,
    printable,
    read_json,
    write_atomically,
)
from fpp_ml_bench.machine import keep_freed_memory
from fpp_ml_bench.style import figure, figure_png, styled
from fpp_ml_bench.tables import words

CHECKPOINT, RECIPE = "checkpoint.safetensors", "recipe.json"
CHECK_EVERY = 16
"""Steps between two checks of the losses: reading a loss makes a GPU wait."""
DIVERGED = 1e6
"""Multiple of the first loss from which on a training counts as diverged."""
LOG_FILE, CURVE_FILE = "log.jsonl", "curve.png"
State = dict[str, Tensor]
Record = dict[str, Any]
CHECKPOINTS = Family("fpp-ml-bench training", TypeAdapter(Record), "RECIPE", nn.Module)


def optimizer_tensors(optimizer: Optimizer, prefix: str) -> State:
    """The optimiser's state as tensors, ``prefix.parameter number.key``."""
    state = optimizer.state_dict()["state"]
    items = (
        (f"{prefix}.{number}.{key}", v)
        for number, values in state.items()
        for key, v in values.items()
    )
    return {name: value for name, value in items if isinstance(value, Tensor)}


def restore_optimizer(optimizer: Optimizer, tensors: State, prefix: str) -> None:
    """Put back what `optimizer_tensors` took; the rate and other settings stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(f"{prefix}."):
            number, key = name[len(prefix) + 1 :].split(".", 1)
            state.setdefault(int(number), {})[key] = value
    optimizer.load_state_dict(
        {"state": state, "param_groups": optimizer.state_dict()["param_groups"]}
    )


def save_checkpoint(path: Path, tensors: State, state: Record) -> None:
    """Write ``tensors`` and the JSON mapping ``state``, sealed with a digest of both."""
    seal = sha256(file_bytes(CHECKPOINTS, state, tensors)).hexdigest()
    write_atomically(path, file_bytes(CHECKPOINTS, {**state, "sha256": seal}, tensors))


def read_checkpoint(path: Path) -> tuple[State, Record]:
    """What `save_checkpoint` wrote. TrainingError for a file that is cut off, changed or something
    else."""
    cure = f"delete {path} to train again from the start"
    try:
        state, tensors, _ = read_file(path, CHECKPOINTS)
    except WeightsError as error:
        raise TrainingError(f"{error}; {cure}") from None
    if state.pop("sha256", None) != sha256(file_bytes(CHECKPOINTS, state, tensors)).hexdigest():
        raise TrainingError(
            f"{path}: its content does not match its own checksum, it was damaged; {cure}"
        )
    return tensors, state


def write_log(folder: Path, history: list[Record]) -> None:
    """``log.jsonl``: a line for each record: step or epoch (from 1), rate, losses, scores in mm,
    seconds."""
    lines = "".join(json.dumps(record, allow_nan=False) + "\n" for record in history)
    write_atomically(folder / LOG_FILE, lines.encode("utf-8"))


@dataclass(frozen=True)
class Panel:
    """A diagram of the curve: ``lines`` of a label (none: ``_``), its x and its y; a single point
    becomes a mark."""

    title: str
    x_label: str
    lines: dict[str, tuple[Sequence[float], Sequence[float]]]
    log: bool = False

    @classmethod
    def of(
        cls, title: str, history: list[Record], x: str, labels: Mapping[str, str], log: bool = False
    ) -> "Panel":
        """The values of the keys ``labels`` over those of ``x``, where there are some."""
        lines: dict[str, tuple[Sequence[float], Sequence[float]]] = {}
        for key, label in labels.items():
            known = [record for record in history if record.get(key) is not None]
            lines[label] = [record[x] for record in known], [record[key] for record in known]
        return cls(title, x, lines, log)


@styled
def draw_curves(path: Path, title: str, panels: Sequence[Panel]) -> None:
    """Write the ``panels`` side by side as the picture ``path``."""
    from matplotlib.ticker import MaxNLocator

    drawn = figure(10, 3.2)
    for axes, panel in zip(drawn.subplots(1, len(panels)), panels, strict=True):
        for label, (x, y) in panel.lines.items():
            axes.plot(x, y, "o" if len(x) == 1 else "-", label=label)
        axes.set(
            title=panel.title,
            xlabel=panel.x_label,
            **({"yscale": "log"} if panel.log else {"ylim": (0, None)}),
        )
        axes.grid()
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        if not all(label.startswith("_") for label in panel.lines):
            axes.legend()
    drawn.suptitle(title)
    write_atomically(path, figure_png(drawn))


class Display(bar.Progress):
    """A progress bar on standard error over at most ``steps`` steps; silent when ``show`` is
    False."""

    def __init__(self, name: str, steps: int, show: bool) -> None:
        super().__init__(
            words("{task.description}"),
            bar.BarColumn(bar_width=20),
            words("{task.fields[state]}"),
            bar.TimeElapsedColumn(),
            words("left at most"),
            bar.TimeRemainingColumn(),
            console=Console(stderr=True, quiet=not show),
            disable=not show,
        )
        self.bar = self.add_task(printable(name), total=steps, state="")

    def step(self, steps: int = 1) -> None:
        """So many more steps are done."""
        self.advance(self.bar, steps)

    def at(self, steps_done: int, state: str) -> None:
        """All steps so far, now or by an earlier call, and words on where they led."""
        self.update(self.bar, completed=steps_done, state=state)


class Training(ABC):
    """A training's state and loop; a subclass says what is trained on what, at which rate, and how
    it is validated. ``objective``: its ``modules`` have an optimiser each. ``bare``: the modules
    themselves, not compiled or distributed, as they are saved. ``identity``: recipe and data, which
    a checkpoint must share. ``interval_steps``: of an interval, but the last may have fewer;
    ``total_steps`` at most."""

    name: str
    title: str
    objective: Any
    optimizers: dict[str, Optimizer]
    bare: dict[str, nn.Module]
    interval_steps: int
    total_steps: int
    largest_gradient: float | None = None

    def __init__(
        self, out: Path, identity: Record, seed: int, precision: str = "fp32", cpu: bool = False
    ) -> None:
        self.out, self.identity = out, dict(identity)
        mixed = "no" if precision == "fp32" else precision
        self.accelerator = Accelerator(
            mixed_precision=mixed, cpu=cpu, gradient_accumulation_steps=1
        )
        set_seed(seed)
        self.history: list[Record] = []
        self.first_loss: float | None = None
        self.before, self.resumed_at = 0.0, 0
        """Seconds of earlier calls, and intervals that they trained."""

    @property
    def steps_done(self) -> int:
        """Steps of all intervals so far."""
        return min(len(self.history) * self.interval_steps, self.total_steps)

    @property
    def over(self) -> bool:
        """Whether it has come to its end."""
        return self.steps_done >= self.total_steps

    @abstractmethod
    def batches(self) -> Iterable[Any]:
        """The batches of the coming interval."""

    @abstractmethod
    def rate(self, number: int) -> float:
        """Learning rate of step ``number`` (from 0) of the coming interval."""

    @abstractmethod
    def validated(self, losses: dict[str, float], began: float) -> Record:
        """The record of an interval that began at ``began`` and had these mean ``losses``; has
        ``seconds``. It is not in `history` yet."""

    @abstractmethod
    def diverged(self, name: str, value: float, number: int) -> str:
        """Words on a loss that is not finite, or far above the first one, at step ``number`` of the
        interval."""

    @abstractmethod
    def progress(self) -> str:
        """Words on the newest record for the progress bar."""

    @abstractmethod
    def panels(self) -> list[Panel]:
        """What the picture of the training shows."""

    def run(self, started: float, minutes: float | None, show: bool) -> float:
        """Train to the end, or until an interval would outlast ``minutes`` since ``started``; one
        is always trained. Returns the seconds so far, those of earlier calls included."""
        with Display(
            self.name, self.total_steps, show and self.accelerator.is_main_process
        ) as display:
            if self.history:
                display.at(self.steps_done, self.progress())
            last_interval_s = 0.0
            while not self.over:
                in_time = (
                    minutes is None or perf_counter() - started + last_interval_s < 60 * minutes
                )
                # The first process decides: clocks differ, and all must train the same intervals.
                if not broadcast_object_list([last_interval_s == 0 or in_time])[0]:
                    break
                began = perf_counter()
                self.history.append(self.validated(self._train_interval(display), began))
                if self.accelerator.is_main_process:
                    self._save()
                    write_log(self.out, self.history)
                self.accelerator.wait_for_everyone()
                display.at(self.steps_done, self.progress())
                last_interval_s = perf_counter() - began
        seconds = round(self.before + perf_counter() - started, 1)
        if self.accelerator.is_main_process and self.history:
            write_log(self.out, self.history)
            draw_curves(self.out / CURVE_FILE, self.title, self.panels())
        return seconds

    def step(self, batch: Any) -> dict[str, Tensor]:
        """Update every module by one batch; what the objective logs."""
        logged: dict[str, Tensor] = {}
        with self.accelerator.autocast():
            for name, loss, values in self.objective.steps(batch):
                optimizer = self.optimizers[name]
                optimizer.zero_grad(set_to_none=True)
                self.accelerator.backward(loss)
                if (largest := self.largest_gradient) is not None:
                    self.accelerator.clip_grad_norm_(
                        self.objective.modules[name].parameters(), largest
                    )
                optimizer.step()
                logged |= values
        return logged

    def resume(self) -> None:
        """Continue from the checkpoint, where there is one. Call it when all modules and optimisers
        are made."""
        if (path := self.out / CHECKPOINT).exists():
            tensors, state = read_checkpoint(path)
            if any(state.get(key) != value for key, value in self.identity.items()):
                raise TrainingError(
                    f"{path}: belongs to another recipe, dataset or depth range; give a new folder"
                )
            for name, module in self.bare.items():
                prefix = f"module.{name}."
                module.load_state_dict(
                    {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
                )
            for name, optimizer in self.optimizers.items():
                restore_optimizer(optimizer, tensors, f"optimizer.{name}")
            self.history, self.first_loss, self.before = (
                state["history"],
                state["first_loss"],
                state["seconds"],
            )
            self.resumed_at = len(self.history)
        if len(set(gather_object([len(self.history)]))) > 1:
            words = "processes found different checkpoints; give a folder that all machines share"
            raise TrainingError(f"{self.out}: {words}")

    def _train_interval(self, display: Display) -> dict[str, float]:
        """One pass over `batches`; the mean over them of everything the objective logs."""
        batches, count = self.batches(), 0
        for module in self.objective.modules.values():
            module.train()
        unchecked: list[tuple[int, dict[str, Tensor]]] = []
        sums: dict[str, float] = {}
        for batch in batches:
            for optimizer in self.optimizers.values():
                for group in optimizer.param_groups:
                    group["lr"] = self.rate(count)
            unchecked.append((count, self.step(batch)))
            count += 1
            if len(unchecked) == CHECK_EVERY:
                self._check_losses(unchecked, sums)
            display.step()
        self._check_losses(unchecked, sums)
        return {name: value / count for name, value in sums.items()}

    def _check_losses(
        self, unchecked: list[tuple[int, dict[str, Tensor]]], sums: dict[str, float]
    ) -> None:
        """Add the losses of the last steps to ``sums``; raise for a loss that is not finite or has
        diverged."""
        for number, logged in unchecked:
            for name, value in logged.items():
                loss = float(value)
                if name == "loss" and self.first_loss is None and math.isfinite(loss):
                    self.first_loss = max(loss, 1e-6)
                if not math.isfinite(loss) or (name == "loss" and loss > self.limit):
                    raise TrainingError(f"{self.out}: {self.diverged(name, loss, number)}")
                sums[name] = sums.get(name, 0.0) + loss
        unchecked.clear()

    @property
    def limit(self) -> float:
        """Loss above which the training has diverged."""
        return DIVERGED * (self.first_loss or math.inf)

    def _save(self) -> None:
        tensors: dict[str, Tensor] = {}
        for name, module in self.bare.items():
            tensors |= {f"module.{name}.{key}": value for key, value in module.state_dict().items()}
        for name, optimizer in self.optimizers.items():
            tensors |= optimizer_tensors(optimizer, f"optimizer.{name}")
        seconds = self.before + sum(record["seconds"] for record in self.history[self.resumed_at :])
        state = {"history": self.history, "first_loss": self.first_loss, "seconds": seconds}
        save_checkpoint(self.out / CHECKPOINT, tensors, {**self.identity, **state})


def alone_in(out: Path) -> AbstractContextManager[None]:
    """Within: no other process trains in ``out``, which is made if it is missing, or
    `TrainingError`."""
    return exclusive(out / LOCK_FILE, out, "training in this folder", TrainingError)


def claim_folder(out: Path, content: dict[str, Any]) -> None:
    """Make ``out`` the folder of the training that ``content`` (``recipe``, and what identifies its
    data) describes, or see that it is. Raises `TrainingError` for a folder of another training or
    of other files."""
    path = out / RECIPE
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(
            f"{out}: expected a training folder, or a new one ({cause_of(error)})"
        ) from None
    existing = read_json(path, TrainingError, "give another folder") if path.exists() else None
    if existing is None:
        # A process that was killed while it wrote the recipe leaves a hidden temporary file.
        if any(
            path.name != LOCK_FILE and not path.name.startswith(f".{RECIPE}.")
            for path in out.iterdir()
        ):
            raise TrainingError(f"{out}: holds files but no {RECIPE}; give a new or empty folder")
        write_atomically(path, (json.dumps(content, indent=1) + "\n").encode("utf-8"))
    elif existing != content:
        existing_recipe = existing.get("recipe", {}) if isinstance(existing, dict) else {}
        differs = [
            key for key, value in content["recipe"].items() if existing_recipe.get(key) != value
        ] or ["dataset"]
        raise TrainingError(
            f"{path}: was made for another training, which differs in {', '.join(differs)}; give "
            f"another folder, or "
            f"remove {out} to train again from the start"
        )


@contextmanager
def reproducible(precision: str = "fp32", cpu: bool = False) -> Iterator[None]:
    """Within: deterministic kernels on the CPU, the fastest ones on a GPU, and freed memory kept
    for the next step. ``cpu``: the training within is one on the processor, whatever GPUs there
    are."""
    # A process may train in fp32 after bf16, or on a GPU after the processor, but accelerate's
    # shared state allows only one precision and device.
    AcceleratorState._reset_state(cpu)
    keep_freed_memory()
    on_gpu = torch.cuda.is_available()
    matmul, cudnn = torch.backends.cuda.matmul, torch.backends.cudnn
    deterministic = torch.are_deterministic_algorithms_enabled()
    before = cudnn.benchmark, matmul.allow_tf32, cudnn.allow_tf32
    torch.use_deterministic_algorithms(not on_gpu)
    cudnn.benchmark = on_gpu
    if precision == "fp32":
        matmul.allow_tf32 = cudnn.allow_tf32 = False
    try:
        with tiny_floats_are_zero():
            yield
    finally:
        torch.use_deterministic_algorithms(deterministic)
        cudnn.benchmark, matmul.allow_tf32, cudnn.allow_tf32 = before
        if cpu:
            AcceleratorState._reset_state(True)
