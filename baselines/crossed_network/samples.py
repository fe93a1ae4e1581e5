"""Training samples of crossed-net: the measured route's scene of each view, with the truth; and windows of them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.crossed_network import inputs
from fpp_ml_bench.baselines.crossed_network.inputs import Scene
from fpp_ml_bench.baselines.crossed_route import Carriers, CrossedRoute
from fpp_ml_bench.baselines.phase_network import IGNORED, Window, place_of
from fpp_ml_bench.baselines.phase_route import Image, Mask
from fpp_ml_bench.baselines.training import View
from fpp_ml_bench.depth import depth_edges

EDGE_POINTS = 2000  # pixels near depth edges that a sample holds, as centres of training windows
FURTHEST_RAD = 2.2
"""Distance in rad of the joint phase from a candidate beyond which it is not the right one: rivals are 2 pi away."""


@dataclass(frozen=True)
class Sample:
    """A view's ``scene`` and its truth: ``missing_rad`` float16 (h, w): joint phase of the true nearness less that of
    the scene's, 0 outside the object; ``target``: object pixels that are not void; ``void``; ``edges`` int32 (n, 2):
    rows and columns beside depth edges and silhouettes."""

    name: str
    scene: Scene
    missing_rad: NDArray[np.float16]
    target: Mask
    void: Mask
    edges: NDArray[np.int32]


def sample_of(view: View, route: CrossedRoute) -> Sample:
    """The sample of a view; its void pixels are no target, and no background either."""
    seen = route.observe(view.frames[0])
    crop = seen.carriers.crop
    depth_mm, void = view.depth_mm[crop], view.void[crop]
    target = (depth_mm > 0) & ~void
    truth = seen.carriers.nearness(np.where(target, depth_mm, 1000.0))
    missing = np.where(target, (truth - seen.fit.nearness) * seen.carriers.joint_gain, 0.0)
    places = np.argwhere(depth_edges(depth_mm)).astype(np.int32)
    sampled = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    scene = Scene.of(seen).single(np.float16)
    return Sample(view.name, scene, np.clip(missing, -100, 100).astype(np.float16), target, void, places[sampled])


@dataclass(frozen=True)
class Variation:
    """How often (0 to 1) windows lie near an edge, get a wrong base order in the whole or in patches, and lose what the
    plane tells."""

    near_edge: float = 0.7
    wrong_window: float = 0.1
    wrong_patch: float = 0.25
    no_plane: float = 0.1


def draw(samples: list[Sample], carriers: Carriers, size: int, vary: Variation, random: np.random.Generator) -> Window:
    """A random window of ``size`` px of one of ``samples``, in one of 8 orientations."""
    sample = samples[random.integers(len(samples))]
    rows, columns = place_of(sample.edges, sample.target.shape, size, random.random() < vary.near_edge, random)
    scene, missing = sample.scene.window(rows, columns).single(), sample.missing_rad[rows, columns].astype(np.float32)
    target, void = sample.target[rows, columns], sample.void[rows, columns]
    before = scene.nearness
    scene = _wrong(scene, carriers, vary, random)
    if scene.nearness is not before:
        missing = np.where(target, missing - (scene.nearness - before) * carriers.at(scene.crop).joint_gain, 0)
    if random.random() < vary.no_plane:
        scene = inputs.without_plane(scene)
    x, exists = inputs.channels(scene, carriers)
    distance = np.stack([missing - scene.step_rad[0], missing, missing - scene.step_rad[1]])
    apart = np.where(exists, np.abs(distance), np.inf)
    place = apart.argmin(axis=0)
    possible = target & (apart.min(axis=0) < FURTHEST_RAD)
    correction = np.take_along_axis(distance, place[None], axis=0)[0] * possible
    order = np.where(possible, place, IGNORED)
    maps, x = inputs.symmetric([exists, order, correction, possible, target, ~void], x, int(random.integers(8)))
    height, width = x.shape[-2:]
    pad = ((0, size - height), (0, size - width))
    deep = ((0, 0), *pad)
    exists, order, correction, possible, target, valid = maps
    return Window(
        np.pad(x, deep),
        np.pad(exists, deep, constant_values=True),
        np.pad(order, pad, constant_values=IGNORED).astype(np.int64),
        np.pad(correction, pad).astype(np.float32),
        np.pad(possible, pad),
        np.pad(target, pad),
        np.pad(valid, pad),
    )


def _wrong(scene: Scene, carriers: Carriers, vary: Variation, random: np.random.Generator) -> Scene:
    """Wrong base orders, where another one exists: the measured route has few in training objects."""
    shape = scene.light.shape
    if random.random() < vary.wrong_window:
        where = np.ones(shape, bool)
    elif random.random() < vary.wrong_patch:
        coarse = random.standard_normal((12, 12)).astype(np.float32)
        noise: Image = cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC)  # type: ignore[assignment]
        where = noise > random.uniform(0.5, 1.5)
    else:
        return scene
    return scene.with_base(int(random.choice((0, 2))), where, carriers)
