"""Predictions as ``.npz``: a zip archive with exactly one array, and no more is unpacked than such a map can need."""

import hashlib
import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.open_file import read_bounded
from fpp_ml_bench.evaluation.read_npy import largest_npy, parse_npy
from fpp_ml_bench.evaluation.text import printable

_ARCHIVE_BYTES = 65536
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1


def read_npz(path: Path, size: tuple[int, int]) -> tuple[NDArray[Any], str]:
    """The array (H, W) of the archive and the SHA-256 of the file; PredictionError as `read_prediction`.

    The array may have any name. The size that the archive declares is checked before a byte is unpacked, and unpacking
    stops at the limit even where the archive declares a wrong size.
    """
    largest = largest_npy(size)
    content = read_bounded(path, largest + _ARCHIVE_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            array = parse_npy(_unpacked(archive, largest), size)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, RuntimeError) as error:
        if isinstance(error, PredictionError):
            raise
        raise PredictionError(
            f"is no .npz archive, or damaged ({printable(str(error), 80)}); write it with np.savez"
        ) from None
    return array, hashlib.sha256(content).hexdigest()


def _unpacked(archive: zipfile.ZipFile, largest: int) -> bytes:
    members = archive.infolist()
    if len(members) != 1:
        names = printable(", ".join(member.filename for member in members[:5]), 120)
        raise PredictionError(f"holds {len(members)} arrays ({names}), expected one; save the depth alone")
    member = members[0]
    name = printable(member.filename, 80)
    if member.filename.startswith(("/", "\\")) or ".." in member.filename or "\\" in member.filename:
        raise PredictionError(f"holds the path {name}, which leads out of the archive; write it with np.savez")
    if not member.filename.endswith(".npy"):
        raise PredictionError(f"holds {name}, expected one .npy array; write it with np.savez")
    if member.flag_bits & _ENCRYPTED or member.compress_type not in _METHODS:
        raise PredictionError(
            f"{name} is encrypted or packed in an unusual way; write it with np.savez or np.savez_compressed"
        )
    if member.file_size > largest:
        raise PredictionError(
            f"{name} would unpack to {member.file_size} bytes, expected at most {largest} for a map of this size; "
            "save one float32 map"
        )
    with archive.open(member) as stream:
        content = stream.read(largest + 1)
    if len(content) > largest:
        raise PredictionError(f"{name} unpacks to more than the {member.file_size} bytes it says; write it again")
    return content
