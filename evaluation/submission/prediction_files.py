"""What a folder of predictions holds: the plain values of its description, the form of its files,
and the files of samples, which are checked before memory is taken, and never unpickled."""

import hashlib
import io
import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, local
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from fpp_ml_bench.containers import (
    PNG_GREY,
    parse_image,
    parse_matrix,
    parse_pfm,
    parse_table,
    pfm_size,
    png_header,
)
from fpp_ml_bench.depth import shape_problem, without_nodata
from fpp_ml_bench.errors import FppBenchError, PredictionError, SubmissionError
from fpp_ml_bench.evaluation.protocol import LARGEST_MM
from fpp_ml_bench.files import LOCK_FILE, fill, opened, printable, read_bounded, read_yaml

if TYPE_CHECKING:
    import pyarrow

    from fpp_ml_bench.loaders.storage.store import DatasetFolder

SUBMISSION_FILE = "submission.yaml"
REPORTS_FILE = "per_sample.json"
"""What a method may report of each sample beside its predictions; it is not scored."""
UNFINISHED_FILE = "unfinished.jsonl"
"""What `baselines.run.predict_split` goes on from, until all predictions are there."""
REFUSED_FILE = "refused.txt"
"""Why a method has no predictions of a dataset, in their place."""
_MAX_BYTES = 65536


def read_plain(folder: Path) -> dict[Any, Any]:
    """Keys and values of a predictions folder's ``submission.yaml``, their meaning unchecked; else
    SubmissionError."""
    path = folder / SUBMISSION_FILE
    if path.is_symlink() or not path.is_file():
        actual = "a symbolic link" if path.is_symlink() else "none"
        raise SubmissionError(
            f"expected a file {printable(path)} that describes the predictions, found "
            f"{actual}; fpp-bench "
            "predict writes one, PROTOCOL.md lists its keys"
        )
    return read_plain_file(path, "'name: My method'")


def read_plain_file(
    path: Path, example: str, raised: type[FppBenchError] = SubmissionError
) -> dict[Any, Any]:
    """Keys and values of a YAML file, of bounded size and plain values; ``example`` shows what a
    line looks like. The error ``raised`` names the file, what is wrong with it and what to do."""
    content = read_yaml(path, raised, "correct it, with short names and settings", _MAX_BYTES)
    if not isinstance(content, dict):
        file = printable(path)
        raise raised(
            f"{file}: expected keys and values like {example}, got {type(content).__name__}"
        )
    return content


PER_SAMPLE = (".npy", ".npz", ".mat", ".png", ".pfm")
SIGMA = ".sigma.npy"
"""Of a sample's optional standard uncertainty, a map (H, W) in mm, 0 where none is stated."""
TABLES = ("predictions.parquet", "predictions.arrow")
_SPARE_BYTES, _ARCHIVE_BYTES = 1 << 20, 1 << 16
"""What a file of another form than .npy, and an .npz, may have beside a float64 map."""


MapAndHash = tuple[NDArray, str]


@dataclass(frozen=True)
class Listing:
    """What a folder of predictions holds. ``form`` is one of `PER_SAMPLE` or `TABLES`; ``problems``
    has a line for each missing or extra entry; ``sigmas``: whether there are `SIGMA` files."""

    folder: Path
    form: str
    problems: list[str]
    present: list[str]
    sigmas: bool

    def named(self, sample: str) -> str:
        """The name of a sample's prediction in messages: its file."""
        return printable(
            f"{self.form}, sample {sample}" if self.form in TABLES else f"{sample}{self.form}"
        )

    def reader(
        self, size: tuple[int, int], png_mm_per_level: float | None, nodata: float | None = None
    ) -> Callable[[str], MapAndHash]:
        """A function from a sample to its map ``size`` (H, W), 0 where the file holds ``nodata``,
        valid until the same thread reads again, and the SHA-256 of its file. It may be called from
        several threads, and raises PredictionError, without the file's name, for a file that is
        refused; a table is read here, and refused with its name."""
        memory = local()
        table = (
            depth_maps(self.folder / self.form, self.present, size) if self.form in TABLES else None
        )

        def read(sample: str) -> MapAndHash:
            depth, digest = read_file(sample) if table is None else table(sample)
            return without_nodata(depth, nodata), digest

        def read_file(sample: str) -> MapAndHash:
            path = self.folder / f"{sample}{self.form}"
            if self.form == ".npy":
                return read_npy(path, size, memory)
            spare_bytes = _ARCHIVE_BYTES if self.form == ".npz" else _SPARE_BYTES
            content = read_bounded(path, _largest_npy(size) + spare_bytes)
            if self.form == ".png":
                depth = parse_png(content, size, png_mm_per_level)
            elif self.form == ".pfm":
                depth = parse_pfm(content)
            else:
                depth = (parse_npz if self.form == ".npz" else parse_mat)(content, size)
            return depth, hashlib.sha256(content).hexdigest()

        return read

    def sigma_mm(self, sample: str, size: tuple[int, int]) -> NDArray:
        """The `SIGMA` file of a sample, real floats (H, W) in mm; PredictionError, without the
        file's name, for any other content."""
        content = read_bounded(self.folder / f"{sample}{SIGMA}", _largest_npy(size))
        sigma_mm = parse_npy(content, size)
        low, high = float(sigma_mm.min()), float(sigma_mm.max())
        if low >= 0 and high <= LARGEST_MM:  # False for NaN
            return sigma_mm
        actual = f"found {low:g} to {high:g}"
        raise PredictionError(
            f"expected finite mm of 0 and more, {actual}; write 0 where none is stated"
        )


def predictions_folder(folder: str | Path) -> Path:
    """``folder``, if there is one; else PredictionError."""
    if not Path(folder).is_dir():
        raise PredictionError(
            f"expected a folder of predictions, found none at {printable(Path(folder))}"
        )
    return Path(folder)


def list_folder(folder: Path, dataset: "DatasetFolder | None" = None, split: str = "") -> Listing:
    """What ``folder`` holds for the samples of a ``split``, or without a dataset for all that it
    has a file of their own for: the form of most of its files, and every entry that is missing or
    extra."""
    try:
        names = {entry.name for entry in os.scandir(folder)}
    except OSError as error:
        name = printable(str(folder))
        raise PredictionError(
            f"the predictions folder {name} can't be read: {error.strerror}"
        ) from None
    if dataset is not None:
        samples = dataset.samples(split)
    else:
        stems = (
            name.removesuffix(suffix)
            for name in sorted(names)
            for suffix in PER_SAMPLE
            if name.endswith(suffix)
        )
        samples = list(
            dict.fromkeys(stem.removesuffix(SIGMA.removesuffix(".npy")) for stem in stems)
        )
    counts = {
        suffix: sum(f"{sample}{suffix}" in names for sample in samples) for suffix in PER_SAMPLE
    }
    form = max(
        PER_SAMPLE, key=lambda suffix: counts[suffix]
    )  # the first of equals: .npy where there is nothing
    if counts[form] == 0:
        form = next((table for table in TABLES if table in names), form)
    files = {form: ""} if form in TABLES else {f"{sample}{form}": sample for sample in samples}

    def hint(name: str) -> str:
        stem, suffix = os.path.splitext(name)  # noqa: PTH122  Path.suffix takes ".npy" alone for a stem
        splits = {} if dataset is None or suffix not in PER_SAMPLE else dataset.splits
        sample_split = next((other for other, names in splits.items() if stem in names), None)
        if sample_split and stem not in samples:
            return (
                f"a sample of split {sample_split}, not of {split}: move it away or score that "
                f"split"
            )
        if name == UNFINISHED_FILE:
            return "a stopped fpp-bench predict left it: run the same command again, it continues"
        if sample_split or name in TABLES:
            return (
                f"the other predictions are {form if form in TABLES else form + ' files'}: keep "
                f"one form"
            )
        return "remove it"

    problems = [
        f"{name}: is missing; write one for each sample" for name in files if name not in names
    ]
    uncertain = {f"{sample}{SIGMA}" for sample in samples}
    if sigmas := bool(uncertain & names):
        problems += [
            f"{name}: is missing; write one for each sample, or none"
            for name in sorted(uncertain - names)
        ]
    extra = sorted(names - {*files, *uncertain, SUBMISSION_FILE, REPORTS_FILE, LOCK_FILE})
    problems += [f"{printable(name)}: is extra ({hint(name)})" for name in extra]
    present = (
        samples if form in TABLES else [sample for name, sample in files.items() if name in names]
    )
    return Listing(folder, form, problems, present, sigmas)


HEADER_BYTES = 16384
# NumPy parses a header through `ast`, whose recursion counter all threads share (CPython 3.11): two
# at once may fail.
_PARSING = Lock()
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
_NO_HEADER = (
    ValueError,
    TypeError,
    SyntaxError,
    TokenError,
    KeyError,
    RecursionError,
    MemoryError,
    OverflowError,
)


def read_npy(path: Path, size: tuple[int, int], memory: local) -> MapAndHash:
    """The array in ``path`` and the SHA-256 of the whole file: the bytes hashed are the bytes
    scored. ``size`` is the expected (H, W). The array is a view of a buffer that the thread keeps
    in ``memory``, valid until its next read. Raises PredictionError, without the file's name, for
    anything but a plain .npy of that size and a real float dtype."""
    if not hasattr(memory, "buffer"):
        memory.buffer = bytearray(_largest_npy(size))
    view = memoryview(memory.buffer)
    with opened(path) as (stream, length):
        content = view[: fill(stream, view[:length])]
    return parse_npy(content, size, length), hashlib.sha256(content).hexdigest()


def _largest_npy(size: tuple[int, int]) -> int:
    """Bytes of the largest accepted .npy of an (H, W) map: float64 and its header."""
    return HEADER_BYTES + size[0] * size[1] * 8


def declared_size(path: Path) -> tuple[int, int] | None:
    """The size (H, W) that a .npy, .npz, .png or .pfm file states; None where it states none. Nothing
    else is checked."""
    with suppress(OSError, zipfile.BadZipFile, IndexError, *_NO_HEADER):
        with opened(path) as (stream, length):
            head = stream.read(min(HEADER_BYTES, length))
        if (header := png_header(head)) is not None:
            return header.size
        if (of_pfm := pfm_size(head)) is not None:
            return of_pfm
        if head.startswith(b"PK"):
            with zipfile.ZipFile(path) as archive, archive.open(archive.infolist()[0]) as member:
                head = member.read(HEADER_BYTES)
        content = io.BytesIO(head)
        with _PARSING:
            shape, _, _ = _HEADERS[npy.read_magic(content)](content)
        return (int(shape[0]), int(shape[1])) if len(shape) == 2 else None
    return None


def parse_npy(
    content: bytes | memoryview, size: tuple[int, int], length: int | None = None
) -> NDArray:
    """The array (H, W) in the bytes of a .npy file, a view; ``length``: that of the file where
    ``content`` may be its beginning only. PredictionError as `read_npy`."""
    if content[:4] == b"PK\x03\x04":
        raise PredictionError(
            "is a zip archive (np.savez?) under the name .npy; write it with np.save, or name it "
            ".npz"
        )
    stream = io.BytesIO(content[:HEADER_BYTES])
    try:
        version = npy.read_magic(stream)
        if (read := _HEADERS.get(version)) is not None:
            with _PARSING:
                shape, fortran, dtype = read(stream)
    except _NO_HEADER:
        raise PredictionError(
            "is no .npy file, or its header is damaged; write it with np.save"
        ) from None
    if read is None:
        raise PredictionError(
            f"has .npy format version {version}; expected 1.0 or 2.0, write it with np.save"
        )
    _check_array(dtype, shape, size)
    start, length = stream.tell(), len(content) if length is None else length
    expected = start + size[0] * size[1] * dtype.itemsize
    if length != expected:
        problem = "is truncated" if length < expected else "has foreign bytes after the array"
        raise PredictionError(f"{problem}: expected {expected} bytes, got {length}; write it again")
    if len(content) != length:
        raise PredictionError(
            f"ended early: expected {length} bytes, got {len(content)}; write it again"
        )
    flat = np.frombuffer(content, dtype=dtype, count=size[0] * size[1], offset=start)
    return flat.reshape(size, order="F" if fortran else "C")


def _check_array(dtype: np.dtype, shape: tuple[int, ...], size: tuple[int, int]) -> None:
    """Refuse anything but a real float map of ``size``: objects, complex numbers, whole numbers,
    other shapes."""
    if dtype.hasobject:
        raise PredictionError(
            "holds pickled Python objects, which are never opened; save a float32 array"
        )
    if dtype.kind != "f" or dtype.itemsize not in (2, 4, 8):
        wrap = ": whole numbers round depth, and wrap around where it does not fit; save as float32"
        why = {"c": " (complex); save its real depth", "i": wrap, "u": wrap}.get(
            dtype.kind, "; save as float32"
        )
        raise PredictionError(
            f"expected float16, float32 or float64, got {printable(str(dtype), 80)}{why}"
        )
    if problem := shape_problem(shape, size):
        raise PredictionError(problem)


_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1


def parse_npz(content: bytes, size: tuple[int, int]) -> NDArray:
    """The array (H, W) in an .npz archive; PredictionError as `read_npy`. The array may have any
    name. The size that the archive declares is checked before a byte is unpacked, and unpacking
    stops at the limit even where the archive declares a wrong size."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return parse_npy(_unpacked(archive, _largest_npy(size)), size)
    except PredictionError:
        raise
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        NotImplementedError,
        ValueError,
        RuntimeError,
    ) as error:
        reason = printable(str(error), 80)
        raise PredictionError(
            f"is no .npz archive, or damaged ({reason}); write it with np.savez"
        ) from None


def _unpacked(archive: zipfile.ZipFile, largest: int) -> bytes:
    members = archive.infolist()
    if len(members) != 1:
        names = printable(", ".join(member.filename for member in members[:5]), 120)
        raise PredictionError(
            f"holds {len(members)} arrays ({names}), expected one; save the depth alone"
        )
    member = members[0]
    name = printable(member.filename, 80)
    if (
        member.filename.startswith(("/", "\\"))
        or ".." in member.filename
        or "\\" in member.filename
    ):
        raise PredictionError(
            f"holds the path {name}, which leads out of the archive; write it with np.savez"
        )
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
        raise PredictionError(
            f"{name} unpacks to more than the {member.file_size} bytes it says; write it again"
        )
    return content


PNG_LEVELS = 65535
_PNG_ADVICE = "write 16-bit grey levels (cv2.imwrite of a uint16 array)"


def parse_png(content: bytes, size: tuple[int, int], mm_per_level: float | None) -> NDArray:
    """Depth (H, W) float64 in mm in a 16-bit PNG; PredictionError as `read_npy`. The header is
    checked before the image is decoded, every checksum and the unpacked length
    (`containers.parse_image`), too. A level of 65535 is refused: there a depth that does not fit
    was cut off."""
    if mm_per_level is None:
        raise PredictionError(
            "has no scale: give png_mm_per_level, the mm of one level, in submission.yaml"
        )
    header = png_header(content)
    if header is None:
        raise PredictionError(f"is no PNG file; {_PNG_ADVICE}")
    if problem := shape_problem(header.size, size):
        raise PredictionError(problem)
    if header[1:] != (16, PNG_GREY, 0):
        kind = (
            f"{header.bits} bits per channel, colour type {header.colour}, interlacing "
            f"{header.interlaced}"
        )
        raise PredictionError(f"has {kind}; expected 16, 0 and 0: {_PNG_ADVICE}")
    try:
        image = parse_image(
            content, len(content) + 2 * size[0] * size[1], unpacked=size[0] * (2 * size[1] + 1)
        )
    except PredictionError as error:
        raise PredictionError(f"{error}; {_PNG_ADVICE}") from None
    if image.transparent or image.levels.shape != size:
        raise PredictionError(f"can't be decoded as a 16-bit grey PNG; {_PNG_ADVICE}")
    if image.levels.max() == PNG_LEVELS:
        cut_off = f"where depth above {PNG_LEVELS * mm_per_level:g} mm is cut off"
        raise PredictionError(
            f"reaches level {PNG_LEVELS}, {cut_off}; use a larger png_mm_per_level, and 0 for no "
            f"surface"
        )
    return image.levels.astype(np.float64) * mm_per_level


def parse_mat(content: bytes, size: tuple[int, int]) -> NDArray:
    """The variable ``depth`` (H, W) of a MATLAB file; PredictionError as `read_npy`."""
    try:
        depth = parse_matrix(content, "depth", _largest_npy(size) + _SPARE_BYTES)
    except PredictionError as error:
        advice = "write it with save(file, 'depth') from a real single or double matrix"
        raise PredictionError(f"{error}; {advice}") from None
    _check_array(depth.dtype, depth.shape, size)
    return depth


_SLACK_BYTES, _SLACK_PER_SAMPLE = 1 << 20, 1 << 16
_TABLE_ADVICE = "write columns sample (text) and depth (list of H lists of W floats) with pyarrow"


def depth_maps(
    path: Path, samples: Sequence[str], size: tuple[int, int]
) -> Callable[[str], MapAndHash]:
    """A function from a sample to its map (H, W) and the SHA-256 of the file, an Arrow (IPC stream
    or file) or Parquet table with the columns ``sample`` (text) and ``depth``, whose rows hold H
    lists of W floats, one list of H W floats, or a tensor. PredictionError with the file's name.
    The whole table is held in memory: at most a float64 map per sample."""
    count, pixels = len(samples), size[0] * size[1]
    largest = count * (pixels * 8 + size[0] * 16 + _SLACK_PER_SAMPLE) + _SLACK_BYTES
    try:
        content = read_bounded(path, largest)
        # Twice what is needed, so that an extra row is refused by its name and not by the size of
        # the file.
        try:
            table = parse_table(content, 2 * largest, 2 * count * (pixels + 1))
        except PredictionError as error:
            raise PredictionError(f"{error}; {_TABLE_ADVICE}") from None
        _check_columns(table.schema)
        rows = _rows(table.column("sample").to_pylist(), samples)
    except PredictionError as error:
        raise PredictionError(f"{printable(path)} {error}") from None
    digest = hashlib.sha256(content).hexdigest()

    def depth_map(sample: str) -> MapAndHash:
        column = table.column("depth").slice(rows[sample], 1).combine_chunks()
        return _depth_map(column.chunk(0) if hasattr(column, "chunk") else column, size), digest

    return depth_map


def _check_columns(schema: "pyarrow.Schema") -> None:
    """Refuse other columns."""
    if sorted(schema.names) != ["depth", "sample"]:
        names = printable(", ".join(schema.names), 120)
        raise PredictionError(
            f"holds the columns {names}; expected sample and depth: {_TABLE_ADVICE}"
        )
    name, declared = (schema.field(column).type for column in ("sample", "depth"))
    if str(name) not in ("string", "large_string"):
        raise PredictionError(f"column sample: expected text, got {name}; {_TABLE_ADVICE}")
    value = declared
    while (inner := _item_type(value)) is not None:
        value = inner
    if value == declared or str(value) not in ("halffloat", "float", "double"):
        given = f"got {printable(str(declared), 80)}"
        why = "whole numbers wrap around, other types are not depth"
        raise PredictionError(
            f"column depth: expected lists of float16, float32 or float64, {given}; {why}: "
            f"{_TABLE_ADVICE}"
        )


def _item_type(value: "pyarrow.DataType") -> "pyarrow.DataType | None":
    """What a tensor or list type holds; None for any other."""
    import pyarrow as pa  # no other form needs it

    if isinstance(value, pa.BaseExtensionType):
        return value.storage_type
    if (
        pa.types.is_list(value)
        or pa.types.is_large_list(value)
        or pa.types.is_fixed_size_list(value)
    ):
        return value.value_type
    return None


def _rows(names: list[str], samples: Sequence[str]) -> dict[str, int]:
    """The row of each sample; refuses a table of other samples."""
    rows = {name: row for row, name in enumerate(names)}
    problems = [f"lacks the sample {sample}" for sample in samples if sample not in rows]
    problems += [
        f"holds {printable(name)}, which is no sample of this split"
        for name in rows
        if name not in set(samples)
    ]
    problems += [
        f"holds the sample {printable(name)} twice" for name in rows if names.count(name) > 1
    ]
    if problems:
        raise PredictionError(f"{'; '.join(problems[:20])}; write one row for each sample")
    return rows


def _depth_map(values: "pyarrow.Array", size: tuple[int, int]) -> NDArray:
    """The (H, W) map in the values of one row."""
    shape: list[int] = []
    while True:
        values = getattr(values, "storage", values)
        if values.null_count:
            raise PredictionError("holds missing values (null); write 0 where nothing was measured")
        if _item_type(values.type) is None:
            break
        lengths = values.value_lengths().unique().to_pylist()
        if len(lengths) != 1:
            raise PredictionError(
                f"expected rows of one length, got {len(lengths)} different ones; write H x W "
                f"values"
            )
        shape += lengths
        values = values.flatten()
    if shape != [size[0] * size[1]] and (problem := shape_problem(shape, size)):
        raise PredictionError(problem)
    dtype = np.dtype(values.type.to_pandas_dtype())
    return np.frombuffer(
        values.buffers()[1], dtype, len(values), values.offset * dtype.itemsize
    ).reshape(size)
