"""Scores of trainings that are no rows of the leaderboard: over every frame that one learned from,
or over the objects that a cross-validation kept from it.

In the paper's multi-frame table (Section 5.4) scores are averages over all (view, frame) pairs of a
condition's test set. Here each sample's score is the mean over its frames, and the headline the
mean over samples: the same number, for every sample has the same frames, and the interval can then
be taken over objects. The rules are the evaluator's own (`Rules`, `score_sample`).
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench.baselines.training.depth_training import fold_samples
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.baselines.trivial import best_range_share
from fpp_ml_bench.constants import split_sample_name
from fpp_ml_bench.errors import PredictionError, SubmissionError
from fpp_ml_bench.evaluation.metrics import HEADLINE, RANGE_KEY
from fpp_ml_bench.evaluation.protocol import PROTOCOL_VERSION
from fpp_ml_bench.evaluation.result.parts import Sha256
from fpp_ml_bench.evaluation.score.check import Rules
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.uncertainty import mean_of
from fpp_ml_bench.files import read_json
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.schema import Count, NonNegative, StrictModel, Text, validate

MAIN_KEY, OVERALL_KEY = "object_mae_mm", "overall_mae_mm"
BINS_MM = np.geomspace(0.1, 1000.0, 41)
"""Ends of a histogram's bins, mm: ten a decade, around the errors of 1 to 100 mm of the paper's
tables."""
SPLIT, TARGET = "test", "depth"


class Scores(StrictModel):
    """Errors of a training that are no row of the leaderboard: over every frame that it was trained
    on, or over the objects that a cross-validation kept from it. ``errors``: means over ``pairs``
    of ``frames`` and samples, of the six errors in mm and of the share of the depth range;
    ``per_object``: the object MAE in mm of each object; ``counts``: of pairs by overall and by
    object MAE, as the paper's histograms, by the key (`histogram`)."""

    schema_version: Literal["3.0.0"] = "3.0.0"
    protocol_version: Text = PROTOCOL_VERSION
    fingerprint: Sha256
    recipe_digest: Sha256
    weights_sha256: Sha256
    frames: list[Count]
    pairs: Annotated[int, Field(gt=0)]
    errors: dict[Text, NonNegative | None]
    per_object: Annotated[dict[Text, NonNegative], Field(min_length=1)]
    counts: dict[Text, list[Count]] = Field(default_factory=dict)


def score_frames(
    opened: DatasetFolder,
    predict: Callable[[NDArray[np.uint8]], NDArray[np.float32]],
    frames: Sequence[int],
    rules: Rules,
    samples: Sequence[str],
    **identity: str,
) -> Scores:
    """Score ``predict`` (a frame (H, W) in, depth (H, W) out) by ``rules`` on every one of
    ``samples`` and frames; ``identity``: the hashes of recipe and weights. Raises PredictionError
    for a prediction that is not finite, and what `Rules.pair` raises."""
    keys = (*HEADLINE, RANGE_KEY)
    rows: list[dict[str, float | None]] = []
    of_pairs: list[dict[str, float | None]] = []
    by_object: dict[str, list[float | None]] = {}
    for sample in samples:
        void = rules.void(opened, sample)
        scores = []
        for frame in frames:
            values = predict(opened.frame(sample, frame))
            if not np.isfinite(values).all():
                raise PredictionError(
                    f"{sample}, frame {frame}: the network gave values that are not finite"
                )
            scores.append(score_sample(*rules.pair(values, opened, sample), void=void).metrics())
        of_pairs += scores
        rows.append({key: mean_of(score.get(key) for score in scores) for key in keys})
        by_object.setdefault(split_sample_name(sample)[0], []).append(rows[-1][MAIN_KEY])
    means = {name: mean_of(errors) for name, errors in by_object.items()}
    return Scores(
        fingerprint=opened.fingerprint,
        frames=list(frames),
        pairs=len(samples) * len(frames),
        errors={key: mean_of(row[key] for row in rows) for key in keys},
        per_object={name: mean for name, mean in means.items() if mean is not None},
        counts={
            key: histogram([score[key] for score in of_pairs]) for key in (OVERALL_KEY, MAIN_KEY)
        },
        **identity,  # type: ignore[arg-type]
    )


def histogram(errors_mm: Sequence[float | None]) -> list[int]:
    """How many errors, None left out, are in each bin of `BINS_MM`; beyond its ends they count in
    the end bins."""
    known = [error for error in errors_mm if error is not None]
    counts, _ = np.histogram(np.clip(known, BINS_MM[0], BINS_MM[-1]), BINS_MM)
    return counts.tolist()  # type: ignore[no-any-return]


def read_scores(path: Path) -> Scores:
    """Read strictly; SubmissionError names the file and what is wrong with it."""
    return validate(
        Scores, read_json(path, SubmissionError, "run the command again"), path, "file of scores"
    )


def scores_that_hold(
    path: Path, fingerprint: str, recipe: Recipe, weights_sha256: str | None = None
) -> Scores | None:
    """The scores in ``path`` if valid and of this dataset, this recipe, the current protocol, and
    these weights where they are given; else None."""
    try:
        scores = read_scores(path)
    except SubmissionError:
        return None
    identity = scores.fingerprint, scores.recipe_digest, scores.protocol_version
    same = identity == (fingerprint, recipe.digest, PROTOCOL_VERSION)
    return scores if same and weights_sha256 in (None, scores.weights_sha256) else None


def constant_scores(opened: DatasetFolder, fold: tuple[int, int]) -> Scores:
    """Of the same share of each sample's range at every pixel."""
    splits = fold_samples(opened, fold)
    answer = np.full(opened.size, best_range_share(opened, splits["train"]), np.float32)
    rules = Rules(TARGET, "normalised", "valid", "paper")
    identity = dict.fromkeys(("recipe_digest", "weights_sha256"), "0" * 64)
    return score_frames(opened, lambda frame: answer, [0], rules, splits["test"], **identity)


def joined(parts: Sequence[Scores]) -> Scores:
    """The scores of several parts of the objects as one; each pair counts the same. Without
    counts."""
    pairs = sum(part.pairs for part in parts)
    sums = {
        key: [part.pairs * value for part in parts if (value := part.errors[key]) is not None]
        for key in parts[0].errors
    }
    return parts[0].model_copy(
        update={
            "pairs": pairs,
            "counts": {},
            "errors": {
                key: sum(values) / pairs if len(values) == len(parts) else None
                for key, values in sums.items()
            },
            "per_object": {
                name: value for part in parts for name, value in part.per_object.items()
            },
        }
    )
