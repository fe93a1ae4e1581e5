"""A dataset's sample as a scene that can be changed, and the same sample under another outline."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.synth import Scene, SceneRenderer
from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface, surface_of_sample
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder


@dataclass(frozen=True)
class Original:
    """An unchanged sample: its ``object``, ``surface`` and ``scene``, exact ``depth_mm`` float64 (H, W), and ``target``
    bool (H, W): the pixels with a decoded depth, which are scored."""

    sample: str
    object: str
    surface: Surface
    scene: Scene
    target: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


@dataclass(frozen=True)
class OutlineChange:
    """The same phase under another outline; ``unchanged`` bool (H, W): target pixels that show the object before and
    after."""

    name: str
    scene: Scene
    unchanged: NDArray[np.bool_]
    depth_mm: NDArray[np.float64]


def original(dataset: DatasetFolder, renderer: SceneRenderer, sample: str) -> Original:
    """``sample`` as the dataset shows it."""
    record, surface = dataset.measured(sample), surface_of_sample(dataset, sample)
    target = object_mask(dataset.depth_mm(sample))
    stream = (dataset.manifest.settings.get("seed", 0), record["object"], record["view"])
    scene = Scene(surface.pixels.astype(np.uint32), renderer.light(surface), target, stream)
    return Original(sample, record["object"], surface, scene, target, surface.depth_mm(renderer.shape))
