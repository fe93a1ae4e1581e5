"""Crossed frames of surfaces of known depth, by the formula of the light alone."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.route import CrossedRoute, two_carriers
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig

SIZE = 320
RIG = replace(crossed_rig(960), camera=crossed_rig(SIZE).camera)
FAMILY: Crossed = RIG.crossed  # type: ignore[assignment]
NO_PLANE = replace(paper_rig(SIZE), background_m=None)


@cache
def route(rig: Rig = RIG, family: Crossed = FAMILY) -> CrossedRoute:
    return two_carriers(TwoCarriers(rig, family=family))


def frame(
    depth_mm: NDArray,
    rig: Rig = RIG,
    family: Crossed = FAMILY,
    white_grey: NDArray | float = 160.0,
    ambient_grey: float = 6.0,
    noise_grey: float = 0.7,
    background_grey: NDArray | float = 50.0,
    number: int = 0,
    gamma: float = 1.0,
) -> NDArray[np.uint8]:
    """Crossed frame ``number`` uint8 (H, W) of a surface at ``depth_mm`` (H, W), 0 where the
    background is; ``gamma``: of the projector."""
    x, y = rig.camera.rays()
    z = np.where(depth_mm > 0, depth_mm / 1000, rig.background_m or 3.2)
    u, v = rig.project(np.stack([x * z, y * z, z], axis=-1))
    waves = [
        weight * np.cos(2 * np.pi * (along_u * u + along_v * v) + np.radians(shift))
        for weight, (along_u, along_v), shift in zip(
            family.weights, family.cycles_per_px, family.shifts_deg[number], strict=True
        )
    ]
    white = np.where(depth_mm > 0, white_grey, background_grey)
    grey = ambient_grey + white * (0.5 + 0.5 * (waves[0] + waves[1])) ** gamma
    return noisy(grey, noise_grey, 7 + number)


def noisy(grey: NDArray, noise_grey: float = 0.7, seed: int = 3) -> NDArray[np.uint8]:
    """What a camera makes of ``grey`` levels, uint8 of the same shape."""
    noise = np.random.default_rng(seed).normal(0, noise_grey, grey.shape)
    return np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)


def slab(rig: Rig = RIG, middle_mm: float = 1800.0, slope: float = 0.4) -> NDArray[np.float64]:
    """Depth in mm (H, W) of a square slab before the background, tilted by ``slope`` mm a px; 0
    around it."""
    height, width = rig.camera.height, rig.camera.width
    y, x = np.mgrid[:height, :width]
    inside = (np.abs(x - width / 2) < width * 0.28) & (np.abs(y - height / 2) < height * 0.28)
    return np.where(inside, middle_mm + slope * (x - width / 2), 0.0)
