"""Training objectives: an objective owns its networks and gives the engine the losses to minimise, one by one.

::

    for module, loss, logged in objective.steps(batch):
        optimisers[module].zero_grad(set_to_none=True)
        loss.backward()
        optimisers[module].step()

Before training, the engine may put wrapped networks (several processes, mixed precision, compiled) in the place of
``objective.modules[name]``: every call goes through that mapping. The weights file holds ``modules["network"]``.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.training import losses as gan_losses
from fpp_ml_bench.baselines.training.losses import loss_function, sample_losses
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.loaders.training import FringeDepth

Step = tuple[str, Tensor, dict[str, Tensor]]
"""Module to update, its loss (0-d, with gradient), and what to log (0-d, detached; no name occurs twice a batch)."""


class Objective(Protocol):
    modules: dict[str, nn.Module]

    def steps(self, batch: FringeDepth) -> Iterator[Step]:
        """The updates of one batch. The engine takes each one before it asks for the next."""

    def validation_losses(self, prediction: Tensor, batch: FringeDepth) -> Tensor:
        """Loss of every sample (B,), of which the rate schedule and the choice of the best weights see the mean."""


class Regression:
    """A network with one of the paper's losses on its output (Section 5.5).

    Raises `RecipeError` for a loss or ``alpha`` that `losses.loss_function` refuses.
    """

    def __init__(self, network: nn.Module, loss_name: str, alpha: float | None = None) -> None:
        self.modules: dict[str, nn.Module] = {"network": network}
        self.loss_name, self.alpha = loss_name, alpha
        self.loss = loss_function(loss_name, alpha)

    def steps(self, batch: FringeDepth) -> Iterator[Step]:
        loss = self.loss(self.modules["network"](batch.fringe), batch.depth)
        yield "network", loss, {"loss": loss.detach()}

    def validation_losses(self, prediction: Tensor, batch: FringeDepth) -> Tensor:
        return sample_losses(self.loss_name, self.alpha, prediction, batch.depth)


@dataclass(frozen=True)
class AdversarialSettings:
    """Weights of the generator's terms; the defaults are those of the paper's pix2pixHD baseline.

    ``l1`` and ``gradient_l1`` weigh differences in [-1, 1], ``scale_invariant_log`` logarithms of depths in [0, 1].
    Raises `RecipeError` for a weight that is negative or not finite.
    """

    adversarial: float = 1.0
    feature_matching: float = 10.0
    l1: float = 10.0
    gradient_l1: float = 5.0
    scale_invariant_log: float = 2.0

    def __post_init__(self) -> None:
        for name, weight in asdict(self).items():
            if isinstance(weight, bool) or not isinstance(weight, (int, float)) or not 0 <= weight < math.inf:
                raise RecipeError(f"loss gan: weight {name}: expected a number from 0 up, got {weight!r}")


class Adversarial:
    """A generator against a discriminator that is trained too: least squares GAN, feature matching, depth terms.

    ``generator`` maps a fringe image to depth, both in [0, 1], so the normalisation must be ``individual``.
    ``discriminator`` takes (B, 2, H, W), fringe and depth, each in [-1, 1], and answers as `gan_losses` says. A batch
    has two steps: the discriminator learns to tell the batch's depth from the generator's; then the generator is judged
    by the updated discriminator. The generator runs forward once for both.
    """

    def __init__(
        self, generator: nn.Module, discriminator: nn.Module, settings: AdversarialSettings | None = None
    ) -> None:
        self.modules: dict[str, nn.Module] = {"network": generator, "discriminator": discriminator}
        self.settings = AdversarialSettings() if settings is None else settings

    def steps(self, batch: FringeDepth) -> Iterator[Step]:
        prediction = self.modules["network"](batch.fringe)
        generated, real = _pairs(batch.fringe, prediction), _pairs(batch.fringe, batch.depth)
        yield self._discriminator_step(generated.detach(), real)
        yield self._generator_step(prediction, generated, real, batch.depth)

    def validation_losses(self, prediction: Tensor, batch: FringeDepth) -> Tensor:
        """The L1 of depth alone, in [0, 1]: a GAN's other terms depend on how good the discriminator is by then."""
        return sample_losses("l1", None, prediction, batch.depth)

    def _discriminator_step(self, generated: Tensor, real: Tensor) -> Step:
        # Both in one call: a discriminator spread over processes expects one backward for each forward.
        answers = self.modules["discriminator"](torch.cat([generated, real]))
        count = len(generated)
        false = gan_losses.scores_against([[f[:count] for f in scale] for scale in answers], real=False)
        true = gan_losses.scores_against([[f[count:] for f in scale] for scale in answers], real=True)
        loss = (false + true) / 2
        logged = {"discriminator": loss, "discriminator_generated": false, "discriminator_real": true}
        return "discriminator", loss, _detached(logged)

    def _generator_step(self, prediction: Tensor, generated: Tensor, real: Tensor, depth: Tensor) -> Step:
        with _fixed(self.modules["discriminator"]) as discriminator:
            on_generated = discriminator(generated)
            with torch.no_grad():
                on_real = discriminator(real)
        terms = {
            "adversarial": gan_losses.scores_against(on_generated, real=True),
            "feature_matching": gan_losses.feature_matching(on_generated, on_real),
            "l1": gan_losses.l1(generated[:, 1:], real[:, 1:]),
            "gradient_l1": gan_losses.gradient_l1(generated[:, 1:], real[:, 1:]),
            "scale_invariant_log": gan_losses.scale_invariant_log(prediction, depth),
        }
        weights = asdict(self.settings)
        loss = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        return "network", loss, _detached({"loss": loss, **terms})


def _pairs(fringe: Tensor, depth: Tensor) -> Tensor:
    """Input of the discriminator: (B, 2, H, W) in [-1, 1] from two images in [0, 1]."""
    return torch.cat([fringe, depth.to(fringe.dtype)], dim=1) * 2 - 1


def _detached(values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach() for name, value in values.items()}


@contextmanager
def _fixed(module: nn.Module) -> Iterator[nn.Module]:
    """Within: gradients of forward passes flow through ``module`` but not into its parameters.

    The graph records which parameters need a gradient, so they are free again before the backward pass.
    """
    free = [parameter for parameter in module.parameters() if parameter.requires_grad]
    for parameter in free:
        parameter.requires_grad_(False)
    try:
        yield module
    finally:
        for parameter in free:
            parameter.requires_grad_(True)
