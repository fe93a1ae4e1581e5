"""What a training writes down: its checkpoint, its log, its curve, and the progress bar.

The checkpoint is a safetensors file, never a pickle, of networks, optimisers, schedule and history.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from pydantic import TypeAdapter
from rich import progress as bar
from rich.console import Console
from torch import Tensor, nn
from torch.optim import Optimizer

from fpp_ml_bench.baselines.training.weights import Family, file_bytes, read_file
from fpp_ml_bench.errors import TrainingError, WeightsError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.style import figure, figure_png, styled

LOG_FILE, CURVE_FILE = "log.jsonl", "curve.png"
Item = TypeVar("Item")
State = dict[str, Tensor]
Record = dict[str, Any]
CHECKPOINTS = Family("fpp-ml-bench training", TypeAdapter(Record), "RECIPE", nn.Module)


def optimizer_tensors(optimizer: Optimizer, prefix: str) -> State:
    """The optimiser's state as tensors, ``prefix.parameter number.key``."""
    state = optimizer.state_dict()["state"]
    items = ((f"{prefix}.{number}.{key}", v) for number, values in state.items() for key, v in values.items())
    return {name: value for name, value in items if isinstance(value, Tensor)}


def restore_optimizer(optimizer: Optimizer, tensors: State, prefix: str) -> None:
    """Put back what `optimizer_tensors` took; the rate and other settings stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(f"{prefix}."):
            number, key = name[len(prefix) + 1 :].split(".", 1)
            state.setdefault(int(number), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def save_checkpoint(path: Path, tensors: State, state: Record) -> None:
    """Write ``tensors`` and the JSON mapping ``state``, sealed with a digest of both."""
    write_atomically(path, file_bytes(CHECKPOINTS, {**state, "sha256": _seal(tensors, state)}, tensors))


def read_checkpoint(path: Path) -> tuple[State, Record]:
    """What `save_checkpoint` wrote. TrainingError for a file that is cut off, changed or something else."""
    cure = f"delete {path} to train again from the start"
    try:
        state, tensors, _ = read_file(path, CHECKPOINTS)
    except WeightsError as error:
        raise TrainingError(f"{error}; {cure}") from None
    if state.pop("sha256", None) != _seal(tensors, state):
        raise TrainingError(f"{path}: its content does not match its own checksum, it was damaged; {cure}")
    return tensors, state


def _seal(tensors: State, state: Record) -> str:
    digest = sha256(json.dumps(state, sort_keys=True, allow_nan=False).encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].detach().cpu().contiguous().numpy().reshape(-1).view("uint8").data)
    return digest.hexdigest()


def write_log(folder: Path, history: list[Record]) -> None:
    """``log.jsonl``: a line for each record: step or epoch (from 1), rate, losses, scores in mm, seconds."""
    lines = "".join(json.dumps(record, allow_nan=False) + "\n" for record in history)
    write_atomically(folder / LOG_FILE, lines.encode("utf-8"))


@dataclass(frozen=True)
class Panel:
    """A diagram of the curve: ``lines`` of a label (none: ``_``), its x and its y; a single point becomes a mark."""

    title: str
    x_label: str
    lines: dict[str, tuple[Sequence[float], Sequence[float]]]
    log: bool = False

    @classmethod
    def of(cls, title: str, history: list[Record], x: str, labels: Mapping[str, str], log: bool = False) -> "Panel":
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
        axes.set(title=panel.title, xlabel=panel.x_label, **({"yscale": "log"} if panel.log else {"ylim": (0, None)}))
        axes.grid()
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        if not all(label.startswith("_") for label in panel.lines):
            axes.legend()
    drawn.suptitle(title)
    write_atomically(path, figure_png(drawn))


class Display:
    """A rich progress bar on standard error over at most ``steps`` steps; silent when ``show`` is False."""

    def __init__(self, name: str, steps: int, show: bool) -> None:
        self.progress = bar.Progress(
            bar.TextColumn("{task.description}"),
            bar.BarColumn(bar_width=20),
            bar.TextColumn("{task.fields[state]}"),
            bar.TimeElapsedColumn(),
            bar.TextColumn("left at most"),
            bar.TimeRemainingColumn(),
            console=Console(stderr=True, quiet=not show),
            disable=not show,
        )
        self.task = self.progress.add_task(name, total=steps, state="")

    def __enter__(self) -> "Display":
        self.progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.progress.stop()

    def advance(self, steps: int = 1) -> None:
        """So many more steps are done."""
        self.progress.advance(self.task, steps)

    def followed(self, items: Iterable[Item]) -> Iterator[Item]:
        """``items``, each a step that is done when the next is asked for."""
        for item in items:
            yield item
            self.advance()

    def update(self, steps_done: int, state: str) -> None:
        """All steps so far, now or by an earlier call, and words on where they led."""
        self.progress.update(self.task, completed=steps_done, state=state)
