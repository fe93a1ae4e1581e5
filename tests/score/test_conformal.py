"""Split-conformal sigma over objects: the quantile by hand, the coverage of new objects, and what is refused."""

import numpy as np
import pytest
from scored_dataset import make_dataset, write_description

from fpp_ml_bench.cli import main_eval as main
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.conformal import calibrate, conformal_quantile, write_calibrated
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import gaussian_quantile
from fpp_ml_bench.evaluation.submission.description import read_submission


def test_the_quantile_weighs_objects_alike_and_their_views_alike():
    # One object with two views of 1 and 3 pixels, one with a single pixel: weights 1/2, 1/6 each, 1.
    scores = {"a": [np.array([1.0]), np.array([2.0, 3.0, 9.0])], "b": [np.array([4.0])], "none": [np.array([])]}
    for coverage, expected in ((0.16, 1.0), (0.18, 2.0), (0.27, 3.0), (0.6, 4.0), (0.62, 9.0), (2 / 3, 9.0)):
        assert conformal_quantile(scores, coverage) == expected, coverage
    with pytest.raises(
        PredictionError, match=r"2 calibration objects can support a coverage of at most 66.7%, 68% was asked"
    ):
        conformal_quantile(scores, 0.68)


def test_new_objects_are_covered_as_often_as_is_said():
    """Objects differ by a factor of their own, so their pixels are far from independent, and sigma is too small. The
    coverage is at least what was asked, and at most one object's share of n + 1 above it."""
    rng = np.random.default_rng(1)
    covered = []
    for _ in range(400):
        spread = rng.lognormal(0, 0.7, 11)
        drawn = [np.abs(rng.normal(0, 4 * scale, 200)) for scale in spread]
        factor = conformal_quantile({str(n): [view] for n, view in enumerate(drawn[:10])}, 0.8)
        covered.append(np.mean(drawn[10] <= factor))
    assert 0.8 < np.mean(covered) < 0.8 + 1 / 11


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return make_dataset(tmp_path_factory.mktemp("data") / "tiny")


def write(folder, dataset, split, **changes):
    """Errors of 4 sigma on average, stated over the object only."""
    folder.mkdir()
    for number, sample in enumerate(dataset.samples(split)):
        rng, depth = np.random.default_rng(number), dataset.depth_mm(sample)
        sigma = np.where(depth > 0, rng.uniform(0.5, 2, depth.shape), 0).astype(np.float32)
        np.save(folder / f"{sample}.npy", (depth + 4 * sigma * rng.normal(size=depth.shape)).astype(np.float32))
        np.save(folder / f"{sample}.sigma.npy", sigma)
    write_description(folder, **changes)
    return folder


@pytest.fixture
def folders(tmp_path, dataset):
    return write(tmp_path / "test", dataset, "test"), write(tmp_path / "validation", dataset, "validation")


def command(folders, dataset, out, *arguments):
    test, validation = map(str, folders)
    return main(["conformal", test, str(dataset.path), "--from", validation, "--out", str(out), *arguments])


def test_the_command_scales_sigma_and_nothing_else(folders, dataset, tmp_path, capsys):
    assert command(folders, dataset, tmp_path / "out", "--coverage", "0.5") == 0
    said = capsys.readouterr().out
    assert "1 calibration object can support at most 50.0%" in said
    found = calibrate(folders[1], dataset, coverage=0.5)
    # With one object, 50% need all of it: the factor is its largest score.
    assert found.factor * gaussian_quantile(0.5) == pytest.approx(4 * 3.5, rel=0.4)
    for sample in dataset.samples("test"):
        old, new = (np.load(folder / f"{sample}.sigma.npy") for folder in (folders[0], tmp_path / "out"))
        np.testing.assert_allclose(new, old * found.factor, rtol=1e-6)
        assert (folders[0] / f"{sample}.npy").read_bytes() == (tmp_path / "out" / f"{sample}.npy").read_bytes()
    before, after = (evaluate(folder, dataset) for folder in (folders[0], tmp_path / "out"))
    assert before.uncertainty.metrics.coverage_68 < 0.3 < 0.99 < after.uncertainty.metrics.coverage_68
    assert before.metrics == after.metrics
    settings = read_submission(tmp_path / "out").settings
    assert settings["conformal_objects"] == 1 and settings["conformal_factor"] == found.factor
    with pytest.raises(PredictionError, match="has been scaled before"):
        write_calibrated(found, tmp_path / "out", dataset, "test", tmp_path / "again")


def test_what_can_not_be_calibrated_is_refused(folders, dataset, tmp_path, capsys):
    test, validation = folders
    out = tmp_path / "out"
    assert command(folders, dataset, out) == 2
    assert "1 calibration object can support a coverage of at most 50.0%, 68% was asked" in capsys.readouterr().err
    assert command(folders, dataset, out, "--coverage", "95") == 2
    assert "expected a share between 0 and 1" in capsys.readouterr().err
    half = ("--coverage", "0.5")
    assert command((validation, validation), dataset, out, "--split", "validation", *half) == 2
    assert "mug was calibrated on" in capsys.readouterr().err
    write_description(validation, name="Another")
    assert command(folders, dataset, out, *half) == 2
    assert "name is 'A method', calibrated was 'Another'" in capsys.readouterr().err
    write_description(validation)
    assert not out.exists()
    out.mkdir()
    assert command(folders, dataset, out, *half) == 2
    assert "is there already" in capsys.readouterr().err
    for path in validation.glob("*.sigma.npy"):
        path.unlink()
    assert command(folders, dataset, tmp_path / "new", *half) == 2
    assert "states no uncertainty" in capsys.readouterr().err
    assert test.exists()
