"""Weights of the networks inside a route, of whatever family: written in half precision, read and checked."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch
from torch import nn

from fpp_ml_bench.baselines.phase_network.network import PhaseNet
from fpp_ml_bench.baselines.training.weights import (
    PHASE_NETWORKS,
    Family,
    NetConfig,
    read_file,
    weights_path,
    write_file,
)
from fpp_ml_bench.errors import NetworkError, WeightsError
from fpp_ml_bench.files import printable

SHIPPED = Path(__file__).resolve().parent / "weights"  # folder of the weights that come with the package
DEFAULT = "phase-net-one-albedo"


@dataclass(frozen=True)
class NetFile:
    """A checked file and the network in it, ready to run."""

    path: Path
    config: NetConfig
    network: PhaseNet
    sha256: str


def save_net(path: Path, network: nn.Module, config: NetConfig, family: Family = PHASE_NETWORKS) -> str:
    """Write ``network`` to ``path`` in half precision, complete or not at all; the file's SHA-256. `WeightsError` for
    tensors that are not finite in half precision, and for a path that can't be written."""
    tensors = {}
    for name, tensor in network.state_dict().items():
        tensors[name] = tensor.detach().cpu().half() if tensor.is_floating_point() else tensor
        if not bool(tensors[name].isfinite().all()):
            raise WeightsError(f"{path}: {name} is not finite in half precision; the training diverged")
    return write_file(path, family, config, tensors)


Network = TypeVar("Network", bound=nn.Module)


def read_net(
    path: Path, build: Callable[..., Network], family: Family = PHASE_NETWORKS
) -> tuple[NetConfig, Network, str]:
    """Configuration, network, float32, and SHA-256 of a file of ``family`` whose options ``build`` takes.
    `WeightsError` for a file that is absent, damaged, of another kind or version, or whose tensors do not fit its
    configuration."""
    shown = printable(str(path), 500)
    config, tensors, digest = read_file(path, family)
    try:
        network = build(**config.options)
        network.load_state_dict({name: t.float() if t.is_floating_point() else t for name, t in tensors.items()})
    except (NetworkError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{shown}: its tensors are not those of its network: {printable(str(error), 300)}") from None
    if not all(bool(torch.isfinite(t).all()) for t in network.state_dict().values()):
        raise WeightsError(f"{shown}: holds values that are not finite; copy or train it again")
    return config, network, digest


def load_net(name_or_path: str | Path = DEFAULT, folded: bool = True, shipped: Path = SHIPPED) -> NetFile:
    """Weights in the folder ``shipped`` or of a file, float32; ``folded``: for inference alone (`PhaseNet.folded`),
    False to train on. Raises what `read_net` raises."""
    path = weights_path(name_or_path, shipped)
    config, network, digest = read_net(path, PhaseNet)
    return NetFile(path, config, network.folded() if folded else network, digest)
