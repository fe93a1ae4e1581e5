"""The trained network on disk: one safetensors file, checked before anything of it is used.

Its metadata is ``format`` (its own: no other reader of this package takes it for a network of its own kind),
``version`` and ``config``, a `NetConfig` as JSON. The same tensors and configuration give the same bytes.
"""

import json
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as checked_dataclass

from fpp_ml_bench.baselines.training import SUFFIX, TrainingBenchmark, weights_path
from fpp_ml_bench.errors import NetworkError, WeightsError
from fpp_ml_bench.evaluation.schema import Count, Scalar, Text, problems_of
from fpp_ml_bench.files import printable, write_atomically

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.phase_network.network import PhaseNet

SHIPPED = Path(__file__).resolve().parent / "weights"
"""Folder of the weights that come with the package."""
DEFAULT = "phase-net"
FORMAT, VERSION = "fpp-ml-bench phase-net", "1"

Finite = Annotated[float, Field(allow_inf_nan=False)]


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid", strict=True, allow_inf_nan=False))
class NetConfig:
    """What the network is, how its answers are used, and what it was trained on.

    ``options``: arguments of `PhaseNet`; ``threshold``: logit from which on a pixel is object; ``lead``: what is added
    to the logit of the base order (see `route.network_answers`), both chosen on the validation split; ``period_px``:
    image px per fringe period of the training images, by direction; ``dataset_fingerprint`` and ``benchmark``: training
    data, the latter None for a dataset of the user's own and in older files; ``steps`` trained; ``recipe``: the
    resolved training recipe; ``validation``: scores."""

    name: Text
    title: Text
    options: dict[Text, Any]
    threshold: Finite
    period_px: dict[Text, Finite]
    dataset_fingerprint: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    benchmark: TrainingBenchmark | None = None
    lead: Finite = 0.0
    steps: Count = 0
    recipe: dict[Text, Any] = field(default_factory=dict)
    validation: dict[Text, Scalar] = field(default_factory=dict)


_CONFIG: TypeAdapter[NetConfig] = TypeAdapter(NetConfig)


@dataclass(frozen=True)
class NetFile:
    """A checked file and the network in it, ready to run."""

    path: Path
    config: NetConfig
    network: "PhaseNet"
    sha256: str


def save_net(path: Path, network: "PhaseNet", config: NetConfig) -> str:
    """Write ``network`` to ``path`` in half precision, complete or not at all; the file's SHA-256.

    Raises `WeightsError` for tensors that are not finite in half precision, and for a path that can't be written.
    """
    from safetensors.torch import save

    from fpp_ml_bench.baselines.training.weights import _ordered_header

    tensors = {}
    for name, tensor in network.state_dict().items():
        stored = tensor.detach().cpu().contiguous().clone()
        tensors[name] = stored.half() if stored.is_floating_point() else stored
        if not bool(tensors[name].isfinite().all()):
            raise WeightsError(f"{path}: {name} is not finite in half precision; the training diverged")
    metadata = {"format": FORMAT, "version": VERSION, "config": _CONFIG.dump_json(config).decode("utf-8")}
    data = _ordered_header(save(tensors, metadata))
    try:
        write_atomically(path, data)
    except OSError as error:
        raise WeightsError(f"{path} can't be written: {error.strerror}; give a folder that exists") from None
    return sha256(data).hexdigest()


def load_net(name_or_path: str | Path = DEFAULT, folded: bool = True) -> NetFile:
    """Configuration and network of shipped weights or of a file, float32; ``folded``: for inference alone
    (`PhaseNet.folded`), False to train on.

    Raises `WeightsError`, naming the file, the expected and the actual content and the cure, for a file that is absent,
    damaged, of another kind or version, or whose tensors do not fit its configuration.
    """
    import torch
    from safetensors import SafetensorError
    from safetensors.torch import load

    from fpp_ml_bench.baselines.phase_network.network import PhaseNet

    path = weights_path(name_or_path, SHIPPED)
    shown = printable(str(path), 500)
    if not path.is_file():
        actual = "a folder" if path.is_dir() else "nothing"
        raise WeightsError(f"{shown}: expected phase-net weights (*{SUFFIX}), found {actual} there")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise WeightsError(f"{shown} can't be read: {error.strerror}") from None
    config = _config(shown, data)
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        raise WeightsError(f"{shown}: damaged ({printable(str(error), 200)}); copy or train it again") from None
    try:
        network = PhaseNet(**config.options)
        network.load_state_dict({name: t.float() if t.is_floating_point() else t for name, t in tensors.items()})
    except (NetworkError, TypeError, ValueError, RuntimeError) as error:
        raise WeightsError(f"{shown}: its tensors are not those of its network: {printable(str(error), 300)}") from None
    if not all(bool(torch.isfinite(t).all()) for t in network.state_dict().values()):
        raise WeightsError(f"{shown}: holds values that are not finite; copy or train it again")
    return NetFile(path, config, network.folded() if folded else network, sha256(data).hexdigest())


def _config(shown: str, data: bytes) -> NetConfig:
    """The checked configuration in the header of a file's ``data``."""
    try:
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > len(data) - 8:
            raise ValueError(f"{len(data)} bytes, cut off or no {SUFFIX} at all")
        metadata = json.loads(data[8 : 8 + length].decode("utf-8"))["__metadata__"]
        header_format = metadata["format"], metadata["version"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise WeightsError(
            f"{shown}: damaged or no phase-net weights ({printable(str(error), 200)}); copy or train it again"
        ) from None
    if header_format != (FORMAT, VERSION):
        raise WeightsError(
            f"{shown}: expected {FORMAT} version {VERSION}, got "
            f"{printable(' version '.join(map(str, header_format)), 100)}; give a file that fpp-bench train phase-net "
            "wrote"
        )
    try:
        return _CONFIG.validate_json(metadata.get("config", ""))
    except ValidationError as error:
        lines = "\n  ".join(problems_of(error))
        raise WeightsError(f"{shown}: its configuration is not valid; train or save it again:\n  {lines}") from None
