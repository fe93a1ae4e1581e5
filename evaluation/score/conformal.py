"""Split-conformal intervals over objects: a stated sigma, scaled so that its intervals hold what they say.

The score of a pixel is |error| / sigma, and the exchangeable unit is the object, because pixels and views of one object
are not independent. A pixel of a new object is drawn by drawing the object, one of its views, and a pixel that states a
sigma; with n calibration objects its score is at most the factor with probability of at least the coverage, if the new
object is exchangeable with them (hierarchical conformal prediction: Lee, Barber and Willett, arXiv 2306.06342). Nothing
else is assumed of method or errors. As a new object may be worse than all n, they support at most n / (n + 1).
"""

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score.check import Rules, check_folder
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.score.sample_scores import gaussian_quantile, states_sigma
from fpp_ml_bench.evaluation.submission.description import Submission, check_submission
from fpp_ml_bench.evaluation.submission.prediction_files import SIGMA, SUBMISSION_FILE, list_folder
from fpp_ml_bench.files import whole_folder, write_atomically
from fpp_ml_bench.loaders.storage.store import DatasetFolder

FACTOR_KEY = "conformal_factor"
Scores = NDArray[np.float64]


@dataclass(frozen=True)
class Calibration:
    """``factor`` scales sigma; ``before``: the mean share of the calibration pixels within the unscaled interval of
    ``coverage``, and on how many ``objects`` of ``split`` it was found."""

    coverage: float
    factor: float
    before: float
    objects: int
    samples: int
    split: str
    target: str
    described: Submission


def largest_coverage(objects: int) -> float:
    """The largest coverage that so many calibration objects support."""
    return objects / (objects + 1)


def counted(objects: int) -> str:
    """``5 calibration objects``."""
    return f"{objects} calibration object{'' if objects == 1 else 's'}"


def conformal_quantile(scores: Mapping[str, list[Scores]], coverage: float) -> float:
    """The smallest score q such that the shares of scores up to q, (n,) for each view of each object, averaged over the
    views of an object and summed over the n objects, reach ``coverage`` x (n + 1). Raises PredictionError where the
    objects can't support it."""
    objects = {name: views for name, own in scores.items() if (views := [view for view in own if view.size])}
    count = len(objects)
    if coverage > largest_coverage(count) + 1e-12:
        support = f"{counted(count)} can support a coverage of at most {100 * largest_coverage(count):.1f}%"
        more = "calibrate on a split of more objects (train, for a method that learned from none)"
        raise PredictionError(f"{support}, {100 * coverage:g}% was asked: give a smaller --coverage, or {more}")
    values = np.concatenate([view for views in objects.values() for view in views])
    weights = np.concatenate(
        [np.full(view.size, 1 / (len(views) * view.size)) for views in objects.values() for view in views]
    )
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weights[order])
    # The weights of an object add up to 1 but for rounding.
    return float(values[order][np.searchsorted(reached, coverage * (count + 1) - 1e-9).clip(max=values.size - 1)])


def calibrate(
    folder: Path, dataset: DatasetFolder, split: str = "validation", coverage: float = 0.68, target: str = "depth"
) -> Calibration:
    """The factor from predictions of ``split`` with a stated sigma. Raises what `evaluate` raises for them, and
    PredictionError for a coverage outside (0, 1) or that the split can't support, and where no factor would help."""
    if not 0 < coverage < 1:
        raise PredictionError(f"coverage: expected a share between 0 and 1, like 0.68, got {coverage:g}")
    result = evaluate(folder, dataset, split, target)  # also checks every file
    _check_stated(folder, result.submission, result.uncertainty is not None)
    scores: dict[str, list[Scores]] = {}
    for sample, view in _scores(folder, dataset, split, target, result.submission):
        scores.setdefault(split_sample_name(sample)[0], []).append(view)
    quantile = conformal_quantile(scores, coverage)
    factor = quantile / gaussian_quantile(coverage)
    if factor == 0:
        raise PredictionError(
            f"{folder}: {100 * coverage:g}% of the pixels have no error at all; there is nothing to scale"
        )
    shares = [
        [float(np.mean(view <= gaussian_quantile(coverage))) for view in own if view.size] for own in scores.values()
    ]
    means = [float(np.mean(own)) for own in shares if own]
    return Calibration(
        coverage, factor, float(np.mean(means)), len(means), sum(map(len, shares)), split, target, result.submission
    )


def _scores(
    folder: Path, dataset: DatasetFolder, split: str, target: str, described: Submission
) -> Iterator[tuple[str, Scores]]:
    """|error| / sigma of the stated object pixels that are not void, (n,), of each sample."""
    listing, rules = (
        list_folder(folder, dataset, split),
        Rules(target, described.units, described.range_rule, "standard"),
    )
    read = listing.reader(dataset.size, described.png_mm_per_level, described.nodata)
    for sample in listing.present:
        pair = rules.pair(read(sample)[0], dataset, sample)
        sigma_mm = listing.sigma_mm(sample, dataset.size)
        scored = object_mask(pair[1]) & ~dataset.void(sample, target) & states_sigma(pair[0], sigma_mm)
        depth, true, sigma = (np.asarray(values[scored], np.float64) for values in (*pair, sigma_mm))
        dataset.release(sample)
        yield sample, np.abs(depth - true) / sigma


def _check_stated(folder: Path, description: Submission, stated: bool) -> None:
    if not stated:
        missing = f"states no uncertainty; write {{sample}}{SIGMA} for each sample"
        raise PredictionError(f"{folder}: {missing} (fpp-bench predict does for methods that state one)")
    if FACTOR_KEY in description.settings:
        raise PredictionError(
            f"{folder}: its sigma has been scaled before; give the predictions as the method made them"
        )


def write_calibrated(calibration: Calibration, folder: Path, dataset: DatasetFolder, split: str, out: Path) -> int:
    """Copy the predictions of ``split`` in ``folder`` to the new folder ``out``, with every sigma scaled and the factor
    among the settings of ``submission.yaml``; how many samples. Raises PredictionError for predictions that are
    unsound, of another method, or of objects that were calibrated on, and for an ``out`` that is there already."""
    checked = check_folder(folder, dataset, split)
    description = checked.sound()
    _check_stated(folder, description, checked.listing.sigmas)
    for key in ("name", "method", "units"):
        pair = getattr(calibration.described, key), getattr(description, key)
        if pair[0] != pair[1]:
            raise PredictionError(f"{folder}: {key} is {pair[1]!r}, calibrated was {pair[0]!r}; give the same method's")
    objects = [
        {split_sample_name(sample)[0] for sample in dataset.samples(name)} for name in (calibration.split, split)
    ]
    if shared := sorted(objects[0] & objects[1]):
        raise PredictionError(
            f"{folder}: {shared[0]} was calibrated on, so its coverage says nothing; give another split"
        )
    if out.exists():
        raise PredictionError(f"{out} is there already; give a new folder")
    left_out = shutil.ignore_patterns(f"*{SIGMA}", SUBMISSION_FILE)
    with whole_folder(out, "writing predictions there", PredictionError) as made:
        shutil.copytree(folder, made, ignore=left_out, copy_function=shutil.copyfile, dirs_exist_ok=True)
        for sample in checked.listing.present:
            sigma_mm = checked.listing.sigma_mm(sample, dataset.size).astype(np.float64) * calibration.factor
            np.save(made / f"{sample}{SIGMA}", sigma_mm.astype(np.float32))
        settings = {
            FACTOR_KEY: calibration.factor,
            "conformal_coverage": calibration.coverage,
            "conformal_split": calibration.split,
            "conformal_objects": calibration.objects,
            "conformal_target": calibration.target,
        }
        content = description.model_dump(exclude_unset=True) | {
            "name": f"{description.name}, conformal sigma",
            "settings": {**description.settings, **settings},
        }
        text = check_submission(out, content).to_yaml()
        write_atomically(made / SUBMISSION_FILE, text.encode("utf-8"))
    return len(checked.listing.present)
