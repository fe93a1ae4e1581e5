"""What counts as the work of another processor, and what does not."""

import pytest

from fpp_ml_bench.evaluation.score.verification import of_processors

FAR_MM = 2100.0
OTHER = ("mug_A0: prediction_sha256", "a" * 64, "b" * 64)
OTHER_ROW = ("predictions_sha256", "a" * 64, "b" * 64)


@pytest.mark.parametrize(
    "found",
    [
        [OTHER, ("mug_A0: object_mae_mm", 1.2, 1.4)],  # a pixel in 10,000, as far as the range goes
        [OTHER, ("mug_A0: object_rmse_mm", 14.0, 25.0)],  # squares add up
        [OTHER, ("mug_A0: object_max_mm", 300.0, 1800.0)],
        [
            OTHER_ROW,
            ("per_object.3.background_mae_mm", 2.485, 2.431),
            ("intervals.object_mae_mm.0", 1.0, 1.01),
        ],
        [OTHER_ROW, ("metrics.object_mae_mm", 1.2, 1.25), ("uncertainty.nll", 1.0, 1.002)],
        [OTHER, ("uncertainty.per_sample.mug_A0.sigma_mean_mm", 1.0, 1.1)],
    ],
)
def test_a_few_pixels_are_the_work_of_a_processor(found):
    assert of_processors(found, FAR_MM)


@pytest.mark.parametrize(
    "found",
    [
        [("mug_A0: object_mae_mm", 1.2, 1.21)],  # other scores of the same predictions
        [OTHER, ("drill_A0: object_mae_mm", 1.2, 1.21)],
        [("metrics.object_mae_mm", 1.2, 1.21)],
        [OTHER, ("mug_A0: object_mae_mm", 1.2, 1.5)],
        [OTHER_ROW, ("metrics.object_mae_mm", 1.2, 1.3)],  # a mean of many
        [OTHER_ROW, ("per_object.3.object_median_mm", 0.0, 0.7)],
        [OTHER_ROW, ("per_object.3.object_pixels", 4000, 4001)],  # other data
        [OTHER_ROW, ("metrics.object_mae_mm", 1.2, None)],
        [OTHER_ROW, ("submission.frames_used", [0], [0, 1])],
        [OTHER_ROW, ("submission.settings.min_confidence", 0.0, 0.0001)],
        [OTHER_ROW, ("dataset.content.test/depth", "a", "b")],
        [OTHER, ("uncertainty.per_sample.mug_A0.nll", 1.0, 0.9)],
    ],
)
def test_anything_else_is_not(found):
    assert not of_processors(found, FAR_MM)
