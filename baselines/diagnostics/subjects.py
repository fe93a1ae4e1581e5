"""The model under diagnosis: shipped weights, a weights file, a method without a network, or a
user's torch module."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fpp_ml_bench.baselines.diagnostics.probe import spread
from fpp_ml_bench.baselines.method import Answer, Frames, Method, checked
from fpp_ml_bench.baselines.networks.model import build, fringe_batch
from fpp_ml_bench.baselines.networks.network_method import NetworkMethod
from fpp_ml_bench.baselines.registry import FILE_MARK, code_in, find, load_from_file, load_method
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.depth import Normalisation, denormalise, object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.evaluation.protocol import Units
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.sequence import Direction

NORMALISATION_OF: dict[str, Normalisation] = {
    "mm": "raw",
    "m": "global",
    "normalised": "individual",
}
"""How a user's module represents depth, by its units."""
BATCH = 8
"""Most images in a batch."""
PIXELS_AT_ONCE = BATCH * 224 * 224
"""Most pixels in a batch: at 960 px a batch is one image."""
NORMALISED_BACKGROUND = 0.1
"""Normalised prediction below which a pixel is taken for background, which is 0."""
SAMPLES_ASKED = 6
"""Samples that show whether a model predicts anything at all."""
_LEAST_SPREAD = 1e-3
"""Relative difference of a model's predictions up to which they count as the same."""
_STRAY = 0.001
"""Share of pixels at either end that may differ from the others all the same."""
Depth = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Subject:
    """A model under diagnosis; ``sha256`` identifies it and its settings. ``units`` of `predict`:
    mm, or normalised to the sample's own depth range. ``direction``: that of the fringes in
    ``frames_used``. With ``uses_ground_truth_mask`` it expects frames that are 0 outside the
    object. ``network`` takes the single frame in ``frames_used`` as (B, 1, H, W) in [0, 1] and
    outputs depth in the representation ``normalisation``. Without a network, it and the following
    fields are None or empty. ``layer_names``: the layers to probe, in forward order.
    ``untrained(seed)``: the same architecture with random weights."""

    name: str
    title: str
    sha256: str
    units: Units
    image_size: tuple[int, int]
    frames_used: tuple[int, ...]
    direction: Direction | Literal["both"]
    answer: Callable[[Frames], Answer]
    uses_ground_truth_mask: bool = False
    normalisation: Normalisation | None = None
    network: nn.Module | None = None
    layer_names: tuple[str, ...] = ()
    untrained: Callable[[int], nn.Module] | None = None
    weights_sha256: str | None = None

    def networks(self) -> tuple[nn.Module, Callable[[int], nn.Module]]:
        """``network`` and ``untrained``. Raises `DiagnosisError` for a method without a network."""
        if self.network is None or self.untrained is None:
            raise DiagnosisError(f"{self.name} has no network to probe")
        return self.network, self.untrained

    def layers_of(self, network: nn.Module) -> dict[str, nn.Module]:
        """The layers to probe of a ``network`` of this architecture, for example of `untrained`."""
        available = _layers(network)
        return {name: available[name] for name in self.layer_names}

    def captured(self, dataset: DatasetFolder, sample: str) -> list[NDArray[np.uint8] | None]:
        """The frames of ``sample`` that the subject uses, uint8 (H, W), by frame number; None for
        all others."""
        return captured_frames(dataset, self, sample)  # type: ignore[arg-type]  # it has what this asks a method for

    def predict(self, frames: Frames) -> Depth:
        """Depth float32 (H, W) in ``units``, `checked`."""
        return checked(self.answer(frames), self.image_size, self.name).depth

    @property
    def answers_normalised(self) -> bool:
        """Whether `predict` gives normalised depth, and not mm."""
        return self.units == "normalised"

    def predicts_nothing(self, dataset: DatasetFolder) -> str | None:
        """How the subject predicts nothing for `SAMPLES_ASKED` samples of all splits: background,
        or the same value, on all object pixels but stray ones. None for a subject that predicts
        something."""
        samples = spread(dataset.samples("all"), SAMPLES_ASKED)
        answers = [
            self.predict(self.captured(dataset, name))[object_mask(dataset.depth_mm(name))]
            for name in samples
        ]
        values = np.concatenate(answers)
        if not values.size:
            return None
        low, high = np.quantile(values, (_STRAY, 1 - _STRAY))
        what = f"{low:.4g}{' of the depth range' if self.answers_normalised else ' mm'}"
        if max(-low, high) < background_below(
            self.answers_normalised, dataset.rig.working_range_mm[0]
        ):
            what = "background"
        elif high - low > _LEAST_SPREAD * abs(high):
            return None
        return (
            f"{self.name} predicts nothing but {what} on the object pixels of {len(samples)} "
            f"samples."
        )

    def input_batch(self, stacks: Sequence[Frames]) -> Tensor:
        """Input of ``network``, float32 (B, 1, H, W) in [0, 1]."""
        images = [np.asarray(frames[self.frames_used[0]]) for frames in stacks]
        return fringe_batch(images, self.image_size, self.name)

    def batches(
        self, dataset: DatasetFolder, samples: Sequence[str], size: int | None = None
    ) -> Iterator[tuple[list[str], Tensor]]:
        """``samples`` in batches of ``size`` (default: so that memory stays bounded), with their
        input (B, 1, H, W)."""
        size = size or max(
            1, min(BATCH, PIXELS_AT_ONCE // (self.image_size[0] * self.image_size[1]))
        )
        for start in range(0, len(samples), size):
            names = list(samples[start : start + size])
            yield names, self.input_batch([self.captured(dataset, name) for name in names])


def background_below(normalised: bool, near_mm: float) -> float:
    """Predictions below it, normalised or in mm, are nearer to background than to any object, of
    which none is nearer than ``near_mm``."""
    return NORMALISED_BACKGROUND if normalised else near_mm / 2


def checked_output(output: Tensor, shape: Sequence[int], name: str) -> Tensor:
    """``output`` as float32 if it is finite and of ``shape``; else `DiagnosisError`."""
    output_shape, expected = tuple(getattr(output, "shape", ())), tuple(shape)
    if output_shape != expected:
        got = output_shape or type(output).__name__
        raise DiagnosisError(
            f"{name}: expected an output of shape {expected}, one depth per pixel, got {got}"
        )
    if not_finite := int((~output.isfinite()).sum()):
        raise DiagnosisError(
            f"{name}: {not_finite} of {output.numel()} values of its output are NaN or infinite"
        )
    return output.float()


def activations_of(
    network: nn.Module,
    layers: dict[str, nn.Module],
    fringe: Tensor,
    reduce: Callable[[Tensor], Tensor],
    name: str,
) -> dict[str, Tensor]:
    """``reduce(activations)`` of every layer by its name, of one forward pass of the network called
    ``name``. ``reduce`` is called before a later layer can change the output in place. Its result
    must not be a view of the output. Raises `DiagnosisError` for a layer whose output is not (B, C,
    h, w) or that the pass does not reach, and for an output that is not a depth map."""
    activations: dict[str, Tensor] = {}

    def record(layer: str, module: nn.Module, inputs: object, output: object) -> None:
        if not isinstance(output, Tensor) or output.dim() != 4:
            shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
            raise DiagnosisError(
                f"layer {layer!r}: expected activations (B, C, h, w), got {shape}; leave it out"
            )
        activations[layer] = reduce(output.float())

    with ExitStack() as hooks, torch.no_grad():
        for layer, module in layers.items():
            hooks.enter_context(module.register_forward_hook(partial(record, layer)))
        checked_output(network(fringe), fringe.shape, name)
    for layer in layers:
        if layer not in activations:
            raise DiagnosisError(
                f"{name}: layer {layer!r} takes no part in a forward pass; leave it out"
            )
    return activations


def subject(
    name: str,
    dataset: DatasetFolder,
    layers: Sequence[str] | None = None,
    units: str | None = None,
    frame: int | None = None,
    threads: int = 1,
    options: Mapping[str, Any] = MappingProxyType({}),
) -> Subject:
    """The model called ``name``, ready to be diagnosed on ``dataset``. ``name``: a method of
    `fpp_ml_bench.baselines.registry`, shipped weights, a ``.safetensors`` file, or
    ``file.py:factory``, where ``factory()`` returns a torch module that maps fringes (B, 1, H, W)
    in [0, 1] to depth (B, 1, H, W) in ``units`` (of `NORMALISATION_OF`; default: normalised).
    ``layers``: names of the layers to probe, by default the network's ``probe_layers``, or every
    child of a module without them. ``frame``: number of the network's input frame, by default the
    first that it was trained on. ``threads``: torch threads of the process. ``options``: those of a
    method. Raises `DiagnosisError` for a name, layer or module that can't be used, and other
    `FppBenchError` of the model."""
    made = load_from_file(name) if FILE_MARK in name else Method
    if not (isinstance(made, type) and issubclass(made, Method)):
        torch.set_num_threads(threads)
        return _subject_of_factory(name, made, dataset, layers, units or "normalised", frame or 0)
    if units is not None:
        raise DiagnosisError(
            f"{name}: its units are known; set units only for your own module, file.py:factory"
        )
    if not issubclass(find(name).method, NetworkMethod):
        if given := [
            option for option, value in (("layers", layers), ("frame", frame)) if value is not None
        ]:
            raise DiagnosisError(
                f"{name} is a method without a network, so it has no {given[0]}; leave it out"
            )
        return subject_of_method(load_method(name, dataset, **options), dataset)
    torch.set_num_threads(threads)
    method: Any = load_method(name, dataset, frame=frame, threads=threads, device="cpu")
    model, config = method.model, method.model.config

    def untrained(seed: int) -> nn.Module:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network: nn.Module = build(config.network, **config.options)
        network = network.eval().requires_grad_(False)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]

    return subject_of_method(
        method,
        dataset,
        normalisation=config.normalisation,
        network=model.network,
        weights_sha256=model.sha256,
        layer_names=_select_layers(layers, model.network, config.name),
        untrained=untrained,
    )


def subject_of_method(method: Method, dataset: DatasetFolder, **network: Any) -> Subject:
    """A method as a subject; ``network``: the fields of a `Subject` with one."""
    # A network's settings hold the hash of its weights.
    identity = json.dumps([method.name, method.settings_of_depth], sort_keys=True)
    same = ("name", "title", "units", "frames_used", "uses_ground_truth_mask")
    return Subject(
        **{key: getattr(method, key) for key in same},
        sha256=hashlib.sha256(identity.encode()).hexdigest(),
        image_size=dataset.size,
        direction=_direction_of(dataset, method.frames_used),
        answer=method.answer,
        **network,
    )


def _layers(network: nn.Module) -> dict[str, nn.Module]:
    """A network's own ``probe_layers``, and all modules below it, by name."""
    own = getattr(network, "probe_layers", None)
    named = {name: module for name, module in network.named_modules() if name}
    return {**own, **named} if isinstance(own, dict) else named


def _select_layers(
    requested: Sequence[str] | None, network: nn.Module, name: str
) -> tuple[str, ...]:
    """The ``requested`` layers in forward order, by default the network's ``probe_layers``, or
    every child of one without them. Raises `DiagnosisError` for unknown ones."""
    available = _layers(network)
    for layer in requested or ():
        if layer not in available:
            suggestions = get_close_matches(layer, available, n=3) or list(available)[:12]
            raise DiagnosisError(
                f"{name} has no layer {layer!r}; there are {', '.join(suggestions)}"
            )
    usual = getattr(network, "probe_layers", None) or dict(network.named_children())
    return tuple(layer for layer in available if layer in (requested or usual))


def _direction_of(dataset: DatasetFolder, frames: Sequence[int]) -> Direction | Literal["both"]:
    """Fringe direction of ``frames``; ``both`` where they differ or have no direction."""
    first, *others = {dataset.sequence.frames[index].direction for index in frames} - {None} or {
        None
    }
    return "both" if first is None or others else first


def _subject_of_factory(
    name: str,
    factory: Any,
    dataset: DatasetFolder,
    layers: Sequence[str] | None,
    units: str,
    frame: int,
) -> Subject:
    """The module that ``factory`` of ``file.py:factory`` makes, as a subject. It is run on a
    sample, so that misfits show early."""
    if not 0 <= frame < len(dataset.sequence):
        raise DiagnosisError(
            f"frame {frame}: expected 0 to {len(dataset.sequence) - 1}, the frames of the sequence"
        )
    network = _build_network(name, factory)
    path, normalisation = Path(name.rpartition(":")[0]), NORMALISATION_OF[units]
    digest = hashlib.sha256(f"{units} {frame} {code_in(path.resolve())}".encode())
    for key, value in network.state_dict().items():
        if isinstance(value, Tensor):
            values = value.detach().cpu().contiguous().flatten().view(torch.uint8)
            digest.update(key.encode() + values.numpy().tobytes())

    def answer(frames: Frames) -> Answer:
        batch = user_subject.input_batch([frames])
        try:
            with torch.inference_mode():
                output = network(batch)
        except Exception as error:  # the user's code can raise anything
            reason = f"{type(error).__name__}: {printable(str(error), 400)}"
            raise DiagnosisError(
                f"{path.stem}: on fringes of shape {tuple(batch.shape)} it failed: {reason}"
            ) from error
        depth = checked_output(output, batch.shape, path.stem)[0, 0].numpy()
        return Answer(denormalise(depth, normalisation, 0.0, 1.0).astype(np.float32))

    user_subject = Subject(
        name=path.stem,
        title=f"{path.name}:{name.rpartition(':')[2]}",
        sha256=digest.hexdigest(),
        units="normalised" if units == "normalised" else "mm",
        image_size=dataset.size,
        frames_used=(frame,),
        direction=_direction_of(dataset, (frame,)),
        answer=answer,
        normalisation=normalisation,
        network=network,
        layer_names=_select_layers(layers, network, name),
        untrained=lambda seed: randomised(_build_network(name, factory), seed),
    )
    samples = dataset.samples("all")
    if not samples:
        raise DiagnosisError(f"{dataset.path}: holds no sample")
    user_subject.predict(user_subject.captured(dataset, samples[0]))
    return user_subject


def randomised(network: nn.Module, seed: int) -> nn.Module:
    """``network`` with random weights, changed in place: layers with ``reset_parameters`` are
    initialised again, the parameters of the others are shuffled, which keeps their scale."""
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


def _build_network(name: str, factory: Any) -> nn.Module:
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)  # random weights are the same every time
            network = factory()
    except (Exception, SystemExit) as error:
        raise DiagnosisError(
            f"{name}: calling it without arguments failed: {type(error).__name__}: "
            f"{printable(str(error), 400)}"
        ) from error
    if not isinstance(network, nn.Module):
        raise DiagnosisError(
            f"{name}: expected it to return a torch module, got {type(network).__name__}"
        )
    return network.eval().requires_grad_(False).cpu()
