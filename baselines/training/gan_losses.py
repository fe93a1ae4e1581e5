"""The terms of the image-translation baseline's losses (pix2pixHD on depth), each a 0-d tensor in float32 or better.

A discriminator answers with a list over scales of lists of feature maps, the last of each its patch scores: the higher,
the more real (1) rather than generated (0).

- Least squares GAN: Mao et al., *Least Squares Generative Adversarial Networks*, ICCV 2017, with targets 1 and 0.
- Feature matching and several scales: Wang et al., *High-Resolution Image Synthesis and Semantic Manipulation with
  Conditional GANs*, CVPR 2018, Eq. 3-5. GAN terms are summed over the scales, feature matching is averaged over them.
- Scale-invariant log error: Eigen, Puhrsch, Fergus, *Depth Map Prediction from a Single Image*, NIPS 2014, Eq. 4.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

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
