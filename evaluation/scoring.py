"""Scoring every prediction of a folder: read, checked, scored, a few files at a time, without pydantic and torch.

Memory does not grow with the number of samples, and nothing depends on the number of cores.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from threading import Lock, local
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.evaluation.listing import Listing
from fpp_ml_bench.evaluation.predictions import value_problems
from fpp_ml_bench.evaluation.protocol import Mode, Units
from fpp_ml_bench.evaluation.reading import reader_for
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.evaluation.units import scored_pair
from fpp_ml_bench.hardware import usable_cores

WORKERS = 4
Outcome = tuple[list[str], list[dict[str, Any]]]
"""Problems and rows of a sample: a line for each problem and no row, or no problem and a row."""


class Rules(NamedTuple):
    """How predictions are read and scored."""

    size: tuple[int, int]
    units: Units
    png_mm_per_level: float | None
    mode: Mode
    edge_band_px: int


def scored(
    folder: Path,
    listing: Listing,
    rules: Rules,
    target_mm: Callable[[str], NDArray[np.float32]],
    release: Callable[[str], None] = lambda sample: None,
) -> Iterator[Outcome]:
    """Problems and row of each sample that has a prediction, in order.

    ``target_mm`` gives a sample's target (H, W); ``release`` is called when it is not needed any more.

    Work begins with this call, in threads, before the first outcome is taken from the iterator.
    """
    read = reader_for(listing.form, folder, listing.present, rules.size, rules.png_mm_per_level)
    memory, dataset_lock = local(), Lock()

    def work(sample: str) -> Outcome:
        with dataset_lock:  # reading the dataset need not be thread-safe
            target = target_mm(sample)
        low, high = float(target.min()), float(target.max())
        if not (low >= 0 and np.isfinite(high)):
            raise DatasetError(
                f"{sample}: the target depth holds NaN, infinite or negative values; run: fpp-bench verify"
            )
        try:
            values, digest = read(sample, memory)
            problems = value_problems(values, target, high, rules.units)
            if not problems:
                pair = scored_pair(values, target, rules.units, rules.mode, sample)
                scores = score_sample(*pair, rules.edge_band_px)
        except PredictionError as error:
            problems = [str(error)]
        with dataset_lock:
            release(sample)
        if problems:
            return [f"{read.named(sample)}: {problem}" for problem in problems], []
        return [], [
            {
                "sample": sample,
                "prediction_sha256": digest,
                "object_pixels": scores.object.pixels,
                "background_pixels": scores.background.pixels,
                **scores.metrics(),
            }
        ]

    pool = ThreadPoolExecutor(min(WORKERS, usable_cores()))
    return _results(pool, [pool.submit(work, sample) for sample in listing.present])


def _results(pool: ThreadPoolExecutor, futures: list[Future[Outcome]]) -> Iterator[Outcome]:
    try:
        for future in futures:
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)
