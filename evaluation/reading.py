"""Readers of all accepted forms of predictions: each gives a sample's depth map and the hash of its file."""

from collections.abc import Callable, Sequence
from pathlib import Path
from threading import local
from typing import Any, Protocol

from numpy.typing import NDArray

from fpp_ml_bench.evaluation.listing import TABLES
from fpp_ml_bench.evaluation.read_npy import buffer_for, read_prediction

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
    """The reader of ``form`` (of `fpp_ml_bench.evaluation.listing`) for maps of ``size`` (H, W).

    Its calls raise PredictionError, without the file's name, for a file that is refused.
    """
    if form in TABLES:
        from fpp_ml_bench.evaluation.read_table import TablePredictions

        return TablePredictions(folder / form, samples, size)
    if form == ".npz":
        from fpp_ml_bench.evaluation.read_npz import read_npz

        return _FilePerSample(folder, form, lambda path, memory: read_npz(path, size))
    if form == ".mat":
        from fpp_ml_bench.evaluation.read_mat import read_mat

        return _FilePerSample(folder, form, lambda path, memory: read_mat(path, size))
    if form == ".png":
        from fpp_ml_bench.evaluation.read_png import read_png

        return _FilePerSample(folder, form, lambda path, memory: read_png(path, size, png_mm_per_level))
    return _FilePerSample(folder, form, lambda path, memory: _read_npy(path, size, memory))


def _read_npy(path: Path, size: tuple[int, int], memory: local) -> MapAndHash:
    if not hasattr(memory, "buffer"):
        memory.buffer = buffer_for(size)
    return read_prediction(path, size, memory.buffer)
