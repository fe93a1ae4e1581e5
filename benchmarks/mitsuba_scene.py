"""A scene of the paper's rig in the path tracer Mitsuba 3, and images of light as `path_traced.py` compares them."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from fpp_ml_bench.loaders.render import Light, SolidMesh, place, projector_centre_m
from fpp_ml_bench.loaders.render.illumination import grey_of_white
from fpp_ml_bench.optics import Rig, pattern_profiles


@dataclass(frozen=True)
class Images:
    """Light in grey levels: ``white`` float64 (H, W), and ``harmonic`` complex (H, W), the first of the 18 frames."""

    white: NDArray[np.float64]
    harmonic: NDArray[np.complex128]
    seconds: float

    @classmethod
    def mean(cls, a: "Images", b: "Images") -> "Images":
        return cls((a.white + b.white) / 2, (a.harmonic + b.harmonic) / 2, (a.seconds + b.seconds) / 2)


def first_harmonic(frames: NDArray[np.float64]) -> NDArray[np.complex128]:
    """2/N sum I_k exp(-2 pi i k / N) of N frames along the first axis; its angle is the N-step phase."""
    steps = len(frames)
    weights = 2 / steps * np.exp(-2j * np.pi * np.arange(steps) / steps)
    return np.tensordot(weights, frames, axes=1)


class PathTraced:
    """A scene in Mitsuba: the same mesh in the same place, before the same plane, lit by the same projector."""

    def __init__(self, mi: Any, mesh: SolidMesh, rig: Rig, light: Light, folder: Path) -> None:
        self.mi, self.rig, self.light = mi, rig, light
        vertices_m, _ = place(mesh, "A0", rig, "fixed", 42)
        self.file = folder / f"{mesh.name}.ply"
        trimesh.Trimesh(vertices_m, mesh.faces, process=False).export(self.file)
        u = rig.camera.fx * vertices_m[:, 0] / vertices_m[:, 2] + rig.camera.cx
        v = rig.camera.fy * vertices_m[:, 1] / vertices_m[:, 2] + rig.camera.cy
        self.left, self.top = int(u.min()) - 2, int(v.min()) - 2
        self.width, self.height = int(u.max()) + 3 - self.left, int(v.max()) + 3 - self.top

    def render(self, length: int, samples: int, seed: int) -> Images:
        """Light by paths of up to ``length`` pieces from the camera, ``samples`` a pixel; 0 beside the object's box."""
        start = time.process_time()
        pixels = np.array(self.mi.render(self.mi.load_dict(self._scene(length, samples)), seed=seed), dtype=np.float64)
        seconds = time.process_time() - start
        whole = np.zeros((self.rig.camera.height, self.rig.camera.width, 3))
        whole[self.top : self.top + self.height, self.left : self.left + self.width] = pixels
        white = whole[..., 0]
        return Images(white, 2 * whole[..., 1] - white + 1j * (2 * whole[..., 2] - white), seconds)

    def _scene(self, length: int, samples: int) -> dict[str, Any]:
        rig, surface, camera = self.rig, self.light.surface, self.rig.camera
        projector = rig.projector
        row = first_harmonic(np.array(pattern_profiles(rig))[list(rig.sequence.sinusoids("horizontal"))] / 255.0)
        row = row[: projector.height]
        channels = np.stack([np.ones_like(row.real), (1 + row.real) / 2, (1 + row.imag) / 2], axis=1)
        screen = np.repeat(channels[:, None], projector.width, axis=1).astype(np.float32)
        centre = projector_centre_m(rig)
        # Mitsuba multiplies by pi, so a white surface that faces the lamp at 1 m has radiance `scale`.
        power = grey_of_white(self.light) * (rig.working_range_mm[0] / 1000) ** 2
        matte: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": surface.albedo}}
        mirror = {"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": surface.roughness**2}
        blend = {"type": "blendbsdf", "weight": surface.gloss, "matte": matte, "mirror": mirror}
        wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": (1 - surface.gloss) * surface.albedo}}
        film = {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},
            "crop_offset_x": self.left,
            "crop_offset_y": self.top,
            "crop_width": self.width,
            "crop_height": self.height,
        }
        return {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": length, "rr_depth": 1000},
            "camera": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": _field_degrees(camera),
                "near_clip": 0.1,
                "far_clip": 100.0,
                "to_world": self._looking(np.zeros(3)),
                "film": film,
                "sampler": {"type": "multijitter", "sample_count": samples},
            },
            "projector": {
                "type": "projector",
                "fov": _field_degrees(projector),
                "scale": power,
                "to_world": self._looking(centre),
                "irradiance": {"type": "bitmap", "bitmap": self.mi.Bitmap(screen), "raw": True, "wrap_mode": "clamp"},
            },
            "object": {
                "type": "ply",
                "filename": str(self.file),
                "face_normals": True,
                "bsdf": {"type": "twosided", "surface": blend if surface.gloss else matte},
            },
            "wall": {
                "type": "rectangle",
                "bsdf": {"type": "twosided", "surface": wall},
                "to_world": self.mi.ScalarTransform4f().translate([0, 0, rig.background_m]).scale([20, 20, 1]),
            },
        }

    def _looking(self, origin: NDArray[np.float64]) -> Any:
        target = origin + np.array([0.0, 0.0, 1.0])
        return self.mi.ScalarTransform4f().look_at(origin=origin.tolist(), target=target.tolist(), up=[0, -1, 0])


def _field_degrees(pinhole: Any) -> float:
    return float(np.degrees(2 * np.arctan(pinhole.width / 2 / pinhole.fx)))
