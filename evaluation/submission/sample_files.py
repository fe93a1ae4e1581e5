"""Predictions with one file for a sample, .npy, .npz or .png: checked before memory is taken, never unpickled."""

import hashlib
import io
import struct
import zipfile
import zlib
from contextlib import suppress
from pathlib import Path
from threading import Lock, local
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from fpp_ml_bench.errors import LayoutError, PredictionError
from fpp_ml_bench.files import fill, opened, printable, read_bounded
from fpp_ml_bench.loaders.published import png_chunks

HEADER_BYTES = 16384
# NumPy parses a header through `ast`, whose recursion counter all threads share (CPython 3.11): two at once may fail.
_PARSING = Lock()
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_NO_HEADER = (ValueError, TypeError, SyntaxError, TokenError, KeyError, RecursionError, MemoryError, OverflowError)
_Layout = tuple[np.dtype[Any], bool, int]
"""Type, whether in Fortran order, and the offset of the first value."""


def read_npy(path: Path, size: tuple[int, int], memory: local) -> tuple[NDArray[Any], str]:
    """The array in ``path`` and the SHA-256 of the whole file: the bytes hashed are the bytes scored. ``size`` is the
    expected (H, W). The array is a view of a buffer that the thread keeps in ``memory``, valid until its next read.
    Raises PredictionError, without the file's name, for anything but a plain .npy of that size and a real float
    dtype."""
    if not hasattr(memory, "buffer"):
        memory.buffer = bytearray(_largest_npy(size))
    view = memoryview(memory.buffer)
    with opened(path) as (stream, length):
        filled = fill(stream, view[: min(HEADER_BYTES, length)])
        layout = _layout(bytes(view[:filled]), length, size)
        filled += fill(stream, view[filled:length])
        if filled != length:
            raise PredictionError(f"ended early: expected {length} bytes, got {filled}; write it again")
    return _array_in(memory.buffer, size, layout), hashlib.sha256(view[:length]).hexdigest()


def _largest_npy(size: tuple[int, int]) -> int:
    """Bytes of the largest accepted .npy of an (H, W) map: float64 and its header."""
    return HEADER_BYTES + size[0] * size[1] * 8


def declared_size(path: Path) -> tuple[int, int] | None:
    """The size (H, W) that a .npy, .npz or .png file states; None where it states none. Nothing else is checked."""
    with suppress(OSError, zipfile.BadZipFile, IndexError, struct.error, *_NO_HEADER):
        with opened(path) as (stream, length):
            head = stream.read(min(HEADER_BYTES, length))
        if head.startswith(_PNG_SIGNATURE):
            width, height = struct.unpack(">II", head[16:24])
            return height, width
        if head.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive, archive.open(archive.infolist()[0]) as member:
                head = member.read(HEADER_BYTES)
        content = io.BytesIO(head)
        with _PARSING:
            shape, _, _ = _HEADERS[npy.read_magic(content)](content)
        return (int(shape[0]), int(shape[1])) if len(shape) == 2 else None
    return None


def parse_npy(content: bytes, size: tuple[int, int]) -> NDArray[Any]:
    """The array in the bytes of a .npy file; PredictionError as `read_npy`."""
    return _array_in(content, size, _layout(content[:HEADER_BYTES], len(content), size))


def _array_in(content: bytes | bytearray, size: tuple[int, int], layout: _Layout) -> NDArray[Any]:
    """The (H, W) array in a whole file's bytes, a view."""
    dtype, fortran, start = layout
    flat = np.frombuffer(content, dtype=dtype, count=size[0] * size[1], offset=start)
    return flat.reshape(size, order="F" if fortran else "C")


def _layout(head: bytes, length: int, size: tuple[int, int]) -> _Layout:
    """Of a .npy file of ``length`` bytes that begins with ``head``; refuses what is not a map of ``size``."""
    if head[:4] == b"PK\x03\x04":
        raise PredictionError(
            "is a zip archive (np.savez?) under the name .npy; write it with np.save, or name it .npz"
        )
    stream = io.BytesIO(head)
    try:
        version = npy.read_magic(stream)
        if (read := _HEADERS.get(version)) is not None:
            with _PARSING:
                shape, fortran, dtype = read(stream)
    except _NO_HEADER:
        raise PredictionError("is no .npy file, or its header is damaged; write it with np.save") from None
    if read is None:
        raise PredictionError(f"has .npy format version {version}; expected 1.0 or 2.0, write it with np.save")
    _check_array(dtype, shape, size)
    start = stream.tell()
    expected = start + size[0] * size[1] * dtype.itemsize
    if length != expected:
        problem = "is truncated" if length < expected else "has foreign bytes after the array"
        raise PredictionError(f"{problem}: expected {expected} bytes, got {length}; write it again")
    return dtype, fortran, start


def _check_array(dtype: np.dtype[Any], shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse anything but a real float map of ``size``: objects, complex numbers, whole numbers, other shapes."""
    if dtype.hasobject:
        raise PredictionError("holds pickled Python objects, which are never opened; save a float32 array")
    if dtype.kind != "f" or dtype.itemsize not in (2, 4, 8):
        wrap = ": whole numbers round depth, and wrap around where it does not fit; save as float32"
        why = {"c": " (complex); save its real depth", "i": wrap, "u": wrap}.get(dtype.kind, "; save as float32")
        raise PredictionError(f"expected float16, float32 or float64, got {printable(str(dtype), 80)}{why}")
    if tuple(shape) != tuple(size):
        raise PredictionError(f"expected shape {tuple(size)} (H, W), got {_shape_text(shape)}; predict at that size")


def _shape_text(shape: tuple[int, ...]) -> str:
    # A hostile header may hold an integer too long for Python to print at all.
    return "(" + ", ".join(str(n) if abs(n) < 10**18 else "more than 10^18" for n in shape) + ")"


_ARCHIVE_BYTES = 65536
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1


def read_npz(path: Path, size: tuple[int, int]) -> tuple[NDArray[Any], str]:
    """The array (H, W) of the archive and the SHA-256 of the file; PredictionError as `read_npy`. The array may have
    any name. The size that the archive declares is checked before a byte is unpacked, and unpacking stops at the limit
    even where the archive declares a wrong size."""
    largest = _largest_npy(size)
    content = read_bounded(path, largest + _ARCHIVE_BYTES)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            array = parse_npy(_unpacked(archive, largest), size)
    except PredictionError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, ValueError, RuntimeError) as error:
        reason = printable(str(error), 80)
        raise PredictionError(f"is no .npz archive, or damaged ({reason}); write it with np.savez") from None
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
        advice = "write it with np.savez or np.savez_compressed"
        raise PredictionError(f"{name} is encrypted or packed in an unusual way; {advice}")
    if member.file_size > largest:
        expected = f"expected at most {largest} for a map of this size; save one float32 map"
        raise PredictionError(f"{name} would unpack to {member.file_size} bytes, {expected}")
    with archive.open(member) as stream:
        content = stream.read(largest + 1)
    if len(content) > largest:
        raise PredictionError(f"{name} unpacks to more than the {member.file_size} bytes it says; write it again")
    return content


PNG_LEVELS = 65535
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_SPARE_BYTES = 1 << 20
_PNG_ADVICE = "write 16-bit grey levels (cv2.imwrite of a uint16 array)"


def read_png(path: Path, size: tuple[int, int], mm_per_level: float | None) -> tuple[NDArray[Any], str]:
    """Depth (H, W) float64 in mm and the SHA-256 of the file; PredictionError as `read_npy`. The header, every checksum
    and the unpacked length are checked before the image is decoded. A level of 65535 is refused: there a depth that
    does not fit was cut off."""
    if mm_per_level is None:
        raise PredictionError("has no scale: give png_mm_per_level, the mm of one level, in submission.yaml")
    content = read_bounded(path, size[0] * size[1] * 2 + _PNG_SPARE_BYTES)
    if problem := _png_problem(content, size):
        raise PredictionError(problem)
    from PIL import Image  # needed for this form only

    try:
        levels = np.asarray(Image.open(io.BytesIO(content), formats=["PNG"])).astype(np.uint16)
    except (OSError, SyntaxError, ValueError):
        raise PredictionError(f"can't be decoded as a 16-bit grey PNG; {_PNG_ADVICE}") from None
    if levels.max() == PNG_LEVELS:
        cut_off = f"where depth above {PNG_LEVELS * mm_per_level:g} mm is cut off"
        raise PredictionError(f"reaches level {PNG_LEVELS}, {cut_off}; use a larger png_mm_per_level")
    return levels.astype(np.float64) * mm_per_level, hashlib.sha256(content).hexdigest()


def _png_problem(content: bytes, size: tuple[int, int]) -> str | None:
    """What Pillow would not refuse: another kind of PNG, wrong checksums, too many pixels, foreign bytes."""
    if not content.startswith(_PNG_SIGNATURE) or content[12:16] != b"IHDR" or len(content) < 33:
        return f"is no PNG file; {_PNG_ADVICE}"
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    if (height, width) != size:
        return f"expected shape {size} (H, W), got ({height}, {width}); predict at that size"
    if bits != 16 or colour != 0 or interlaced:
        kind = f"{bits} bits per channel, colour type {colour}, interlacing {interlaced}"
        return f"has {kind}; expected 16, 0 and 0: {_PNG_ADVICE}"
    try:
        chunks = list(png_chunks(content))
    except LayoutError as error:
        return f"{error}; {_PNG_ADVICE}"
    kinds = [kind for kind, _ in chunks]
    if kinds[-1:] != [b"IEND"] or kinds.count(b"IHDR") != 1 or b"IDAT" not in kinds or b"tRNS" in kinds:
        return f"is cut off or damaged; {_PNG_ADVICE}"
    if len(_PNG_SIGNATURE) + sum(12 + len(data) for _, data in chunks) != len(content):
        return f"has foreign bytes after the image; {_PNG_ADVICE}"
    packed = b"".join(data for kind, data in chunks if kind == b"IDAT")
    expected = height * (2 * width + 1)
    try:
        unpacked = len(zlib.decompressobj().decompress(packed, expected + 1))
    except zlib.error:
        return f"is damaged: its pixels can't be unpacked; {_PNG_ADVICE}"
    if unpacked != expected:
        more = "more than " if unpacked > expected else ""
        return f"unpacks to {more}{min(unpacked, expected)} bytes, expected {expected}; {_PNG_ADVICE}"
    return None
