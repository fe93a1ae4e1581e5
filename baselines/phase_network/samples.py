"""Training samples: the measured route's scene of each view, with the true phase, in half precision."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.inputs import Geometry, Scene
from fpp_ml_bench.baselines.phase_route import TAU, Image, Mask
from fpp_ml_bench.baselines.training import View
from fpp_ml_bench.depth import depth_edges, object_mask
from fpp_ml_bench.optics import Direction

EDGE_POINTS = 2000  # pixels near depth edges that a sample holds, as centres of training windows


@dataclass(frozen=True)
class Sample:
    """An image of a training set: the ``scene`` and its ground truth. ``missing_rad`` float16 (h, w): true absolute
    phase minus that of the base order, 0 outside the object; ``target``: object pixels that are not ``void``, which are
    neither object nor background; ``edges`` int32 (n, 2): rows and columns beside depth edges and silhouettes;
    ``group``: the light it is of."""

    name: str
    group: str
    direction: Direction
    scene: Scene
    missing_rad: NDArray[np.float16]
    target: Mask
    void: Mask
    edges: NDArray[np.int32]


def sample_of(
    image: NDArray[np.uint8],
    depth_mm: Image,
    void: Mask,
    name: str,
    group: str,
    geometry: Geometry,
    shading: bool = True,
) -> Sample | None:
    """Sample of an image uint8 (H, W), its true depth in mm, 0 = background, and its ``void`` pixels (H, W), which
    count nowhere; None where nothing calibrates its brightness, or no object is seen. ``shading``: as of
    `Scene.of`."""
    observation = geometry.route.observe(image)
    if not observation.background.calibrated or not observation.inside.any():
        return None
    order, _ = geometry.route.choose(observation)
    scene = Scene.of(observation, order, shading)
    crop_depth_mm, crop_void = depth_mm[observation.crop], void[observation.crop]
    target = object_mask(crop_depth_mm) & ~crop_void
    if not target.any():
        return None
    true_phase = observation.layer.absolute_phase(np.where(target, crop_depth_mm, 1000.0))
    missing = np.where(target, true_phase - observation.phase_rad - TAU * order, 0.0)
    places = np.argwhere(depth_edges(crop_depth_mm)).astype(np.int32)
    sampled = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    direction, half = geometry.route.settings.direction, np.nan_to_num(missing).astype(np.float16)
    scene = scene.single(np.float16, np.int16)
    return Sample(name, group, direction, scene, half, target, crop_void, places[sampled])


def samples_of(views: Iterable[View], geometries: Mapping[Direction, Geometry], shading: bool) -> list[Sample]:
    """Samples of ``views``, whose frames are the first fringes of the directions of ``geometries``, in their order; of
    a union for one direction alone, in turn. A view whose light the background does not calibrate is left out, since
    the network is not used on it."""
    samples: list[Sample] = []
    unions = 0
    for view in views:
        pairs = list(zip(geometries.values(), view.frames, strict=True))
        if view.united:
            pairs = [pairs[unions % len(pairs)]]
            unions += 1
        for geometry, frame in pairs:
            sample = sample_of(frame, view.depth_mm, view.void, view.name, view.group, geometry, shading)
            samples += [] if sample is None else [sample]
    return samples
