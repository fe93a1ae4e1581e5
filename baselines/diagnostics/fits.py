"""What probes read from a frozen network: activations of its layers, the true maps as targets, and fits between them.

*Linear probes* have a weight per channel, the same at every pixel (a 1 x 1 convolution), in closed form.
*Four-convolution probes* are the paper's (Section 7.1), which gives only "four convolutional layers"; the other choices
are ours. Both learn from the network's batches as they come, so no activations are stored.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import product
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.diagnostics.subjects import checked_output
from fpp_ml_bench.baselines.phase.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import normalise, object_mask
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

Image = NDArray[np.float32]
Source = tuple[str, int, str]
"""What is probed: a network's name, the seed of its weights, and a layer."""
MEAN: Source = "controls", 0, "mean"  # predicting each target's mean over the training samples, the reference
OBJECT_DEPTH = "object_depth"  # depth on object pixels
Measured = Mapping[str, tuple[tuple[str, ...], str]]
"""What is measured: its maps, by the names in `truth`, and the mask of the pixels where they are compared."""
LINEAR: Measured = {
    "edges": (("edges",), "image"),
    "depth": (("depth",), "image"),
    OBJECT_DEPTH: (("depth",), "object"),
    "distance": (("depth_mm",), "object"),
    "phase": (("sine", "cosine"), "object"),
    "order": (("order",), "object"),
}
"""Of the linear probes, each of which is fitted where it is compared; the phase is an angle and so has two maps."""
FRINGE = ("phase", "order")  # of these, what needs fringes of a single direction
SPATIAL: Measured = {name: LINEAR[name] for name in ("edges", "depth", OBJECT_DEPTH)}
"""Of the four-convolution probes, which are trained on the maps of the whole image."""
RIDGE = 1e-6
"""Ridge strength per pixel for standardised channels; it only makes constant or duplicate channels solvable."""
WIDTH = 16
SHARE, LONGEST = 4, 120
"""Image px per grid step, and the most grid points along a side; for larger images the step grows."""
LEARNING_RATE = 3e-3
EPOCHS = 6
BATCH = 4


def activations_of(
    network: nn.Module, layers: dict[str, nn.Module], fringe: Tensor, reduce: Callable[[Tensor], Tensor], name: str
) -> dict[str, Tensor]:
    """``reduce(activations)`` of every layer by its name, of one forward pass of the network called ``name``.
    ``reduce`` is called before a later layer can change the output in place. Its result must not be a view of the
    output. Raises `DiagnosisError` for a layer whose output is not (B, C, h, w) or that the pass does not reach, and
    for an output that is not a depth map."""
    activations: dict[str, Tensor] = {}

    def hook(name: str) -> Any:
        def record(module: nn.Module, inputs: object, output: object) -> None:
            if not isinstance(output, Tensor) or output.dim() != 4:
                shape = tuple(output.shape) if isinstance(output, Tensor) else type(output).__name__
                raise DiagnosisError(f"layer {name!r}: expected activations (B, C, h, w), got {shape}; leave it out")
            activations[name] = reduce(output.float())

        return record

    handles = [layer.register_forward_hook(hook(name)) for name, layer in layers.items()]
    try:
        with torch.no_grad():
            checked_output(network(fringe), fringe, name)
    finally:
        for handle in handles:
            handle.remove()
    for layer in layers:
        if layer not in activations:
            raise DiagnosisError(f"{name}: layer {layer!r} takes no part in a forward pass; leave it out")
    return activations


def at_size(features: Tensor, side: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) resized to a new tensor ``(B, C, *side)``: area means to shrink, bilinear to enlarge."""
    if tuple(features.shape[2:]) == side:
        return features.clone()
    if features.shape[2] >= side[0] and features.shape[3] >= side[1]:
        return functional.adaptive_avg_pool2d(features, side)
    return functional.interpolate(features, size=side, mode="bilinear", align_corners=False)


def at_pixels(features: Tensor, pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Activations (B, C, h, w) at ``pixels`` (B, P), flat indices into an image of ``size``: (B, P, C); those of layers
    of another size are interpolated bilinearly between their pixel centres."""
    if tuple(features.shape[2:]) == size:
        flat = features.flatten(2)
        return flat.gather(2, pixels[:, None].expand(-1, flat.shape[1], -1)).transpose(1, 2)
    rows, columns = pixels // size[1], pixels % size[1]
    position = torch.stack([(2 * columns + 1) / size[1] - 1, (2 * rows + 1) / size[0] - 1], dim=-1).to(features.dtype)
    values = functional.grid_sample(features, position[:, None], "bilinear", "border", align_corners=False)
    return values[:, :, 0].transpose(1, 2)


def truth(depth_mm: Image, rig: Rig, direction: Direction) -> dict[str, NDArray]:
    """Ground truth of a depth map (H, W) in mm, 0 = background, seen by ``rig`` under fringes of ``direction``. Raises
    ``ValueError`` for a map without an object. ``object``: its mask. ``edges``: `edge_map`, [0, 1]. ``depth``:
    normalised to the sample's own range, background 0 (the paper's target). ``depth_mm``. ``sine``, ``cosine``: of the
    wrapped phase, 0 outside the object. ``order``: the fringe order minus that of a plane at the rig's standoff, 0
    outside the object; the plane's order follows from the pixel's position alone. All are float32."""
    inside = object_mask(depth_mm)
    if not inside.any():
        raise ValueError("expected a depth map with an object, got background throughout")
    standoff_mm = rig.standoff_m * MM_PER_M
    # Of the background as if it were at the standoff.
    phase = _layer(rig, direction).absolute_phase(np.where(inside, depth_mm, standoff_mm))
    order = np.floor(phase / TAU) - np.floor(_layer(rig, direction).absolute_phase(standoff_mm) / TAU)
    sine, cosine = (np.where(inside, of(phase), 0.0) for of in (np.sin, np.cos))
    maps = {
        "object": inside,
        "edges": edge_map(depth_mm),
        "depth": normalise(depth_mm, "individual", float(depth_mm[inside].min()), float(depth_mm[inside].max())),
        "depth_mm": depth_mm,
        "sine": sine,
        "cosine": cosine,
        "order": order,
    }
    return {name: np.array(values, dtype=np.float32) for name, values in maps.items()}


def edge_map(depth_mm: NDArray) -> Image:
    """Sobel gradient magnitude (3 x 3) of a depth map (H, W), float32, divided by its largest value, a scale that the
    paper leaves open; 0 for a constant map."""
    depth = np.asarray(depth_mm, dtype=np.float32)
    across, down = (cv2.Sobel(depth, cv2.CV_32F, *order, ksize=3) for order in ((1, 0), (0, 1)))
    strength = np.hypot(across, down).astype(np.float32)
    top = float(strength.max())
    return (strength / top).astype(np.float32) if top > 0 else strength


@lru_cache(maxsize=2)
def _layer(rig: Rig, direction: Direction) -> CalibrationLayer:
    return CalibrationLayer.of(rig, direction)


class NormalEquations:
    """Linear probes: sums of products of N observations of C features and T targets, float64."""

    def __init__(self, features: int, targets: int) -> None:
        self.count = 0
        self.inner = torch.zeros(features + 1, features + 1, dtype=torch.float64)
        self.cross = torch.zeros(features + 1, targets, dtype=torch.float64)

    def add(self, features: Tensor, targets: Tensor) -> None:
        """Add observations (N, C) and their targets (N, T)."""
        augmented = _with_bias_column(features)
        self.count += len(augmented)
        self.inner += augmented.T @ augmented
        self.cross += augmented.T @ targets.double()

    @property
    def target_mean(self) -> Tensor:
        """Mean of the targets, (T,)."""
        return self.cross[-1] / self.count

    def standard(self, least_spread: float = 1e-9) -> tuple[Tensor, Tensor]:
        """Mean and 1 / standard deviation of each feature, (C,); 0 for a constant one, which removes it. Constant: its
        spread is below ``least_spread``, relative to 1 plus its mean."""
        mean = self.inner[-1, :-1] / self.count
        spread = (self.inner.diagonal()[:-1] / self.count - mean * mean).clamp(min=0).sqrt()
        return mean, torch.where(spread > least_spread * (1 + mean.abs()), 1 / spread, torch.zeros_like(spread))

    def solve(self, strength: float = RIDGE) -> Tensor:
        """Weights (C + 1, T) float64, the last row the bias, of least squared error plus ``strength`` times N times
        the squared weights of standardised features; the bias is free."""
        (mean, factor), target = self.standard(), self.target_mean
        inner = (self.inner[:-1, :-1] / self.count - torch.outer(mean, mean)) * torch.outer(factor, factor)
        cross = (self.cross[:-1] / self.count - torch.outer(mean, target)) * factor[:, None]
        inner.diagonal().add_(strength)
        weight = torch.linalg.solve(inner, cross) * factor[:, None]
        return torch.cat([weight, (target - mean @ weight)[None]])


def apply(weights: Tensor, features: Tensor) -> Tensor:
    """Predictions (..., T) float64 of a solved probe for features (..., C)."""
    return _with_bias_column(features) @ weights


def _with_bias_column(features: Tensor) -> Tensor:
    return functional.pad(features.double(), (0, 1), value=1.0)


def grid_step(size: tuple[int, int]) -> int:
    """Image px per grid step for images of ``size``: 4 up to 480 px, 8 at 960."""
    return max(SHARE, -(-max(size) // LONGEST))


class Probes(ABC):
    """Probes of everything in ``measured``, for all sources together: they observe the training samples, start, may
    be trained in steps, and have errors."""

    def __init__(self, measured: Measured) -> None:
        self.measured = measured
        self.maps = list(dict.fromkeys(name for maps, _ in measured.values() for name in maps))
        self.equations: dict[tuple[Source, str], NormalEquations] = {}

    def observe(self, features: Mapping[Source, Tensor], targets: Mapping[str, Tensor]) -> None:
        """Take in a batch: activations (B, C, h, w), and maps and masks (B, 1, h, w) by name."""
        wanted = torch.cat([targets[name] for name in self.maps], dim=1)
        for (source, maps), where in product(features.items(), ("image", "object")):
            inside = targets[where][:, 0] > 0
            if (source, where) not in self.equations:
                self.equations[source, where] = NormalEquations(maps.shape[1], len(self.maps))
            self.equations[source, where].add(*(of.movedim(1, -1)[inside] for of in (maps, wanted)))

    def mean(self, name: str) -> Tensor:
        """Mean (T, 1, 1) of the maps of something measured."""
        maps, place = self.measured[name]
        means = next(equations for (_, where), equations in self.equations.items() if where == place).target_mean
        return means[[self.maps.index(one) for one in maps]][:, None, None]

    @abstractmethod
    def start(self) -> None:
        """When all training samples were observed."""

    def step(self, features: Mapping[Source, Tensor], targets: Mapping[str, Tensor]) -> None:
        """One training step on a batch, as of `observe`."""
        raise NotImplementedError("its weights are a closed form")

    @abstractmethod
    def predictions(self, features: Mapping[Source, Tensor], name: str) -> dict[tuple[Source, int], Tensor]:
        """The maps (B, T, h, w) of something measured, by source and seed of the probe."""

    @torch.no_grad()
    def errors(
        self, features: Mapping[Source, Tensor], targets: Mapping[str, Tensor]
    ) -> dict[tuple[Source, str, int], list[float]]:
        """Mean squared error on each sample of a batch, by source, what is measured, and seed; with `MEAN`'s."""
        errors = {}
        for name, (maps, where) in self.measured.items():
            truth = torch.cat([targets[one] for one in maps], dim=1).double()
            for (source, seed), predicted in {(MEAN, 0): self.mean(name), **self.predictions(features, name)}.items():
                square = (predicted - truth).square().mean(1, keepdim=True) * targets[where]
                errors[source, name, seed] = (square.sum((1, 2, 3)) / targets[where].sum((1, 2, 3))).tolist()
        return errors


class LinearProbes(Probes):
    """A weight per channel, the same at every pixel, for each source."""

    def start(self) -> None:
        self.weights = {key: equations.solve() for key, equations in self.equations.items()}

    def predictions(self, features: Mapping[Source, Tensor], name: str) -> dict[tuple[Source, int], Tensor]:
        maps, where = self.measured[name]
        columns = [self.maps.index(one) for one in maps]
        found = {}
        for source, activations in features.items():
            values = apply(self.weights[source, where][:, columns], activations.movedim(1, -1))
            found[source, 0] = values.movedim(-1, 1)
        return found


class ConvolutionProbe(nn.Module):
    """Four convolutions from activations (B, C, h, w) to a target (B, 1, h, w); untrained they give ``target_mean``.
    The first is narrow so that layers of 8 and of 1024 channels get probes of similar capacity. The receptive field is
    5 x 5 grid points."""

    def __init__(self, observed: NormalEquations, target_mean: float) -> None:
        super().__init__()
        self.mean, self.factor = (part.float()[:, None, None] for part in observed.standard(1e-6))
        self.body = nn.Sequential(
            nn.Conv2d(len(self.mean), WIDTH, 1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(WIDTH, 1, 1),
        )
        last = self.body[-1]
        nn.init.zeros_(last.weight)  # type: ignore[arg-type]
        nn.init.constant_(last.bias, target_mean)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        return self.body((features - self.mean) * self.factor)


class ConvolutionProbes(Probes):
    """Four-convolution probes that are trained together, with Adam and cosine decay over ``steps``; ``seeds``: how many
    each network's layers get."""

    def __init__(self, measured: Measured, seeds: Mapping[str, int], steps: int) -> None:
        super().__init__(measured)
        self.seeds, self.steps = seeds, steps
        self.probes: dict[tuple[Source, str, int], ConvolutionProbe] = {}

    def start(self) -> None:
        for (source, where), target in product(self.equations, self.maps):
            for seed in range(self.seeds[source[0]] if where == "image" else 0):
                with torch.random.fork_rng(devices=[]):
                    torch.manual_seed(seed)
                    probe = ConvolutionProbe(self.equations[source, where], float(self.mean(target)))
                self.probes[source, target, seed] = probe
        parameters = [parameter for probe in self.probes.values() for parameter in probe.parameters()]
        self._optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE, foreach=True)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._optimiser, max(1, self.steps))

    def step(self, features: Mapping[Source, Tensor], targets: Mapping[str, Tensor]) -> None:
        self._optimiser.zero_grad(set_to_none=True)
        for (source, target, _), probe in self.probes.items():
            # One backward pass per probe: a graph of all probes would hold every intermediate map at once.
            nn.functional.mse_loss(probe(features[source]), targets[target]).backward()
        self._optimiser.step()
        self._schedule.step()

    def predictions(self, features: Mapping[Source, Tensor], name: str) -> dict[tuple[Source, int], Tensor]:
        ((target,), _) = self.measured[name]
        return {
            (source, seed): probe(features[source]) for (source, of, seed), probe in self.probes.items() if of == target
        }
