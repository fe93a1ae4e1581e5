"""Simulated captures for the decoder's tests: a tilted plane before three rigs."""

from dataclasses import replace

import cv2
import numpy as np

from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.patterns import pattern_image
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.optics.sequence import Sequence


def opencv_matrix(device):
    """Intrinsic matrix of a camera or projector, as OpenCV takes it."""
    return np.array([[device.fx, 0, device.cx], [0, device.fy, device.cy], [0, 0, 1]])


def rig_with(sequence, size=200, **changes):
    """The paper's rig with another sequence, as a rig file holds it, and other ``changes``; a key
    that is set to ``...`` is left out."""
    pitch = {} if "steps" in sequence else {"pitch_px": ...}
    data = {**paper_rig(size).to_dict(), **pitch, "sequence": sequence, **changes}
    return rig_from_dict({key: value for key, value in data.items() if value is not ...})


def projected(rig, depth_m):
    """Projector coordinates u and v of what each camera pixel sees at ``depth_m``, (H, W) or one
    number for all."""
    x, y = rig.camera.rays()
    return rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * np.expand_dims(depth_m, -1))


def capture(rig, depth_m, noise=1.0, seed=0, albedo=0.45, ambient=4.0):
    """Frames of a surface at ``depth_m`` (H, W): pattern lookup by OpenCV, light, noise and 8
    bits."""
    u, v = (coordinates.astype(np.float32) for coordinates in projected(rig, depth_m))
    rng = np.random.default_rng(seed)
    frames = []
    for index in range(len(rig.sequence)):
        pattern = cv2.remap(pattern_image(rig, index).astype(np.float32), u, v, cv2.INTER_LINEAR)
        image = ambient + albedo * pattern + noise * rng.standard_normal(pattern.shape)
        frames.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return frames


def tilted(rig):
    x, y = rig.camera.rays()
    return 1.8 / (1.0 - 0.4 * x + 0.25 * y)


PAPER = paper_rig(200)
TURNED = Rig(
    camera=Pinhole(180, 160, 420.0, 415.0, 91.0, 77.0, (-0.15, 0.06, 0.001, -0.001, 0.0)),
    projector=Pinhole(900, 1100, 1800.0, 1790.0, 455.0, 540.0),
    rotation=rotation_matrix((-0.03, 0.04, 0.05)),
    translation_m=(0.15, -0.12, 0.03),
    pitch_horizontal_px=17.3,
    pitch_vertical_px=20.0,
    sequence=Sequence(9, 8, 7),
)
LENSES = replace(
    TURNED, projector=replace(TURNED.projector, distortion=(0.05, -0.03, 0.001, -0.001, 0.0))
)
