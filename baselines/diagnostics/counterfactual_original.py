"""A dataset's sample as a scene that can be changed, and what a change of its outline is."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.synth import Darkroom, Scene
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, surface_of_sample
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.pixel_sets import object_mask


@dataclass(frozen=True)
class Original:
    """A sample as it is: ``surface`` and ``scene``, ``target`` bool (H, W) (pixels with a decoded depth, those that are
    scored), exact ``depth_mm`` float64 (H, W), and its object."""

    sample: str
    object: str
    surface: Surface
    scene: Scene
    target: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Recut:
    """The same phase under another outline; ``keeps`` bool (H, W): target pixels that are object before and after."""

    name: str
    scene: Scene
    keeps: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


def original(dataset: DatasetFolder, room: Darkroom, sample: str) -> Original:
    """The sample as the dataset shows it."""
    about, surface = dataset.measured(sample), surface_of_sample(dataset, sample)
    target = object_mask(dataset.depth_mm(sample))
    stream = (dataset.manifest.settings.get("seed", 0), about["object"], about["view"])
    scene = Scene(surface.pixels.astype(np.uint32), room.light(surface), target, stream)
    return Original(sample, about["object"], surface, scene, target, surface.depth_mm(room.shape))
