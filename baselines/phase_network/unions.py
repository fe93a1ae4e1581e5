"""Several training objects in one place: depth jumps and creases that no single one of them has.

All objects of a dataset stand in the same field before the same lamp, so the nearer of two images at every pixel is
what the rig would capture of both standing there, through each other where they meet, but for the light that one takes
from the other. No new object, no renderer.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_network.samples import Geometry, Sample, sample_of
from fpp_ml_bench.loaders.store import DatasetFolder

SHADOW_GREY = 6.0
"""Grey levels by which one background must be darker than the other to count as an object's shadow on the plane."""
MOST = 3
"""Objects in one union, at most."""


def united(
    images: Sequence[NDArray[np.uint8]], depths_mm: Sequence[NDArray[np.floating]]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Image uint8 (H, W) and depth in mm float32 (H, W), 0 = background, of all objects together.

    The nearest surface counts; where none is, the first image's background, or another's where an object shadows it.
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
    """One or two samples that show other objects than ``sample`` does, each another; fewer where there are none.

    ``objects``: the object of every sample that may be taken."""
    here = [sample]
    for _ in range(int(random.integers(1, MOST))):
        seen = {objects[one] for one in here}
        others = [one for one, shown in objects.items() if shown not in seen]
        if others:
            here.append(others[int(random.integers(len(others)))])
    return here[1:]


def unions_of(
    opened: DatasetFolder, names: Sequence[str], geometry: Geometry, count: int, seed: int,
    progress: Callable[[int], None] = lambda n: None,
) -> list[Sample]:  # fmt: skip
    """``count`` unions of every one of ``names`` with others of them, the same objects for both fringe directions."""
    frame = opened.sequence.sinusoids(geometry.route.settings.direction)[0]
    objects = {name: str(opened.measured(name)["object"]) for name in names}
    found = []
    for number, name in enumerate(names):
        for copy in range(count):
            random = np.random.default_rng([seed, number, copy])
            members = [name, *companions(objects, name, random)]
            if len(members) > 1:
                image, depth_mm = united(
                    [np.asarray(opened.frame(one, frame)) for one in members],
                    [opened.depth_mm(one) for one in members],
                )
                found.append(sample_of(image, depth_mm, "+".join(members), geometry))
            progress(1)
    return found
