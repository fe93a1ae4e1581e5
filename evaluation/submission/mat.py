"""The variable ``depth`` of a MATLAB file (v5, compressed or not, and v7.3), by SciPy and h5py; see `isolated`."""

import io
import math

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable

VARIABLE = "depth"
_V5_MARKS = (b"\x00\x01IM", b"\x01\x00MI")
_HDF5_AT, _HDF5_SIGNATURE = 512, b"\x89HDF\r\n\x1a\n"
_CLASSES = {"double": "f8", "single": "f4", **{f"{u}int{n}": f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)}}


def read(content: bytes, largest: int) -> bytes:
    """The matrix as in MATLAB (rows, columns), as the bytes of a .npy file; PredictionError for any other file.

    No matrix of more than ``largest`` bytes is unpacked, and HDF5 links and storage in other files are refused.
    """
    try:
        if content.startswith(b"MATLAB") and content[_HDF5_AT:].startswith(_HDF5_SIGNATURE):
            matrix = _read_hdf5(content, largest)
        elif content[124:128] in _V5_MARKS:
            matrix = _read_v5(content, largest)
        else:
            raise PredictionError("expected a MATLAB v5 or v7.3 file; the header is neither")
        answer = io.BytesIO()
        np.save(answer, matrix, allow_pickle=False)
    except PredictionError as error:
        problem = printable(str(error), 300)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file may raise anything
        problem = f"can't be read, is cut off or damaged ({printable(str(error), 200)})"
    else:
        return answer.getvalue()
    raise PredictionError(f"{problem}; write it with save(file, 'depth') from a real single or double matrix")


def _read_v5(content: bytes, largest: int) -> NDArray:
    variables = {name: (shape, kind) for name, shape, kind in whosmat(io.BytesIO(content))}
    if VARIABLE not in variables:
        raise PredictionError(f"expected the variable {VARIABLE}, got {', '.join(variables) or 'none'}")
    shape, kind = variables[VARIABLE]
    if kind not in _CLASSES:
        raise PredictionError(f"{VARIABLE}: expected a real numeric matrix, got MATLAB class {kind}")
    _check_size(shape, math.prod(shape) * 8, largest)
    matrix = loadmat(io.BytesIO(content), variable_names=[VARIABLE])[VARIABLE]
    if matrix.dtype.kind not in "iuf":
        raise PredictionError(f"{VARIABLE}: expected a real numeric matrix, got MATLAB class {kind}, complex")
    # MATLAB stores whole numbers in the smallest type that fits; the matrix class gives their true type.
    return np.ascontiguousarray(matrix, dtype=_CLASSES[kind])


def _read_hdf5(content: bytes, largest: int) -> NDArray:
    with h5py.File(io.BytesIO(content), "r") as file:
        if VARIABLE not in file:
            names = [name for name in file if not name.startswith("#")]
            raise PredictionError(f"expected the variable {VARIABLE}, got {', '.join(names) or 'none'}")
        if not isinstance(file.get(VARIABLE, getlink=True), h5py.HardLink):
            raise PredictionError(f"{VARIABLE} is a link; expected the matrix itself in this file")
        matrix = file[VARIABLE]
        if not isinstance(matrix, h5py.Dataset) or matrix.dtype.kind not in "iuf" or matrix.ndim != 2:
            raise PredictionError(f"{VARIABLE}: expected a real numeric matrix (rows, columns)")
        if matrix.is_virtual or matrix.external:
            raise PredictionError(f"{VARIABLE} is stored in other files; expected the matrix itself in this file")
        # HDF5 unpacks whole chunks, and in a damaged file a chunk may be far larger than the matrix.
        _check_size(matrix.shape, max(matrix.size, math.prod(matrix.chunks or (1,))) * matrix.dtype.itemsize, largest)
        # MATLAB is column-major, HDF5 row-major: the file holds the transpose.
        return np.ascontiguousarray(np.asarray(matrix).T)


def _check_size(shape: tuple[int, ...], unpacked: int, largest: int) -> None:
    if unpacked > largest:
        raise PredictionError(f"{VARIABLE}: {shape} is too large for a depth map")
