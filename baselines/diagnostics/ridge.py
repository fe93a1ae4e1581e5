"""A linear probe in closed form: a weight per channel, the same at every pixel (a 1 x 1 convolution).

The normal equations are accumulated batch by batch in float64. The activations need not be in memory together, and the
solution is the same as for all of them at once.
"""

import torch
from torch import Tensor

STRENGTH = 1e-6
"""Ridge strength per pixel for standardised channels; it only makes constant or duplicate channels solvable."""


class NormalEquations:
    """Sums of products of N observations of C features and T targets."""

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

    def solve(self, strength: float = STRENGTH) -> Tensor:
        """Weights (C + 1, T) float64, the last row the bias, of least squared error plus ``strength`` times N times
        the squared weights of standardised features; the bias is free. Raises ``ValueError`` without observations."""
        if not self.count:
            raise ValueError("a linear probe needs observations, but none were added")
        mean = self.inner[-1, :-1] / self.count
        target = self.cross[-1] / self.count
        spread = (self.inner.diagonal()[:-1] / self.count - mean * mean).clamp(min=0).sqrt()
        scale = torch.where(spread > 1e-9 * (1 + mean.abs()), spread, torch.full_like(spread, torch.inf))
        inner = (self.inner[:-1, :-1] / self.count - torch.outer(mean, mean)) / torch.outer(scale, scale)
        cross = (self.cross[:-1] / self.count - torch.outer(mean, target)) / scale[:, None]
        inner.diagonal().add_(strength)
        weight = torch.linalg.solve(inner, cross) / scale[:, None]
        return torch.cat([weight, (target - mean @ weight)[None]])

    @property
    def target_mean(self) -> Tensor:
        """Mean of the targets, (T,)."""
        return self.cross[-1] / self.count


def apply(weights: Tensor, features: Tensor) -> Tensor:
    """Predictions (N, T) float64 of a solved probe for features (N, C)."""
    return _with_bias_column(features) @ weights


def _with_bias_column(features: Tensor) -> Tensor:
    return torch.cat([features.double(), torch.ones(len(features), 1, dtype=torch.float64)], dim=1)
