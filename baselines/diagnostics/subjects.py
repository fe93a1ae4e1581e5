"""The model under diagnosis: shipped weights, a weights file, a method without a network, or a user's torch module."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.method import METHODS, Method, load_method
from fpp_ml_bench.depth import Normalisation, object_mask
from fpp_ml_bench.errors import DiagnosisError, WeightsError
from fpp_ml_bench.evaluation.protocol import Units
from fpp_ml_bench.optics import Direction

if TYPE_CHECKING:
    from torch import Tensor, nn

    from fpp_ml_bench.loaders.storage import DatasetFolder

Frames = Sequence[NDArray[np.uint8] | None]
"""A captured sequence by frame number, with None for frames that are not needed."""
OutputUnits = Literal["mm", "m", "normalised"]
NORMALISATION_OF: dict[str, Normalisation] = {"mm": "raw", "m": "global", "normalised": "individual"}
FACTORY_MARK = ".py:"


@dataclass(frozen=True, eq=False)
class Subject:
    """A model under diagnosis.

    ``sha256`` identifies the model and its settings. ``units`` of `predict`: mm, or normalised to the sample's own
    depth range. ``frames_used``: numbers of the frames that it needs; ``direction``: their fringe direction, or
    ``both``. With ``uses_ground_truth_mask`` it expects frames that are 0 outside the object, as `captured` gives them.

    ``network`` takes the single frame in ``frames_used`` as (B, 1, H, W) in [0, 1] and outputs depth in the
    representation ``normalisation``. Without a network, it and the following fields are None or empty. ``layer_names``:
    the layers to probe, in forward order. ``untrained(seed)``: the same architecture with random weights.
    ``find_layers``: the layers of any network of that architecture by name. ``weights_sha256``: hash of the weights
    file.
    """

    name: str
    title: str
    sha256: str
    units: Units
    image_size: tuple[int, int]
    frames_used: tuple[int, ...]
    direction: Direction | Literal["both"]
    predict_frames: Callable[[Frames], NDArray[np.float32]]
    uses_ground_truth_mask: bool = False
    normalisation: Normalisation | None = None
    network: "nn.Module | None" = None
    layer_names: tuple[str, ...] = ()
    find_layers: "Callable[[nn.Module], dict[str, nn.Module]] | None" = None
    untrained: "Callable[[int], nn.Module] | None" = None
    weights_sha256: str | None = None

    @property
    def layers(self) -> "dict[str, nn.Module]":
        """The layers to probe of ``network`` by name, in forward order; empty without a network."""
        return {} if self.network is None else self.layers_of(self.network)

    def layers_of(self, network: "nn.Module") -> "dict[str, nn.Module]":
        """The layers to probe of a ``network`` of this architecture, for example of `untrained`."""
        all_layers = {} if self.find_layers is None else self.find_layers(network)
        return {name: all_layers[name] for name in self.layer_names}

    def captured(self, dataset: "DatasetFolder", sample: str) -> list[NDArray[np.uint8] | None]:
        """The frames of ``sample`` that the subject uses, uint8 (H, W), by frame number; None for all others."""
        frames: list[NDArray[np.uint8] | None] = [None] * len(dataset.sequence)
        for index in self.frames_used:
            frames[index] = self.as_input(dataset.frame(sample, index), dataset.depth_mm(sample))
        return frames

    def as_input(self, frame: NDArray[np.uint8], depth_mm: NDArray[np.float32]) -> NDArray[np.uint8]:
        """``frame`` (H, W) as the subject expects it: 0 outside the object if it uses the ground-truth mask."""
        return frame * object_mask(depth_mm) if self.uses_ground_truth_mask else frame

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in ``units``. Raises `DiagnosisError` for an output of another shape or not finite."""
        depth = np.asarray(self.predict_frames(frames))
        if depth.shape != self.image_size:
            raise DiagnosisError(f"{self.name}: expected a prediction of {self.image_size} px, got {depth.shape}")
        if not np.isfinite(depth).all():
            raise DiagnosisError(f"{self.name}: its prediction holds NaN or infinity, so it can't be diagnosed")
        return depth.astype(np.float32, copy=False)

    def input_tensor(self, frames: Frames) -> "Tensor":
        """The input of ``network``: float32 (1, 1, H, W) in [0, 1]. Raises `DiagnosisError` without a network or its
        frame."""
        return self.input_batch([frames])

    def input_batch(self, stacks: Sequence[Frames]) -> "Tensor":
        """`input_tensor` of several samples: float32 (B, 1, H, W)."""
        from fpp_ml_bench.baselines.networks import fringe_batch

        if self.network is None:
            raise DiagnosisError(f"{self.name} has no network, so there is no input to it")
        (index,) = self.frames_used
        images = [frame for frame in (frames[index] for frames in stacks) if frame is not None]
        if len(images) != len(stacks):
            raise DiagnosisError(f"{self.name} needs frame {index}, which is missing")
        return fringe_batch(images, self.image_size, self.name)

    def represent(self, frames: Frames) -> NDArray[np.float32]:
        """The network's output float32 (H, W) in its ``normalisation``.

        Raises `DiagnosisError` as `input_tensor`, and for an output of another shape or with values that are not
        finite.
        """
        import torch

        if self.network is None:
            raise DiagnosisError(f"{self.name} has no network, so it has no network output")
        batch = self.input_tensor(frames)
        with torch.inference_mode():
            return checked_output(self.network(batch), batch, self.name)[0, 0].numpy()


def checked_output(output: "Tensor", batch: "Tensor", name: str) -> "Tensor":
    """``output`` if it is finite and shaped as ``batch`` (B, 1, H, W); else `DiagnosisError`."""
    shape = tuple(getattr(output, "shape", ()))
    if shape != tuple(batch.shape):
        raise DiagnosisError(
            f"{name}: expected an output of shape {tuple(batch.shape)}, one depth per pixel, got "
            f"{shape or type(output).__name__}"
        )
    not_finite = int((~output.isfinite()).sum())
    if not_finite:
        raise DiagnosisError(f"{name}: {not_finite} of {output.numel()} values of its output are NaN or infinite")
    return output.float()


def subject(
    name: str, dataset: "DatasetFolder", layers: Sequence[str] | None = None, units: OutputUnits | None = None,
    frame: int | None = None, threads: int = 1,
) -> Subject:  # fmt: skip
    """The model called ``name``, ready to be diagnosed on ``dataset``.

    ``name``: a method of `fpp_ml_bench.baselines.method.METHODS`, shipped weights, a ``.safetensors`` file, or
    ``file.py:factory``, where ``factory()`` returns a torch module that maps fringes (B, 1, H, W) in [0, 1] to depth
    (B, 1, H, W) in ``units`` (default: normalised). ``layers``: names of the layers to probe, by default the network's
    ``probe_layers``, or every child of a module without them. ``frame``: number of the network's input frame, by
    default the first that it was trained on. ``threads``: torch threads of the process.

    Raises `DiagnosisError` for a name, layer or module that can't be used, and other `FppBenchError` of the model.
    """
    if FACTORY_MARK in name:
        from fpp_ml_bench.baselines.diagnostics.user_module import subject_of_factory

        return subject_of_factory(name, dataset, layers, units or "normalised", 0 if frame is None else frame, threads)
    if units is not None:
        raise DiagnosisError(f"{name}: its units are known; set units only for your own module, file.py:factory")
    if name in METHODS:
        _refuse_options(name, layers=layers, frame=frame)
        return subject_of_method(load_method(name, dataset.rig), dataset)
    return _weights(name, dataset, layers, frame, threads)


def subject_of_method(depth_method: Method, dataset: "DatasetFolder") -> Subject:
    """A method without a network as a subject."""
    return Subject(
        name=depth_method.name,
        title=depth_method.title,
        sha256=_digest(depth_method.name, depth_method.settings),
        units=depth_method.units,
        image_size=dataset.size,
        frames_used=depth_method.frames_used,
        direction=direction_of(dataset, depth_method.frames_used),
        predict_frames=depth_method.predict,
        uses_ground_truth_mask=depth_method.uses_ground_truth_mask,
    )


def _weights(
    name: str, dataset: "DatasetFolder", layers: Sequence[str] | None, frame: int | None, threads: int
) -> Subject:
    from fpp_ml_bench.baselines.training import shipped_names, weights_path

    try:
        path = weights_path(name)
    except WeightsError:
        names = ", ".join((*METHODS, *shipped_names()))
        raise DiagnosisError(
            f"unknown model {name!r}; there are {names}, every .safetensors file of trained weights, and your own "
            "module as file.py:factory"
        ) from None
    import torch

    from fpp_ml_bench.baselines.networks import NetworkMethod, load

    torch.set_num_threads(threads)
    model = load(path, "cpu")
    if model.config.image_size != dataset.size:
        raise WeightsError(
            f"{path}: was trained at {model.config.image_size} px (H x W), {dataset.path} has images of {dataset.size} "
            "px; give a dataset built at the weights' size"
        )
    network_method = NetworkMethod(model, frame=frame, threads=threads, sequence=dataset.sequence)
    return subject_of_network(network_method, dataset, layers)


def subject_of_network(network_method: Any, dataset: "DatasetFolder", layers: Sequence[str] | None = None) -> Subject:
    """A `fpp_ml_bench.baselines.networks.network_method.NetworkMethod` as a subject."""
    import torch

    from fpp_ml_bench.baselines.networks import build

    model = network_method.model
    names = select_layers(layers, model.network.probe_layers, model.config.name)

    def untrained(seed: int) -> "nn.Module":
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network: nn.Module = build(model.config.network, **model.config.options)
        network = network.eval().requires_grad_(False)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]

    return Subject(
        name=network_method.name,
        title=network_method.title,
        sha256=_digest(network_method.name, network_method.settings),
        units=network_method.units,
        image_size=model.config.image_size,
        frames_used=network_method.frames_used,
        direction=direction_of(dataset, network_method.frames_used),
        predict_frames=network_method.predict,
        uses_ground_truth_mask=network_method.uses_ground_truth_mask,
        normalisation=model.config.normalisation,
        network=model.network,
        layer_names=names,
        find_layers=lambda network: network.probe_layers,  # type: ignore[arg-type, return-value]
        untrained=untrained,
        weights_sha256=model.sha256,
    )


def select_layers(requested: Sequence[str] | None, available: "dict[str, nn.Module]", name: str) -> tuple[str, ...]:
    """The ``requested`` layers, or all ``available``, in forward order. Raises `DiagnosisError` for unknown ones."""
    unknown = [layer for layer in requested or () if layer not in available]
    if unknown:
        from difflib import get_close_matches

        suggestions = get_close_matches(unknown[0], available, n=3) or list(available)[:12]
        raise DiagnosisError(f"{name} has no layer {unknown[0]!r}; there are {', '.join(suggestions)}")
    return tuple(available) if not requested else tuple(layer for layer in available if layer in set(requested))


def direction_of(dataset: "DatasetFolder", frames: Sequence[int]) -> Direction | Literal["both"]:
    """Fringe direction of ``frames``; ``both`` where they differ or have no direction."""
    directions = {dataset.sequence.frames[index].direction for index in frames} - {None}
    direction = next(iter(directions)) if len(directions) == 1 else None
    return "both" if direction is None else direction


def _digest(name: str, settings: Mapping[str, Any]) -> str:
    """Hash of name and settings without those of the machine; a network's settings hold the hash of its weights."""
    relevant = {key: value for key, value in settings.items() if key not in ("threads", "device")}
    return hashlib.sha256(json.dumps([name, relevant], sort_keys=True).encode()).hexdigest()


def _refuse_options(name: str, **options: object) -> None:
    for option, value in options.items():
        if value is not None:
            raise DiagnosisError(f"{name} is a method without a network, so it has no {option}; leave it out")
