"""The network's answers for a decoded view, and the depth map that follows from them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.classical_network import DepthFilter
from fpp_ml_bench.baselines.learned.classical_scene import DepthScene, channels
from fpp_ml_bench.baselines.learned.odds import SCALE_TO_SIGMA
from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask


@dataclass(frozen=True)
class Filtered:
    """Maps (h, w) of a `DepthScene`: ``depth_mm``, less the scene's median; ``sigma_mm``, its standard uncertainty;
    ``object_logit``; ``near``: whether a neighbour has a depth."""

    depth_mm: Image
    sigma_mm: Image
    object_logit: Image
    near: Mask


def filtered(network: DepthFilter, scene: DepthScene) -> Filtered:
    """Run ``network`` on a scene."""
    height, width = scene.found.shape
    pad = (0, -height % network.stride), (0, -width % network.stride)

    def batch(maps: NDArray) -> torch.Tensor:
        return torch.from_numpy(np.pad(maps, [(0, 0)] * (maps.ndim - 2) + list(pad)))[None]

    with torch.inference_mode():
        x = batch(channels(scene)).contiguous(memory_format=torch.channels_last)
        out = network(x, batch(scene.depth_mm), batch(scene.sigma_mm), batch(scene.found))
        depth, logit, scale, near = (maps[0, :height, :width].numpy() for maps in out)
    return Filtered(depth, np.exp(scale) * np.float32(SCALE_TO_SIGMA * scene.unit_mm), logit, near)


def decided(answer: Filtered, scene: DepthScene, threshold: float) -> Mask:
    """Pixels that get a depth: those that had one, and those beside one whose logit is above ``threshold``."""
    return scene.found | (answer.near & (answer.object_logit > threshold))


def written(answer: Filtered, scene: DepthScene, inside: Mask, shape: tuple[int, int]) -> tuple[Image, Image]:
    """Depth and its standard uncertainty in mm, float32 ``shape``, 0 outside ``inside``."""
    depth_mm, sigma_mm = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    depth_mm[scene.crop] = np.where(inside, answer.depth_mm + np.float32(scene.middle_mm), 0)
    sigma_mm[scene.crop] = np.where(inside, answer.sigma_mm, 0)
    return depth_mm, sigma_mm
