"""Intervals and tests over objects, paired comparison and verification."""

import json

import numpy as np
import pytest
from conftest import fpp_eval, printed, read_json, refusal
from scipy import stats
from scored_dataset import write_predictions

from fpp_ml_bench.evaluation.metrics import RANKED
from fpp_ml_bench.evaluation.report.comparison import compare
from fpp_ml_bench.evaluation.result.file import read_result, write_result
from fpp_ml_bench.evaluation.score import uncertainty
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.uncertainty import holm, object_interval, sign_flip_p


@pytest.fixture
def make(tmp_path, dataset):
    def write(file, **changes):
        folder = write_predictions(tmp_path / file, dataset, **changes)
        path = tmp_path / f"{file}.json"
        write_result(evaluate(folder, dataset), path)
        return path

    return write


def test_interval_is_the_expanded_percentile_of_resampled_objects():
    """Against SciPy's bootstrap at the widened level: another generator, so only roughly the
    same."""
    rng = np.random.default_rng(1)
    means = rng.normal(1.0, 0.3, 12)
    objects = np.repeat(np.arange(12), 6)
    values = means[objects] + rng.normal(0, 0.05, objects.size)
    low, high = object_interval(values.tolist(), objects.tolist())
    widened = stats.norm.cdf(-np.sqrt(12 / 11) * stats.t.ppf(0.975, 11))
    per_object = values.reshape(12, 6).mean(axis=1)
    expected = stats.bootstrap(
        (per_object,),
        np.mean,
        n_resamples=10_000,
        method="percentile",
        confidence_level=1 - 2 * widened,
        rng=np.random.default_rng(0),
    ).confidence_interval
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=0.03)
    assert low < values.mean() < high
    assert object_interval(values.tolist(), objects.tolist()) == (low, high)


def test_unequal_views_weigh_samples_alike_and_gaps_are_left_out():
    values = [1.0, 1.0, 1.0, 5.0, None]
    low, high = object_interval(values, ["a", "a", "a", "b", "c"])
    assert (low, high) == (1.0, 5.0)
    assert object_interval([1.0, 2.0], ["a", "a"]) is None
    assert object_interval([None, None], ["a", "b"]) is None
    assert object_interval([2.0, 2.0], ["a", "b"]) == (2.0, 2.0)


def test_interval_covers_the_truth_about_as_often_as_it_says():
    """Five objects of six correlated views each, as in the test split; the plain percentile
    interval covers 84%."""
    rng = np.random.default_rng(7)
    objects = np.repeat(np.arange(5), 6).tolist()
    covered = 0
    for _ in range(200):
        values = (rng.normal(0, 1, 5)[objects] + rng.normal(0, 0.3, 30)).tolist()
        low, high = object_interval(values, objects)
        covered += low <= 0 <= high
    assert 0.87 <= covered / 200 <= 0.99


def test_too_few_objects_for_95_percent_are_said():
    assert "at most 50% of cases" in uncertainty.caution(
        2
    ) and "at most 88%" in uncertainty.caution(4)
    assert uncertainty.caution(5) is None and uncertainty.caution(1) is None


def scipy_p(differences):
    """All flips, by SciPy."""
    answer = stats.permutation_test(
        (differences, np.zeros(len(differences))),
        lambda a, b, axis: np.mean(a - b, axis=axis),
        vectorized=True,
        permutation_type="samples",
        n_resamples=np.inf,
    )
    return answer.pvalue


@pytest.mark.parametrize("objects", [2, 6, 12])
def test_the_sign_flip_test_is_scipys(objects):
    rng = np.random.default_rng(objects)
    for differences in (
        rng.normal(0.5, 1, objects),
        rng.exponential(1, objects) - 0.3,
        np.full(objects, 0.1),
    ):
        assert sign_flip_p(differences.tolist()) == pytest.approx(scipy_p(differences), abs=1e-12)
    ties = rng.integers(-2, 3, objects) / 10  # sums that are equal but for rounding
    assert sign_flip_p(ties.tolist()) == pytest.approx(scipy_p(ties), abs=1e-12)


def test_the_sign_flip_test_at_its_ends():
    assert sign_flip_p([]) == sign_flip_p([0.0, 0.0]) == sign_flip_p([1.0, -1.0]) == 1.0
    assert (
        sign_flip_p([3.0] * 5)
        == 0.0625
        > uncertainty.SIGNIFICANT
        > sign_flip_p([3.0] * 6)
        == 0.03125
    )
    assert sign_flip_p([1e30] * 25) == sign_flip_p([1e-30] * 25) == 2.0**-24
    differences = np.random.default_rng(1).normal(0.4, 1, 25).tolist()
    assert sign_flip_p([-value for value in differences]) == sign_flip_p(differences)


@pytest.mark.parametrize("objects", [25, 70])
def test_sampled_flips_agree_with_all_of_them(objects, monkeypatch):
    """Objects without a difference change nothing; 70 of them need more than one word of random
    bits."""
    differences = np.random.default_rng(objects).normal(0.3, 1, 25).tolist() + [0.0] * (
        objects - 25
    )
    exact = sign_flip_p(differences[:25])
    monkeypatch.setattr(uncertainty, "_EXACT_OBJECTS", 5)
    sampled = sign_flip_p(differences)
    assert sampled == sign_flip_p(differences) == pytest.approx(exact, abs=5 * (exact / 1e5) ** 0.5)
    assert sign_flip_p([1.0] * objects) == 1 / 100_001


def test_holm_against_its_step_down_procedure():
    rng = np.random.default_rng(5)
    for count in (0, 1, 2, 7):
        for values in rng.uniform(0, 0.2, (20, count)).tolist():
            adjusted = holm(values)
            for level in (0.01, 0.05, 0.2, 0.7):
                rejected = set()
                for place, index in enumerate(
                    np.argsort(values)
                ):  # stop at the first that is not rejected
                    if values[index] > level / (count - place):
                        break
                    rejected.add(int(index))
                assert rejected == {index for index, value in enumerate(adjusted) if value <= level}


def test_result_carries_intervals_objects_and_seeds(make):
    result = read_result(make("a", noise_mm=2.0))
    assert set(type(result.intervals).model_fields) == set(RANKED)
    for key in RANKED:
        low, high = getattr(result.intervals, key)
        assert low <= getattr(result.metrics, key) <= high
    assert [(o.object, o.samples) for o in result.per_object] == [
        ("power_drill", 2),
        ("wooden_boards", 2),
    ]
    first = [row.object_mae_mm for row in result.per_sample if row.object == "power_drill"]
    assert result.per_object[0].spread["object_mae_mm"] == pytest.approx(
        np.std(first, ddof=1), rel=1e-12
    )
    assert result.seeds == {"bootstrap": 20250} and result.bootstrap.over == "objects"
    assert result.intervals.of("object_median_mm") is None


def test_one_object_has_no_interval(dataset, tmp_path):
    folder = write_predictions(tmp_path / "p", dataset, split="train", noise_mm=1.0)
    result = evaluate(folder, dataset, "train")
    assert (
        result.intervals.object_mae_mm == [None, None]
        and result.intervals.of("object_mae_mm") is None
    )


def test_comparison_is_paired_and_says_so(make, tmp_path):
    first, second = make("one", noise_mm=2.0, name="One"), make("two", noise_mm=1.0, name="Two")
    comparison = compare(read_result(first), read_result(second))
    rows = [row.differences["object_mae_mm"] for row in comparison.per_sample]
    first_rows, second_rows = (read_json(p)["per_sample"] for p in (first, second))
    assert rows == [
        y["object_mae_mm"] - x["object_mae_mm"]
        for x, y in zip(first_rows, second_rows, strict=True)
    ]
    main_difference = comparison.differences["object_mae_mm"]
    assert main_difference.mean_mm == pytest.approx(np.mean(rows)) and main_difference.lower == 4
    assert main_difference.distinguishable
    assert comparison.sentence.startswith("Two has a lower two-sided MAE than One, by")
    assert "lower in 4 of 4 samples" in comparison.sentence
    assert main_difference.sign_flip_p == 0.5
    assert "sign-flip test p = 0.5" in comparison.sentence
    assert "does not confirm it at 5%: 2 objects never reach 5%" in comparison.sentence
    output = printed(fpp_eval, "compare", first, second, "--json", tmp_path / "d.json")
    assert "Two has a lower two-sided MAE than One" in " ".join(output.split())
    assert read_json(tmp_path / "d.json")["differences"]["object_mae_mm"]["lower"] == 4


def test_a_comparison_with_0_in_its_interval(make, dataset, tmp_path):
    first = make("one", noise_mm=1.0, name="One")
    folder = write_predictions(tmp_path / "two", dataset, noise_mm=1.0, name="Two")
    for number, sample in enumerate(
        dataset.samples("test")
    ):  # better on an object, worse on the other
        depth = np.load(folder / f"{sample}.npy")
        np.save(folder / f"{sample}.npy", depth + np.float32(1.0 if number < 2 else -0.5))
    write_result(evaluate(folder, dataset), tmp_path / "two.json")
    comparison = compare(read_result(first), read_result(tmp_path / "two.json"))
    assert not comparison.differences["object_mae_mm"].distinguishable
    assert "can't be distinguished" in comparison.sentence and "holds 0" in comparison.sentence
    assert (
        "the same two-sided MAE in all 4 samples"
        in compare(read_result(first), read_result(first)).sentence
    )


def test_results_of_other_data_are_not_compared(make, dataset, tmp_path):
    first = make("one")
    second = tmp_path / "oracle.json"
    folder = write_predictions(tmp_path / "two", dataset, uses_ground_truth_range=True)
    write_result(evaluate(folder, dataset, target="depth_exact"), second)
    message = refusal(fpp_eval, "compare", first, second)
    assert (
        "target: depth against depth_exact" in message
        and "track: metric against oracle range" in message
    )


def test_verify_says_verified_or_not(make, dataset, tmp_path, capsys):
    file, folder = make("p", noise_mm=2.0), tmp_path / "p"
    command = ["verify", str(file), str(folder), str(dataset.path)]
    assert printed(fpp_eval, *command).startswith("verified: ")
    sample = dataset.samples("test")[0]
    depth = np.load(folder / f"{sample}.npy")
    np.save(folder / f"{sample}.npy", depth + np.float32(0.001))  # as another processor adds
    output = printed(fpp_eval, *command)
    assert (
        output.startswith("the same within what processors change: ")
        and "0.01% of the pixels" in output
    )
    np.save(folder / f"{sample}.npy", depth + np.float32(1.0))
    assert fpp_eval(*command) == 1
    output = capsys.readouterr().out
    assert output.startswith("not the same: ") and f"{sample}: prediction_sha256" in output
    assert f"{sample}: overall_mae_mm" in output
    np.save(folder / f"{sample}.npy", depth)
    assert fpp_eval(*command) == 0
    write_predictions(folder, dataset, noise_mm=2.0, name="Another name", frames_used=[0, 1])
    capsys.readouterr()
    assert fpp_eval(*command) == 1
    assert (
        "submission.name" in (output := capsys.readouterr().out)
        and "submission.frames_used" in output
    )
    file.write_text(file.read_text().replace('"protocol_version": "', '"protocol_version": "9'))
    assert "scored by protocol 9" in refusal(fpp_eval, *command)
    (folder / f"{sample}.npy").unlink()
    assert fpp_eval(*command) == 2


@pytest.mark.long
def test_schema_describes_the_file(make):
    import jsonschema

    for name in ("submission", "comparison", "result"):
        schema = json.loads(printed(fpp_eval, "schema", name))
        jsonschema.Draft202012Validator.check_schema(schema)
    content = json.loads(make("p").read_text())
    jsonschema.validate(content, schema)
    content["per_sample"][0]["object_mae_mm"] = "0.1"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, schema)
