"""Which prediction files a folder holds, in which of the accepted forms, and what is missing or extra."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.submission_file import REPORTS_FILE, SUBMISSION_FILE
from fpp_ml_bench.evaluation.text import printable

PER_SAMPLE = (".npy", ".npz", ".mat", ".png")
TABLES = ("predictions.parquet", "predictions.arrow")
FORMS = "{sample}.npy, .npz, .mat or .png, or one predictions.parquet or .arrow"


class Listing(NamedTuple):
    """``form`` is one of `PER_SAMPLE` or `TABLES`; ``problems`` has a line for each missing or extra entry."""

    form: str
    problems: list[str]
    present: list[str]


def list_folder(folder: Path, samples: Sequence[str], split: str, split_of: Mapping[str, str]) -> Listing:
    """What ``folder`` holds for ``samples``: the form of most of its files, and every entry that is missing or extra.

    ``split_of`` gives the split of every sample of the dataset, for the hint at a sample of another split.
    """
    try:
        names = sorted(entry.name for entry in os.scandir(folder))
    except OSError as error:
        raise PredictionError(
            f"the predictions folder {printable(str(folder))} can't be read: {error.strerror}"
        ) from None
    form = _form(set(names), samples)
    expected = {form} if form in TABLES else {f"{sample}{form}" for sample in samples}
    problems = [
        f"{name}: is missing; write one for each sample"
        for name in _in_order(expected, samples, form)
        if name not in names
    ]
    problems += [
        f"{printable(name)}: is extra ({_hint(name, form, samples, split, split_of)})"
        for name in names
        if name not in expected and name not in (SUBMISSION_FILE, REPORTS_FILE)
    ]
    if form in TABLES:
        return Listing(form, problems, list(samples))
    present = set(names)
    return Listing(form, problems, [sample for sample in samples if f"{sample}{form}" in present])


def _form(names: set[str], samples: Sequence[str]) -> str:
    counts = {suffix: sum(f"{sample}{suffix}" in names for sample in samples) for suffix in PER_SAMPLE}
    best = max(PER_SAMPLE, key=lambda suffix: counts[suffix])  # the first of equals: .npy where there is nothing
    if counts[best] == 0:
        return next((table for table in TABLES if table in names), best)
    return best


def _in_order(expected: set[str], samples: Sequence[str], form: str) -> list[str]:
    return list(expected) if form in TABLES else [f"{sample}{form}" for sample in samples]


def _hint(name: str, form: str, samples: Sequence[str], split: str, split_of: Mapping[str, str]) -> str:
    stem, suffix = os.path.splitext(name)  # noqa: PTH122  Path.suffix takes ".npy" alone for a stem
    sample_split = split_of.get(stem) if suffix in PER_SAMPLE else None
    if sample_split and stem not in samples:
        return f"a sample of split {sample_split}, not of {split}: move it away or score that split"
    if sample_split or name in TABLES:
        return f"the other predictions are {form if form in TABLES else form + ' files'}: keep one form"
    return "remove it"
