"""The weights in the package: small, readable, and what their names say."""

import pytest

from fpp_ml_bench.baselines import load
from fpp_ml_bench.baselines.training.recipe import recipe_from_dict
from fpp_ml_bench.baselines.training.weights import SHIPPED, shipped_names
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, read_entry
from fpp_ml_bench.loaders.render import BuildSettings, Studio, solid_mesh
from fpp_ml_bench.loaders.sample import void_pixels
from fpp_ml_bench.optics import paper_rig

SAMPLE = "power_drill_A60"


def test_there_are_some_and_they_are_small():
    assert "unet-individual-hybrid_l1_0.7" in shipped_names()
    assert sum(path.stat().st_size for path in SHIPPED.iterdir()) < 20e6


@pytest.fixture(scope="module")
def view():
    """A test view, rendered as in the benchmark of the weights."""
    name, pose = split_sample_name(SAMPLE)
    return Studio(BuildSettings(rig=paper_rig(224), objects=(name,))).photograph(solid_mesh(name), pose)


@pytest.mark.parametrize("name", shipped_names())
def test_each_is_its_recipe_and_gives_the_score_of_its_row(name, view):
    """Against the leaderboard's row of the same weights, whose per-sample scores come from the full set."""
    model = load(name)
    assert model.config.name == name == recipe_from_dict(model.config.recipe).name
    suffix = "-range-predicted" if model.config.normalisation == "individual" else ""
    row = read_entry(SHIPPED_ROWS / f"{model.config.recipe['preset']}-{name}{suffix}.json").result
    assert row.submission.settings["weights_sha256"] == model.sha256
    (expected,) = [scores for scores in row.per_sample if scores.sample == SAMPLE]
    void = void_pixels(view.flags, view.depth_mm, view.depth_exact_mm)
    scores = score_sample(model.predict(view.frames[0]), view.depth_mm, void=void)
    # A pixel on the mask's threshold may fall to the other side on another processor.
    assert scores.object.mae_mm == pytest.approx(expected.object_mae_mm, rel=0.01)
    assert scores.background.mae_mm == pytest.approx(expected.background_mae_mm, rel=0.01)
    assert scores.overall.mae_mm == pytest.approx(expected.overall_mae_mm, rel=0.01)
