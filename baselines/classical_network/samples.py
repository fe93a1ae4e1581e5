"""Training samples: the decoded scene of each view, with the exact depth; and windows of them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.classical_network.scene import DepthScene, channels
from fpp_ml_bench.baselines.phase_network import place_of
from fpp_ml_bench.baselines.phase_route import Image, Mask
from fpp_ml_bench.baselines.training import View
from fpp_ml_bench.depth import depth_edges

EDGE_POINTS = 2000  # pixels near depth edges and beside missing ones, as centres of training windows
ORIENTATIONS = 8
STRIDES, STRIDE_SHARES = (1, 2, 4), (0.6, 0.25, 0.15)
"""Every so many-th pixel of a view makes a window, and how often: a coarser camera sees steeper, more bent surfaces."""


@dataclass(frozen=True)
class Sample:
    """A view's ``scene`` and the truth: ``exact_mm`` (h, w), less the scene's ``middle_mm``; ``target``: object pixels
    that are not void; ``void``; ``edges`` int32 (n, 2): rows and columns of interest."""

    name: str
    scene: DepthScene
    exact_mm: Image
    target: Mask
    void: Mask
    edges: NDArray[np.int32]


@dataclass(frozen=True)
class Window:
    """One training example, maps (n, n) of a `Sample`; ``x`` (C, n, n); ``valid``: neither void nor padding;
    ``unit_mm``: median sigma of the scene, the unit of the errors."""

    x: Image
    depth_mm: Image
    sigma_mm: Image
    found: Mask
    exact_mm: Image
    target: Mask
    valid: Mask
    unit_mm: NDArray[np.float32]


def sample_of(view: View, method: ClassicalMethod) -> Sample | None:
    """The sample of a view, decoded by ``method``; None where nothing was decoded."""
    frames: list[NDArray[np.uint8] | None] = [None] * len(method.rig.sequence)
    for index, frame in zip(method.frames_used, view.frames, strict=True):
        frames[index] = frame
    answer, modulation = method.measure(frames)
    scene = None if answer.sigma_mm is None else DepthScene.of(answer.depth, answer.sigma_mm, modulation)
    if scene is None:
        return None
    depth_mm, void = view.depth_mm[scene.crop], view.void[scene.crop]
    target = (depth_mm > 0) & ~void
    exact = np.where(target, depth_mm - np.float32(scene.middle_mm), 0).astype(np.float32)
    places = np.argwhere(depth_edges(depth_mm) | (target & ~scene.found)).astype(np.int32)
    chosen = np.random.default_rng(0).permutation(len(places))[:EDGE_POINTS]
    return Sample(view.name, scene, exact, target, void, places[chosen])


def draw(samples: list[Sample], size: int, near_edge: float, random: np.random.Generator) -> Window:
    """A random window of ``size`` px of one of ``samples``, of one of `STRIDES`, in one of 8 orientations."""
    sample = samples[random.integers(len(samples))]
    orientation, every = int(random.integers(ORIENTATIONS)), int(random.choice(STRIDES, p=STRIDE_SHARES))
    rows, columns = place_of(sample.edges, sample.target.shape, size * every, random.random() < near_edge, random)

    def cut(maps: NDArray) -> NDArray:
        part = np.rot90(maps[rows, columns][::every, ::every], orientation % 4)
        part = part[:, ::-1] if orientation >= 4 else part
        return np.pad(part, [(0, size - length) for length in part.shape])

    scene = sample.scene.with_maps(cut)
    return Window(
        channels(scene),
        scene.depth_mm,
        scene.sigma_mm,
        scene.found,
        cut(sample.exact_mm),
        cut(sample.target),
        cut(~sample.void),
        np.asarray(scene.unit_mm, dtype=np.float32),
    )
