"""A user's torch module as a subject: ``path/to/file.py:factory``."""

import hashlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from fpp_ml_bench.baselines.diagnostics.subjects import (
    FACTORY_MARK,
    NORMALISATION_OF,
    Frames,
    OutputUnits,
    Subject,
    checked_output,
    direction_of,
    select_layers,
)
from fpp_ml_bench.baselines.networks import fringe_batch
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import DiagnosisError, FppBenchError
from fpp_ml_bench.files import printable

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

_LONGEST_MESSAGE = 400


def subject_of_factory(
    name: str, dataset: "DatasetFolder", layers: Sequence[str] | None, units: OutputUnits, frame: int, threads: int
) -> Subject:
    """The module that ``file.py:factory`` makes, as a subject. It is run on a sample, so that misfits show early.

    The file is the user's own code and is executed. Raises `DiagnosisError` for a file, factory, layer, frame or output
    that can't be used; its message quotes errors of the user's code.
    """
    if units not in NORMALISATION_OF:
        raise DiagnosisError(f"unknown units {units!r}; there are {', '.join(NORMALISATION_OF)}")
    if not 0 <= frame < len(dataset.sequence):
        raise DiagnosisError(f"frame {frame}: expected 0 to {len(dataset.sequence) - 1}, the frames of the sequence")
    torch.set_num_threads(threads)
    path, factory = _factory(name)
    network = _build_network(name, factory)
    normalisation = NORMALISATION_OF[units]

    def predict(frames: Frames) -> NDArray[np.float32]:
        image = frames[frame]
        if image is None:
            raise DiagnosisError(f"{name} needs frame {frame}, which is missing")
        batch = fringe_batch([image], dataset.size, name)
        with torch.inference_mode():
            values = checked_output(_run(name, network, batch), batch, name)[0, 0].numpy()
        return values if units == "normalised" else denormalise(values, normalisation, 0.0, 0.0).astype(np.float32)

    user_subject = Subject(
        name=path.stem,
        title=f"{path.name}:{name.rpartition(':')[2]}",
        sha256=_digest(path, network, units, frame),
        units="normalised" if units == "normalised" else "mm",
        image_size=dataset.size,
        frames_used=(frame,),
        direction=direction_of(dataset, (frame,)),
        predict_frames=predict,
        normalisation=normalisation,
        network=network,
        layer_names=select_layers(layers, _layers(network, bool(layers)), name),
        find_layers=lambda model: _layers(model, bool(layers)),
        untrained=lambda seed: randomised(_build_network(name, factory), seed),
    )
    first = next((sample for split in dataset.splits for sample in dataset.samples(split)), None)
    if first is None:
        raise DiagnosisError(f"{dataset.path}: holds no sample")
    user_subject.predict(user_subject.captured(dataset, first))
    return user_subject


def randomised(network: nn.Module, seed: int) -> nn.Module:
    """``network`` with random weights, changed in place.

    Layers with ``reset_parameters`` are initialised again, with the buffers of normalisation layers. The parameters of
    the others are shuffled, which keeps their scale.
    """
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        for module in network.modules():
            reset = getattr(module, "reset_parameters", None)
            if callable(reset):
                reset()
                continue
            for parameter in module.parameters(recurse=False):
                order = torch.randperm(parameter.numel())
                parameter.copy_(parameter.reshape(-1)[order].reshape(parameter.shape))
    return network


def _layers(network: nn.Module, every: bool) -> dict[str, nn.Module]:
    """A module's own ``probe_layers``, else its children; with ``every`` also all modules below it."""
    own = getattr(network, "probe_layers", None)
    if isinstance(own, dict) and not every:
        return own
    named = {name: module for name, module in network.named_modules() if name}
    return {**named, **(own or {})} if every else dict(network.named_children())


def _factory(name: str) -> tuple[Path, Any]:
    file, _, attribute = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise DiagnosisError(f"{file}: no such file; expected path/to/file{FACTORY_MARK}factory")
    spec = importlib.util.spec_from_file_location(f"fpp_bench_user_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise DiagnosisError(f"{file}: can't be imported as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    sys.path.insert(0, str(path.parent.resolve()))  # for imports from its own folder
    try:
        spec.loader.exec_module(module)
    except FppBenchError:
        raise
    except (Exception, SystemExit) as error:  # the user's code can raise anything
        raise DiagnosisError(f"{file}: importing it failed: {_error_text(error)}") from error
    finally:
        sys.path.remove(str(path.parent.resolve()))
    factory = getattr(module, attribute, None)
    if not callable(factory):
        names = ", ".join(key for key, value in vars(module).items() if callable(value) and not key.startswith("_"))
        raise DiagnosisError(f"{file}: holds no function {attribute!r}; there are {names or 'none'}")
    return path, factory


def _build_network(name: str, factory: Any) -> nn.Module:
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # random weights are the same every time
            network = factory()
    except (Exception, SystemExit) as error:
        raise DiagnosisError(f"{name}: calling it without arguments failed: {_error_text(error)}") from error
    if not isinstance(network, nn.Module):
        raise DiagnosisError(f"{name}: expected it to return a torch module, got {type(network).__name__}")
    return network.eval().requires_grad_(False).cpu()


def _run(name: str, network: nn.Module, batch: torch.Tensor) -> Any:
    try:
        return network(batch)
    except FppBenchError:
        raise
    except Exception as error:
        raise DiagnosisError(
            f"{name}: on fringes of shape {tuple(batch.shape)} it failed: {_error_text(error)}"
        ) from error


def _digest(path: Path, network: nn.Module, units: str, frame: int) -> str:
    digest = hashlib.sha256(f"{units} {frame}".encode())
    digest.update(path.read_bytes())
    for key, value in network.state_dict().items():
        if isinstance(value, torch.Tensor):
            digest.update(
                key.encode() + value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes()
            )
    return digest.hexdigest()


def _error_text(error: BaseException) -> str:
    return printable(f"{type(error).__name__}: {error}", _LONGEST_MESSAGE)
