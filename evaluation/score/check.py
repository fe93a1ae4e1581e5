"""What can be checked of a submission without ground truth: its description, its files, their size and values."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.constants import LARGEST_SIDE_PX
from fpp_ml_bench.errors import PredictionError, SubmissionError
from fpp_ml_bench.evaluation import submission
from fpp_ml_bench.evaluation.score.units import unit_note, value_problems
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage import DatasetFolder


@dataclass(frozen=True)
class Checked:
    """``problems``: a line for each reason to refuse the folder, usually none; ``notes``: what is worth a look.
    ``size`` (H, W) in px; ``sigmas``: whether the samples state their uncertainty."""

    problems: list[str]
    notes: list[str]
    description: submission.Submission | None
    samples: list[str]
    form: str
    size: tuple[int, int]
    sigmas: bool


def checked_description(
    folder: Path, content: dict[Any, Any], form: str, frames: int | None = None
) -> submission.Submission:
    """The folder's description, checked against the predictions' ``form`` and a sequence of ``frames``, where known."""
    description = submission.check_submission(folder, content)
    outside = [index for index in description.frames_used if frames is not None and index >= frames]
    if frames is not None and outside:
        expected = f"expected indices from 0 to {frames - 1} of this dataset's sequence"
        problem = f"frames_used: {expected}, got {printable(str(outside), 100)}"
    elif form == ".png" and description.png_mm_per_level is None:
        problem = "png_mm_per_level: expected what one level of the .png files is in mm, like 0.05, got nothing"
    elif form != ".png" and description.png_mm_per_level is not None:
        problem = f"png_mm_per_level is given, but the predictions are {form}; remove the key"
    else:
        return description
    raise SubmissionError(f"{printable(str(folder / submission.SUBMISSION_FILE), 500)}: {problem}")


def check_folder(folder: str | Path, dataset: DatasetFolder | None = None, split: str = "test") -> Checked:
    """Check everything of a submission that needs no ground truth. With a ``dataset``, its split says which samples of
    which size are expected; without, the files' names and the size that most of them have do. Raises PredictionError
    for no folder, and for a form that can't be read without a dataset."""
    folder = Path(folder)
    if not folder.is_dir():
        raise PredictionError(f"expected a folder of predictions, found none at {printable(str(folder), 500)}")
    samples = submission.samples_in(folder) if dataset is None else dataset.samples(split)
    if not samples:
        expected = "expected one {sample}.npy for each sample, found none"
        raise PredictionError(f"{printable(str(folder), 500)}: {expected}; tables need DATASET")
    split_of = {} if dataset is None else {name: part for part, names in dataset.splits.items() for name in names}
    listing = submission.list_folder(folder, samples, split, split_of)
    problems, notes = list(listing.problems), []
    description = None
    try:
        content = submission.read_plain(folder)
        description = checked_description(
            folder, content, listing.form, None if dataset is None else len(dataset.sequence)
        )
    except SubmissionError as error:
        problems.insert(0, str(error))
    size = _declared_size(folder, listing) if dataset is None else dataset.size
    level_mm = None if description is None else description.png_mm_per_level
    units = "mm" if description is None else description.units
    largest = 0.0
    if listing.form != ".png" or level_mm is not None:
        reader = submission.reader_for(listing.form, folder, listing.present, size, level_mm)
        for sample in listing.present:
            try:
                values, _ = reader.read(sample)
                largest = max(largest, float(values.max()))
                found = value_problems(values, np.zeros(size), 0.0, units)
            except PredictionError as error:
                found = [str(error)]
            problems += [f"{printable(reader.named(sample))}: {problem}" for problem in found]
    for sample in listing.present if listing.sigmas else ():
        try:
            submission.read_sigma(folder, sample, size)
        except PredictionError as error:
            problems.append(f"{printable(sample)}{submission.SIGMA}: {error}")
    if note := unit_note(largest, units):
        notes.append(note)
    return Checked(problems, notes, description, listing.present, listing.form, size, listing.sigmas)


def _declared_size(folder: Path, listing: submission.Listing) -> tuple[int, int]:
    """The size (H, W) that most of the files declare. PredictionError where it is too large to be read."""
    if listing.form == ".mat":
        raise PredictionError(f"{printable(str(folder), 500)}: .mat files can only be checked with DATASET")
    files = [folder / f"{sample}{listing.form}" for sample in listing.present]
    declared = {file: size for file in files if (size := submission.declared_size(file)) and min(size) > 0}
    if not declared:
        named = printable(str(folder), 500)
        raise PredictionError(f"{named}: no file holds a depth map (H, W); write them with np.save")
    size = Counter(declared.values()).most_common(1)[0][0]
    if max(size) > LARGEST_SIDE_PX:
        file = next(file for file in declared if declared[file] == size)
        most = f"expected at most {LARGEST_SIDE_PX} without a dataset; write the depth map itself, or give DATASET"
        raise PredictionError(f"{printable(str(file), 500)}: declares {size[1]} x {size[0]} px, {most}")
    return size
