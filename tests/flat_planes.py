"""Scenes of the phase routes' tests: an object, and a fringe on a plane that fills the frame, from
the benchmark's own light and sensor: what its builder can't place."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.loaders.render.illumination import light_surface
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.sensor import Exposure, camera_noise
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig

RIG = paper_rig(480)
OTHER_RIG = replace(
    RIG,
    translation_m=(0.22, -0.16, 0.0),
    pitch_horizontal_px=24.0,
    pitch_vertical_px=27.0,
    working_range_mm=(1400.0, 2200.0),
    background_m=2.9,
)
FIRST = {"horizontal": 0, "vertical": 18}
"""The first fringe of each direction."""
PAPER = named_light("paper")
DIRECT = PAPER.changed("bounces", interreflection=False, ambient_occlusion=False).changed(
    "camera", rays_across=1
)
"""Light of one bounce, on the central ray of each pixel: closed forms of noise and modulation hold
in it."""
USERS_WORD = {"white_grey": PAPER.camera.reference_grey, "ambient_grey": PAPER.ambient_grey}
"""Photometric calibration of a plane that fills the frame: no background is left to calibrate its
brightness."""


@cache
def photograph(name: str, view: str, rig: Rig = RIG, light: Light = PAPER):
    """An object of the benchmark, anywhere in the working range."""
    studio = Studio(BuildSettings(rig=rig, objects=(name,), placement="varied", light=light))
    row = studio.photograph(solid_mesh(name), view)
    return replace(row, frames={index: frame.copy() for index, frame in row.frames.items()})


def plane_depth_m(
    rig: Rig, distance_m: float, tilt: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Depth (H, W) in m of the plane Z = distance + tilt_x X + tilt_y Y."""
    x, y = rig.camera.rays()
    return distance_m / (1 - tilt[0] * x - tilt[1] * y)


def turned(rig: Rig, degrees: float, translation_m: tuple[float, float, float]) -> Rig:
    """``rig`` with a projector that is turned about the vertical axis, and stands elsewhere."""
    cosine, sine = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    rotation = ((cosine, 0.0, sine), (0.0, 1.0, 0.0), (-sine, 0.0, cosine))
    return replace(rig, rotation=rotation, translation_m=translation_m)


def plane_fringe(rig: Rig, frame: int, *plane: Any, **light: Any) -> NDArray[np.uint8]:
    """Frame ``frame`` of `plane_frames`."""
    return plane_frames(rig, [frame], *plane, **light)[frame]


def plane_frames(
    rig: Rig,
    indices: Sequence[int],
    depth_m: NDArray[np.float64],
    tilt: tuple[float, float] = (0.0, 0.0),
    noise: float = 1.0,
    light: Light = PAPER,
) -> list[Any]:
    """The rig's frames of a matte plane, uint8 (H, W) at ``indices`` and else None."""
    x, y = rig.camera.rays()
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * depth_m[..., None]
    normal = np.array([tilt[0], tilt[1], -1.0])
    normals = np.broadcast_to(normal / np.linalg.norm(normal), points.shape)
    light = light.changed("camera", **camera_noise(noise))
    exposure = Exposure.of(rig, light)
    lit = light_surface(points.reshape(-1, 3), normals.reshape(-1, 3), rig, light, exposure.pattern)
    pixels = np.arange(x.size, dtype=np.uint32)
    frames: list[Any] = [None] * len(rig.sequence)
    images = exposure.expose(list(indices), lit, pixels, (7, "plane", 0))
    for index, image in zip(indices, images, strict=True):
        frames[index] = image.reshape(x.shape)
    return frames
