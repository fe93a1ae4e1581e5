"""Unions: several training objects in one image, for depth jumps and creases that no single object has.

All objects of a dataset are captured by the same rig in the same light. Taking, at every pixel, the image whose surface
is nearer gives what the rig would capture of all of them together (they may intersect), except for the shadows that
they cast on one another. This needs no new object and no renderer.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.samples import Geometry, Sample, sample_of
from fpp_ml_bench.loaders.storage import DatasetFolder

SHADOW_GREY = 6.0
"""Grey levels by which a background must be darker than the other to count as an object's shadow on the plane."""
MOST_OBJECTS = 3
"""Objects in one union, at most."""


def united(
    images: Sequence[NDArray[np.uint8]], depths_mm: Sequence[NDArray[np.floating]]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image uint8 (H, W) and depth in mm float32 (H, W), 0 = background, of all objects together.

    The nearest surface counts; without one, the first image's background, or another image's where it is in shadow.
    """
    ranges = np.stack([np.where(depth > 0, depth, np.inf) for depth in depths_mm])
    nearest = ranges.argmin(axis=0)
    depth = np.take_along_axis(ranges, nearest[None], axis=0)[0]
    stacked = np.stack(images)
    image = np.take_along_axis(stacked, nearest[None], axis=0)[0]
    empty = np.isinf(depth)
    darkest = stacked.min(axis=0)
    shadow = empty & (darkest + SHADOW_GREY < image)
    return np.where(shadow, darkest, image), np.where(empty, 0.0, depth).astype(np.float32)


def companions(objects: Mapping[str, str], sample: str, random: np.random.Generator) -> list[str]:
    """One or two samples of objects that differ from that of ``sample`` and from each other; fewer if there are none.

    ``objects``: the object of every sample to choose from."""
    members = [sample]
    for _ in range(int(random.integers(1, MOST_OBJECTS))):
        shown_objects = {objects[member] for member in members}
        candidates = [member for member, object_name in objects.items() if object_name not in shown_objects]
        if candidates:
            members.append(candidates[int(random.integers(len(candidates)))])
    return members[1:]


def unions_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, count: int, seed: int,
    progress: Callable[[int], None] = lambda n: None,
) -> list[Sample]:  # fmt: skip
    """``count`` unions of each of ``names`` with others of them, the same objects for both fringe directions."""
    frame = opened.sequence.sinusoids(geometry.route.settings.direction)[0]
    objects = {name: str(opened.measured(name)["object"]) for name in names}
    samples = []
    for number, name in enumerate(names):
        for copy in range(count):
            random = np.random.default_rng([seed, number, copy])
            members = [name, *companions(objects, name, random)]
            if len(members) > 1:
                image, depth_mm = united(
                    [np.asarray(opened.frame(member, frame)) for member in members],
                    [opened.depth_mm(member) for member in members],
                )
                samples.append(sample_of(image, depth_mm, "+".join(members), geometry))
            progress(1)
    return samples
