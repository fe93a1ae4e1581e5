"""Units and modes: mm, m and normalised depth, and the paper's rule for individually normalised
rows."""

import numpy as np
import pytest
from conftest import fpp_eval, printed, read_json, refusal
from scored_dataset import disk_depth, make_dataset, write_description, write_predictions

import fpp_ml_bench
from fpp_ml_bench.depth import denormalise, normalise
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.score.check import scored_pair
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.loaders.sample import Flag

ORACLE = {"units": "normalised", "uses_ground_truth_range": True}


def span_of(target):
    inside = target[target > 0]
    return float(inside.min()), float(inside.max())


def write_normalised(folder, dataset, noise=0.01, **changes):
    """Normalised targets with noise of either sign everywhere, as a network gives them."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, sample in enumerate(dataset.samples("test")):
        target = dataset.depth_mm(sample)
        values = normalise(target, "individual", *span_of(target)).astype(np.float64)
        values += np.random.default_rng(number).normal(0, noise, target.shape)
        np.save(folder / f"{sample}.npy", values)
    write_description(folder, **{**ORACLE, **changes})
    return folder


def to_the_letter(values, target):
    """Paper Section 5.3.2 under individual normalisation, literally: normalise, mask, denormalise
    both, subtract."""
    low, high = span_of(target)
    target_norm = (target.astype(np.longdouble) - low) / (high - low) * (target > 0)
    inside = target_norm > 0
    error = (values.astype(np.longdouble) * (high - low) + low) - (target_norm * (high - low) + low)
    sets = {"overall": np.ones_like(inside), "object": inside, "background": ~inside}
    scores = {f"{name}_mae_mm": np.abs(error[pixels]).mean() for name, pixels in sets.items()}
    return scores | {
        f"{name}_rmse_mm": np.sqrt((error[pixels] ** 2).mean()) for name, pixels in sets.items()
    }


def test_paper_mode_is_the_papers_rule_to_the_letter(dataset, tmp_path):
    folder = write_normalised(tmp_path / "p", dataset)
    result = evaluate(folder, dataset, mode="paper")
    assert result.mode == "paper" and result.track == "oracle range"
    for row in result.per_sample:
        target, values = dataset.depth_mm(row.sample), np.load(folder / f"{row.sample}.npy")
        for key, expected in to_the_letter(values, target).items():
            assert getattr(row, key) == pytest.approx(float(expected), rel=1e-10), key
        low, high = span_of(target)
        # The object pixel at depth_min normalises to 0 and counts as background.
        at_minimum = np.count_nonzero(target == low)
        assert row.object_pixels == np.count_nonzero(target) - at_minimum and at_minimum >= 1
        background = np.abs(values[(target == 0) | (target == low)])
        assert row.background_mae_mm == pytest.approx(background.mean() * (high - low), rel=1e-12)
    write_result(result, tmp_path / "r.json")
    assert read_result(tmp_path / "r.json") == result


def test_exact_zeros_in_the_background_cost_nothing(dataset, tmp_path):
    """Strictly, the object's nearest pixels, which normalise to 0, are lost."""
    result = evaluate(write_normalised(tmp_path / "p", dataset, noise=0.0), dataset)
    assert result.mode == "standard" and result.metrics.background_mae_mm == 0.0
    for row in result.per_sample:
        target = dataset.depth_mm(row.sample)
        low, high = span_of(target)
        lost = np.count_nonzero(target == low) * low / np.count_nonzero(target)
        # Normalising in float32 rounds a value in [0, 1] three times, by at most 2^-24 each.
        assert row.object_mae_mm == pytest.approx(lost, abs=3 * 2.0**-24 * (high - low))


def test_denormalising_is_the_training_sides_inverse(dataset):
    sample = dataset.samples("test")[0]
    target = dataset.depth_mm(sample)
    values = np.random.default_rng(0).uniform(0.01, 1.0, target.shape)
    depth, same = scored_pair(values, target, "normalised", "standard", sample)
    assert (
        np.array_equal(depth, denormalise(values, "individual", *span_of(target)))
        and same is target
    )


def test_metres_score_like_millimetres(dataset, tmp_path):
    mm = write_predictions(tmp_path / "mm", dataset, noise_mm=2.0)
    m = write_predictions(tmp_path / "m", dataset, noise_mm=2.0, units="m")
    for path in m.glob("*.npy"):
        np.save(path, np.load(path).astype(np.float64) / 1000)
    in_mm, in_m = (evaluate(folder, dataset).metrics.model_dump() for folder in (mm, m))
    for key, value in in_mm.items():
        assert in_m[key] == (
            value if value is None else pytest.approx(value, rel=1e-9, abs=1e-9)
        ), key


def test_modes_and_tracks_cannot_be_mixed_up(dataset, tmp_path):
    normalised = write_normalised(tmp_path / "n", dataset, uses_ground_truth_range=False)
    assert "units: normalised needs uses_ground_truth_range: true" in refusal(
        fpp_eval, normalised, dataset.path
    )
    write_description(normalised, **ORACLE)
    written = tmp_path / "r.json"
    command = [str(normalised), str(dataset.path), "--mode", "paper", "--json", str(written)]
    assert "oracle range track, mode paper" in printed(fpp_eval, *command)
    assert read_json(written)["mode"] == "paper"


def test_a_target_without_range_is_refused_by_sample():
    empty, flat = np.zeros((4, 5), np.float32), np.full((4, 5), 1800, np.float32)
    values = np.full((4, 5), 0.5)
    with pytest.raises(DatasetError, match="s: the target holds no object"):
        scored_pair(values, empty, "normalised", "standard", "s")
    assert not scored_pair(0 * values, empty, "normalised", "standard", "s")[0].any()
    with pytest.raises(DatasetError, match="s: the target is one flat plane"):
        scored_pair(values, flat, "normalised", "paper", "s")
    assert np.array_equal(scored_pair(values, flat, "normalised", "standard", "s")[0], flat)


@pytest.mark.parametrize("mode", ["standard", "paper"])
def test_a_range_without_void_pixels(mode, tmp_path):
    """A void pixel 300 mm behind the object widens the range of ``object``, not that of
    ``valid``."""

    def flagged(depth):
        flags = np.zeros(depth.shape, np.uint8)
        flags[depth == depth.max()] = Flag.MIXED
        return flags

    def scene(seed):
        depth = disk_depth((32, 40), seed)
        depth.flat[np.flatnonzero(depth)[5]] += 300
        return np.full(depth.shape, seed, np.uint8), depth

    dataset = make_dataset(tmp_path / "data", flagged=flagged, scene=scene)
    scores = {}
    for rule in ("object", "valid"):
        folder = tmp_path / rule
        folder.mkdir()
        for sample in dataset.samples("test"):
            depth, void = dataset.depth_mm(sample).astype(np.float64), dataset.void(sample)
            low, high = span_of(np.where(void, 0, depth) if rule == "valid" else depth)
            np.save(
                folder / f"{sample}.npy", np.where(depth > 0, (depth + 2 - low) / (high - low), 0)
            )
        write_description(folder, **ORACLE, **({"range_rule": rule} if rule == "valid" else {}))
        scores[rule] = evaluate(folder, dataset, mode=mode)
        assert scores[rule].metrics.object_mae_mm == pytest.approx(2.0, abs=1e-9)
    assert (
        scores["valid"].submission.range_rule == "valid"
        and "range_rule" not in scores["object"].submission.to_yaml()
    )
    write_description(folder, range_rule="valid")
    with pytest.raises(PredictionError, match="range_rule is that of normalised depth"):
        evaluate(folder, dataset, mode=mode)


def test_another_reading_is_said_and_changes_no_score(tmp_path, recwarn, capsys):
    dataset = make_dataset(tmp_path / "data", size=(48, 48))
    predictions = write_predictions(tmp_path / "p", dataset)
    for sample in dataset.samples("test"):
        np.save(predictions / f"{sample}.npy", dataset.depth_mm(sample)[::-1])
    scored = fpp_ml_bench.evaluate(predictions, dataset)
    assert "upside down" in str(recwarn.pop().message)
    assert fpp_eval(predictions, dataset.path, "--json", tmp_path / "r.json") == 0
    assert (
        "fpp-eval: note: another reading fits the predictions far better: upside down"
        in capsys.readouterr().err
    )
    for sample in dataset.samples("test"):
        np.save(predictions / f"{sample}.npy", dataset.depth_mm(sample))
    assert (
        fpp_ml_bench.evaluate(predictions, dataset).metrics.object_mae_mm
        < scored.metrics.object_mae_mm
    )
    assert not recwarn.list
