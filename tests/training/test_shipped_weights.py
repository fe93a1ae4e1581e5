"""The weights in the package: small, readable, and what their names say."""

from copy import deepcopy
from statistics import fmean

import pytest

from fpp_ml_bench.baselines.networks.model import load
from fpp_ml_bench.baselines.training.recipe import recipe_from_dict
from fpp_ml_bench.baselines.training.weights import SHIPPED, shipped_names
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.evaluation.score.check import scored_pair
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import void_pixels
from fpp_ml_bench.optics.named_rigs import paper_rig

OBJECT = "power_drill"


def test_there_are_some_and_they_are_small():
    assert "unet-individual-hybrid_l1_0.7" in shipped_names()
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 20e6


@pytest.fixture(scope="module")
def views():
    """A test object's views, rendered as in the benchmark of the weights."""
    studio = Studio(BuildSettings(rig=paper_rig(224), objects=(OBJECT,)))
    return [
        deepcopy(studio.photograph(solid_mesh(OBJECT), view)) for view in VIEWS
    ]  # it uses its arrays again


@pytest.mark.long
@pytest.mark.parametrize("name", shipped_names())
def test_each_is_its_recipe_and_gives_the_score_of_its_row(name, views):
    """Against the leaderboard's row of the same weights, whose scores come from the full set."""
    model = load(name)
    assert model.config.name == name == recipe_from_dict(model.config.recipe).name
    row = read_entry(SHIPPED_ROWS / f"{model.config.recipe['preset']}-{name}.json").row
    assert row.submission.settings["weights_sha256"] == model.sha256
    (expected,) = [means for means in row.per_object if means.object == OBJECT]
    scores = []
    for view in views:
        void = void_pixels(view.flags, view.depth_mm, view.depth_exact_mm)
        left_out = void if model.config.range_rule == "valid" else None
        pair = scored_pair(
            model.predict(view.frames[0]),
            view.depth_mm,
            row.submission.units,
            row.mode,
            OBJECT,
            left_out,
        )
        scores.append(score_sample(*pair, void=void if row.mode == "standard" else None).metrics())
    for key in ("object_mae_mm", "background_mae_mm", "overall_mae_mm"):
        assert fmean(view[key] for view in scores) == pytest.approx(
            getattr(expected, key), rel=0.01
        )
