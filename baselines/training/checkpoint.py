"""A training's whole state in one safetensors file: networks, optimisers, schedule and history. Never a pickle.

Written after every epoch, atomically; the history travels in it, so that the log is always that of the state.
"""

import hashlib
import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from torch.optim import Optimizer

from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically

_FORMAT = "fpp-ml-bench training 1"
State = dict[str, Tensor]


def optimizer_tensors(optimizer: Optimizer, prefix: str) -> State:
    """The optimiser's state as tensors, ``prefix.parameter number.key``."""
    tensors: State = {}
    for number, state in optimizer.state_dict()["state"].items():
        for key, value in state.items():
            if isinstance(value, Tensor):
                tensors[f"{prefix}.{number}.{key}"] = value
    return tensors


def restore_optimizer(optimizer: Optimizer, tensors: State, prefix: str) -> None:
    """Put back what `optimizer_tensors` took; the rate and other settings stay as they are."""
    state: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith(f"{prefix}."):
            number, key = name[len(prefix) + 1 :].split(".", 1)
            state.setdefault(int(number), {})[key] = value
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def save_checkpoint(path: Path, tensors: State, state: dict[str, Any]) -> None:
    """Write ``tensors`` and the JSON mapping ``state``, sealed with a digest of both."""
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps(state, allow_nan=False)
    seal = _seal(contiguous, text)
    write_atomically(path, save(contiguous, {"format": _FORMAT, "state": text, "sha256": seal}))


def read_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """What `save_checkpoint` wrote. TrainingError for a file that is cut off, changed or something else."""
    cure = f"; delete {path} to train again from the start"
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  it is no mapping
    except (SafetensorError, OSError, ValueError) as error:
        raise TrainingError(
            f"{path}: expected a checkpoint of this package, it can't be read ({error}){cure}"
        ) from None
    if metadata.get("format") != _FORMAT:
        raise TrainingError(f"{path}: expected {_FORMAT!r}, got {metadata.get('format')!r}{cure}")
    if metadata.get("sha256") != _seal(tensors, metadata.get("state", "")):
        raise TrainingError(f"{path}: its content does not match its own checksum, it was damaged{cure}")
    return tensors, json.loads(metadata["state"])


def _seal(tensors: State, text: str) -> str:
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().reshape(-1).view("uint8").data)
    return digest.hexdigest()
