"""Scenes of the renderer's tests: a small rig, a light without anything but direct light, meshes
and a studio."""

import numpy as np

from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings, SolidMesh
from fpp_ml_bench.loaders.render.sensor import camera_noise
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(176)
X, Y = RIG.camera.rays()
CENTRE = np.array([-0.125, 0.1, 0.0])
"""Of the projector in the camera's frame, from rig.md's coordinates."""
TOWARD_CAMERA = np.array([0.0, 0.0, -1.0])
PAPER = named_light("paper").changed("camera", **camera_noise(0))
"""The paper's light without noise."""
DIRECT = PAPER.changed("bounces", interreflection=False, ambient_occlusion=False).changed(
    "camera", rays_across=1
)
"""Direct light alone, of a matte surface, seen by the central ray of each pixel."""
ALL_PIXELS = np.arange(X.size, dtype=np.uint32)


def solid(mesh, name="thing"):
    return SolidMesh(
        name, np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces, dtype=np.int32)
    )


def sheet(*rectangles, name="sheet"):
    """Rectangles without thickness, each of a corner and two sides in m."""
    vertices, faces = [], []
    for corner, first, second in rectangles:
        n = len(vertices)
        corner, first, second = (np.asarray(v, dtype=float) for v in (corner, first, second))
        vertices += [corner, corner + first, corner + first + second, corner + second]
        faces += [[n, n + 1, n + 2], [n, n + 2, n + 3]]
    return SolidMesh(name, np.array(vertices), np.array(faces, dtype=np.int32))


def plane(z_m):
    """Points and normals of a plane square to the camera's axis, one for each pixel of `RIG`."""
    points = np.column_stack([X.ravel(), Y.ravel(), np.ones(X.size)]) * z_m
    return points, np.broadcast_to(TOWARD_CAMERA, points.shape)


def studio(light: Light = DIRECT, **changes):
    return Studio(BuildSettings(**{"rig": RIG, "objects": ("mug",), "light": light, **changes}))


def kept(row):
    """Copies of a row's frames, which the studio overwrites."""
    return {index: frame.copy() for index, frame in row.frames.items()}
