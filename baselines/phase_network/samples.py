"""Training samples: what the measured route saw of each image beside the phase it should have seen.

The route runs once an image; what the network needs of it is kept in half precision.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.inputs import Image, Rotation, Scene
from fpp_ml_bench.baselines.phase_route import orders
from fpp_ml_bench.baselines.phase_route.calibration_layer import TAU, CalibrationLayer
from fpp_ml_bench.baselines.phase_route.observation import Observation
from fpp_ml_bench.baselines.phase_route.route import PhaseRoute
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.pixel_sets import depth_edges, object_mask
from fpp_ml_bench.rig import Rig

EDGE_POINTS = 2000
"""Places near depth edges that a sample keeps, for windows to be centred on."""


@dataclass(frozen=True)
class Geometry:
    """What all images of one rig and fringe direction share."""

    rig: Rig
    route: PhaseRoute
    rotation: Rotation

    @classmethod
    def of(cls, rig: Rig, settings: Settings) -> "Geometry":
        route = PhaseRoute(rig, settings)
        return cls(rig, route, Rotation.of(route.layer, settings.direction))

    @property
    def layer(self) -> CalibrationLayer:
        return self.route.layer


@dataclass(frozen=True)
class Sample:
    """One image of a training set: the ``scene``, and what is true there.

    ``missing_rad`` float16 (h, w): true absolute phase less that of the base, 0 outside the object; ``target``: object
    pixels; ``edges`` int32 (n, 2): rows and columns beside depth edges and silhouettes.
    """

    name: str
    direction: Direction
    scene: Scene
    missing_rad: NDArray[np.float16]
    target: NDArray[np.bool_]
    edges: NDArray[np.int32]


def first_order(seen: Observation, rig: Rig, settings: Settings) -> tuple[NDArray[np.int32], Image]:
    """The measured route's own order of every pixel (h, w), and its margin."""
    choice, margin = orders.by_shading_and_smoothness(seen.question, rig, settings)
    return orders.spread_over_pixels(seen.question, choice, margin, seen.layer.residual_phase(seen.phase_rad, 0.0))


def sample_of(image: NDArray[np.uint8], depth_mm: Image, name: str, geometry: Geometry) -> Sample:
    """Sample of one image uint8 (H, W) and its true depth in mm, 0 = background."""
    settings = geometry.route.settings
    seen = geometry.route.observe(image)
    order, _ = first_order(seen, geometry.rig, settings)
    scene = Scene.of(seen, order, geometry.rig)
    part = depth_mm[seen.crop]
    target = object_mask(part)
    true = seen.layer.absolute_phase(np.where(target, part, 1000.0))
    missing = np.where(target, true - seen.phase_rad - TAU * order, 0.0)
    places = np.argwhere(depth_edges(part)).astype(np.int32)
    chosen = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    return Sample(
        name, settings.direction, scene.half(), np.nan_to_num(missing).astype(np.float16), target, places[chosen]
    )


def samples_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, progress: Callable[[int], None] = lambda n: None
) -> list[Sample]:
    """Samples of ``names``, in their order."""
    frame = opened.sequence.sinusoids(geometry.route.settings.direction)[0]
    found = []
    for name in names:
        found.append(sample_of(np.array(opened.frame(name, frame)), opened.depth_mm(name), name, geometry))
        progress(1)
    return found
