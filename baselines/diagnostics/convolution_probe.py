"""The paper's spatial probe: four convolutions trained on frozen activations, at one resolution for every layer.

The paper (Section 7.1) gives only "four convolutional layers"; the other choices are ours. A 1 x 1 convolution to
`WIDTH` channels, two of 3 x 3, and a 1 x 1 to the target, with ReLU between them. The first is narrow so that layers of
8 and of 1024 channels get probes of similar capacity. The receptive field is 5 x 5 grid points. Activations and targets
are resized to a grid of a quarter of the image's sides (`grid_step`): area means to shrink, bilinear to enlarge.
Channels are standardised over the training samples. Adam with cosine decay. All probes learn from one forward pass of
the network over a batch, so no activations are stored.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

WIDTH = 16
SHARE, LONGEST = 4, 120
"""Image px per grid step, and the most grid points along a side; for larger images the step grows."""
LEARNING_RATE = 3e-3
EPOCHS = 6
BATCH = 4
_LEAST_SPREAD = 1e-6


def grid_step(size: tuple[int, int]) -> int:
    """Image px per grid step for images of ``size``: 4 up to 480 px, 8 at 960."""
    return max(SHARE, -(-max(size) // LONGEST))


@dataclass
class Moments:
    """Mean and standard deviation of each channel, accumulated batch by batch in float64."""

    count: int = 0
    total: Tensor | None = None
    square: Tensor | None = None

    def add(self, features: Tensor) -> None:
        """Add a batch (B, C, h, w)."""
        flat = features.double().transpose(0, 1).flatten(1)
        total, square = flat.sum(1), flat.square().sum(1)
        self.count += flat.shape[1]
        self.total = total if self.total is None else self.total + total
        self.square = square if self.square is None else self.square + square

    def standard(self) -> tuple[Tensor, Tensor]:
        """Mean and 1 / standard deviation, float32 (C,); 0 for a constant channel, which removes it."""
        if self.total is None or self.square is None:
            raise ValueError("moments need at least one batch")
        mean = self.total / self.count
        spread = (self.square / self.count - mean * mean).clamp(min=0).sqrt()
        factor = torch.where(spread > _LEAST_SPREAD * (1 + mean.abs()), 1 / spread, torch.zeros_like(spread))
        return mean.float(), factor.float()


class ConvolutionProbe(nn.Module):
    """Four convolutions from activations (B, C, h, w) to a target (B, 1, h, w); untrained they give ``target_mean``."""

    mean: Tensor
    factor: Tensor

    def __init__(self, moments: Moments, target_mean: float) -> None:
        super().__init__()
        mean, factor = moments.standard()
        self.register_buffer("mean", mean[:, None, None])
        self.register_buffer("factor", factor[:, None, None])
        self.body = nn.Sequential(
            nn.Conv2d(len(mean), WIDTH, 1), nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1), nn.ReLU(),
            nn.Conv2d(WIDTH, WIDTH, 3, padding=1), nn.ReLU(),
            nn.Conv2d(WIDTH, 1, 1),
        )  # fmt: skip
        last = self.body[-1]
        nn.init.zeros_(last.weight)  # type: ignore[arg-type]
        nn.init.constant_(last.bias, target_mean)  # type: ignore[arg-type]

    def forward(self, features: Tensor) -> Tensor:
        return self.body((features - self.mean) * self.factor)


class ProbeSet:
    """Probes that are trained together, one for each (features, target, seed).

    ``seeds``: number of seeds by features; ``steps``: number of training steps, for the learning rate schedule.
    """

    def __init__(
        self, moments: Mapping[str, Moments], target_means: Mapping[str, float], seeds: Mapping[str, int], steps: int
    ) -> None:
        self.probes: dict[tuple[str, str, int], ConvolutionProbe] = {}
        for features in moments:
            for seed in range(seeds[features]):
                for target, mean in target_means.items():
                    with torch.random.fork_rng(devices=[]):
                        torch.manual_seed(seed)
                        self.probes[features, target, seed] = ConvolutionProbe(moments[features], mean)
        parameters = [parameter for probe in self.probes.values() for parameter in probe.parameters()]
        self._optimiser = torch.optim.Adam(parameters, lr=LEARNING_RATE, foreach=True)
        self._schedule = torch.optim.lr_scheduler.CosineAnnealingLR(self._optimiser, max(1, steps))

    def step(self, features: Mapping[str, Tensor], targets: Mapping[str, Tensor]) -> None:
        """One training step of every probe on a batch: activations (B, C, h, w) and targets (B, 1, h, w) by name."""
        self._optimiser.zero_grad(set_to_none=True)
        for (source, target, _), probe in self.probes.items():
            # One backward pass per probe: a graph of all probes would hold every intermediate map at once.
            nn.functional.mse_loss(probe(features[source]), targets[target]).backward()
        self._optimiser.step()
        self._schedule.step()

    @torch.no_grad()
    def errors(
        self, features: Mapping[str, Tensor], targets: Mapping[str, Tensor]
    ) -> dict[tuple[str, str, int], list[float]]:
        """Mean squared error of every probe on each sample of a batch."""
        errors = {}
        for (source, target, seed), probe in self.probes.items():
            squared = (probe(features[source]) - targets[target]).double().square().mean((1, 2, 3))
            errors[source, target, seed] = squared.tolist()
        return errors
