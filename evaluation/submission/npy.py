"""Predictions as ``.npy``: the header is checked before memory is taken, and nothing is ever unpickled."""

import hashlib
import io
import zipfile
import zlib
from io import BytesIO
from pathlib import Path
from threading import Lock
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import fill, opened, printable, read_bounded

HEADER_BYTES = 16384
# NumPy parses a header through `ast`, whose recursion counter all threads share (CPython 3.11): two at once may fail.
_PARSING = Lock()


def read_prediction(path: Path, size: tuple[int, int], buffer: bytearray | None = None) -> tuple[NDArray[Any], str]:
    """The array in ``path`` and the SHA-256 of the whole file: the bytes hashed are the bytes scored.

    ``size`` is the expected (H, W). ``buffer`` (see `buffer_for`) is reused when given: the array is a view of it and
    valid until the next read. Raises PredictionError, without the file's name, for anything but a plain .npy of that
    size and a real float dtype.
    """
    buffer = buffer_for(size) if buffer is None else buffer
    view = memoryview(buffer)
    with opened(path) as (stream, length):
        filled = fill(stream, view[: min(HEADER_BYTES, length)])
        dtype, fortran, start = check_header(bytes(view[:filled]), size)
        expected = start + size[0] * size[1] * dtype.itemsize
        check_length(length, expected)
        filled += fill(stream, view[filled:expected])
        if filled != expected:
            raise PredictionError(f"ended early: expected {expected} bytes, got {filled}; write it again")
    digest = hashlib.sha256(view[:expected]).hexdigest()
    return array_in(buffer, size, dtype, fortran, start), digest


def buffer_for(size: tuple[int, int]) -> bytearray:
    """A buffer for the largest accepted file of an (H, W) map: float64 and its header."""
    return bytearray(largest_npy(size))


def largest_npy(size: tuple[int, int]) -> int:
    """Bytes of the largest accepted .npy of an (H, W) map."""
    return HEADER_BYTES + size[0] * size[1] * 8


def parse_npy(content: bytes, size: tuple[int, int]) -> NDArray[Any]:
    """The array in the bytes of a .npy file; PredictionError as `read_prediction`."""
    dtype, fortran, start = check_header(content[:HEADER_BYTES], size)
    check_length(len(content), start + size[0] * size[1] * dtype.itemsize)
    return array_in(content, size, dtype, fortran, start)


def array_in(
    content: bytes | bytearray, size: tuple[int, int], dtype: np.dtype[Any], fortran: bool, start: int
) -> NDArray[Any]:
    """The (H, W) array that begins at byte ``start``, a view."""
    flat = np.frombuffer(content, dtype=dtype, count=size[0] * size[1], offset=start)
    return flat.reshape(size, order="F" if fortran else "C")


def check_length(length: int, expected: int) -> None:
    """Refuse a file that is shorter or longer than its header says."""
    if length != expected:
        problem = "is truncated" if length < expected else "has foreign bytes after the array"
        raise PredictionError(f"{problem}: expected {expected} bytes, got {length}; write it again")


def check_header(head: bytes, size: tuple[int, int]) -> tuple[np.dtype[Any], bool, int]:
    """Dtype, Fortran order and data offset of a .npy file that begins with ``head``."""
    if head[:4] == b"PK\x03\x04":
        raise PredictionError(
            "is a zip archive (np.savez?) under the name .npy; write it with np.save, or name it .npz"
        )
    stream = BytesIO(head)
    try:
        version = npy.read_magic(stream)
        if version not in ((1, 0), (2, 0)):
            raise PredictionError(f"has .npy format version {version}; expected 1.0 or 2.0, write it with np.save")
        read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        with _PARSING:
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
    check_array(dtype, shape, size)
    return dtype, fortran, stream.tell()


def check_array(dtype: np.dtype[Any], shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse anything but a real float map of ``size``: objects, complex numbers, whole numbers, other shapes."""
    if dtype.hasobject:
        raise PredictionError("holds pickled Python objects, which are never opened; save a float32 array")
    if dtype.kind == "c":
        raise PredictionError(f"expected float16, float32 or float64, got {dtype} (complex); save its real depth")
    if dtype.kind in "iu":
        raise PredictionError(
            f"expected float16, float32 or float64, got {dtype}: whole numbers round depth, and wrap around where it "
            "does not fit; save as float32"
        )
    if dtype.kind != "f" or dtype.itemsize not in (2, 4, 8):
        raise PredictionError(f"expected float16, float32 or float64, got {printable(str(dtype), 80)}; save as float32")
    if tuple(shape) != tuple(size):
        raise PredictionError(f"expected shape {tuple(size)} (H, W), got {_shape_text(shape)}; predict at that size")


def _shape_text(shape: tuple[int, ...]) -> str:
    # A hostile header may hold an integer too long for Python to print at all.
    return "(" + ", ".join(str(n) if abs(n) < 10**18 else "more than 10^18" for n in shape) + ")"


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
