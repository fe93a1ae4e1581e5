"""The weights in the package: small, readable, and what their names say."""

from pathlib import Path

import numpy as np
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


def scene_of(benchmark):
    """One test view as the data of a row had it: fringe, decoded depth, void pixels. Version 0 is no longer built."""
    if benchmark is None:
        with np.load(Path(__file__).parent / f"version_0_{SAMPLE}.npz") as stored:
            return stored["fringe"], stored["depth_mm"], None
    name, view = split_sample_name(SAMPLE)
    studio = Studio(BuildSettings(rig=paper_rig(224), objects=(name,)))
    row = studio.photograph(solid_mesh(name), view)
    return row.frames[0], row.depth_mm, void_pixels(row.flags, row.depth_mm, row.depth_exact_mm)


@pytest.mark.parametrize("name", shipped_names())
def test_each_is_its_recipe_and_gives_the_score_of_its_row(name):
    """Against the leaderboard's row of the same weights, whose per-sample scores come from the full set."""
    model = load(name)
    assert model.config.name == name == recipe_from_dict(model.config.recipe).name
    suffix = "-range-predicted" if model.config.normalisation == "individual" else ""
    row = read_entry(SHIPPED_ROWS / f"{model.config.recipe['preset']}-{name}{suffix}.json").result
    assert row.submission.settings["weights_sha256"] == model.sha256
    (expected,) = [scores for scores in row.per_sample if scores.sample == SAMPLE]
    fringe, truth, void = scene_of(row.dataset.benchmark)
    scores = score_sample(model.predict(fringe), truth, void=void)
    # A pixel on the mask's threshold may fall to the other side on another processor.
    assert scores.object.mae_mm == pytest.approx(expected.object_mae_mm, rel=0.01)
    assert scores.background.mae_mm == pytest.approx(expected.background_mae_mm, rel=0.01)
    assert scores.overall.mae_mm == pytest.approx(expected.overall_mae_mm, rel=0.01)
