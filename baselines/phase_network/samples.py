"""Training samples: the measured route's scene of each image, with the true phase, in half precision.

Unions are several training objects in one image, for depth jumps and creases that no single object has. All share
rig and light: the image whose surface is nearer, at every pixel, is what the rig would capture of
all of them together (they may intersect), except for the shadows that they cast on one another.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.inputs import Geometry, Scene
from fpp_ml_bench.baselines.phase_route import TAU, Image, Mask, of_choice
from fpp_ml_bench.depth import depth_edges, object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction

EDGE_POINTS = 2000  # pixels near depth edges that a sample holds, as centres of training windows
SHADOW_GREY = 6.0
"""Grey levels by which a background must be darker than the other to count as an object's shadow on the plane."""
MOST_OBJECTS = 3  # objects in one union, at most


@dataclass(frozen=True)
class Sample:
    """An image of a training set: the ``scene`` and its ground truth. ``missing_rad`` float16 (h, w): true absolute
    phase minus that of the base order, 0 outside the object; ``target``: object pixels; ``edges`` int32 (n, 2): rows
    and columns beside depth edges and silhouettes."""

    name: str
    direction: Direction
    scene: Scene
    missing_rad: NDArray[np.float16]
    target: Mask
    edges: NDArray[np.int32]


def sample_of(image: NDArray[np.uint8], depth_mm: Image, name: str, geometry: Geometry) -> Sample:
    """Sample of an image uint8 (H, W) and its true depth in mm, 0 = background."""
    observation = geometry.route.observe(image)
    order, _ = geometry.route.choose(observation)
    scene = Scene.of(observation, order)
    crop_depth_mm = depth_mm[observation.crop]
    target = object_mask(crop_depth_mm)
    true_phase = observation.layer.absolute_phase(np.where(target, crop_depth_mm, 1000.0))
    missing = np.where(target, true_phase - observation.phase_rad - TAU * order, 0.0)
    places = np.argwhere(depth_edges(crop_depth_mm)).astype(np.int32)
    sampled = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    direction, half = geometry.route.settings.direction, np.nan_to_num(missing).astype(np.float16)
    return Sample(name, direction, scene.single(np.float16, np.int16), half, target, places[sampled])


def samples_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, progress: Callable[[int], None] = lambda n: None
) -> list[Sample]:
    """Samples of ``names``, in their order."""
    samples = []
    for name in names:
        samples.append(sample_of(_image(opened, name, geometry), opened.depth_mm(name), name, geometry))
        progress(1)
    return samples


def _image(opened: DatasetFolder, name: str, geometry: Geometry) -> NDArray[np.uint8]:
    """The first fringe of a sample, a copy of its own."""
    return np.array(opened.frame(name, opened.sequence.sinusoids(geometry.route.settings.direction)[0]))


def united(
    images: Sequence[NDArray[np.uint8]], depths_mm: Sequence[NDArray[np.floating]]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image uint8 (H, W) and depth in mm float32 (H, W), 0 = background, of all objects together. The nearest surface
    counts; without one, the first image's background, or another image's where it is in shadow."""
    ranges, stacked = np.stack([np.where(depth > 0, depth, np.inf) for depth in depths_mm]), np.stack(images)
    nearest = ranges.argmin(axis=0)
    depth, image, darkest = of_choice(ranges, nearest), of_choice(stacked, nearest), stacked.min(axis=0)
    empty = np.isinf(depth)
    shadow = empty & (darkest + SHADOW_GREY < image)
    return np.where(shadow, darkest, image), np.where(empty, 0.0, depth).astype(np.float32)


def companions(objects: Mapping[str, str], sample: str, random: np.random.Generator) -> list[str]:
    """One or two samples of objects that differ from that of ``sample`` and from each other; fewer if there are none.
    ``objects``: the object of every sample to choose from."""
    members = [sample]
    for _ in range(int(random.integers(1, MOST_OBJECTS))):
        shown = {objects[member] for member in members}
        candidates = [member for member, object_name in objects.items() if object_name not in shown]
        if candidates:
            members.append(candidates[int(random.integers(len(candidates)))])
    return members[1:]


def unions_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, count: int, seed: int,
    progress: Callable[[int], None] = lambda n: None,
) -> list[Sample]:  # fmt: skip
    """``count`` unions of each of ``names`` with others of them, the same objects for both fringe directions."""
    objects = {name: str(opened.measured(name)["object"]) for name in names}
    samples = []
    for number, name in enumerate(names):
        for copy in range(count):
            members = [name, *companions(objects, name, np.random.default_rng([seed, number, copy]))]
            if len(members) > 1:
                images = [_image(opened, member, geometry) for member in members]
                image, depth_mm = united(images, [opened.depth_mm(member) for member in members])
                samples.append(sample_of(image, depth_mm, "+".join(members), geometry))
            progress(1)
    return samples
