"""Training samples: the measured route's scene of each image, with the true phase.

The route runs once an image; the maps that the network needs are held in half precision.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.inputs import Image, Rotation, Scene
from fpp_ml_bench.baselines.phase_route import TAU, CalibrationLayer, Observation, PhaseRoute, Settings, orders
from fpp_ml_bench.depth import depth_edges, object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction, Rig

EDGE_POINTS = 2000
"""Pixels near depth edges that a sample holds, as centres of training windows."""


@dataclass(frozen=True)
class Geometry:
    """Route and rotation for all images of a rig and fringe direction."""

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
    """An image of a training set: the ``scene`` and its ground truth.

    ``missing_rad`` float16 (h, w): true absolute phase minus that of the base order, 0 outside the object; ``target``:
    object pixels; ``edges`` int32 (n, 2): rows and columns beside depth edges and silhouettes.
    """

    name: str
    direction: Direction
    scene: Scene
    missing_rad: NDArray[np.float16]
    target: NDArray[np.bool_]
    edges: NDArray[np.int32]


def first_order(observation: Observation, rig: Rig, settings: Settings) -> tuple[NDArray[np.int32], Image]:
    """The measured route's own order of every pixel (h, w), and its margin."""
    choice, margin = orders.by_shading_and_smoothness(observation.question, rig, settings)
    return orders.spread_over_pixels(
        observation.question, choice, margin, observation.layer.residual_phase(observation.phase_rad, 0.0)
    )


def sample_of(image: NDArray[np.uint8], depth_mm: Image, name: str, geometry: Geometry) -> Sample:
    """Sample of an image uint8 (H, W) and its true depth in mm, 0 = background."""
    settings = geometry.route.settings
    observation = geometry.route.observe(image)
    order, _ = first_order(observation, geometry.rig, settings)
    scene = Scene.of(observation, order, geometry.rig)
    crop_depth_mm = depth_mm[observation.crop]
    target = object_mask(crop_depth_mm)
    true_phase = observation.layer.absolute_phase(np.where(target, crop_depth_mm, 1000.0))
    missing = np.where(target, true_phase - observation.phase_rad - TAU * order, 0.0)
    places = np.argwhere(depth_edges(crop_depth_mm)).astype(np.int32)
    sampled = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    return Sample(
        name, settings.direction, scene.half(), np.nan_to_num(missing).astype(np.float16), target, places[sampled]
    )


def samples_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, progress: Callable[[int], None] = lambda n: None
) -> list[Sample]:
    """Samples of ``names``, in their order."""
    frame = opened.sequence.sinusoids(geometry.route.settings.direction)[0]
    samples = []
    for name in names:
        samples.append(sample_of(np.array(opened.frame(name, frame)), opened.depth_mm(name), name, geometry))
        progress(1)
    return samples
