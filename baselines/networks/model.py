"""The networks by name, a trained one ready to use (fringe image in, depth in mm out), and networks as ONNX files."""

import importlib.util
import inspect
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.networks.base import FringeNetwork, checked_option, tiny_floats_are_zero
from fpp_ml_bench.baselines.networks.hformer import Hformer
from fpp_ml_bench.baselines.networks.pix2pix import Discriminator, Pix2Pix, Pix2PixUNet
from fpp_ml_bench.baselines.networks.unet import ResUNet, TransUNet, UNet
from fpp_ml_bench.baselines.training.weights import ModelConfig, open_weights, weights_path
from fpp_ml_bench.decoding.decode import grey_levels
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import FppBenchError, NetworkError, PredictionError, WeightsError
from fpp_ml_bench.loaders.training import unit_range

_CLASSES: dict[str, type[FringeNetwork]] = {
    network.name: network for network in (UNet, TransUNet, ResUNet, Hformer, Pix2Pix, Pix2PixUNet)
}
NETWORKS = tuple(_CLASSES)
Fringe = NDArray[np.uint8] | NDArray[np.floating[Any]]


def build(name: str, **options: int | float) -> FringeNetwork:
    """One of `NETWORKS`, untrained, in float32 on the default device. ``options`` are the network's keyword options,
    the paper's values by default; ``width`` scales every width. The weights depend on torch's random state only.
    ``build(network.name, **network.options)`` makes the network again. Raises `NetworkError` for an unknown name, an
    unknown option, or a value that the network can't have."""
    if name not in _CLASSES:
        raise NetworkError(f"unknown network {name!r}; there are {', '.join(NETWORKS)}")
    return _constructed(name, _CLASSES[name], options)


def discriminator(**options: int | float) -> Discriminator:
    """The two-scale discriminator of a GAN (`pix2pix.Discriminator`); `NetworkError` as `build`."""
    return _constructed("discriminator", Discriminator, options)


def _constructed(name: str, cls: Any, options: dict[str, Any]) -> Any:
    parameters = inspect.signature(cls).parameters
    if unknown := sorted(set(options) - set(parameters)):
        available = ", ".join(f"{p.name} (default {p.default})" for p in parameters.values())
        raise NetworkError(f"network {name!r} has no option {', '.join(map(repr, unknown))}; there are: {available}")
    kinds = {option: type(parameters[option].default) for option in options}
    checked = {n: checked_option(name, n, value, kinds[n], cls.rules.get(n, (1, 1))) for n, value in options.items()}
    return cls(**checked)


def fringe_batch(fringes: Sequence[Fringe] | Fringe, size: tuple[int, int], trained_on: str) -> Tensor:
    """Images (B, H, W), uint8 or float in [0, 1], as the network's input: float32 (B, 1, H, W) in [0, 1], on the CPU.
    ``size`` (H, W): what the network ``trained_on`` was trained at. `PredictionError` for another size, shape or dtype,
    and for values that are NaN or outside [0, 1]."""
    images = [grey_levels(image) for image in fringes]
    if not images:
        raise PredictionError("expected at least one fringe image, got none")
    batch = torch.empty(len(images), 1, *size)
    for number, image in enumerate(images):
        _check_image(image, size, trained_on)
        row = batch[number, 0].numpy()
        if image.dtype == np.uint8:
            unit_range(np.ascontiguousarray(image), row)
        else:
            row[...] = image
    return batch


def _check_image(image: NDArray[Any], size: tuple[int, int], trained_on: str) -> None:
    if image.ndim != 2:
        raise PredictionError(f"expected one fringe image (H, W), got shape {image.shape}; give a single grey channel")
    if image.shape != size:
        raise PredictionError(
            f"expected a fringe image of {size[0]}x{size[1]} px (H x W), the size {trained_on} was trained at, got "
            f"{image.shape[0]}x{image.shape[1]}: the fringe period in px depends on the size, so a network works at "
            "one size only; use weights of that size, or a dataset built at this one"
        )
    if image.dtype == np.uint8:
        return
    if not np.issubdtype(image.dtype, np.floating):
        raise PredictionError(f"expected a fringe image in uint8 (0 to 255) or float (0 to 1), got {image.dtype}")
    low, high = float(image.min()), float(image.max())
    if not (low >= 0 and high <= 1):  # NaN fails this too
        raise PredictionError(
            f"expected a float fringe image within [0, 1], got values from {low:g} to {high:g}; divide grey levels by "
            "their largest possible value (255 for 8 bits), and leave no NaN"
        )


def represent(network: nn.Module, fringe: Tensor, name: str) -> Tensor:
    """Output (B, 1, H, W) of ``network``; `PredictionError` where it holds a value that is not finite."""
    output: Tensor = network(fringe)
    if not_finite := int((~output.isfinite()).sum()):
        raise PredictionError(
            f"{name}: the network gave {not_finite} of {output.numel()} values that are NaN or infinite; its weights "
            "come from a training that diverged, or the precision it runs in is too low: train it again"
        )
    return output


@dataclass(frozen=True)
class Probe:
    """Outputs of two layers of a network for the last batch: see `probed`."""

    outputs: dict[str, Tensor]

    def pooled(self) -> Tensor:
        """Mean and spread over the pixels of each bottleneck channel, float64 (B, 2 C), on the CPU."""
        layer = self.outputs["bottleneck"].double().flatten(2)
        return torch.cat([layer.mean(2), layer.std(2, correction=0)], dim=1).cpu()

    def pixels(self, size: tuple[int, int]) -> Tensor:
        """Features of the last decoder layer (B, C, H, W) at ``size``; bilinear where the layer is coarser."""
        layer = self.outputs["last"]
        if layer.shape[2:] == size:
            return layer
        return functional.interpolate(layer, size=size, mode="bilinear", align_corners=False)


@contextmanager
def probed(network: FringeNetwork) -> Iterator[Probe]:
    """Record the outputs of the bottleneck and the last decoder layer for every batch inside this block."""
    outputs: dict[str, Tensor] = {}

    def recorded(name: str) -> Callable[[nn.Module, object, Tensor], None]:
        return lambda module, inputs, output: outputs.update({name: output})

    layers = {"bottleneck": "bottleneck", "last": network.last_layer}
    handles = [network.probe_layers[at].register_forward_hook(recorded(name)) for name, at in layers.items()]
    try:
        yield Probe(outputs)
    finally:
        for handle in handles:
            handle.remove()


Twin = Literal["mean", "predicted"]
TWINS: tuple[Twin, ...] = get_args(Twin)


@dataclass(frozen=True)
class RangeHeads:
    """Metric depth from an individually normalised network that is not given the sample's depth range.

    Such a network puts out v in [0, 1], and mm are v (D_max - D_min) + D_min. The *metric twin* of its row (own
    definition) replaces the range of the test sample, which only the ground truth knows, by either

    - ``mean``: D_min and D_max averaged over the training split;
    - ``predicted``: a ridge regression from the mean and spread of each bottleneck channel to (D_min, D_max - D_min).

    Both also need an object mask, because v = 0 means both background and D_min: a logistic regression on the features
    of the last decoder layer. Depth is v span + D_min, held within the training set's range and a quarter of its width
    to either side, where the mask says object, and 0 elsewhere. `range_heads.fit_heads` fits the heads.

    Ranges and limits in mm, float64; ``F`` pooled and ``C`` per-pixel features.
    mean_range_mm (2,): D_min, D_max. range_weight (F, 2), range_bias (2,): to (D_min, span). mask_weight (C,),
    mask_bias (): the logit of being object. mask_threshold (2,): least logit of an object pixel, for each of `TWINS`.
    limits_mm (2,): what depth is held within.
    """

    mean_range_mm: Tensor
    range_weight: Tensor
    range_bias: Tensor
    mask_weight: Tensor
    mask_bias: Tensor
    mask_threshold: Tensor
    limits_mm: Tensor

    def depth_range_mm(self, probe: Probe, twin: Twin) -> Tensor:
        """D_min and span of the probed batch, float64 (B, 2); a span is never below 0."""
        pooled = probe.pooled()
        if twin == "mean":
            low, high = self.mean_range_mm.tolist()
            return torch.tensor([[low, high - low]], dtype=torch.float64).expand(len(pooled), 2)
        predicted = pooled @ self.range_weight + self.range_bias
        return torch.stack([predicted[:, 0], predicted[:, 1].clamp(min=0)], dim=1)

    def logits(self, probe: Probe, size: tuple[int, int]) -> Tensor:
        """Logit of being object of each pixel of the probed batch, float32 (B, 1, H, W)."""
        features = probe.pixels(size).float()
        weight, bias = (part.to(features.device, torch.float32) for part in (self.mask_weight, self.mask_bias))
        return functional.conv2d(features, weight[None, :, None, None], bias[None])

    def unmasked_mm(self, values: Tensor, depth_range_mm: Tensor) -> Tensor:
        """v span + D_min, held within the limits: ``values`` (B, 1, H, W), ``depth_range_mm`` (B, 2) -> float32 mm."""
        least, most = self.limits_mm.tolist()
        low, span = depth_range_mm.to(values.device, torch.float32).T[:, :, None, None, None]
        return (values * span + low).clamp(least, most)

    def depth_mm(self, values: Tensor, probe: Probe, twin: Twin) -> Tensor:
        """Depth of the probed batch, float32 (B, 1, H, W) in mm, 0 = background."""
        depth = self.unmasked_mm(values.float(), self.depth_range_mm(probe, twin))
        threshold = float(self.mask_threshold[TWINS.index(twin)])
        is_object = self.logits(probe, (values.shape[2], values.shape[3])) >= threshold
        return torch.where(is_object, depth, 0.0)


def heads_from_tensors(tensors: Mapping[str, Tensor], name: str) -> RangeHeads | None:
    """The heads stored with the weights ``name``; None without any. `WeightsError` for what can't be heads."""
    if not tensors:
        return None
    tensors = {key: tensor for key, tensor in tensors.items() if key != "report"}  # of older files
    fields = RangeHeads.__dataclass_fields__
    if odd := [*sorted(set(fields) - set(tensors)), *sorted(set(tensors) - set(fields))]:
        raise WeightsError(f"{name}: expected the range heads {', '.join(fields)}, differs in {odd[0]}; fit them again")
    features = tensors["range_weight"].shape[0] if tensors["range_weight"].dim() == 2 else 0
    channels = tensors["mask_weight"].numel()
    shapes = {
        "mean_range_mm": (2,),
        "range_weight": (features, 2),
        "range_bias": (2,),
        "mask_weight": (channels,),
        "mask_bias": (),
        "mask_threshold": (2,),
        "limits_mm": (2,),
    }
    for key, shape in shapes.items():
        if tuple(tensors[key].shape) != shape or tensors[key].dtype != torch.float64:
            actual = f"{tensors[key].dtype} {tuple(tensors[key].shape)}"
            raise WeightsError(f"{name}: range head {key}: expected float64 {shape}, got {actual}; fit the heads again")
    return RangeHeads(**tensors)


@dataclass(frozen=True, eq=False)
class Model:
    """A network with its weights, in eval mode. ``heads`` turn an individually normalised output into mm, or None;
    ``sha256`` is that of the weights file."""

    network: FringeNetwork
    config: ModelConfig
    heads: RangeHeads | None
    device: torch.device
    sha256: str

    @property
    def parameters(self) -> int:
        """Numbers in the network, without those in the range heads."""
        return sum(parameter.numel() for parameter in self.network.parameters())

    def predict(self, fringe: Fringe, depth_range: Twin = "predicted") -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm of one fringe image (H, W), uint8 or float in [0, 1], of the size trained at.

        Under raw or global normalisation the output as it is, negative values and all; under individual normalisation
        the range heads make it, with a range ``predicted`` from the image or the training set's ``mean``. A network
        trained with the background removed expects ``fringe`` to be 0 outside the object. Raises `PredictionError` for
        another image or an output that is not finite, `WeightsError` without range heads."""
        return self.predict_batch([fringe], depth_range)[0]

    def predict_batch(self, fringes: Sequence[Fringe], depth_range: Twin = "predicted") -> NDArray[np.float32]:
        """`predict` of several images at once: float32 (B, H, W) in mm."""
        if depth_range not in TWINS:
            raise PredictionError(f"unknown depth_range {depth_range!r}; there are {', '.join(TWINS)}")
        if self.config.normalisation != "individual":
            values = self.predict_representation(fringes)
            return denormalise(values, self.config.normalisation, 0.0, 0.0).astype(np.float32)
        if self.heads is None:
            raise WeightsError(
                f"{self.config.name}: its output is a share of the sample's depth range, and this file holds no range "
                "heads to make mm of it; use predict_representation, or fit them with "
                "fpp_ml_bench.baselines.networks.range_heads.fit_heads and save them with the weights"
            )
        with torch.inference_mode(), tiny_floats_are_zero(), probed(self.network) as probe:
            depth = self.heads.depth_mm(self._output(fringes), probe, depth_range)
        return depth[:, 0].cpu().numpy()

    def predict_representation(self, fringes: Sequence[Fringe]) -> NDArray[np.float32]:
        """The network's own output float32 (B, H, W) for images (B, H, W), in the representation it was trained on
        (`fpp_ml_bench.depth`). Raises `PredictionError` as `predict`."""
        with torch.inference_mode(), tiny_floats_are_zero():
            return self._output(fringes)[:, 0].float().cpu().numpy()

    def _output(self, fringes: Sequence[Fringe]) -> Tensor:
        batch = fringe_batch(fringes, self.config.image_size, self.config.name).to(self.device)
        return represent(self.network, batch, self.config.name)


def load(name_or_path: str | Path, device: str | None = None) -> Model:
    """The weights ``name_or_path``, shipped with the package or a ``.safetensors`` file, as a `Model`. ``device``:
    ``cpu``, ``cuda``, ...; None takes a CUDA device where there is one. `WeightsError` for an unknown name, a damaged
    or foreign file, or a device that does not exist."""
    weights = open_weights(weights_path(name_or_path))
    heads, torch_device = heads_from_tensors(weights.heads, str(weights.path)), _device(device)
    # Channels last: never slower here, and up to 1.7 times faster on a CPU (UNet, width 8, 224 px).
    network = weights.network.requires_grad_(False).to(torch_device)
    network = network.to(memory_format=torch.channels_last)
    return Model(network, weights.config, heads, torch_device, weights.sha256)


def _device(name: str | None) -> torch.device:
    if name is None:
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError, ValueError, TypeError) as error:
        raise WeightsError(f"device {name!r} can't be used here: {str(error).splitlines()[0]}; give cpu") from None


INPUT = "fringe"
OUTPUT = "depth_representation"
OPSET = 17
"""Of the ONNX file: its input, its output, its version of the operators."""


def export_onnx(model: Any, path: str | Path, size: int | tuple[int, int]) -> Path:
    """Write a network as an ONNX file in float32, and return its path.

    The file takes ``fringe`` float32 (B, 1, H, W) in [0, 1] and gives ``depth_representation`` of the same shape; B is
    free, H and W are ``size`` (one number for a square). ``model``: a `FringeNetwork`, or what holds one as
    ``.network``. Torch's older exporter takes 0.4 to 2 s where the newer takes 6 to 30 s, to the same numbers. Raises
    `FppBenchError` where the onnx package is missing or the file can't be written, and `NetworkError` for something
    that is no network or a size that it does not take."""
    if importlib.util.find_spec("onnx") is None:
        raise FppBenchError('ONNX export needs the onnx package; install it with: pip install "fpp-ml-bench[onnx]"')
    network = model if isinstance(model, FringeNetwork) else getattr(model, "network", None)
    if not isinstance(network, FringeNetwork):
        raise NetworkError(f"expected a network or a model that holds one; it was given {type(model).__name__}")
    height, width = (size, size) if isinstance(size, int) else size
    network.check_size(height, width)
    target = Path(path)
    if not target.parent.is_dir():
        raise FppBenchError(f"can't write {target}: there is no folder {target.parent}; make it first")
    example = torch.zeros(1, 1, height, width, dtype=torch.float32, device=next(network.parameters()).device)
    try:
        # A file that appears under its name only when whole.
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".onnx-") as folder:
            unfinished = Path(folder) / target.name
            with warnings.catch_warnings():
                # The size rule is checked once, here, and is meant to be a constant of the file.
                warnings.simplefilter("ignore")
                torch.onnx.export(
                    deepcopy(network).eval().float(),
                    (example,),
                    str(unfinished),
                    dynamo=False,
                    input_names=[INPUT],
                    output_names=[OUTPUT],
                    dynamic_axes={INPUT: {0: "batch"}, OUTPUT: {0: "batch"}},
                    opset_version=OPSET,
                )
            unfinished.replace(target)
    except OSError as error:
        raise FppBenchError(f"can't write {target}: {error.strerror or error}") from error
    return target
