"""What a row's own page shows of the predictions that it was scored from, where they are at hand: two samples as
pictures, and a prediction as a point cloud."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.errors import CaptureError, DatasetError, FppBenchError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.report.report_page import SampleMaps, chosen_samples, sample_maps
from fpp_ml_bench.evaluation.result.model import Result
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.rows import Entry, read_scored
from fpp_ml_bench.loaders.captures.exports import camera_points
from fpp_ml_bench.loaders.cloud import cloud_html
from fpp_ml_bench.loaders.storage.store import DatasetFolder

PLACES = "Median", "Worst"
"""The samples that are shown; where there are too few for that, the only one."""


@dataclass(frozen=True)
class Samples:
    """The samples that are shown, and the page of the first prediction as a point cloud; ``cloud`` is None where the
    prediction has no depth, or the dataset no camera of its size."""

    shown: list[SampleMaps]
    cloud: bytes | None


def predicted_samples(entries: Sequence[Entry], folders: Sequence[tuple[Path, DatasetFolder]]) -> dict[str, Samples]:
    """The samples of every folder of predictions, each with its dataset, by `Row.result_sha256` of the entries that
    were scored from it. Row files name no samples, so only results have them. Raises SubmissionError for a folder that
    no result was scored from, and says why."""
    results = [entry for entry in entries if folders and not entry.is_row_file]
    scored = {entry.row.result_sha256: read_scored(entry.path) for entry in results}
    found: dict[str, Samples] = {}
    for folder, dataset in folders:
        why: FppBenchError | str = "row files name no samples; give the result of fpp-eval"
        of_folder = {}
        for digest, result in scored.items():
            try:
                if isinstance(result, Result):
                    of_folder[digest] = _samples(result, folder, dataset)
            except (DatasetError, PredictionError) as error:
                why = error
        if not of_folder:
            raise SubmissionError(f"{printable(str(folder), 500)}: no given result was scored from it ({why})")
        found |= of_folder
    return found


def _samples(result: Result, folder: Path, dataset: DatasetFolder) -> Samples:
    chosen = chosen_samples(result.per_sample)
    shown = list(sample_maps(result, dataset, folder, [c for c in chosen if c[0] in PLACES] or chosen[:1]))
    if not shown or result.mode != "standard":  # no sample has an object; depths of another mode may lack an offset
        return Samples(shown, None)
    try:
        points_mm, there = camera_points(shown[0].prediction_mm, dataset.rig.camera)
    except CaptureError:
        return Samples(shown, None)
    return Samples(
        shown, cloud_html(f"{result.submission.name}: {shown[0].row.sample}", points_mm, shown[0].fringe[there])
    )
