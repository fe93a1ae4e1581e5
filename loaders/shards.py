"""Writing shards: the rows of a few objects, one Arrow stream file per column group, complete or not at all."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.frames import Sequence
from fpp_ml_bench.loaders.direct_file import DirectFile
from fpp_ml_bench.loaders.manifest import ShardFile
from fpp_ml_bench.loaders.schema import (
    DATA_GROUP,
    DEPTH,
    DEPTH_EXACT,
    LABELS,
    RANGE,
    arrow_schema,
    group_columns,
    stored_groups,
)  # fmt: skip
from fpp_ml_bench.pixel_sets import object_mask

if TYPE_CHECKING:
    import pyarrow as pa

OBJECTS_PER_SHARD = 4
"""Four objects are 24 rows: a frame-0 batch of that size no longer notices the file's batch boundaries (measured)."""


@dataclass
class Row:
    """One sample on its way to disk: frames by index uint8 (H, W), depths float32 (H, W) in mm, what was measured.

    Frames are held until the last row of their object has come: the rows of one object must not share their memory.
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
    """Which samples go into shard ``index`` of ``of`` of a split: (sample, object, view), and the first one's row."""

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
    """Shards of one split from its objects' samples, four objects or a few more each, in the order given."""
    names = list(objects)
    count = max(1, len(names) // OBJECTS_PER_SHARD)
    plans, first_row = [], 0
    for index, chunk in enumerate(np.array_split(np.arange(len(names)), count)):
        samples = tuple(sample for i in chunk for sample in objects[names[i]])
        plans.append(ShardPlan(split, index, count, first_row, samples))
        first_row += len(samples)
    return plans


class ShardWriter:
    """Writes the files of one shard. Rows come in plan order; pixels are copied once, into reused batch buffers."""

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
        """Write all rows; returns the files and, per row, its labels and measurements. ``row_done`` follows each row.

        Raises `BuildError` when the disk is full or can't be written; no unfinished file stays behind.
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
            sinks = {group: DirectFile(path, thread) for group, path in paths.items()}
            for sink in sinks.values():
                files.callback(sink.close)
            writers = {
                group: pa.ipc.new_stream(pa.PythonFile(sink, mode="w"), schemas[group]) for group, sink in sinks.items()
            }
            described = []
            data = _Batch(self._size)
            data.restart(len(self._plan.samples))
            extra = {group: _Batch(self._size) for group in self._groups if group != DATA_GROUP}
            for place, row in enumerate(self._checked(rows)):
                least, greatest = depth_range_mm(row.depth_mm, row.sample)
                described.append(
                    {
                        "sample": row.sample,
                        "object": row.object,
                        "view": row.view,
                        "object_px": int(np.count_nonzero(object_mask(row.depth_mm))),
                        "depth_min_mm": least,
                        "depth_max_mm": greatest,
                        **row.measured,
                    }
                )
                data.add_row(row, (least, greatest), self._plan.split, self._groups[DATA_GROUP], self._sequence)
                # Frames beyond the first leave by object: six rows of them are all that is ever held.
                object_rows, first, last = self._object_rows(place)
                for group, batch in extra.items():
                    if first:
                        batch.restart(object_rows)
                    batch.hold_frames(row, self._groups[group], self._sequence)
                    if last:
                        writers[group].write_batch(batch.record_batch(schemas[group]))
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
                came = "nothing" if row is None else f"sample {row.sample!r}"
                raise BuildError(f"shard {self._plan.name}: expected sample {planned!r}, got {came}")
            yield row

    def _object_rows(self, place: int) -> tuple[int, bool, bool]:
        """Rows of the object that row ``place`` shows, and whether it is the first and the last of them."""
        names = [name for _, name, _ in self._plan.samples]
        first, count = names.index(names[place]), names.count(names[place])
        return count, place == first, place == first + count - 1


class _Batch:
    """Columns of one record batch, each on memory that Arrow takes without a copy.

    Images of a *held* batch stay where the source has them until the batch is written; a column whose images lie one
    after another in memory is not copied at all. The others are gathered in a buffer that the next batch reuses.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._buffers: dict[str, NDArray] = {}
        self.restart(0)

    def restart(self, rows: int) -> None:
        """Begin a batch of ``rows`` rows."""
        self._rows, self._filled = rows, 0
        self._held: dict[str, list[NDArray]] = {}
        self._values: dict[str, list[Any]] = {}

    def _checked(self, column: str, image: NDArray) -> NDArray:
        if image.shape != self._size:
            raise BuildError(f"column {column}: expected an image {self._size}, got {image.shape}")
        return image

    def _copy(self, column: str, image: NDArray) -> None:
        image = self._checked(column, image)
        buffer = self._buffers.get(column)
        if buffer is None or len(buffer) < self._rows:
            buffer = self._buffers[column] = np.empty((self._rows, *self._size), dtype=image.dtype)
        buffer[self._filled] = image

    def hold_frames(self, row: Row, frames: tuple[int, ...], sequence: Sequence) -> None:
        """Take the frames of a row as they are; they must not change before `record_batch` has been written."""
        for index in frames:
            column = sequence.frames[index].column
            self._held.setdefault(column, []).append(self._checked(column, row.frames[index]))

    def add_row(
        self, row: Row, range_mm: tuple[float, float], split: str, frames: tuple[int, ...], sequence: Sequence
    ) -> None:
        """Copy labels, depths and ``frames`` of a row."""
        values: dict[str, Any] = dict(zip(LABELS, (row.sample, row.object, row.view, split), strict=True))
        values.update(zip(RANGE, range_mm, strict=True))
        for name, value in values.items():
            self._values.setdefault(name, []).append(value)
        self._copy(DEPTH, row.depth_mm)
        if row.depth_exact_mm is not None:
            self._copy(DEPTH_EXACT, row.depth_exact_mm)
        for index in frames:
            self._copy(sequence.frames[index].column, row.frames[index])
        self._filled += 1

    def _images(self, column: str) -> NDArray:
        if column not in self._held:
            return self._buffers[column][: self._rows]
        images = self._held[column]
        first, step = images[0], images[0].nbytes
        addresses = [image.__array_interface__["data"][0] for image in images]
        if all(image.flags.c_contiguous for image in images) and addresses == [
            addresses[0] + i * step for i in range(len(images))
        ]:
            return np.lib.stride_tricks.as_strided(
                first, (len(images), *first.shape), (step, *first.strides), writeable=False
            )
        buffer = self._buffers.get(column)
        if buffer is None or len(buffer) < len(images):
            buffer = self._buffers[column] = np.empty((len(images), *self._size), dtype=first.dtype)
        return np.stack(images, out=buffer[: len(images)])

    def record_batch(self, schema: "pa.Schema") -> "pa.RecordBatch":
        """The batch; its columns live on the held images and the buffers."""
        import pyarrow as pa

        columns = [
            pa.array(self._values[field.name], field.type)
            if field.name in self._values
            else _image_column(self._images(field.name), field.type)
            for field in schema
        ]
        return pa.record_batch(columns, schema=schema)


def _image_column(images: NDArray, kind: "pa.DataType") -> "pa.Array":
    """Images (rows, H, W) as a list of lists, on the same memory."""
    import pyarrow as pa

    rows, height, width = images.shape
    values = pa.Array.from_buffers(kind.value_type.value_type, images.size, [None, pa.py_buffer(images)])
    lines = np.arange(rows * height + 1, dtype=np.int64) * width
    if lines[-1] > np.iinfo(np.int32).max:
        raise BuildError(f"{rows} images of {height} x {width} px exceed one Arrow batch; use a smaller size")
    inner = pa.ListArray.from_arrays(pa.array(lines.astype(np.int32)), values)
    return pa.ListArray.from_arrays(pa.array(np.arange(rows + 1, dtype=np.int32) * height), inner)


def depth_range_mm(depth_mm: NDArray[np.float32], sample: str) -> tuple[float, float]:
    """Least and greatest depth above 0 of a sample (paper Section 3.3), mm.

    Raises `BuildError` for a map without any, or with a depth that is negative or not finite.
    """
    if not (np.isfinite(depth_mm).all() and depth_mm.min() >= 0):
        raise BuildError(f"sample {sample!r}: its depth map has depths that are negative or not finite")
    inside = depth_mm[object_mask(depth_mm)]
    if inside.size == 0:
        raise BuildError(f"sample {sample!r}: its depth map has no pixel above 0 mm, so there is nothing to measure")
    return float(inside.min()), float(inside.max())


def _reason(error: BaseException) -> str:
    number = getattr(error, "errno", None)
    return os.strerror(number) if number else str(error)
