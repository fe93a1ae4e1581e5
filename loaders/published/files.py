"""Files of the published layout, read strictly: 8-bit grey PNG, and MATLAB files with one real matrix (v5, v7.3).

OpenCV decodes a truncated PNG to a partly empty image without an error, so all chunks and checksums are checked first.
MATLAB v5 is parsed here: ``scipy.io.loadmat`` trusts the lengths in a file, and some damaged uncompressed files end the
whole process (segmentation fault, SciPy 1.17). Files are written by SciPy, so its ``loadmat`` reads them.
"""

import io
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import LayoutError, PredictionError
from fpp_ml_bench.files import file_content, opened

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB = 0, 2
_KINDS = {_GREY: "grey", _RGB: "RGB", 3: "palette", 4: "grey + alpha", 6: "RGB + alpha"}
_HEADER_BYTES = 33
COMPRESSION_LEVEL = 1  # twice as fast as 3 on noisy fringes, and 6% larger (measured)


def read_png_size(path: Path) -> tuple[int, int]:
    """Size (H, W) of a PNG that is 8-bit grey or RGB; raises `LayoutError` naming the file for any other."""
    try:
        with opened(path, links=True) as (stream, _):
            return _header(stream.read(_HEADER_BYTES), path)[0]
    except PredictionError as error:
        raise LayoutError(f"{path}: {error}") from error


def _header(start: bytes, path: Path) -> tuple[tuple[int, int], int]:
    """Size (H, W) and colour type."""
    if len(start) < _HEADER_BYTES or not start.startswith(_SIGNATURE) or start[12:16] != b"IHDR":
        raise LayoutError(f"{path}: expected a PNG file, got other content")
    width, height, bits, colour = struct.unpack(">IIBB", start[16:26])
    if bits != 8:
        raise LayoutError(f"{path}: expected an 8-bit PNG, got {bits} bits per channel; convert it to 8 bits")
    if colour not in (_GREY, _RGB):
        raise LayoutError(f"{path}: expected a grey PNG, or RGB with equal channels, got {_KINDS.get(colour, colour)}")
    return (height, width), colour


def read_grey_png(path: Path) -> NDArray[np.uint8]:
    """Grey levels of an 8-bit PNG, uint8 (H, W); RGB is accepted where its three channels are equal. Raises
    `LayoutError` naming the file when it is not a PNG, is cut off or damaged, has another bit depth or colour type, or
    its channels differ."""
    content = file_content(path, _LARGEST_BYTES, LayoutError, "write it again")
    size, colour = _header(content, path)
    try:
        kinds = [kind for kind, _ in png_chunks(content)]
    except LayoutError as error:
        raise LayoutError(f"{path}: the PNG {error}") from error
    if b"tRNS" in kinds:
        raise LayoutError(f"{path}: has transparent colours; expected plain grey levels")
    if kinds[-1:] != [b"IEND"] or b"IDAT" not in kinds:
        raise LayoutError(f"{path}: the PNG is cut off or damaged")
    import cv2  # takes longer to import than a .mat file to read

    image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    channels = (3,) if colour == _RGB else ()
    if image is None or image.dtype != np.uint8 or image.shape != (*size, *channels):
        raise LayoutError(f"{path}: can't be decoded as an 8-bit {_KINDS[colour]} PNG")
    if not channels:
        return np.asarray(image, dtype=np.uint8)
    blue, green, red = image[..., 0], image[..., 1], image[..., 2]
    if not (np.array_equal(blue, green) and np.array_equal(green, red)):
        raise LayoutError(f"{path}: an RGB image whose channels differ; expected grey levels")
    return np.ascontiguousarray(blue)


def png_chunks(content: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and data of a PNG's chunks up to its end, the signature not looked at, each with a right checksum. Raises
    `LayoutError` that says, without a subject, what is wrong: "is cut off"."""
    view, position = memoryview(content), len(_SIGNATURE)
    kind = b""
    while position < len(view) and kind != b"IEND":
        length = struct.unpack(">I", view[position : position + 4])[0] if len(view) - position >= 12 else len(view)
        stop = position + 12 + length
        if stop > len(view):
            raise LayoutError("is cut off")
        if zlib.crc32(view[position + 4 : stop - 4]) != struct.unpack(">I", view[stop - 4 : stop])[0]:
            raise LayoutError("is damaged, a checksum does not match")
        kind = bytes(view[position + 4 : position + 8])
        yield kind, view[position + 8 : stop - 4]
        position = stop


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """A grey image uint8 (H, W) as PNG."""
    import cv2

    done, content = cv2.imencode(".png", np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION_LEVEL])
    if not done:
        raise LayoutError(f"OpenCV could not encode an image of shape {image.shape} as PNG")
    return content.tobytes()


_V5_HEADER_BYTES = 128
_COMPRESSED, _MATRIX = 15, 14
_HEADER_PARTS = (6,), (5, 6), (1, 16)
"""Element types of a matrix's flags, dimensions and name."""
_HDF5_AT, _HDF5_SIGNATURE = 512, b"\x89HDF\r\n\x1a\n"
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_CLASSES = (
    "unknown",
    "cell",
    "struct",
    "object",
    "char",
    "sparse",
    "double",
    "single",
    "int8",
    "uint8",
    "int16",
    "uint16",
    "int32",
    "uint32",
    "int64",
    "uint64",
)
_FIRST_NUMERIC = 6
_COMPLEX = 0x0800
_LARGEST_BYTES = 1 << 30
_WRITTEN_BY = b"MATLAB 5.0 MAT-file, written by fpp-ml-bench"


def read_matrix(path: Path, variable: str) -> NDArray:
    """Variable ``variable`` of a v5 or v7.3 file as in MATLAB: a real numeric matrix (rows, columns) of any dtype.
    Raises `LayoutError` naming the file when it can't be read, lacks the variable (the message lists its variables), or
    the variable is not a real numeric matrix."""
    content = file_content(path, _LARGEST_BYTES, LayoutError, "write it again")
    try:
        return parse_matrix(content, variable)
    except LayoutError as error:
        raise LayoutError(f"{path}: {error}") from error


def parse_matrix(content: bytes, variable: str, largest_bytes: int = _LARGEST_BYTES) -> NDArray:
    """`read_matrix` on the content of a file; its `LayoutError` names no file. No variable is unpacked to more than
    ``largest_bytes``, and other files that ``content`` refers to are not read."""
    if content.startswith(b"MATLAB") and content[_HDF5_AT:].startswith(_HDF5_SIGNATURE):
        return _read_hdf5(content, variable, largest_bytes)
    try:
        return _read_v5(content, variable, largest_bytes)
    except (zlib.error, struct.error) as error:
        raise LayoutError(str(error)) from error


def read_scalar(path: Path, variable: str) -> float:
    """A scalar that MATLAB stores as a 1 x 1 matrix. Raises `LayoutError` as `read_matrix`, or for another shape."""
    matrix = read_matrix(path, variable)
    if matrix.shape != (1, 1) or not np.isfinite(matrix).all():
        shape = " x ".join(map(str, matrix.shape))
        raise LayoutError(f"{path}: {variable}: expected a finite number stored as 1 x 1, got {shape} {matrix.dtype}")
    return float(matrix[0, 0])


def matrix_bytes(values: Mapping[str, NDArray | float]) -> bytes:
    """A compressed v5 file holding ``values``; equal values give equal bytes (the header carries no date)."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, {name: np.atleast_2d(value) for name, value in values.items()}, do_compression=True)
    return _WRITTEN_BY.ljust(116) + buffer.getvalue()[116:]


def _read_v5(content: bytes, variable: str, largest_bytes: int) -> NDArray:
    if len(content) < _V5_HEADER_BYTES:
        raise LayoutError(f"expected a MATLAB v5 or v7.3 file, got {len(content)} bytes; the file is cut off")
    order = {b"IM": "<", b"MI": ">"}.get(content[126:128])
    if order is None or struct.unpack(order + "H", content[124:126])[0] != 0x0100:
        raise LayoutError("expected a MATLAB v5 or v7.3 file; the header is neither")
    names = []
    rest = memoryview(content)[_V5_HEADER_BYTES:]
    while len(rest):
        kind, data, rest = _element(rest, order, padded=False)
        if kind == _COMPRESSED:
            unpacker = zlib.decompressobj()
            unpacked = memoryview(unpacker.decompress(data, largest_bytes))
            if unpacker.unconsumed_tail:
                _, shape, name, _ = _matrix_header(unpacked[8:], order)
                if name == variable:
                    raise LayoutError(f"{variable}: {shape} is too large for a depth map")
                names.append(name)
                continue
            if not unpacker.eof:
                raise LayoutError("a compressed variable is cut off or too large; the file is damaged")
            kind, data, more = _element(unpacked, order)
            if len(more):
                raise LayoutError("a compressed variable holds more than its matrix; the file is damaged")
        if kind != _MATRIX:
            raise LayoutError(f"expected a matrix, got element type {kind}; the file is damaged")
        flags, shape, name, data = _matrix_header(data, order)
        if name == variable:
            return _real_matrix(variable, flags, shape, order, data)
        names.append(name or "(unnamed)")
    raise LayoutError(f"expected the variable {variable}, got {', '.join(names) or 'none'}")


def _matrix_header(content: memoryview, order: str) -> tuple[int, tuple[int, ...], str, memoryview]:
    """Flags, shape and name of a matrix, and the content after them."""
    parts = []
    for expected in _HEADER_PARTS:
        kind, part, content = _element(content, order)
        if kind not in expected:
            raise LayoutError(f"a matrix header has element type {kind} for {expected[0]}; the file is damaged")
        parts.append(part)
    flags, dimensions, name = parts
    if len(flags) != 8 or len(dimensions) % 4:
        raise LayoutError("a matrix header has a wrong length; the file is damaged")
    shape = struct.unpack(f"{order}{len(dimensions) // 4}i", dimensions)
    if any(length < 0 for length in shape):
        raise LayoutError(f"a matrix has the shape {shape}; the file is damaged")
    return struct.unpack(order + "II", flags)[0], shape, bytes(name).decode("latin-1"), content


def _real_matrix(name: str, flags: int, shape: tuple[int, ...], order: str, content: memoryview) -> NDArray:
    number = flags & 0xFF
    matrix_class = _CLASSES[number if number < len(_CLASSES) else 0]
    if number < _FIRST_NUMERIC or matrix_class == _CLASSES[0] or flags & _COMPLEX:
        note = ", complex" if flags & _COMPLEX else ""
        raise LayoutError(f"{name}: expected a real numeric matrix, got MATLAB class {matrix_class}{note}")
    if len(shape) != 2:
        raise LayoutError(f"{name}: expected a matrix (rows, columns), got shape {shape}")
    kind, data, _ = _element(content, order)
    if kind not in _STORED:
        raise LayoutError(f"{name}: unknown data type {kind}; the file is damaged")
    stored = np.dtype(order + _STORED[kind])
    if len(data) != math.prod(shape) * stored.itemsize:
        raise LayoutError(f"{name}: {len(data)} bytes do not make {shape}; the file is damaged")
    # MATLAB stores whole numbers in the smallest type that fits; the matrix class gives their true type.
    values = np.frombuffer(data, stored).reshape(shape, order="F")
    return np.ascontiguousarray(values, dtype=np.dtype(matrix_class))


def _element(content: memoryview, order: str, padded: bool = True) -> tuple[int, memoryview, memoryview]:
    """First data element: its type, its bytes, and the content after it. Elements in a matrix are padded to 8 bytes."""
    if len(content) < 8:
        raise LayoutError("a data element is cut off; the file is damaged")
    kind, size = struct.unpack(order + "II", content[:8])
    if kind >> 16:  # up to four bytes, packed into the tag itself
        kind, size = kind & 0xFFFF, kind >> 16
        if size > 4:
            raise LayoutError("a small data element is too long; the file is damaged")
        return kind, content[4 : 4 + size], content[8:]
    if size > len(content) - 8:
        raise LayoutError(f"a data element of {size} bytes has only {len(content) - 8}; the file is cut off or damaged")
    stop = 8 + (size + 7 & ~7 if padded else size)
    return kind, content[8 : 8 + size], content[stop:]


def _read_hdf5(content: bytes, variable: str, largest_bytes: int) -> NDArray:
    import h5py

    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            if variable not in file:
                names = [name for name in file if not name.startswith("#")]
                raise LayoutError(f"expected the variable {variable}, got {', '.join(names) or 'none'}")
            if not isinstance(file.get(variable, getlink=True), h5py.HardLink):
                raise LayoutError(f"{variable} is a link; expected the matrix itself in this file")
            matrix = file[variable]
            if not isinstance(matrix, h5py.Dataset) or matrix.dtype.kind not in "iuf" or matrix.ndim != 2:
                raise LayoutError(f"{variable}: expected a real numeric matrix (rows, columns)")
            if matrix.is_virtual or matrix.external:
                raise LayoutError(f"{variable} is stored in other files; expected the matrix itself in this file")
            # HDF5 unpacks whole chunks, and in a damaged file a chunk may be far larger than the matrix.
            unpacked = max(matrix.size, math.prod(matrix.chunks or (1,))) * matrix.dtype.itemsize
            if unpacked > largest_bytes:
                raise LayoutError(f"{variable}: {matrix.shape} is too large for a depth map")
            # MATLAB is column-major, HDF5 row-major: the file holds the transpose.
            return np.ascontiguousarray(np.asarray(matrix).T)
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError) as error:
        raise LayoutError(f"can't be read as MATLAB v7.3 (HDF5): {error}") from error
