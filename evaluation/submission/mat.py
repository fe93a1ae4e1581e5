"""Predictions as MATLAB ``.mat`` (v5, compressed or not, and v7.3), one variable ``depth``."""

import hashlib
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from fpp_ml_bench.errors import LayoutError, PredictionError
from fpp_ml_bench.evaluation.submission.npy import check_array
from fpp_ml_bench.files import printable, read_bounded
from fpp_ml_bench.loaders.published import parse_matrix

VARIABLE = "depth"
_FILE_BYTES = 1 << 20


def read_mat(path: Path, size: tuple[int, int]) -> tuple[NDArray[Any], str]:
    """The matrix ``depth`` (H, W) and the SHA-256 of the file; PredictionError as `read_prediction`.

    No more is unpacked than a float64 map of ``size`` and a header need, and HDF5 links and storage in other files are
    refused.
    """
    largest = size[0] * size[1] * 8 + _FILE_BYTES
    content = read_bounded(path, largest)
    try:
        matrix = parse_matrix(content, VARIABLE, largest)
    except LayoutError as error:
        raise PredictionError(
            f"{printable(str(error), 300)}; write it with save(file, 'depth') from a real single or double matrix"
        ) from None
    check_array(matrix.dtype, matrix.shape, size)
    return matrix, hashlib.sha256(content).hexdigest()
