"""The six losses of the paper's comparison (Section 5.5), on a batch for training and on each sample for validation.

With p the prediction, t the target, both in the training representation, and e = 1e-8:

============ ======================================= ==========================
name         value                                   pixels
============ ======================================= ==========================
rmse         sqrt(mean (p - t)^2 + e)                all
l1           mean abs(p - t)                         all
masked_rmse  sqrt(mean (p - t)^2 + e)                object
masked_l1    mean abs(p - t)                         object
hybrid_rmse  alpha masked_rmse + (1 - alpha) rmse
hybrid_l1    alpha masked_l1 + (1 - alpha) l1
============ ======================================= ==========================

- Object pixels are those with t > 0 *in the representation*: under individual normalisation the pixels at D_min are 0
  and count as background, as in the paper.
- `loss_function` takes one mean over all pixels of the batch, `sample_losses` one for each sample. The two differ: the
  root of a mean is not the mean of roots, and a masked mean over a batch weighs samples by their object's size. Scores
  average samples, so validation must too.
- e is under the root once, so an RMSE loss is never below 1e-4 in its representation (0.1 mm under global
  normalisation). It makes the gradient at zero residual 0 instead of 0/0, and is the reason why no score is a loss.
- Without a single object pixel a masked part is exactly 0, with zero gradient, instead of 0/0. In a batch the loss then
  depends on the other samples. In `sample_losses` such a sample gives 0 too; it shifts a validation mean by the same
  amount in every epoch.
- A prediction or target that is NaN or infinite *anywhere* makes every loss NaN or infinite, outside the mask too:
  masking multiplies, it does not select. The training engine stops on it.
- Half precisions are computed in float32 (2,100 mm squared is beyond float16), float64 in float64. float32 sums differ
  from float64 ones by less than 1e-6 of their value, at four images of 960 x 960 px in mm (tests/test_losses.py).
"""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from fpp_ml_bench.baselines.training.tables import check_loss

EPSILON = 1e-8

LossFunction = Callable[[Tensor, Tensor], Tensor]


def loss_function(name: str, alpha: float | None = None) -> LossFunction:
    """The training loss ``name`` as a function of ``prediction`` and ``target``, each (B, 1, H, W), any float dtype.

    It returns a 0-d tensor, float32 (float64 for float64 input). ``alpha`` in [0, 1], the weight of the object's part,
    is for the hybrids and must be given there.

    Raises `RecipeError` for an unknown name or an ``alpha`` that is missing, out of range, or of no use. The function
    raises ``ValueError`` for tensors that are not of one shape (B, 1, H, W), empty, or not of floats.
    """
    check_loss(name, alpha)
    return partial(_loss, name, alpha, per_sample=False)


def sample_losses(name: str, alpha: float | None, prediction: Tensor, target: Tensor) -> Tensor:
    """The loss ``name`` of every sample for itself, (B,), float32 or float64; all else as in `loss_function`."""
    check_loss(name, alpha)
    return _loss(name, alpha, prediction, target, per_sample=True)


def _loss(name: str, alpha: float | None, prediction: Tensor, target: Tensor, *, per_sample: bool) -> Tensor:
    prediction, target = _checked(prediction, target)
    difference = prediction - target
    root = name.endswith("rmse")
    errors = difference.square() if root else difference.abs()
    pixels = (1, 2, 3) if per_sample else (0, 1, 2, 3)
    if name in ("rmse", "l1"):
        return _everywhere(errors, root, pixels)
    masked = _on_object(errors, target > 0, root, pixels)
    return masked if alpha is None else alpha * masked + (1 - alpha) * _everywhere(errors, root, pixels)


def _everywhere(errors: Tensor, root: bool, pixels: tuple[int, ...]) -> Tensor:
    mean = errors.mean(pixels)
    return (mean + EPSILON).sqrt() if root else mean


def _on_object(errors: Tensor, mask: Tensor, root: bool, pixels: tuple[int, ...]) -> Tensor:
    count = mask.sum(pixels)
    # Products, not selections: 0 x NaN is NaN, and the gradient of what they leave out is 0.
    mean = (errors * mask).sum(pixels) / count.clamp(min=1)
    return (mean + EPSILON).sqrt() * (count > 0) if root else mean


def _checked(prediction: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both in float32 or better. Shapes must agree: broadcasting (B, H, W) would compare every pair of samples."""
    shapes = f"prediction {tuple(prediction.shape)} and target {tuple(target.shape)}"
    if prediction.shape != target.shape or prediction.ndim != 4 or prediction.shape[1] != 1 or not prediction.numel():
        raise ValueError(f"expected prediction and target of one shape (B, 1, H, W), not empty, got {shapes}")
    if not (prediction.is_floating_point() and target.is_floating_point()):
        raise ValueError(f"expected prediction and target as floats, got {prediction.dtype} and {target.dtype}")
    dtype = torch.promote_types(torch.promote_types(prediction.dtype, target.dtype), torch.float32)
    return prediction.to(dtype), target.to(dtype)


Features = Sequence[Sequence[Tensor]]

LOG_FLOOR = 1e-3
"""Added to depths in [0, 1] before their logarithm, so that differences below a thousandth of the range hardly count.
Own choice: with 1e-6 the pixels near D_min would have gradients up to a million times those of all others."""

SHARED_SCALE = 0.5
"""How much of an error common to all pixels, a wrong scale, is forgiven: Eigen et al.'s lambda."""


def scores_against(answers: Features, real: bool) -> Tensor:
    """Mean squared distance of the patch scores from 1 (``real``) or 0, summed over the scales."""
    target = 1.0 if real else 0.0
    return torch.stack([(_wide(features[-1]) - target).square().mean() for features in answers]).sum()


def feature_matching(generated: Features, real: Features) -> Tensor:
    """Mean absolute difference of each layer's features but the scores', summed over layers, averaged over scales.

    The real image's features are taken as they are: no gradient flows into them.
    """
    scales = [
        torch.stack(
            [(_wide(generated_map) - _wide(real_map).detach()).abs().mean() for generated_map, real_map in layers]
        ).sum()
        for layers in (
            list(zip(generated_maps[:-1], real_maps[:-1], strict=True))
            for generated_maps, real_maps in zip(generated, real, strict=True)
        )
    ]
    return torch.stack(scales).mean()


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of two images of one shape."""
    return (_wide(prediction) - _wide(target)).abs().mean()


def gradient_l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference of the steps to the next pixel, to the right plus downwards; (B, 1, H, W), H and W > 1.

    The step of a difference is the difference of the steps, so a constant offset costs nothing.
    """
    difference = _wide(prediction) - _wide(target)
    return difference.diff(dim=-1).abs().mean() + difference.diff(dim=-2).abs().mean()


def scale_invariant_log(prediction: Tensor, target: Tensor) -> Tensor:
    """mean g^2 - lambda (mean g)^2 of g = log p - log t over each sample's object (t > 0), averaged over the samples.

    ``prediction`` and ``target`` (B, 1, H, W) in [0, 1]; `LOG_FLOOR` is added to both, and a prediction below 0 counts
    as 0. Never negative; 0 for a sample without an object. NaN anywhere makes it NaN.
    """
    prediction, target = _wide(prediction), _wide(target)
    mask = target > 0
    # Products, not selections, so that a NaN in the background is not hidden.
    ratio = ((prediction.clamp(min=0) + LOG_FLOOR).log() - (target.clamp(min=0) + LOG_FLOOR).log()) * mask
    count = mask.sum((1, 2, 3)).clamp(min=1)
    squares, mean = ratio.square().sum((1, 2, 3)) / count, ratio.sum((1, 2, 3)) / count
    return (squares - SHARED_SCALE * mean.square()).mean()


def _wide(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
