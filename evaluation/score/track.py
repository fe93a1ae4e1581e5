"""Scoring a method on many rigs: a folder of datasets, of several rigs and lights, against a folder
of predictions that has one folder for each.

A rig that a method can't be for has a file `REFUSED_FILE` in the place of predictions, which says
why. There it has no score, and no mean is over it.
"""

import math
from collections.abc import Callable
from pathlib import Path

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.evaluation.result.parts import BenchmarkInfo, DatasetScores, TrackScores
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.evaluation.submission.prediction_files import REFUSED_FILE
from fpp_ml_bench.files import file_content, printable
from fpp_ml_bench.loaders.storage.benchmark import known_track
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.schema import LONGEST_REASON
from fpp_ml_bench.style import percent, three_digits
from fpp_ml_bench.tables import Table

SPLIT, TARGET = "test", "depth_exact"
"""What is scored of each dataset: the depth that a method of one frame should find, not the decoded
one, whose error is a measure here."""
PER_MILLE = 1000


def score_track(
    predictions: Path,
    datasets: dict[str, Path],
    progress: Callable[[int], None] = lambda datasets: None,
) -> TrackScores:
    """Scores on ``datasets`` (folder by name) of the folders of the same names in ``predictions``.
    ``progress`` is called after each. Raises `PredictionError` for a folder that is missing, for
    predictions of several methods, and what `evaluate` raises."""
    scores: dict[str, DatasetScores] = {}
    refused: dict[str, str] = {}
    content = {}
    said: tuple[str, Result] | None = None
    for name, place in datasets.items():
        folder, dataset = predictions / name, DatasetFolder(place)
        content[name] = dataset.content
        if (reason := folder / REFUSED_FILE).is_file():
            text = file_content(reason, LONGEST_REASON, PredictionError, "shorten it")
            refused[name] = printable(text.decode("utf-8", "replace").strip(), LONGEST_REASON)
        elif not folder.is_dir():
            raise PredictionError(
                f"{folder}: missing; expected the predictions of {place}, or {REFUSED_FILE} with "
                f"the reason why the method has none there"
            )
        else:
            result = evaluate(folder, dataset, SPLIT, TARGET, EDGE_BAND_PX)
            if said is None:
                said = folder.name, result
            elif said[1].submission.method != result.submission.method:
                raise PredictionError(
                    f"{folder}: method {printable(result.submission.method)}, {said[0]} has "
                    f"{printable(said[1].submission.method)}; expected one method on all rigs"
                )
            scores[name] = dataset_scores(result, dataset)
        progress(1)
    if said is None:
        raise PredictionError(f"{predictions}: the method refused every rig; nothing to score")
    weights, track = said[1].submission.settings.get("weights_sha256"), known_track(content)
    return TrackScores(
        benchmark=None if track is None else BenchmarkInfo(name=track.name, version=track.version),
        name=said[1].submission.name,
        method=said[1].submission.method,
        weights_sha256=weights if isinstance(weights, str) else None,
        datasets=scores,
        refused=refused,
    )


def dataset_scores(result: Result, dataset: DatasetFolder) -> DatasetScores:
    """A result against the exact depth in the units of `DatasetScores`. Raises `DatasetError` for a
    dataset without an object in sight."""
    error_mm, rig = result.metrics.two_sided_mae_mm, dataset.rig
    if error_mm is None:
        raise DatasetError(f"{dataset.path}: no object in any sample; there is nothing to score")
    decoded = [
        value
        for sample in dataset.samples(SPLIT)
        if (value := dataset.measured(sample).get("gt_mae_mm")) is not None
    ]
    decoded_mm = math.fsum(decoded) / len(decoded) if decoded else 0.0
    answered_mm = result.metrics.object_valid_mae_mm
    per_mm = PER_MILLE / (rig.standoff_m * MM_PER_M)
    light = dataset.manifest.settings.get("light", {})
    return DatasetScores(
        light=str(light.get("name", "unknown")),
        mae_mm=error_mm,
        per_mille=per_mm * error_mm,
        answered_per_mille=None if answered_mm is None else per_mm * answered_mm,
        projector_px=error_mm * rig.projector_px_per_mm,
        of_decoded=error_mm / decoded_mm if decoded_mm else None,
        missing_share=result.metrics.object_missing_share,
        invented_share=result.metrics.invented_share,
    )


def track_table(scores: TrackScores) -> Table:
    """The scores by dataset, and the means and worst of each light."""
    table = Table(
        "Dataset",
        numbers=(
            "per mille",
            "answered",
            "mm",
            "projector px",
            "x many frames",
            "missing",
            "invented",
        ),
        title=f"{printable(scores.name)}: two-sided MAE by rig, of {scores.title}",
        first_out=("projector px", "mm"),
        caption="per mille of the standoff, answered: of the pixels with an answer alone; x many "
        "frames: over the error of the decoded depth",
    )

    def add(name: str, row: DatasetScores, style: str | None = None) -> None:
        errors = row.per_mille, row.answered_per_mille, row.mae_mm, row.projector_px, row.of_decoded
        cells = ["-" if error is None else three_digits(error) for error in errors]
        shares = percent(row.missing_share), percent(row.invented_share)
        table.add_row(name, *cells, *shares, style=style)

    for name in sorted({*scores.datasets, *scores.refused}):
        if name in scores.datasets:
            add(name, scores.datasets[name])
        else:
            table.add_row(name, "refused")
    for light in scores.lights:
        add(f"mean, {light}", scores.mean(light), "bold")
        worst = scores.worst(light)
        add(f"worst, {light}: {worst}", scores.datasets[worst])
    return table
