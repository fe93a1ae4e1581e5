"""Writing shards: the rows of a few objects, an Arrow stream file per column group, completely or not at all."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTH,
    DEPTH_EXACT,
    LABELS,
    RANGE,
    SINGLE_SHOT_FRAME,
    arrow_schema,
    group_columns,
    stored_groups,
)
from fpp_ml_bench.loaders.storage.direct_file import DirectFile
from fpp_ml_bench.loaders.storage.manifest import ShardFile
from fpp_ml_bench.optics import Sequence

if TYPE_CHECKING:
    import pyarrow as pa

OBJECTS_PER_SHARD = 4
"""Four objects are 24 rows: with batches of that size, batch boundaries no longer slow down reading (measured)."""


@dataclass
class Row:
    """A sample to be written: frames by index uint8 (H, W), depths float32 (H, W) in mm, measurements for the manifest.

    The images' memory may be reused as soon as the writer takes the next row.
    """

    sample: str
    object: str
    view: str
    frames: dict[int, NDArray[np.uint8]]
    depth_mm: NDArray[np.float32]
    depth_exact_mm: NDArray[np.float32] | None
    measured: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ShardPlan:
    """Samples of shard ``index`` of ``of`` of a split, as (sample, object, view), and the row of the first sample."""

    split: str
    index: int
    of: int
    first_row: int
    samples: tuple[tuple[str, str, str], ...]

    @property
    def name(self) -> str:
        return f"{self.split}-{self.index:05d}-of-{self.of:05d}"

    def path(self, group: str) -> str:
        stem = f"{group}-{self.index:05d}-of-{self.of:05d}.arrow"
        return f"{self.split}/{stem}" if group == DATA_GROUP else f"frames/{self.split}/{stem}"


def plan_shards(split: str, objects: dict[str, list[tuple[str, str, str]]]) -> list[ShardPlan]:
    """Shards of a split from its objects' samples, four objects or a few more each, in the given order."""
    names = list(objects)
    count = max(1, len(names) // OBJECTS_PER_SHARD)
    plans, first_row = [], 0
    for index, chunk in enumerate(np.array_split(np.arange(len(names)), count)):
        samples = tuple(sample for i in chunk for sample in objects[names[i]])
        plans.append(ShardPlan(split, index, count, first_row, samples))
        first_row += len(samples)
    return plans


class ShardWriter:
    """Writes the files of a shard. Rows come in plan order; pixels are copied once, into reused batch buffers."""

    def __init__(
        self, folder: Path, scratch: Path, plan: ShardPlan, sequence: Sequence, stored: str, exact: bool,
        size: tuple[int, int],
    ) -> None:  # fmt: skip
        self._folder, self._scratch, self._plan = folder, scratch, plan
        self._sequence, self._exact, self._size = sequence, exact, size
        self._groups = stored_groups(sequence, stored)

    def write(
        self, rows: Iterable[Row], row_done: Callable[[], None] = lambda: None
    ) -> tuple[list[ShardFile], list[dict[str, Any]]]:
        """Write all rows and call ``row_done`` after each; returns the files and, per row, its labels and measurements.

        Raises `BuildError` when the disk is full or can't be written; no unfinished file is left.
        """
        import pyarrow as pa

        stem = f"{self._plan.name}.{os.getpid()}"
        temporary = {group: self._scratch / f"{stem}.{group}.tmp" for group in self._groups}
        try:
            described, sinks = self._write_streams(rows, temporary, row_done)
            files = []
            for group, path in temporary.items():
                target = self._folder / self._plan.path(group)
                target.parent.mkdir(parents=True, exist_ok=True)
                path.replace(target)
                files.append(
                    ShardFile(
                        path=self._plan.path(group),
                        split=self._plan.split,
                        group=group,
                        first_row=self._plan.first_row,
                        rows=len(self._plan.samples),
                        bytes=sinks[group].size,
                        xxh3_128=sinks[group].xxh3_128,
                    )
                )
        except (OSError, pa.ArrowException) as error:
            raise BuildError(
                f"{self._folder / self._plan.path(DATA_GROUP)}: can't be written ({_reason(error)}); free some space "
                "or choose another disk, then run the same command again: it resumes"
            ) from error
        finally:
            for path in temporary.values():
                path.unlink(missing_ok=True)
        return files, described

    def _write_streams(
        self, rows: Iterable[Row], paths: dict[str, Path], row_done: Callable[[], None]
    ) -> tuple[list[dict[str, Any]], dict[str, DirectFile]]:
        import pyarrow as pa

        schemas = {
            group: arrow_schema(group_columns(self._sequence, group, frames, self._exact), self._size)
            for group, frames in self._groups.items()
        }
        with ThreadPoolExecutor(1) as thread, ExitStack() as files:
            sinks: dict[str, DirectFile] = {}
            for group, path in paths.items():
                sinks[group] = DirectFile(path, thread)
                files.callback(sinks[group].close)
            writers = {
                group: pa.ipc.new_stream(pa.PythonFile(sink, mode="w"), schemas[group]) for group, sink in sinks.items()
            }
            described = []
            data = _DataBatch(len(self._plan.samples), self._size)
            for row in self._checked(rows):
                low_mm, high_mm = depth_range_mm(row.depth_mm, row.sample)
                described.append(
                    {
                        "sample": row.sample,
                        "object": row.object,
                        "view": row.view,
                        "object_px": int(np.count_nonzero(object_mask(row.depth_mm))),
                        "depth_min_mm": low_mm,
                        "depth_max_mm": high_mm,
                        **row.measured,
                    }
                )
                data.add(row, (low_mm, high_mm), self._plan.split, self._sequence)
                # All frames but the first are written at once, one row per batch, and not held in memory.
                for group, frames in self._groups.items():
                    if group != DATA_GROUP:
                        images = [self._image(row, index)[None] for index in frames]
                        writers[group].write_batch(_record_batch(images, schemas[group]))
                row_done()
            writers[DATA_GROUP].write_batch(data.record_batch(schemas[DATA_GROUP]))
            for writer in writers.values():
                writer.close()
        return described, sinks

    def _checked(self, rows: Iterable[Row]) -> Iterator[Row]:
        rows = iter(rows)
        for planned, _, _ in self._plan.samples:
            row = next(rows, None)
            if row is None or row.sample != planned:
                received = "nothing" if row is None else f"sample {row.sample!r}"
                raise BuildError(f"shard {self._plan.name}: expected sample {planned!r}, got {received}")
            yield row

    def _image(self, row: Row, index: int) -> NDArray[np.uint8]:
        return _checked_image(row.frames[index], self._size, self._sequence.frames[index].column)


_buffers: dict[tuple[str, tuple[int, int]], NDArray] = {}
"""Memory of `_DataBatch`, reused for all shards: mapping 200 MB of new pages takes longer than filling them."""


class _DataBatch:
    """The batch of the ``data`` group: labels and copies of frame 0 and the depth maps of all rows of a shard."""

    def __init__(self, rows: int, size: tuple[int, int]) -> None:
        self._rows, self._size, self._filled = rows, size, 0
        self._values: dict[str, list[Any]] = {}

    def _buffer(self, column: str, dtype: np.dtype) -> NDArray:
        buffer = _buffers.get((column, self._size))
        if buffer is None or len(buffer) < self._rows or buffer.dtype != dtype:
            buffer = _buffers[column, self._size] = np.empty((self._rows, *self._size), dtype=dtype)
        return buffer[: self._rows]

    def add(self, row: Row, range_mm: tuple[float, float], split: str, sequence: Sequence) -> None:
        """Copy the columns of the group from a row."""
        values: dict[str, Any] = dict(zip(LABELS, (row.sample, row.object, row.view, split), strict=True))
        values.update(zip(RANGE, range_mm, strict=True))
        for name, value in values.items():
            self._values.setdefault(name, []).append(value)
        first_column = sequence.frames[SINGLE_SHOT_FRAME].column
        images: dict[str, NDArray] = {first_column: row.frames[SINGLE_SHOT_FRAME], DEPTH: row.depth_mm}
        if row.depth_exact_mm is not None:
            images[DEPTH_EXACT] = row.depth_exact_mm
        for column, image in images.items():
            self._buffer(column, image.dtype)[self._filled] = _checked_image(image, self._size, column)
        self._filled += 1

    def record_batch(self, schema: "pa.Schema") -> "pa.RecordBatch":
        """The batch; its images stay in the shared buffers until the next shard."""
        columns: list[Any] = [
            self._values.get(name) or _buffers[name, self._size][: self._rows] for name in schema.names
        ]
        return _record_batch(columns, schema)


def _checked_image(image: NDArray, size: tuple[int, int], column: str) -> NDArray:
    """The image, after a check of shape and dtype: Arrow takes over its memory unchecked."""
    dtype = np.dtype(np.float32 if column in (DEPTH, DEPTH_EXACT) else np.uint8)
    if image.shape != size or image.dtype != dtype:
        raise BuildError(f"column {column}: expected {dtype} {size}, got {image.dtype} {image.shape}")
    return image


def _record_batch(columns: list[Any], schema: "pa.Schema") -> "pa.RecordBatch":
    """Columns in the schema's order: images as arrays (rows, H, W), used without a copy; all others as lists."""
    import pyarrow as pa

    arrays = [
        pa.array(column, field.type) if isinstance(column, list) else _image_column(column, field.type)
        for column, field in zip(columns, schema, strict=True)
    ]
    return pa.record_batch(arrays, schema=schema)


def _image_column(images: NDArray, kind: "pa.DataType") -> "pa.Array":
    """Images (rows, H, W) as a list of lists, on the same memory."""
    import pyarrow as pa

    rows, height, width = images.shape
    images = np.ascontiguousarray(images)
    values = pa.Array.from_buffers(kind.value_type.value_type, images.size, [None, pa.py_buffer(images)])
    lines = np.arange(rows * height + 1, dtype=np.int64) * width
    if lines[-1] > np.iinfo(np.int32).max:
        raise BuildError(f"{rows} images of {height} x {width} px exceed one Arrow batch; use a smaller size")
    inner = pa.ListArray.from_arrays(pa.array(lines.astype(np.int32)), values)
    return pa.ListArray.from_arrays(pa.array(np.arange(rows + 1, dtype=np.int32) * height), inner)


def depth_range_mm(depth_mm: NDArray[np.float32], sample: str) -> tuple[float, float]:
    """Least and greatest depth above 0 of a sample (paper Section 3.3), mm.

    Raises `BuildError` for a map without object pixels, or with a depth that is negative or not finite.
    """
    if not (np.isfinite(depth_mm).all() and depth_mm.min() >= 0):
        raise BuildError(f"sample {sample!r}: its depth map has depths that are negative or not finite")
    inside = depth_mm[object_mask(depth_mm)]
    if inside.size == 0:
        raise BuildError(
            f"sample {sample!r}: its depth map has no pixel above 0 mm; expected an object in the working range"
        )
    return float(inside.min()), float(inside.max())


def _reason(error: BaseException) -> str:
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)
