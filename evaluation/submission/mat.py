"""The variable ``depth`` of a MATLAB file, read in a process of its own: HDF5 trusts the lengths in a file."""

import io
from contextlib import suppress

import numpy as np

from fpp_ml_bench.errors import LayoutError, PredictionError
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.published import parse_matrix

with suppress(ImportError):
    import h5py as h5py  # for v7.3: once the limit of memory is set, it can't be loaded any more


def read(content: bytes, largest: int) -> bytes:
    """The matrix as in MATLAB (rows, columns), as the bytes of a .npy file; PredictionError for any other file."""
    try:
        answer = io.BytesIO()
        np.save(answer, parse_matrix(content, "depth", largest), allow_pickle=False)
        return answer.getvalue()
    except LayoutError as error:
        problem = printable(str(error), 300)
    except MemoryError:
        raise
    except Exception as error:  # a damaged file may raise anything
        problem = f"can't be read, is cut off or damaged ({printable(str(error), 200)})"
    raise PredictionError(f"{problem}; write it with save(file, 'depth') from a real single or double matrix")
