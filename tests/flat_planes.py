"""A fringe on a plane that fills the frame, from the benchmark's own light and sensor: what its builder can't place."""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.loaders.render import Exposure, Lighting, Noise, light_surface
from fpp_ml_bench.optics import Rig


def plane_depth_m(rig: Rig, distance_m: float, tilt: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """Depth (H, W) in m of the plane Z = distance + tilt_x X + tilt_y Y."""
    x, y = rig.camera.rays()
    return distance_m / (1 - tilt[0] * x - tilt[1] * y)


def plane_fringe(
    rig: Rig, frame: int, depth_m: NDArray[np.float64], tilt: tuple[float, float] = (0.0, 0.0), noise: float = 1.0
) -> NDArray[np.uint8]:
    """Frame ``frame`` of a matte plane, uint8 (H, W)."""
    x, y = rig.camera.rays()
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m[..., None]
    normal = np.array([tilt[0], tilt[1], -1.0])
    normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
    lit = light_surface(points.reshape(-1, 3), normals.reshape(-1, 3), rig, Lighting())
    pixels = np.arange(x.size, dtype=np.uint32)
    exposure = Exposure.of(rig, Noise.of_sigma(noise))
    return exposure.expose([frame], lit, pixels, (7, "plane", frame))[0].reshape(x.shape)
