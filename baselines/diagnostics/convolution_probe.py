"""The paper's spatial probe: four convolutions trained on frozen activations, at one resolution for every layer.

The paper (Section 7.1) says "four convolutional layers" and no more; the rest is ours. 1 x 1 to `WIDTH` channels, two
of 3 x 3, 1 x 1 to the target, ReLU between: the first is narrow so that layers of 8 and of 1024 channels get probes of
about the same power, and the reach is 5 x 5 grid points. Activations are brought to a grid of a quarter of the image's
sides (`grid_step`): mean over areas where finer, bilinear where coarser; targets too. Channels get mean 0 and spread 1
over the training samples. Adam, cosine decay. All probes learn from one pass of the network over a batch, so that no
activation is kept.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

WIDTH = 16
SHARE, LONGEST = 4, 120
"""Image px a grid step, and grid points along a side at most, above which a step holds more px."""
LEARNING_RATE = 3e-3
EPOCHS = 6
BATCH = 4
_LEAST_SPREAD = 1e-6


def grid_step(size: tuple[int, int]) -> int:
    """Image px a grid step for images of ``size``: 4 up to 480 px, 8 at 960."""
    return max(SHARE, -(-max(size) // LONGEST))


@dataclass
class Moments:
    """Mean and spread of each channel, summed up batch by batch in float64."""

    count: int = 0
    total: Tensor | None = None
    square: Tensor | None = None

    def add(self, features: Tensor) -> None:
        """Take (B, C, h, w) in."""
        flat = features.double().transpose(0, 1).flatten(1)
        total, square = flat.sum(1), flat.square().sum(1)
        self.count += flat.shape[1]
        self.total = total if self.total is None else self.total + total
        self.square = square if self.square is None else self.square + square

    def standard(self) -> tuple[Tensor, Tensor]:
        """Mean and 1 / spread, float32 (C,); a constant channel gets 0, so that it says nothing."""
        if self.total is None or self.square is None:
            raise ValueError("moments of nothing")
        mean = self.total / self.count
        spread = (self.square / self.count - mean * mean).clamp(min=0).sqrt()
        factor = torch.where(spread > _LEAST_SPREAD * (1 + mean.abs()), 1 / spread, torch.zeros_like(spread))
        return mean.float(), factor.float()


class ConvolutionProbe(nn.Module):
    """Four convolutions from activations (B, C, h, w) to one target (B, 1, h, w); starts at ``target_mean``."""

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
    """Probes that learn side by side: one for each (features, target, seed), by those three names.

    ``seeds``: how many of each features; ``steps``: how many steps there will be.
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
        """One step of every probe on a batch: activations and targets by name, (B, C, h, w) and (B, 1, h, w)."""
        self._optimiser.zero_grad(set_to_none=True)
        for (source, target, _), probe in self.probes.items():
            # One probe after the other: a graph of all of them would hold every intermediate map at once.
            nn.functional.mse_loss(probe(features[source]), targets[target]).backward()
        self._optimiser.step()
        self._schedule.step()

    @torch.no_grad()
    def errors(
        self, features: Mapping[str, Tensor], targets: Mapping[str, Tensor]
    ) -> dict[tuple[str, str, int], list[float]]:
        """Mean squared error of every probe on each sample of a batch."""
        found = {}
        for (source, target, seed), probe in self.probes.items():
            miss = (probe(features[source]) - targets[target]).double().square().mean((1, 2, 3))
            found[source, target, seed] = miss.tolist()
        return found
