"""What is diagnosed: a shipped network, a weights file, a method without a network, or a torch module of the user's."""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.methods import METHODS, Method, method
from fpp_ml_bench.errors import DiagnosisError, WeightsError
from fpp_ml_bench.evaluation.protocol import Units
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.normalisation import Normalisation
from fpp_ml_bench.pixel_sets import object_mask

if TYPE_CHECKING:
    from torch import Tensor, nn

    from fpp_ml_bench.loaders.store import DatasetFolder

Frames = Sequence[NDArray[np.uint8] | None]
"""A captured sequence by frame number; None for frames that are not needed."""
OutputUnits = Literal["mm", "m", "normalised"]
NORMALISATION_OF: dict[str, Normalisation] = {"mm": "raw", "m": "global", "normalised": "individual"}
FACTORY_MARK = ".py:"


@dataclass(frozen=True, eq=False)
class Subject:
    """A model under diagnosis.

    ``sha256`` tells it from every other, settings included. ``units`` are those of `predict`: mm, or normalised to the
    sample's own depth range. ``frames_used`` must be captured; ``direction`` is that of their fringes, or ``both``.
    With ``uses_ground_truth_mask`` it expects frames that are 0 outside the object, as `captured` gives them.

    ``network`` takes (B, 1, H, W) in [0, 1] of the one frame in ``frames_used`` and puts out depth in the
    representation ``normalisation``; it and what belongs to it are None for a method without a network. ``layer_names``
    are the layers that probes look into, in forward order. ``untrained(seed)`` is the same architecture with random
    weights; ``find_layers`` gives the layers of any network of that architecture by name. ``weights_sha256`` is that of
    its weights file.
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
        """The chosen layers of ``network`` by name, in forward order; empty without a network."""
        return {} if self.network is None else self.layers_of(self.network)

    def layers_of(self, network: "nn.Module") -> "dict[str, nn.Module]":
        """The same layers of another network of this architecture, `untrained` for one."""
        found = {} if self.find_layers is None else self.find_layers(network)
        return {name: found[name] for name in self.layer_names}

    def captured(self, dataset: "DatasetFolder", sample: str) -> list[NDArray[np.uint8] | None]:
        """The frames of ``sample`` that the subject may see, uint8 (H, W), by frame number; None for every other."""
        frames: list[NDArray[np.uint8] | None] = [None] * len(dataset.sequence)
        for index in self.frames_used:
            frames[index] = self.as_given(dataset.frame(sample, index), dataset.depth_mm(sample))
        return frames

    def as_given(self, frame: NDArray[np.uint8], depth_mm: NDArray[np.float32]) -> NDArray[np.uint8]:
        """``frame`` (H, W) as the subject expects it: 0 outside the object where it is given the mask."""
        return frame * object_mask(depth_mm) if self.uses_ground_truth_mask else frame

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        """Depth float32 (H, W) in ``units``. Raises `DiagnosisError` for an output of another shape or not finite."""
        depth = np.asarray(self.predict_frames(frames))
        if depth.shape != self.image_size:
            raise DiagnosisError(f"{self.name}: expected a prediction of {self.image_size} px, got {depth.shape}")
        if not np.isfinite(depth).all():
            raise DiagnosisError(f"{self.name}: its prediction holds NaN or infinity; nothing can be read from that")
        return depth.astype(np.float32, copy=False)

    def input_tensor(self, frames: Frames) -> "Tensor":
        """What ``network`` is given: float32 (1, 1, H, W) in [0, 1]. Raises `DiagnosisError` without a network or
        frame."""
        return self.input_batch([frames])

    def input_batch(self, stacks: Sequence[Frames]) -> "Tensor":
        """`input_tensor` of several samples: float32 (B, 1, H, W)."""
        from fpp_ml_bench.baselines.inference import fringe_batch

        if self.network is None:
            raise DiagnosisError(f"{self.name} has no network, so there is no input to it")
        (index,) = self.frames_used
        images = [frame for frame in (frames[index] for frames in stacks) if frame is not None]
        if len(images) != len(stacks):
            raise DiagnosisError(f"{self.name} needs frame {index}, which is missing")
        return fringe_batch(images, self.image_size, self.name)

    def represent(self, frames: Frames) -> NDArray[np.float32]:
        """The network's own output float32 (H, W) in its ``normalisation``; raises as `input_tensor`, and for an output
        of another shape or not finite."""
        import torch

        if self.network is None:
            raise DiagnosisError(f"{self.name} has no network, so it has no output of its own")
        batch = self.input_tensor(frames)
        with torch.inference_mode():
            return checked_output(self.network(batch), batch, self.name)[0, 0].numpy()


def checked_output(output: "Tensor", batch: "Tensor", name: str) -> "Tensor":
    """``output`` if it is finite and shaped as ``batch`` (B, 1, H, W); else `DiagnosisError`."""
    shape = tuple(getattr(output, "shape", ()))
    if shape != tuple(batch.shape):
        raise DiagnosisError(
            f"{name}: expected an output of shape {tuple(batch.shape)}, one depth a pixel, got "
            f"{shape or type(output).__name__}"
        )
    sick = int((~output.isfinite()).sum())
    if sick:
        raise DiagnosisError(f"{name}: {sick} of {output.numel()} values of its output are NaN or infinite")
    return output.float()


def subject(
    name: str, dataset: "DatasetFolder", layers: Sequence[str] | None = None, units: OutputUnits | None = None,
    frame: int | None = None, threads: int = 1,
) -> Subject:  # fmt: skip
    """The model called ``name``, ready to be diagnosed on ``dataset``.

    ``name``: a method of `fpp_ml_bench.baselines.methods.METHODS`, weights that ship, a ``.safetensors`` file, or
    ``file.py:factory``, where ``factory()`` returns a torch module from fringes (B, 1, H, W) in [0, 1] to one depth a
    pixel (B, 1, H, W) in ``units`` (default: normalised). ``layers``: names of the layers to look into; by default the
    network's own ``probe_layers``, and of a module without them every child. ``frame``: which frame a network is given,
    by default the first that it was trained on. ``threads`` are torch's, for the whole process.

    Raises `DiagnosisError` for a name, layer or module that can't be used, `FppBenchError` where the model says so.
    """
    if FACTORY_MARK in name:
        from fpp_ml_bench.baselines.diagnostics.user_module import subject_of_factory

        return subject_of_factory(name, dataset, layers, units or "normalised", 0 if frame is None else frame, threads)
    if units is not None:
        raise DiagnosisError(f"{name}: its units are known; units are for a module of yours, file.py:factory")
    if name in METHODS:
        _none_of(name, layers=layers, frame=frame)
        return subject_of_method(method(name, dataset.rig), dataset)
    return _weights(name, dataset, layers, frame, threads)


def subject_of_method(found: Method, dataset: "DatasetFolder") -> Subject:
    """A method without a network as a subject."""
    return Subject(
        name=found.name,
        title=found.title,
        sha256=_digest(found.name, found.settings),
        units=getattr(found, "units", "mm"),
        image_size=dataset.size,
        frames_used=found.frames_used,
        direction=direction_of(dataset, found.frames_used),
        predict_frames=found.predict,
        uses_ground_truth_mask=getattr(found, "uses_ground_truth_mask", False),
    )


def _weights(
    name: str, dataset: "DatasetFolder", layers: Sequence[str] | None, frame: int | None, threads: int
) -> Subject:
    from fpp_ml_bench.baselines.weights_file import shipped_names, weights_path

    try:
        path = weights_path(name)
    except WeightsError:
        known = ", ".join((*METHODS, *shipped_names()))
        raise DiagnosisError(
            f"unknown model {name!r}; there are {known}, every .safetensors file of trained weights, and a module of "
            "yours as file.py:factory"
        ) from None
    from fpp_ml_bench.baselines.model import load

    model = load(path, "cpu")
    if model.config.image_size != dataset.size:
        raise WeightsError(
            f"{path}: was trained at {model.config.image_size} px (H x W), {dataset.path} has images of {dataset.size} "
            "px; give a dataset built at the weights' size"
        )
    from fpp_ml_bench.baselines.network_method import NetworkMethod

    found = NetworkMethod(model, frame=frame, threads=threads, sequence=dataset.sequence)
    return subject_of_network(found, dataset, layers)


def subject_of_network(found: Any, dataset: "DatasetFolder", layers: Sequence[str] | None = None) -> Subject:
    """A `fpp_ml_bench.baselines.network_method.NetworkMethod` as a subject."""
    import torch

    from fpp_ml_bench.baselines.networks import build

    model = found.model
    names = chosen_layers(layers, model.network.probe_layers, model.config.name)

    def untrained(seed: int) -> "nn.Module":
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network: nn.Module = build(model.config.network, **model.config.options)
        network = network.eval().requires_grad_(False)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]

    return Subject(
        name=found.name,
        title=found.title,
        sha256=_digest(found.name, found.settings),
        units=found.units,
        image_size=model.config.image_size,
        frames_used=found.frames_used,
        direction=direction_of(dataset, found.frames_used),
        predict_frames=found.predict,
        uses_ground_truth_mask=found.uses_ground_truth_mask,
        normalisation=model.config.normalisation,
        network=model.network,
        layer_names=names,
        find_layers=lambda network: network.probe_layers,  # type: ignore[arg-type, return-value]
        untrained=untrained,
        weights_sha256=model.sha256,
    )


def chosen_layers(asked: Sequence[str] | None, there: "dict[str, nn.Module]", name: str) -> tuple[str, ...]:
    """``asked``, or all that are ``there``, in forward order. Raises `DiagnosisError` for a layer that there is not."""
    unknown = [layer for layer in asked or () if layer not in there]
    if unknown:
        from difflib import get_close_matches

        near = get_close_matches(unknown[0], there, n=3) or list(there)[:12]
        raise DiagnosisError(f"{name} has no layer {unknown[0]!r}; there are {', '.join(near)}")
    return tuple(there) if not asked else tuple(layer for layer in there if layer in set(asked))


def direction_of(dataset: "DatasetFolder", frames: Sequence[int]) -> Direction | Literal["both"]:
    """Direction of the fringes in ``frames``; both where they differ or have none."""
    known = {dataset.sequence.frames[index].direction for index in frames} - {None}
    found = next(iter(known)) if len(known) == 1 else None
    return "both" if found is None else found


def _digest(name: str, settings: Mapping[str, Any]) -> str:
    """Name and settings, those of the machine aside; a network's settings hold the hash of its weights."""
    told = {key: value for key, value in settings.items() if key not in ("threads", "device")}
    return hashlib.sha256(json.dumps([name, told], sort_keys=True).encode()).hexdigest()


def _none_of(name: str, **given: object) -> None:
    for option, value in given.items():
        if value is not None:
            raise DiagnosisError(f"{name} is a method without a network, so it has no {option}; leave it out")
