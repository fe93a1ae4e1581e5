"""What a folder of predictions holds: the plain values of its description, and the files, their form and reader."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import local
from typing import Any, NamedTuple

from numpy.typing import NDArray

from fpp_ml_bench.errors import FppBenchError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.protocol import LARGEST_MM
from fpp_ml_bench.evaluation.submission.sample_files import HEADER_BYTES, parse_npy, read_npy, read_npz, read_png
from fpp_ml_bench.files import LOCK_FILE, printable, read_bounded, read_yaml

SUBMISSION_FILE = "submission.yaml"
REPORTS_FILE = "per_sample.json"
"""What a method may report of each sample beside its predictions; it is not scored."""
UNFINISHED_FILE = "unfinished.jsonl"
"""What `baselines.run.predict_split` goes on from, until all predictions are there."""
_MAX_BYTES = 65536


def read_plain(folder: Path) -> dict[Any, Any]:
    """Keys and values of a predictions folder's ``submission.yaml``, their meaning unchecked; else SubmissionError."""
    path = folder / SUBMISSION_FILE
    if path.is_symlink() or not path.is_file():
        found = "a symbolic link" if path.is_symlink() else "none"
        raise SubmissionError(
            f"expected a file {printable(str(path), 500)} that describes the predictions, found {found}; fpp-bench "
            "predict writes one, PROTOCOL.md lists its keys"
        )
    return read_plain_file(path, "'name: My method'")


def read_plain_file(path: Path, example: str, raised: type[FppBenchError] = SubmissionError) -> dict[Any, Any]:
    """Keys and values of a YAML file, of bounded size and plain values; ``example`` shows what a line looks like. The
    error ``raised`` names the file, what is wrong with it and what to do."""
    content = read_yaml(path, raised, "correct it, with short names and settings", _MAX_BYTES)
    if not isinstance(content, dict):
        file = printable(str(path), 500)
        raise raised(f"{file}: expected keys and values like {example}, got {type(content).__name__}")
    return content


PER_SAMPLE = (".npy", ".npz", ".mat", ".png")
SIGMA = ".sigma.npy"
"""Of a sample's optional standard uncertainty, a map (H, W) in mm, 0 where none is stated."""
TABLES = ("predictions.parquet", "predictions.arrow")
_MAT_SPARE_BYTES = 1 << 20


class Listing(NamedTuple):
    """``form`` is one of `PER_SAMPLE` or `TABLES`; ``problems`` has a line for each missing or extra entry; ``sigmas``:
    whether there are `SIGMA` files."""

    form: str
    problems: list[str]
    present: list[str]
    sigmas: bool


def list_folder(folder: Path, samples: Sequence[str], split: str, split_of: Mapping[str, str]) -> Listing:
    """What ``folder`` holds for ``samples``: the form of most of its files, and every entry that is missing or extra.
    ``split_of`` gives the split of every sample of the dataset, for the hint at a sample of another split."""
    try:
        names = {entry.name for entry in os.scandir(folder)}
    except OSError as error:
        name = printable(str(folder))
        raise PredictionError(f"the predictions folder {name} can't be read: {error.strerror}") from None
    counts = {suffix: sum(f"{sample}{suffix}" in names for sample in samples) for suffix in PER_SAMPLE}
    form = max(PER_SAMPLE, key=lambda suffix: counts[suffix])  # the first of equals: .npy where there is nothing
    if counts[form] == 0:
        form = next((table for table in TABLES if table in names), form)
    files = {form: ""} if form in TABLES else {f"{sample}{form}": sample for sample in samples}

    def hint(name: str) -> str:
        stem, suffix = os.path.splitext(name)  # noqa: PTH122  Path.suffix takes ".npy" alone for a stem
        sample_split = split_of.get(stem) if suffix in PER_SAMPLE else None
        if sample_split and stem not in samples:
            return f"a sample of split {sample_split}, not of {split}: move it away or score that split"
        if name == UNFINISHED_FILE:
            return "a stopped fpp-bench predict left it: run the same command again, it continues"
        if sample_split or name in TABLES:
            return f"the other predictions are {form if form in TABLES else form + ' files'}: keep one form"
        return "remove it"

    problems = [f"{name}: is missing; write one for each sample" for name in files if name not in names]
    uncertain = {f"{sample}{SIGMA}" for sample in samples}
    if sigmas := bool(uncertain & names):
        problems += [f"{name}: is missing; write one for each sample, or none" for name in sorted(uncertain - names)]
    extra = sorted(names - {*files, *uncertain, SUBMISSION_FILE, REPORTS_FILE, LOCK_FILE})
    problems += [f"{printable(name)}: is extra ({hint(name)})" for name in extra]
    present = list(samples) if form in TABLES else [sample for name, sample in files.items() if name in names]
    return Listing(form, problems, present, sigmas)


def samples_in(folder: Path) -> list[str]:
    """The samples that a folder holds a file of its own for, by the files' names, ascending."""
    try:
        names = sorted(path.name for path in folder.iterdir())
    except OSError as error:
        raise PredictionError(f"{printable(str(folder), 500)} can't be read: {error.strerror}") from None
    stems = (name.removesuffix(suffix) for name in names for suffix in PER_SAMPLE if name.endswith(suffix))
    return list(dict.fromkeys(stem.removesuffix(SIGMA.removesuffix(".npy")) for stem in stems))


def read_sigma(folder: Path, sample: str, size: tuple[int, int]) -> NDArray[Any]:
    """The `SIGMA` file of a sample, real floats (H, W) in mm; PredictionError, without the file's name, for any other
    content."""
    sigma_mm = parse_npy(read_bounded(folder / f"{sample}{SIGMA}", size[0] * size[1] * 8 + HEADER_BYTES), size)
    low, high = float(sigma_mm.min()), float(sigma_mm.max())
    if low >= 0 and high <= LARGEST_MM:  # False for NaN
        return sigma_mm
    found = f"found {low:g} to {high:g}"
    raise PredictionError(f"expected finite mm of 0 and more, {found}; write 0 where none is stated")


MapAndHash = tuple[NDArray[Any], str]


class Reader(NamedTuple):
    """``read(sample)`` gives a map (H, W), valid until the same thread reads again, and the SHA-256 of its file. It may
    be called from several threads, and raises PredictionError, without the file's name, for a file that is refused.
    ``named(sample)`` is the name of the sample's prediction in messages: its file."""

    read: Callable[[str], MapAndHash]
    named: Callable[[str], str]


def reader_for(
    form: str, folder: Path, samples: Sequence[str], size: tuple[int, int], png_mm_per_level: float | None
) -> Reader:
    """The reader of ``form`` (of `PER_SAMPLE` or `TABLES`) for maps of ``size`` (H, W)."""
    if form in TABLES:
        from fpp_ml_bench.evaluation.submission.table import depth_maps  # needs pyarrow, which other forms do not

        maps = depth_maps(folder / form, samples, size)
        return Reader(maps, lambda sample: f"{form}, sample {printable(sample)}")
    memory, largest_mat = local(), size[0] * size[1] * 8 + _MAT_SPARE_BYTES
    if form == ".mat":
        from fpp_ml_bench.evaluation.submission.isolated import ReadingProcess  # needs multiprocessing

        matrix_as_npy = ReadingProcess(f"{__package__}.mat", largest_mat)

    def read_mat(path: Path) -> MapAndHash:
        content = read_bounded(path, largest_mat)
        return parse_npy(matrix_as_npy(content), size), hashlib.sha256(content).hexdigest()

    read = {
        ".npy": lambda path: read_npy(path, size, memory),
        ".npz": lambda path: read_npz(path, size),
        ".png": lambda path: read_png(path, size, png_mm_per_level),
        ".mat": read_mat,
    }[form]
    return Reader(lambda sample: read(folder / f"{sample}{form}"), lambda sample: f"{sample}{form}")
