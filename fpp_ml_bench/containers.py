"""Foreign containers: MATLAB files, images, Arrow and Parquet, and, for
`loaders.render.mesh_files`, meshes. Libraries read them in another process.

The libraries that read these forms (SciPy, HDF5, Arrow, trimesh) trust the lengths in a file: a
damaged one may end the process that reads it, and a compressed page or buffer may state any
unpacked size. So they run in a process of their own, with an upper limit of memory, which is ended
when it takes too long. It goes on with the next file, so that a folder of files starts one process
for each thread that reads.

Errors of reading are `PredictionError` without a subject ("is cut off"); `from_file` makes the
room's own error of it.
"""

import io
import json
import math
import os
import re
import resource
import struct
import subprocess
import sys
import weakref
import zlib
from collections.abc import Callable, Mapping
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import FppBenchError, LayoutError, PredictionError
from fpp_ml_bench.files import file_content, printable
from fpp_ml_bench.machine import THREAD_COUNTS

T = TypeVar("T")
Answer = tuple[dict[str, Any], Any]
"""What a reader says of a file, as JSON values, and the bytes read."""

TIMEOUT_S = 120
LARGEST_BYTES = 1 << 30
"""Of a file whose size nothing else limits, and of what it unpacks to."""
_SPARE_BYTES = 64 << 20
_COPIES = 8
"""How many times the largest file and what it unpacks to may be in memory: received, unpacked,
written, sent."""


class ReadingProcess:
    """Another process that calls readers; it ends with this object, and with the process that made
    it."""

    def __init__(self) -> None:
        self._connection, theirs = Pipe()
        one_thread = dict.fromkeys(THREAD_COUNTS, "1")  # each thread's stack would count as memory
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-W", "ignore", "-m", __name__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **one_thread, "ARROW_DEFAULT_MEMORY_POOL": "system"},
        )
        theirs.close()
        weakref.finalize(self, _end, self.process, self._connection)

    def ask(self, request: Mapping[str, Any], content: bytes) -> Answer:
        """The reader's answer, also a refusal. After an error the process is of no use any more;
        PredictionError where it ended or took too long."""
        try:
            self._connection.send_bytes(json.dumps(request).encode())
            self._connection.send_bytes(content)
            if not self._connection.poll(TIMEOUT_S):
                raise PredictionError(f"can't be read within {TIMEOUT_S} s; write it again")
            return json.loads(self._connection.recv_bytes()), self._connection.recv_bytes()
        except (OSError, EOFError, ValueError):
            raise PredictionError(
                "is damaged: it ended the process that read it; write it again"
            ) from None


def _end(process: subprocess.Popen, connection: Connection) -> None:
    connection.close()
    process.kill()
    process.wait()


_idle: dict[int, list[ReadingProcess]] = {}
"""Processes that wait for a file, by the process that started them: a fork must not share them."""


def guarded(
    read: Callable[..., Answer] | str, content: bytes, largest: int, **arguments: Any
) -> Answer:
    """``read(content, largest, **arguments)`` in a process that may end: a function, or its name as
    module:function. PredictionError as it raises, and where the process ended, took too long, or
    needs more memory than a few times ``largest`` bytes."""
    name = read if isinstance(read, str) else f"{read.__module__}:{read.__name__}"
    waiting = _idle.setdefault(os.getpid(), [])
    try:
        process = waiting.pop()
    except IndexError:
        process = ReadingProcess()
    facts, answer = process.ask(
        {"reader": name, "largest": largest, "arguments": arguments}, content
    )
    waiting.append(process)
    if "refused" in facts:
        raise PredictionError(facts["refused"])
    if "missing" in facts:
        raise ModuleNotFoundError(f"No module named {facts['missing']!r}", name=facts["missing"])
    return facts, answer


def _serve(descriptor: int) -> None:
    """The other process: answers each request and content until the connection is closed."""
    connection, unlimited = Connection(descriptor), resource.getrlimit(resource.RLIMIT_AS)
    while True:
        try:
            request, content = json.loads(connection.recv_bytes()), connection.recv_bytes()
        except EOFError:
            return
        module, _, name = request["reader"].partition(":")
        largest, answer = request["largest"], b""
        try:
            facts, answer = getattr(import_module(module), name)(
                content, largest, **request["arguments"]
            )
        except PredictionError as error:
            facts = {"refused": printable(str(error), 500)}
        except MemoryError:
            needs = f"reading it takes more memory than {largest} bytes need"
            facts = {"refused": f"is too large or damaged: {needs}; write it again"}
        except ModuleNotFoundError as error:
            facts = {"missing": error.name}
        connection.send_bytes(json.dumps(facts).encode())
        connection.send_bytes(answer)
        resource.setrlimit(resource.RLIMIT_AS, unlimited)


def limit_memory(largest: int) -> None:
    """Of this process, until the next request; a reader calls it once its libraries are loaded."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most, (_, hard) = (
        used + _SPARE_BYTES + _COPIES * largest,
        resource.getrlimit(resource.RLIMIT_AS),
    )
    resource.setrlimit(
        resource.RLIMIT_AS, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
    )


def from_file(
    parse: Callable[..., T],
    path: Path,
    raised: type[FppBenchError],
    *arguments: Any,
    cure: str = "write it again",
) -> T:
    """``parse(content, *arguments)`` of a file that the user names. Raises ``raised`` with the
    file's name."""
    content = file_content(path, LARGEST_BYTES, raised, cure)
    try:
        return parse(content, *arguments)
    except PredictionError as error:
        raise raised(f"{path}: {error}") from None


def with_arrays(facts: dict[str, Any], *arrays: NDArray[Any]) -> Answer:
    """A reader's answer that holds arrays."""
    facts["arrays"] = [(values.dtype.str, values.shape) for values in arrays]
    parts = [np.ascontiguousarray(values).reshape(-1).view(np.uint8) for values in arrays]
    return facts, parts[0] if len(parts) == 1 else np.concatenate(parts)


def arrays_of(facts: dict[str, Any], content: bytes) -> list[NDArray[Any]]:
    """The arrays of such an answer, read only; taken out of ``facts``."""
    arrays, start = [], 0
    for dtype, shape in facts.pop("arrays"):
        arrays.append(np.frombuffer(content, dtype, math.prod(shape), start).reshape(shape))
        start += arrays[-1].nbytes
    return arrays


_HDF5_AT, _HDF5_SIGNATURE = 512, b"\x89HDF\r\n\x1a\n"
_V5_HEADER_BYTES = 128
_V5_MARKS = b"\0\1IM", b"\1\0MI"
_NUMERIC = (
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
    "logical",
)
_WRITTEN_BY = b"MATLAB 5.0 MAT-file, written by fpp-ml-bench"


def parse_matrix(content: bytes, variable: str, largest: int = LARGEST_BYTES) -> NDArray[Any]:
    """Variable ``variable`` of a MATLAB v5 or v7.3 file as in MATLAB: a real numeric matrix (rows,
    columns) of any dtype. PredictionError when it can't be read, lacks the variable (the message
    lists its variables), or the variable is not a real numeric matrix or unpacks to more than
    ``largest`` bytes. No other file is read. v7.3 needs h5py."""
    return arrays_of(*guarded(_read_matrix, content, largest, variable=variable))[0]


def _read_matrix(content: bytes, largest: int, variable: str) -> Answer:
    v73 = content.startswith(b"MATLAB") and content[_HDF5_AT:].startswith(_HDF5_SIGNATURE)
    if not v73 and len(content) < _V5_HEADER_BYTES:
        raise PredictionError(
            f"expected a MATLAB v5 or v7.3 file, got {len(content)} bytes; the file is cut off"
        )
    if not v73 and content[124:_V5_HEADER_BYTES] not in _V5_MARKS:
        raise PredictionError("expected a MATLAB v5 or v7.3 file; the header is neither")
    read, form = (_matrix_v73, "MATLAB v7.3 (HDF5)") if v73 else (_matrix_v5, "MATLAB v5")
    import_module("h5py" if v73 else "scipy.io")
    limit_memory(largest)
    try:
        values = read(content, variable, largest)
    except (MemoryError, PredictionError):
        raise
    except Exception as error:  # of any kind, on a damaged file
        reason = printable(" ".join(str(error).split()), 200)
        raise PredictionError(
            f"a data element can't be read as {form}, the file is cut off or damaged ({reason})"
        ) from None
    return with_arrays({}, values)


class _WholeFile(io.BytesIO):
    """Refuses to read or go beyond its end: SciPy takes a compressed variable without its last
    bytes, which are its checksum, and a matrix that ends behind the file."""

    def read(self, size: int | None = -1) -> bytes:
        content = super().read(size)
        if content and size is not None and len(content) < size:
            raise EOFError(f"expected {size} bytes, got {len(content)}")
        return content

    def seek(self, position: int, whence: int = io.SEEK_SET) -> int:
        length = self.getbuffer().nbytes
        if whence == io.SEEK_SET and position > length:
            raise EOFError(f"expected {position} bytes, got {length}")
        return super().seek(position, whence)


def _matrix_v5(content: bytes, variable: str, largest: int) -> NDArray[Any]:
    from scipy.io import loadmat, whosmat

    file = _WholeFile(content)
    listed = whosmat(file)
    if variable not in (name for name, _, _ in listed):
        raise PredictionError(
            f"expected the variable {variable}, got "
            f"{', '.join(name for name, _, _ in listed) or 'none'}"
        )
    shape, kind = next((shape, kind) for name, shape, kind in listed if name == variable)
    if kind not in _NUMERIC:
        raise PredictionError(
            f"{variable}: expected a real numeric matrix, got MATLAB class {kind}"
        )
    if len(shape) != 2:
        raise PredictionError(f"{variable}: expected a matrix (rows, columns), got shape {shape}")
    dtype = np.dtype("uint8" if kind == "logical" else kind)
    if min(shape) < 0 or math.prod(shape) * dtype.itemsize > largest:
        raise PredictionError(f"{variable}: {shape} is too large for a depth map")
    values = loadmat(file, variable_names=[variable])[variable]
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iufb":
        note = "complex" if np.iscomplexobj(values) else "sparse"
        raise PredictionError(
            f"{variable}: expected a real numeric matrix, got MATLAB class {kind}, {note}"
        )
    # MATLAB stores whole numbers in the smallest type that fits; the matrix class gives their true
    # type.
    return values.astype(dtype, copy=False)


def _matrix_v73(content: bytes, variable: str, largest: int) -> NDArray[Any]:
    import h5py

    with h5py.File(io.BytesIO(content), "r") as file:
        if variable not in file:
            names = [name for name in file if not name.startswith("#")]
            raise PredictionError(
                f"expected the variable {variable}, got {', '.join(names) or 'none'}"
            )
        if not isinstance(file.get(variable, getlink=True), h5py.HardLink):
            raise PredictionError(f"{variable} is a link; expected the matrix itself in this file")
        matrix = file[variable]
        if (
            not isinstance(matrix, h5py.Dataset)
            or matrix.dtype.kind not in "iuf"
            or matrix.ndim != 2
        ):
            raise PredictionError(f"{variable}: expected a real numeric matrix (rows, columns)")
        if matrix.is_virtual or matrix.external:
            raise PredictionError(
                f"{variable} is stored in other files; expected the matrix itself in this file"
            )
        # HDF5 unpacks whole chunks, and in a damaged file a chunk may be far larger than the
        # matrix.
        unpacked = max(matrix.size, math.prod(matrix.chunks or (1,))) * matrix.dtype.itemsize
        if unpacked > largest:
            raise PredictionError(f"{variable}: {matrix.shape} is too large for a depth map")
        # MATLAB is column-major, HDF5 row-major: the file holds the transpose.
        return np.asarray(matrix).T


def matrix_bytes(values: Mapping[str, NDArray | float]) -> bytes:
    """A compressed v5 file holding ``values``; equal values give equal bytes (the header carries no
    date)."""
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(
        buffer, {name: np.atleast_2d(value) for name, value in values.items()}, do_compression=True
    )
    return _WRITTEN_BY.ljust(116) + buffer.getvalue()[116:]


PNG_HEADER_BYTES = 33
PNG_GREY, PNG_RGB = 0, 2
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
COMPRESSION_LEVEL = 1  # of PNG: twice as fast as 3 on noisy fringes, and 6% larger (measured)
_LOSSY = ("jpeg", "tiff_jpeg", "webp")
_BITS_PER_SAMPLE, _PHOTOMETRIC, _ORIENTATION = 258, 262, 274


class PngHeader(NamedTuple):
    """``size`` (H, W) in px; bits of a channel; colour type and interlacing as numbers of the PNG
    specification."""

    size: tuple[int, int]
    bits: int
    colour: int
    interlaced: int


def png_header(content: bytes) -> PngHeader | None:
    """What the first `PNG_HEADER_BYTES` of a PNG say; None for any other content."""
    if (
        len(content) < PNG_HEADER_BYTES
        or not content.startswith(_PNG_SIGNATURE)
        or content[12:16] != b"IHDR"
    ):
        return None
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    return PngHeader((height, width), bits, colour, interlaced)


class StoredImage(NamedTuple):
    """An image as a file holds it. ``levels`` are uint8 or uint16 (H, W) or (H, W, C), C as red,
    green, blue, alpha or grey, alpha; a palette is resolved; empty where the file holds several
    ``images``. ``form`` and ``mode`` as Pillow names them, ``bits`` of a
    stored level or palette entry. ``orientation`` as EXIF numbers it, 1 where ``levels`` are
    upright; ``transparent``: whether a colour is; ``white_is_0``: of a TIFF."""

    levels: NDArray[Any]
    form: str
    mode: str
    bits: int
    images: int
    lossy: bool
    orientation: int
    transparent: bool
    white_is_0: bool


def parse_image(
    content: bytes, largest: int = LARGEST_BYTES, unpacked: int | None = None
) -> StoredImage:
    """The image in a PNG, BMP, TIFF or JPEG file, complete and with right checksums. ``unpacked``:
    of a PNG, the bytes that its pixels must unpack to, and nothing may follow it. PredictionError
    for any other content."""
    facts, values = guarded(_read_image, content, largest, unpacked=unpacked)
    return StoredImage(arrays_of(facts, values)[0], **facts)


def _read_image(content: bytes, largest: int, unpacked: int | None) -> Answer:
    from PIL import BmpImagePlugin, Image, JpegImagePlugin, PngImagePlugin, TiffImagePlugin  # noqa: F401

    try:
        image: Any = Image.open(io.BytesIO(content), formats=("PNG", "BMP", "TIFF", "JPEG"))
        bits = _stored_bits(image, content)
        if coloured := bits > 8 and image.mode in ("RGB", "RGBA", "LA"):
            import cv2
        limit_memory(largest)
        lossy = image.format in ("JPEG", "MPO") or image.info.get("compression") in _LOSSY
        facts = {
            "form": image.format,
            "mode": image.mode,
            "bits": bits,
            "images": getattr(image, "n_frames", 1),
            "lossy": lossy,
            "orientation": 1,
            "white_is_0": image.format == "TIFF" and image.tag_v2.get(_PHOTOMETRIC) == 0,
        }
        levels: NDArray[Any] = np.zeros((0, 0), np.uint8)
        if facts["images"] == 1:
            if not lossy:
                _check_complete(content, image.format, unpacked)
            if image.format != "TIFF":  # which Pillow and OpenCV turn themselves
                facts["orientation"] = image.getexif().get(_ORIENTATION, 1)
            image.load()
            # Pillow reduces it to 8 bits; OpenCV returns part of an image that is cut off, this one is not.
            if coloured:
                stored = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
                if (
                    stored is None
                    or stored.dtype != np.uint16
                    or stored.shape[:2] != image.size[::-1]
                ):
                    raise PredictionError(
                        f"colour of {bits} bits that OpenCV can't decode; write it as grey levels"
                    )
                levels = stored[..., [2, 1, 0, *range(3, stored.shape[2])]]
            else:
                if image.mode in ("P", "PA"):
                    image = image.convert("RGBA" if image.mode == "PA" else "RGB")
                levels = np.asarray(image).astype(np.uint16 if bits > 8 else np.uint8)
        facts["transparent"] = "transparency" in image.info
    except (MemoryError, PredictionError):
        raise
    except Exception as error:  # of any kind, on a damaged file
        reason = printable(" ".join(str(error).split()), 100)
        expected = "expected a PNG, BMP or TIFF image, found a file that"
        raise PredictionError(
            f"{expected} is cut off, damaged or of another form ({reason})"
        ) from None
    return with_arrays(facts, levels)


def _stored_bits(image: Any, content: bytes) -> int:
    if image.format == "PNG":
        return 8 if image.mode in ("P", "PA") else content[24]
    if image.format == "TIFF":
        return max(image.tag_v2.get(_BITS_PER_SAMPLE, (1,)))
    if image.format == "BMP":
        pixel_bits = struct.unpack("<H", content[28:30])[0]
        return 5 if pixel_bits == 16 else min(pixel_bits, 8)
    return 8


def _check_complete(content: bytes, form: str, unpacked: int | None) -> None:
    """What Pillow lets pass: wrong checksums and a missing end of a PNG, a BMP shorter than it
    says."""
    if form == "BMP" and len(content) < (expected := struct.unpack("<I", content[2:6])[0]):
        raise PredictionError(
            f"the BMP is cut off: expected {expected} bytes, found {len(content)}"
        )
    if form != "PNG":
        return
    from PIL.PngImagePlugin import ChunkStream

    file = io.BytesIO(content)
    kinds: list[bytes] = []
    pixels: list[bytes] = []
    file.seek(len(_PNG_SIGNATURE))
    chunks = ChunkStream(file)
    try:
        while kinds[-1:] != [b"IEND"]:
            kind, _, length = chunks.read()
            chunks.crc(kind, data := file.read(length))
            kinds.append(kind)
            pixels += [data] if kind == b"IDAT" else []
    except (SyntaxError, struct.error) as error:
        wrong = (
            "damaged, a checksum does not match"
            if "bad header checksum" in str(error)
            else "cut off or damaged"
        )
        raise PredictionError(f"the PNG is {wrong}") from None
    if kinds.count(b"IHDR") != 1 or b"IDAT" not in kinds:
        raise PredictionError("the PNG is cut off or damaged")
    if unpacked is None:
        return
    if file.tell() != len(content):
        raise PredictionError("the PNG has foreign bytes after the image")
    length = len(zlib.decompressobj().decompress(b"".join(pixels), unpacked + 1))
    if length != unpacked:
        more = "more than " if length > unpacked else ""
        raise PredictionError(
            f"the PNG unpacks to {more}{min(length, unpacked)} bytes, expected {unpacked}"
        )


def png_bytes(image: NDArray[np.uint8], *settings: int) -> bytes:
    """An image uint8 (H, W) or (H, W, 3) as PNG; ``settings`` are further ones of
    ``cv2.imencode``."""
    import cv2

    level = cv2.IMWRITE_PNG_COMPRESSION, COMPRESSION_LEVEL
    done, content = cv2.imencode(".png", np.ascontiguousarray(image), [*level, *settings])
    if not done:
        raise LayoutError(f"OpenCV could not encode an image of shape {image.shape} as PNG")
    return content.tobytes()


_ARROW_MAGIC, _PARQUET_MAGIC = b"ARROW1\0\0", b"PAR1"
_ROWS_AT_ONCE = 8


def parse_table(content: bytes, largest: int, most_values: int) -> Any:
    """The ``pyarrow.Table`` in an Arrow file, an Arrow stream or a Parquet file, of at most
    ``largest`` bytes and, in Parquet, ``most_values`` values. PredictionError for any other
    content."""
    import pyarrow as pa

    _, unpacked = guarded(_read_table, content, largest, most_values=most_values)
    return pa.ipc.open_stream(unpacked).read_all()


def _read_table(content: bytes, largest: int, most_values: int) -> Answer:
    import pyarrow as pa
    import pyarrow.parquet as pq

    limit_memory(largest)
    try:
        if content.startswith(_PARQUET_MAGIC):
            limits = {"thrift_string_size_limit": 1 << 20, "thrift_container_size_limit": 1 << 16}
            file = pq.ParquetFile(pa.py_buffer(content), **limits)
            groups = [
                file.metadata.row_group(index) for index in range(file.metadata.num_row_groups)
            ]
            chunks = [group.column(index) for group in groups for index in range(group.num_columns)]
            total, values = (
                sum(c.total_uncompressed_size for c in chunks),
                sum(c.num_values for c in chunks),
            )
            if total > largest or values > most_values:
                sizes, most = f"{total} bytes and {values} values", f"{largest} and {most_values}"
                raise PredictionError(
                    f"would unpack to {sizes}, expected at most {most} for this split"
                )
            schema, batches = file.schema_arrow, file.iter_batches(_ROWS_AT_ONCE, use_threads=False)
        else:
            # An IPC file is an IPC stream between a mark and a footer.
            body = pa.py_buffer(content.removeprefix(_ARROW_MAGIC))
            batches = pa.ipc.open_stream(body, options=pa.ipc.IpcReadOptions(use_threads=False))
            schema = batches.schema
        unpacked = pa.BufferOutputStream()
        with pa.ipc.new_stream(unpacked, schema) as stream:
            for batch in batches:
                batch.validate(full=True)
                stream.write_batch(batch)
                if unpacked.tell() > largest:
                    raise PredictionError(
                        f"unpacks to more than {largest} bytes, which this split can't need"
                    )
        return {}, unpacked.getvalue()
    except (PredictionError, MemoryError):
        raise
    except (pa.ArrowException, OSError, EOFError, IndexError, KeyError, ValueError) as error:
        reason = printable(str(error).split("\n")[0], 120)
        raise PredictionError(f"can't be read as Arrow or Parquet ({reason})") from None


if __name__ == "__main__":
    _serve(int(sys.argv[1]))


_PFM = re.compile(rb"Pf\s+(\d{1,6})\s+(\d{1,6})\s+(-?\d+(?:\.\d+)?)\s")
"""The head of a portable float map of one channel; a scale below 0 says little-endian."""


def pfm_bytes(values: NDArray) -> bytes:
    """A map (H, W) as a portable float map (PFM): float32, rows from the last to the first."""
    height, width = values.shape
    rows = np.ascontiguousarray(values[::-1], "<f4")
    return b"Pf\n%d %d\n-1.0\n" % (width, height) + rows.tobytes()


def pfm_size(content: bytes) -> tuple[int, int] | None:
    """Height and width in px that a PFM states; None for content that begins as none."""
    head = _PFM.match(content)
    return None if head is None else (int(head[2]), int(head[1]))


def parse_pfm(content: bytes) -> NDArray[np.float32]:
    """The map (H, W) of a PFM; `PredictionError` for content that is none, or cut off."""
    head = _PFM.match(content)
    if head is None or float(head[3]) == 0:
        raise PredictionError("is no PFM file of one channel; expected Pf, width, height, -1.0")
    width, height = int(head[1]), int(head[2])
    expected, got = 4 * width * height, len(content) - head.end()
    if got != expected:
        raise PredictionError(
            f"holds {got} bytes of values, expected {expected} of {width} x {height}"
        )
    order = "<f4" if float(head[3]) < 0 else ">f4"
    values = np.frombuffer(content, order, offset=head.end()).reshape(height, width)
    return values[::-1].astype(np.float32)
