"""Which prediction files a folder holds, in which of the accepted forms, and what is missing or extra."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import local
from typing import Any, NamedTuple, Protocol

from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.submission.description import REPORTS_FILE, SUBMISSION_FILE
from fpp_ml_bench.evaluation.submission.npy import buffer_for, read_prediction
from fpp_ml_bench.files import printable

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


MapAndHash = tuple[NDArray[Any], str]


class Reader(Protocol):
    """Called from several threads; ``memory`` is the calling thread's own, for buffers that it reuses."""

    def __call__(self, sample: str, memory: local) -> MapAndHash: ...

    def named(self, sample: str) -> str:
        """The name of the sample's prediction in messages: its file."""
        ...


class _FilePerSample:
    def __init__(self, folder: Path, form: str, read: Callable[[Path, local], MapAndHash]) -> None:
        self._folder, self._form, self._read = folder, form, read

    def named(self, sample: str) -> str:
        return f"{sample}{self._form}"

    def __call__(self, sample: str, memory: local) -> MapAndHash:
        return self._read(self._folder / self.named(sample), memory)


def reader_for(
    form: str, folder: Path, samples: Sequence[str], size: tuple[int, int], png_mm_per_level: float | None
) -> Reader:
    """The reader of ``form`` (of `fpp_ml_bench.evaluation.submission.prediction_files`) for maps of ``size`` (H, W).

    Its calls raise PredictionError, without the file's name, for a file that is refused.
    """
    if form in TABLES:
        from fpp_ml_bench.evaluation.submission.table import TablePredictions

        return TablePredictions(folder / form, samples, size)
    if form == ".npz":
        from fpp_ml_bench.evaluation.submission.npy import read_npz

        return _FilePerSample(folder, form, lambda path, memory: read_npz(path, size))
    if form == ".mat":
        from fpp_ml_bench.evaluation.submission.mat import read_mat

        return _FilePerSample(folder, form, lambda path, memory: read_mat(path, size))
    if form == ".png":
        from fpp_ml_bench.evaluation.submission.png import read_png

        return _FilePerSample(folder, form, lambda path, memory: read_png(path, size, png_mm_per_level))
    return _FilePerSample(folder, form, lambda path, memory: _read_npy(path, size, memory))


def _read_npy(path: Path, size: tuple[int, int], memory: local) -> MapAndHash:
    if not hasattr(memory, "buffer"):
        memory.buffer = buffer_for(size)
    return read_prediction(path, size, memory.buffer)
