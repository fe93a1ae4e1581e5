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

from collections.abc import Callable
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
