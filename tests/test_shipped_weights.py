"""The weights in the package: small, readable, and what their names say."""

import numpy as np
import pytest

from fpp_ml_bench.baselines import load
from fpp_ml_bench.baselines.training.recipe import load_recipe, recipe_from_dict
from fpp_ml_bench.baselines.weights_file import SHIPPED, shipped_names
from fpp_ml_bench.loaders.build import build
from fpp_ml_bench.loaders.settings import BuildSettings
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.rig import paper_rig


def test_there_are_some_and_they_are_small():
    assert "unet-individual-hybrid_l1_0.7" in shipped_names()
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 20e6


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """One test view at the size of the weights: fringe and true depth."""
    size = load_recipe("base", "cpu").size
    folder = tmp_path_factory.mktemp("shipped") / "dataset"
    settings = BuildSettings(rig=paper_rig(size), objects=("bowl", "mug", "power_drill"), stored="single_shot")
    build(folder, settings, workers=1)
    opened = DatasetFolder(folder)
    return opened.frame("power_drill_A60", 0), opened.depth_mm("power_drill_A60")


@pytest.mark.parametrize("name", shipped_names())
def test_each_is_its_recipe_and_sees_the_object(name, scene):
    model = load(name)
    assert model.config.name == name == recipe_from_dict(model.config.recipe).name
    assert model.metric
    fringe, truth = scene
    depth_mm = model.predict(fringe)
    inside = truth > 0
    # Trained for minutes at a small size: it need not be good, but it must have learnt where the object is and how far.
    found = depth_mm > truth[inside].min() / 2
    assert (found & inside).sum() / (found | inside).sum() > 0.7
    assert np.median(np.abs(depth_mm - truth)[inside & found]) < 300
