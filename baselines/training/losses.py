"""The six losses of the paper's comparison (Section 5.5), those of a GAN, and the objectives that
are made of them.

With p the prediction, t the target, both in the training representation, and e = 1e-8, ``rmse`` is sqrt(mean (p - t)^2
+ e), ``l1`` mean abs(p - t), over all pixels; ``masked_rmse`` and ``masked_l1`` the same over the object's (t > 0);
``hybrid_rmse`` and ``hybrid_l1`` are alpha masked + (1 - alpha) unmasked.

- Under individual normalisation the pixels at D_min are 0 and count as background, as in the paper.
- `loss_function` takes one mean over the batch, `sample_losses` one for each sample, as scores do.
  The two differ: the root of a mean is not the mean of roots, and a masked mean over a batch weighs
  samples by their object's size.
- e makes the gradient at zero residual 0 instead of 0/0; an RMSE loss is never below 1e-4, so no
  score is a loss.
- Without an object pixel a masked part is exactly 0, with zero gradient, instead of 0/0.
- A value that is NaN or infinite *anywhere* makes every loss so, outside the mask too: masking
  multiplies, it does not select. The training engine stops on it.
- Half precisions are computed in float32 (2,100 mm squared is beyond float16), float64 in float64.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial

import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.training.recipe import check_loss
from fpp_ml_bench.loaders.training import FringeDepth

EPSILON = 1e-8


def loss_function(name: str, alpha: float | None = None) -> Callable[[Tensor, Tensor], Tensor]:
    """The training loss ``name`` as a function of ``prediction`` and ``target``, each (B, 1, H, W),
    any float dtype, to a 0-d tensor, float32 (float64 for float64 input). ``alpha`` in [0, 1] is
    for the hybrids, and needed there. Raises `RecipeError` for an unknown name or an ``alpha`` that
    is missing, out of range, or of no use. The function raises ``ValueError`` for tensors that are
    not of one shape (B, 1, H, W), empty, or not of floats."""
    check_loss(name, alpha)
    return partial(_loss, name, alpha, per_sample=False)


def sample_losses(name: str, alpha: float | None, prediction: Tensor, target: Tensor) -> Tensor:
    """The loss ``name`` of every sample for itself, (B,), float32 or float64; all else as in
    `loss_function`."""
    check_loss(name, alpha)
    return _loss(name, alpha, prediction, target, per_sample=True)


def _loss(
    name: str, alpha: float | None, prediction: Tensor, target: Tensor, *, per_sample: bool
) -> Tensor:
    # Shapes must agree: broadcasting (B, H, W) would compare every pair of samples.
    shapes = f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)}"
    if (
        prediction.shape != target.shape
        or prediction.ndim != 4
        or prediction.shape[1] != 1
        or not prediction.numel()
    ):
        raise ValueError(
            f"expected prediction and target of one shape (B, 1, H, W), not empty, got {shapes}"
        )
    if not (prediction.is_floating_point() and target.is_floating_point()):
        raise ValueError(
            f"expected prediction and target as floats, got {prediction.dtype} and {target.dtype}"
        )
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    target = target.to(dtype)
    difference = prediction.to(dtype) - target
    root = name.endswith("rmse")
    errors = difference.square() if root else difference.abs()
    pixels = (1, 2, 3) if per_sample else (0, 1, 2, 3)

    def everywhere() -> Tensor:
        return (errors.mean(pixels) + EPSILON).sqrt() if root else errors.mean(pixels)

    if name in ("rmse", "l1"):
        return everywhere()
    mask = target > 0
    count = mask.sum(pixels)
    # Products, not selections: 0 x NaN is NaN, and the gradient of what they leave out is 0.
    masked = (errors * mask).sum(pixels) / count.clamp(min=1)
    masked = (masked + EPSILON).sqrt() * (count > 0) if root else masked
    return masked if alpha is None else alpha * masked + (1 - alpha) * everywhere()


Features = Sequence[Sequence[Tensor]]

LOG_FLOOR = 1e-3
"""Added to depths in [0, 1] before their logarithm. Own choice: with 1e-6 the pixels near D_min
would have gradients up to a million times those of all others."""
SHARED_SCALE = 0.5
"""How much of an error common to all pixels, a wrong scale, is forgiven: Eigen et al.'s lambda."""


def scores_against(answers: Features, real: bool) -> Tensor:
    """Mean squared distance of the patch scores from 1 (``real``) or 0, summed over the scales."""
    target = 1.0 if real else 0.0
    return torch.stack(
        [(_wide(features[-1]) - target).square().mean() for features in answers]
    ).sum()


def feature_matching(generated: Features, real: Features) -> Tensor:
    """Mean absolute difference of each layer's features but the scores', summed over layers,
    averaged over scales. The real image's features are taken as they are: no gradient flows into
    them."""
    scales = []
    for ours, theirs in zip(generated, real, strict=True):
        pairs = zip(ours[:-1], theirs[:-1], strict=True)
        scales.append(
            torch.stack(
                [(_wide(our) - _wide(their).detach()).abs().mean() for our, their in pairs]
            ).sum()
        )
    return torch.stack(scales).mean()


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two images of one shape."""
    return (_wide(prediction) - _wide(target)).abs().mean()


def gradient_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of the steps to the next pixel, to the right plus downwards; (B, 1,
    H, W), H and W > 1. The step of a difference is the difference of the steps, so a constant
    offset costs nothing."""
    difference = _wide(prediction) - _wide(target)
    return difference.diff(dim=-1).abs().mean() + difference.diff(dim=-2).abs().mean()


def scale_invariant_log(prediction: Tensor, target: Tensor) -> Tensor:
    """mean g^2 - lambda (mean g)^2 of g = log p - log t over each sample's object (t > 0), averaged
    over the samples. ``prediction`` and ``target`` (B, 1, H, W) in [0, 1]; `LOG_FLOOR` is added to
    both, and a prediction below 0 counts as 0. Never negative; 0 for a sample without an object.
    NaN anywhere makes it NaN."""
    prediction, target = _wide(prediction), _wide(target)
    mask = target > 0
    # Products, not selections, so that a NaN in the background is not hidden.
    ratio = (
        (prediction.clamp(min=0) + LOG_FLOOR).log() - (target.clamp(min=0) + LOG_FLOOR).log()
    ) * mask
    count = mask.sum((1, 2, 3)).clamp(min=1)
    squares, mean = ratio.square().sum((1, 2, 3)) / count, ratio.sum((1, 2, 3)) / count
    return (squares - SHARED_SCALE * mean.square()).mean()


def _wide(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))


Step = tuple[str, Tensor, dict[str, Tensor]]
"""Module to update, its loss (0-d, with gradient), and what to log (0-d, detached; no name occurs
twice a batch).

An objective owns its networks and gives the engine such steps of a batch, one by one; each is taken
before the next is asked for. Every call goes through its ``modules``: the engine may put wrapped
networks (several processes, mixed precision, compiled) there. The weights file holds
``modules["network"]``."""


class Regression:
    """A network with one of the paper's losses on its output, and maybe a ``further`` term of
    output and target, (B, 1, H, W) each; `RecipeError` as `loss_function`."""

    def __init__(
        self,
        network: nn.Module,
        loss_name: str,
        alpha: float | None = None,
        further: Callable[[Tensor, Tensor], Tensor] | None = None,
    ) -> None:
        self.modules: dict[str, nn.Module] = {"network": network}
        self.loss_name, self.alpha, self.further = loss_name, alpha, further
        self.loss = loss_function(loss_name, alpha)

    def steps(self, batch: FringeDepth) -> Iterator[Step]:
        prediction = self.modules["network"](batch.fringe)
        loss = self.loss(prediction, batch.depth)
        logged = {"loss": loss.detach()}
        if self.further is not None:
            further = self.further(_wide(prediction), _wide(batch.depth))
            loss, logged = loss + further, logged | {"further": further.detach()}
        yield "network", loss, logged

    def validation_losses(self, prediction: Tensor, batch: FringeDepth) -> Tensor:
        return sample_losses(self.loss_name, self.alpha, prediction, batch.depth)


@dataclass(frozen=True)
class AdversarialSettings:
    """Weights of the generator's terms; the defaults are those of the authors' pix2pixHD. ``l1``
    and ``gradient_l1`` weigh differences in [-1, 1], ``scale_invariant_log`` logarithms of depths
    in [0, 1], ``hybrid_l1`` that loss with ``alpha`` in [0, 1]."""

    adversarial: float = 1.0
    feature_matching: float = 10.0
    l1: float = 10.0
    gradient_l1: float = 5.0
    scale_invariant_log: float = 2.0
    hybrid_l1: float = 0.0
    alpha: float = 0.7

    @classmethod
    def of(cls, alpha: float | None) -> "AdversarialSettings":
        """The defaults for None. Else Isola et al.'s objective with the hybrid L1 in the place of
        their L1, of weight 100 for differences in [-1, 1], so 200 here; and the feature matching of
        pix2pixHD, which it is adapted from."""
        return cls() if alpha is None else cls(1.0, 10.0, 0.0, 0.0, 0.0, 200.0, alpha)


class Adversarial:
    """A generator against a discriminator that is trained too: least squares GAN, feature matching,
    depth terms. ``generator`` maps a fringe image to depth, both in [0, 1]; ``discriminator`` takes
    (B, 2, H, W), fringe and depth, each in [-1, 1], to lists of features, the scores last. It
    learns first; the generator, run forward once for both, is then judged by the updated one."""

    def __init__(
        self,
        generator: nn.Module,
        discriminator: nn.Module,
        settings: AdversarialSettings | None = None,
    ) -> None:
        self.modules: dict[str, nn.Module] = {"network": generator, "discriminator": discriminator}
        self.settings = settings or AdversarialSettings()

    def steps(self, batch: FringeDepth) -> Iterator[Step]:
        prediction = self.modules["network"](batch.fringe)
        generated, real = _pairs(batch.fringe, prediction), _pairs(batch.fringe, batch.depth)
        yield self._discriminator_step(generated.detach(), real)
        yield self._generator_step(prediction, generated, real, batch.depth)

    def validation_losses(self, prediction: Tensor, batch: FringeDepth) -> Tensor:
        """The L1 of depth alone, or the hybrid L1, in [0, 1]: a GAN's other terms depend on how
        good the discriminator is by then."""
        hybrid = self.settings.hybrid_l1 > 0
        name, alpha = ("hybrid_l1", self.settings.alpha) if hybrid else ("l1", None)
        return sample_losses(name, alpha, prediction, batch.depth)

    def _discriminator_step(self, generated: Tensor, real: Tensor) -> Step:
        # Both in one call: a discriminator spread over processes expects one backward for each
        # forward.
        answers = self.modules["discriminator"](torch.cat([generated, real]))
        count = len(generated)
        false = scores_against([[f[:count] for f in scale] for scale in answers], real=False)
        true = scores_against([[f[count:] for f in scale] for scale in answers], real=True)
        loss = (false + true) / 2
        logged = {
            "discriminator": loss,
            "discriminator_generated": false,
            "discriminator_real": true,
        }
        return "discriminator", loss, {name: value.detach() for name, value in logged.items()}

    def _generator_step(
        self, prediction: Tensor, generated: Tensor, real: Tensor, depth: Tensor
    ) -> Step:
        with _fixed(self.modules["discriminator"]) as discriminator:
            on_generated = discriminator(generated)
            with torch.no_grad():
                on_real = discriminator(real)
        # A term without weight is still logged.
        terms = {
            "adversarial": scores_against(on_generated, real=True),
            "feature_matching": feature_matching(on_generated, on_real),
            "l1": l1(generated[:, 1:], real[:, 1:]),
            "gradient_l1": gradient_l1(generated[:, 1:], real[:, 1:]),
            "scale_invariant_log": scale_invariant_log(prediction, depth),
            "hybrid_l1": loss_function("hybrid_l1", self.settings.alpha)(prediction, depth),
        }
        weights = asdict(self.settings)
        loss = torch.stack([weights[name] * term for name, term in terms.items()]).sum()
        return (
            "network",
            loss,
            {name: value.detach() for name, value in {"loss": loss, **terms}.items()},
        )


def _pairs(fringe: Tensor, depth: Tensor) -> Tensor:
    """Input of the discriminator: (B, 2, H, W) in [-1, 1] from two images in [0, 1]."""
    return torch.cat([fringe, depth.to(fringe.dtype)], dim=1) * 2 - 1


@contextmanager
def _fixed(module: nn.Module) -> Iterator[nn.Module]:
    """Within: gradients of forward passes flow through ``module`` but not into its parameters. The
    graph records that, so they are free again before the backward pass."""
    free = [parameter for parameter in module.parameters() if parameter.requires_grad]
    for parameter in free:
        parameter.requires_grad_(False)
    try:
        yield module
    finally:
        for parameter in free:
            parameter.requires_grad_(True)
