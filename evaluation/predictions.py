"""Predictions from a stranger: which files are there, and what is in each, checked before a byte is trusted.

One ``{sample}.npy`` per sample: an (H, W) map of depth in mm, float16, float32 or float64, 0 = background. The header
is checked before memory is taken, nothing is ever unpickled, no link is followed, and the bytes that were hashed are
the bytes that are scored.
"""

import hashlib
import os
import stat
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import protocol
from fpp_ml_bench.evaluation.submission import SUBMISSION_FILE
from fpp_ml_bench.evaluation.text import printable

HEADER_BYTES = 16384
_SUFFIX = ".npy"


def list_problems(folder: Path, samples: Sequence[str], split: str, split_of: Mapping[str, str]) -> list[str]:
    """One line for each missing and each extra entry of ``folder``, in the order of the samples, then by name.

    ``split_of`` gives the split of every sample of the dataset, for the hint beside a sample of another split.
    """
    try:
        present = sorted(entry.name for entry in os.scandir(folder))
    except OSError as error:
        raise PredictionError(
            f"the predictions folder {printable(str(folder))} can't be read: {error.strerror}"
        ) from None
    names = set(present)
    expected = {f"{sample}{_SUFFIX}" for sample in samples}
    problems = [f"{sample}{_SUFFIX}: is missing" for sample in samples if f"{sample}{_SUFFIX}" not in names]
    for name in present:
        if name in expected or name == SUBMISSION_FILE:
            continue
        other = split_of.get(name.removesuffix(_SUFFIX)) if name.endswith(_SUFFIX) else None
        hint = f"a sample of split {other}, not of {split}: move it away or score that split" if other else "remove it"
        problems.append(f"{printable(name)}: is extra ({hint})")
    return problems


def read_prediction(path: Path, size: tuple[int, int], buffer: bytearray | None = None) -> tuple[NDArray[Any], str]:
    """The array in ``path`` and the SHA-256 of the whole file.

    ``size`` is the expected (H, W). ``buffer`` (see `buffer_for`) is reused when given: the array is a view of it and
    holds until the next read. Raises PredictionError, without the file's name, when the file is no plain .npy of that
    size and a real float dtype.
    """
    buffer = buffer_for(size) if buffer is None else buffer
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        linked = path.is_symlink()
        reason = "is a symbolic link; put the file itself there" if linked else f"can't be read: {error.strerror}"
        raise PredictionError(reason) from None
    info = os.fstat(descriptor)
    if not stat.S_ISREG(info.st_mode):
        os.close(descriptor)
        raise PredictionError("is not a regular file")
    with os.fdopen(descriptor, "rb", buffering=0) as stream:
        view = memoryview(buffer)
        got = _fill(stream, view[: min(HEADER_BYTES, info.st_size)])
        dtype, fortran, start = _check_header(bytes(view[:got]), size)
        expected = start + size[0] * size[1] * dtype.itemsize
        if info.st_size != expected:
            what = "is truncated" if info.st_size < expected else "has foreign bytes after the array"
            raise PredictionError(f"{what}: expected {expected} bytes, got {info.st_size}; write it again")
        got += _fill(stream, view[got:expected])
        if got != expected:
            raise PredictionError(f"ended early: expected {expected} bytes, got {got}; write it again")
    digest = hashlib.sha256(view[:expected]).hexdigest()
    flat = np.frombuffer(buffer, dtype=dtype, count=size[0] * size[1], offset=start)
    return flat.reshape(size, order="F" if fortran else "C"), digest


def buffer_for(size: tuple[int, int]) -> bytearray:
    """Room for the largest acceptable file of an (H, W) map: float64 and its header."""
    return bytearray(HEADER_BYTES + size[0] * size[1] * 8)


def value_problems(prediction: NDArray[np.floating[Any]], target_max_mm: float) -> list[str]:
    """What is wrong with the values of a prediction (H, W) whose target reaches ``target_max_mm``; usually nothing."""
    low, high = float(prediction.min()), float(prediction.max())
    problems = []
    if not np.isfinite([low, high]).all():  # min and max carry NaN through
        nans, infinities = int(np.isnan(prediction).sum()), int(np.isinf(prediction).sum())
        counts = [f"{n} {word}" for n, word in ((nans, "NaN"), (infinities, "infinite")) if n]
        problems.append(f"holds {' and '.join(counts)} of {prediction.size} values; write 0 where nothing was measured")
        with np.errstate(invalid="ignore"):
            finite = prediction[np.isfinite(prediction)]
        if not finite.size:
            return problems
        low, high = float(finite.min()), float(finite.max())
    if max(high, -low) > protocol.LARGEST_MM:
        problems.append(
            f"holds values up to {max(high, -low):.3g} mm in magnitude; the limit is {protocol.LARGEST_MM:g}"
        )
    if 0 < high < protocol.METRES_BELOW and target_max_mm > protocol.MILLIMETRES_ABOVE:
        problems.append(
            f"looks like metres or normalised depth: its largest value is {high:.4g}, the target reaches "
            f"{target_max_mm:.0f} mm; convert it to mm"
        )
    return problems


def _fill(stream: Any, view: memoryview) -> int:
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])
        if not count:
            break
        done += count
    return done


def _check_header(head: bytes, size: tuple[int, int]) -> tuple[np.dtype[Any], bool, int]:
    """Dtype, Fortran order and data offset of a .npy file that begins with ``head``."""
    if head[:4] == b"PK\x03\x04":
        raise PredictionError("is a zip archive (np.savez?); expected a .npy file, write it with np.save")
    stream = BytesIO(head)
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise PredictionError(f"has .npy format version {version}; expected 1.0 or 2.0, write it with np.save")
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, fortran, dtype = read(stream)
    except (
        ValueError,
        TypeError,
        SyntaxError,
        TokenError,
        KeyError,
        RecursionError,
        MemoryError,
        OverflowError,
    ) as error:
        if isinstance(error, PredictionError):
            raise
        raise PredictionError("is no .npy file, or its header is damaged; write it with np.save") from None
    if dtype.hasobject:
        raise PredictionError("holds pickled Python objects, which are never opened; save a float32 array")
    if dtype.kind != "f" or dtype.itemsize not in (2, 4, 8):
        raise PredictionError(f"expected float16, float32 or float64, got {printable(str(dtype), 80)}; save as float32")
    if tuple(shape) != tuple(size):
        raise PredictionError(f"expected shape {tuple(size)} (H, W), got {_shape_text(shape)}")
    return dtype, fortran, stream.tell()


def _shape_text(shape: tuple[int, ...]) -> str:
    # A hostile header may hold an integer too long for Python to print at all.
    return "(" + ", ".join(str(n) if abs(n) < 10**18 else "more than 10^18" for n in shape) + ")"
