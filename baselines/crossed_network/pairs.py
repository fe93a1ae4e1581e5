"""The views that crossed-net learns from as pairs of a frame and depth, for networks from image to depth.

A control: the paper's networks in the same drawn lights. Their input is standardised by the frame itself, so that no
absolute grey level reaches them either.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines import training
from fpp_ml_bench.baselines.crossed_network.training import CrossedRecipe
from fpp_ml_bench.baselines.training import View
from fpp_ml_bench.depth import Normalisation, RangeRule, object_mask
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.loaders.training import FringeDepthDataset
from fpp_ml_bench.optics import crossed_rig


class ViewSource:
    """Rendered views, by names that say their light, with what `FringeDepthDataset` asks of a dataset folder."""

    def __init__(self, views: list[View], fingerprint: str) -> None:
        self.fingerprint = fingerprint
        self._views = {f"{view.group}-{view.name}": view for view in views}
        self.samples, self.size = list(self._views), views[0].depth_mm.shape

    def frame(self, sample: str, index: int) -> NDArray[np.uint8]:
        return self._views[sample].frames[index]

    def depth_mm(self, sample: str) -> NDArray[np.float32]:
        return self._views[sample].depth_mm

    def void(self, sample: str) -> NDArray[np.bool_]:
        return self._views[sample].void

    def left_out(self, sample: str, rule: RangeRule) -> NDArray[np.bool_] | None:
        return self.void(sample) if rule == "valid" else None

    def measured(self, sample: str) -> Mapping[str, float]:
        depth_mm = self.depth_mm(sample)
        inside = depth_mm[object_mask(depth_mm)]
        return {"depth_min_mm": float(inside.min()), "depth_max_mm": float(inside.max())}


class ViewPairs(FringeDepthDataset):
    """A pair for each view: its crossed frame and exact depth, in a representation of `FringeDepthDataset`."""

    def __init__(self, source: ViewSource, normalisation: Normalisation) -> None:
        self.source = source  # type: ignore[assignment]
        self.samples, self.frames = source.samples, (0,)
        self.normalisation, self.background_removed = normalisation, False
        self.range_rule, self._ranges_mm = "valid", {}


def view_recipe(recipe: training.Recipe) -> training.Recipe:
    """``recipe`` with an input standardised by the frame itself. Raises `RecipeError` for another network than the
    UNet, and for a recipe that needs other frames or the background's mask."""
    if recipe.network != "unet" or recipe.frames != "single_shot" or recipe.background_removed:
        raise RecipeError(f"{recipe.name}: --views trains a unet on the single crossed frame with its background")
    return recipe.model_copy(update={"options": {**recipe.options, "standardised": 1}})


def view_pairs(
    recipe: training.Recipe, folder: Path, workers: int = 1, show: bool = False, views: CrossedRecipe | None = None
) -> tuple[ViewPairs, ViewPairs]:
    """Training and validation pairs of ``recipe.size`` px in ``folder``, rendered where it lacks them, in the lights
    of ``views`` (default: those of crossed-net). Raises `TrainingError` for a folder that can't be used."""
    drawn, rig = views or CrossedRecipe(), crossed_rig(recipe.size)
    groups = training.groups_of(drawn.lights, drawn.views_a_light, drawn.seed)
    fingerprint = training.fingerprint_of({"rig": rig.to_dict()}, groups)
    training.claim_folder(folder, {"views": "crossed", "dataset_fingerprint": fingerprint})
    with training.Display("rendering views", sum(len(group.views) for group in groups), show) as display:
        training.render_views(groups, rig, rig.sequence.crossed_frames[:1], folder, workers, display.advance)
    learnt, checked = (
        ViewPairs(ViewSource(list(training.read_views(folder, groups, split)), fingerprint), recipe.normalisation)
        for split in ("train", "validation")
    )
    return learnt, checked
