"""Arrays in memory are scored as a folder with the same content."""

import numpy as np
import pytest
from scored_dataset import make_dataset, write_description

from fpp_ml_bench import evaluate
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.sample import Flag


@pytest.fixture(scope="module")
def scored(tmp_path_factory):
    """Dataset, folder, and its content as arrays."""
    folder = tmp_path_factory.mktemp("scored")

    def flagged(depth):
        flags = np.zeros(depth.shape, np.uint8)
        flags[14:16] = Flag.MIXED
        return flags

    dataset, predictions = make_dataset(folder / "data", flagged=flagged), folder / "p"
    predictions.mkdir()
    columns = {"predictions": [], "targets": [], "flags": [], "sigma": [], "objects": []}
    for number, sample in enumerate(dataset.samples("test")):
        rng, depth = np.random.default_rng(number), dataset.depth_mm(sample)
        sigma = rng.uniform(0, 2, depth.shape).astype(np.float32)
        predicted = (depth + sigma * rng.normal(size=depth.shape)).astype(np.float32)
        np.save(predictions / f"{sample}.npy", predicted)
        np.save(predictions / f"{sample}.sigma.npy", sigma)
        values = predicted, depth, dataset.flags(sample), sigma, sample.rpartition("_")[0]
        for column, value in zip(columns.values(), values, strict=True):
            column.append(value)
    write_description(predictions)
    return dataset, predictions, columns


@pytest.mark.parametrize("form", [list, np.array])
def test_the_same_scores_as_a_folder(form, scored):
    dataset, folder, columns = scored
    of_folder = evaluate(folder, dataset)
    arrays = {
        name: values if name == "objects" else form(values) for name, values in columns.items()
    }
    arrays["charge_mm"] = dataset.rig.half_range_mm
    of_arrays = evaluate(arrays.pop("predictions"), arrays.pop("targets"), **arrays)
    for name in ("metrics", "intervals", "median", "pooled", "bootstrap", "seeds"):
        assert getattr(of_arrays, name) == getattr(of_folder, name), name
    assert [(row.object, row.metrics) for row in of_arrays.per_object] == [
        (row.object, row.metrics) for row in of_folder.per_object
    ]
    assert of_arrays.uncertainty.metrics == of_folder.uncertainty.metrics
    assert of_arrays.uncertainty.per_object == of_folder.uncertainty.per_object
    plain = evaluate(columns["predictions"], columns["targets"])
    assert (
        plain.metrics.void_share == 0 and plain.uncertainty is None and len(plain.per_object) == 4
    )


def test_a_perfect_prediction_and_maps_of_different_sizes():
    truth = [np.full((4, 5), 1800.0), np.full((3, 2), 1700.0, np.float32)]
    assert evaluate(truth, truth).metrics.object_rmse_mm == 0.0


TRUE = np.full((2, 4, 5), 1800.0)
VOID = np.zeros(TRUE.shape, bool)
VOID[:, :2] = True
OFF = np.where(VOID, 900.0, TRUE + 2)
ACCEPTED = {
    "masked target": ((OFF, np.ma.masked_array(TRUE, VOID)), {}),
    "nothing masked": ((np.ma.masked_array(TRUE + 2), TRUE), {}),
    "flags as uint8": ((OFF, TRUE), {"flags": VOID.astype(np.uint8)}),
    "flags as int64, as datasets gives them": (
        (OFF, TRUE),
        {"flags": VOID.astype(np.int64) * Flag.MIXED},
    ),
    "metres": (((TRUE + 2) / 1000, TRUE / 1000), {"units": "m"}),
    "close by": ((np.full((1, 4, 5), 7.0), np.full((1, 4, 5), 5.0)), {"units": "mm"}),
}


@pytest.mark.parametrize("case", ACCEPTED)
def test_what_is_answered(case):
    arguments, options = ACCEPTED[case]
    scores = evaluate(*arguments, **options)
    assert scores.metrics.object_mae_mm == pytest.approx(2.0, rel=1e-12)
    assert scores.metrics.overall_mae_mm == pytest.approx(2.0, rel=1e-12)


def test_sigma_is_in_the_same_units():
    stated = [
        evaluate(
            (TRUE + 2) / k, TRUE / k, sigma=np.full(TRUE.shape, 3 / k), units=units
        ).uncertainty
        for k, units in ((1, "mm"), (1000, "m"))
    ]
    assert (
        stated[1].metrics.sigma_mean_mm
        == pytest.approx(stated[0].metrics.sigma_mean_mm)
        == pytest.approx(3.0)
    )


REFUSED = {
    "number": ((TRUE[:1], TRUE), {}, "predictions: expected 2, one for each target, got 1"),
    "one map": (
        (TRUE[0], TRUE[0]),
        {},
        r"targets: expected an array \(N, H, W\) .* got one map \(4, 5\)",
    ),
    "no map": (([], []), {}, "expected one depth map or more"),
    "size": ((TRUE[:, :3], TRUE), {}, "sample 0: predictions: expected a map .* got .3, 5."),
    "whole numbers": (
        (TRUE.astype(int), TRUE),
        {},
        "sample 0: predictions: expected real floats, got int64",
    ),
    "NaN": ((TRUE * np.nan, TRUE), {}, "sample 0: the prediction holds 20 NaN"),
    "bad target": ((TRUE, -TRUE), {}, "sample 0: targets: expected finite mm of 0 and more"),
    "bad sigma": ((TRUE, TRUE), {"sigma": TRUE * np.nan}, "sample 0: sigma: expected finite mm"),
    "flags as a mask": (
        (TRUE, TRUE),
        {"flags": TRUE > 0},
        "sample 0: flags: expected whole .* got bool",
    ),
    "flags of valid pixels": (
        (TRUE, TRUE),
        {"flags": np.uint8(255) * (TRUE > 0)},
        "expected sums of 1 .* got 255",
    ),
    "flags that wrap": (
        (TRUE, TRUE),
        {"flags": np.uint16(256) * (TRUE > 0)},
        "expected sums of .* got 256",
    ),
    "masked prediction": (
        (np.ma.masked_equal(TRUE, 1800), TRUE),
        {},
        "predictions: a masked array",
    ),
    "both in metres": (
        (TRUE / 1000, TRUE / 1000),
        {},
        "largest depth is 1.8, which could be metres; say units",
    ),
    "target in metres": ((TRUE, TRUE / 1000), {}, "targets: the largest depth is 1.8"),
    "metres close by": (
        (TRUE / 4500, TRUE / 4.5),
        {},
        "sample 0: the prediction looks like metres",
    ),
    "mm for metres": (
        (TRUE, TRUE / 1000),
        {"units": "m"},
        "the prediction does not look like metres",
    ),
    "other units": ((TRUE, TRUE), {"units": "inch"}, "units: expected mm or m, got inch"),
    "ragged": (([[[1800.0], [1.0, 2.0]]], TRUE[:1]), {}, "predictions: expected an array"),
    "units of a folder": (("folder", "data"), {"units": "m"}, "units: belongs to arrays"),
    "objects": ((TRUE, TRUE), {"objects": ["mug"]}, "objects: expected 2"),
    "objects as text": ((TRUE, TRUE), {"objects": "ab"}, "objects: expected .* got str"),
    "a dataset": ((TRUE, "data"), {}, "need the targets as arrays"),
    "a folder": (("folder", "data"), {"sigma": TRUE}, "sigma: belongs to arrays"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    arguments, options, message = REFUSED[case]
    with pytest.raises(PredictionError, match=message):
        evaluate(*arguments, **options)


ROWS, COLUMNS = np.mgrid[0:60, 0:80]
THERE = np.hypot(ROWS - 30, COLUMNS - 40) < 20
DISK = np.where(THERE, 1800.0 + COLUMNS / 3, 0.0)[None]
NEAR = DISK + 2 * (DISK > 0)


@pytest.mark.parametrize("mark", [1e10, 65535.0, 1.0, -1.0, np.inf, np.nan])
def test_a_mark_for_no_surface_is_no_depth(mark):
    prediction, target = (
        np.where(DISK > 0, depth, mark).astype(np.float32) for depth in (NEAR, DISK)
    )
    with pytest.raises(PredictionError, match="nodata"):
        evaluate(prediction, target)
    scores = evaluate(prediction, target, nodata=mark).metrics
    assert scores.object_mae_mm == pytest.approx(2.0, abs=1e-4) and scores.background_mae_mm == 0.0


def test_the_message_names_the_mark_and_its_share():
    share = round(100 * (1 - THERE.mean()))
    with pytest.raises(
        PredictionError,
        match=f"sample 0: targets: {share}% of the pixels are exactly 65535, far from",
    ):
        evaluate(NEAR, np.where(DISK > 0, DISK, 65535.0))
    with pytest.raises(
        PredictionError,
        match=f"prediction holds a mark .* {share}% of the pixels are exactly 65504",
    ):
        evaluate(np.where(DISK > 0, NEAR, 65504.0), DISK)
    with pytest.raises(PredictionError, match="nodata: expected a number, got str"):
        evaluate(NEAR, DISK, nodata="65535")


FLAT = np.full((1, 60, 80), 1800.0)
DEPTHS = {
    "a constant for everything": (FLAT, DISK),
    "a constant against a flat wall": (FLAT + 5, FLAT),
    "a wall behind the object": (NEAR, np.where(DISK > 0, DISK, 4000.0)),
    "a far wall that was measured": (
        np.where(DISK > 0, NEAR, 12001.0),
        np.where(DISK > 0, DISK, 12000.0),
    ),
    "a single wrong depth": (np.where((ROWS == 3) & (COLUMNS == 3), 65504.0, NEAR), DISK),
    "negative where nothing is": (NEAR - (DISK == 0) * (80 * ROWS + COLUMNS) / 1000, DISK),
    "a scene of decades": (DISK * 1.01, np.where(COLUMNS < 40, DISK, DISK * 30)),
}


@pytest.mark.parametrize("case", DEPTHS)
def test_depths_are_no_marks(case):
    assert evaluate(*DEPTHS[case]).metrics.object_mae_mm > 0


def test_an_axis_too_many_is_named():
    with pytest.raises(PredictionError, match=r"an axis too many; write np\.squeeze"):
        evaluate(NEAR[None], DISK)
    with pytest.raises(PredictionError, match=r"targets: .* np\.squeeze"):
        evaluate(NEAR[..., None], DISK[..., None])
