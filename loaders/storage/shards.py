"""Writing shards: the rows of a few objects, an Arrow stream file per column group, completely or
not at all."""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fpp_ml_bench.depth import depth_problem, depth_range_mm, object_mask
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import file_hash, whole_file
from fpp_ml_bench.loaders import sample as layout
from fpp_ml_bench.loaders.sample import (
    COVER,
    DATA_GROUP,
    DEPTH,
    DEPTH_EXACT,
    DEPTHS,
    FLAGS,
    LABELS,
    RANGE,
    Row,
)
from fpp_ml_bench.loaders.storage.manifest import Manifest, OtherFile, ShardFile

OBJECTS_PER_SHARD = 4
"""Four objects are 24 rows: with batches of that size, batch boundaries no longer slow down reading
(measured)."""
ROWS_PER_SHARD, SHARD_PX = 24, 1 << 26
"""A shard's frame and depth map of every row are in memory until it is written: 0.3 GB for so many
pixels."""


@dataclass(frozen=True)
class Receipt:
    """What is written of a shard: its files, per row the labels and measurements and the ``hashes``
    of its images by column, and the meshes of its objects."""

    files: list[ShardFile]
    rows: list[dict[str, Any]]
    meshes: list[OtherFile] = field(default_factory=list)

    @property
    def written(self) -> tuple[ShardFile | OtherFile, ...]:
        return (*self.files, *self.meshes)


@dataclass(frozen=True)
class ShardPlan:
    """Samples of shard ``index`` of ``of`` of a split, as (sample, object, view), and the row of
    the first sample."""

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


Sample = tuple[str, str, str]
"""Sample, object and view."""


def plan_shards(split: str, objects: dict[str, list[Sample]]) -> list[ShardPlan]:
    """Shards of a split from its objects' samples, four objects or a few more each, in the given
    order."""
    names = list(objects)
    chunks = np.array_split(np.arange(len(names)), max(1, len(names) // OBJECTS_PER_SHARD))
    return _numbered(
        split, [tuple(sample for i in chunk for sample in objects[names[i]]) for chunk in chunks]
    )


def plan_rows(split: str, samples: list[Sample], image_px: int) -> list[ShardPlan]:
    """Shards of a split from samples of any number of views: as many as four objects of six views
    have, or fewer where their images of ``image_px`` would fill the memory."""
    most = int(np.clip(SHARD_PX // image_px, 1, ROWS_PER_SHARD))
    chunks = np.array_split(np.arange(len(samples)), -(-len(samples) // most))
    return _numbered(split, [tuple(samples[i] for i in chunk) for chunk in chunks])


def _numbered(split: str, chunks: list[tuple[Sample, ...]]) -> list[ShardPlan]:
    plans, first_row = [], 0
    for index, rows in enumerate(chunks):
        plans.append(ShardPlan(split, index, len(chunks), first_row, rows))
        first_row += len(rows)
    return plans


def arrow_schema(described: Mapping[str, Mapping[str, Any]]) -> pa.Schema:
    """The Arrow schema of columns with these `features`, as ``datasets.Features(...).arrow_schema``
    has it, written without importing ``datasets``. Arrays are the storage type of its Array2D
    extension, a list of rows, with the extension named in the field's metadata: a reader that has
    imported ``datasets`` sees Array2D, all others see plain lists."""
    fields = []
    types = {"string": pa.string(), "float32": pa.float32(), "uint8": pa.uint8()}
    image = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    for name, feature in described.items():
        kind = image if feature["_type"] == "Image" else types[feature["dtype"]]
        if feature["_type"] == "Array2D":
            metadata = {
                b"ARROW:extension:name": b"datasets.features.features.Array2DExtensionType",
                b"ARROW:extension:metadata": json.dumps(
                    [feature["shape"], feature["dtype"]]
                ).encode(),
            }
            fields.append(pa.field(name, pa.list_(pa.list_(kind)), metadata=metadata))
        else:
            fields.append(pa.field(name, kind))
    return pa.schema(
        fields, metadata={b"huggingface": json.dumps({"info": {"features": described}}).encode()}
    )


class ShardWriter:
    """Writes shards of the dataset that ``manifest`` describes, one after the other. Pixels are
    copied once, into buffers that all shards reuse."""

    def __init__(self, manifest: Manifest) -> None:
        self._manifest, self._size = manifest, manifest.size
        self._schemas = {group: arrow_schema(manifest.features(group)) for group in manifest.groups}
        self._images = [
            name for name in self._schemas[DATA_GROUP].names if name not in (*LABELS, *RANGE)
        ]
        # Mapping 200 MB of new pages for every shard takes longer than filling them.
        self._buffers: dict[str, NDArray] = {}

    def write(
        self,
        folder: Path,
        plan: ShardPlan,
        rows: Iterable[Row],
        row_done: Callable[[], None] = lambda: None,
    ) -> Receipt:
        """Write the rows of ``plan``, which come in its order, into the dataset's folder, and call
        ``row_done`` after each. Raises `BuildError` when the disk is full or can't be written; no
        unfinished file is left."""
        try:
            with ExitStack() as opened:
                files: dict[str, IO[bytes]] = {}
                for group in self._schemas:
                    target = folder / plan.path(group)
                    target.parent.mkdir(parents=True, exist_ok=True)
                    files[group] = opened.enter_context(
                        whole_file(target, sync=False)
                    )  # `_settled` does it
                described = self._write_streams(plan, rows, files, row_done)
                place = plan.first_row, len(plan.samples)
                written = [
                    ShardFile(plan.path(group), plan.split, group, *place, *_settled(file))
                    for group, file in files.items()
                ]
        except (OSError, pa.ArrowException) as error:
            number = getattr(error, "errno", None)
            reason = os.strerror(number) if number else error
            where = folder / plan.path(DATA_GROUP)
            advice = (
                "free some space or choose another disk, then run the same command again: it "
                "resumes"
            )
            raise BuildError(f"{where}: can't be written ({reason}); {advice}") from error
        return Receipt(written, described)

    def _write_streams(
        self,
        plan: ShardPlan,
        rows: Iterable[Row],
        files: dict[str, IO[bytes]],
        row_done: Callable[[], None],
    ) -> list[dict[str, Any]]:
        writers = {
            group: pa.ipc.new_stream(pa.PythonFile(file, mode="w"), self._schemas[group])
            for group, file in files.items()
        }
        described = []
        for number, row in enumerate(_in_order(plan, rows)):
            low_mm, high_mm = checked_range_mm(row.depth_mm, row.sample)
            labels = {"sample": row.sample, "object": row.object, "view": row.view}
            object_px = int(np.count_nonzero(object_mask(row.depth_mm)))
            measured = {
                "object_px": object_px,
                "depth_min_mm": low_mm,
                "depth_max_mm": high_mm,
                **row.measured,
            }
            hashes: dict[str, str] = {}
            described.append({**labels, **measured, "hashes": hashes})
            # The data group is one batch of all rows. All frames but the first are written at once,
            # one row per batch, and not held in memory.
            for group, frames in self._manifest.groups.items():
                images: dict[str, Any] = {
                    self._manifest.sequence.frames[i].column: row.frames[i] for i in frames
                }
                if group == DATA_GROUP:
                    images |= {DEPTH: row.depth_mm, DEPTH_EXACT: row.depth_exact_mm}
                    images |= {FLAGS: row.flags, COVER: row.cover}
                    images = {column: images[column] for column in self._images}
                images = {column: self._checked(image, column) for column, image in images.items()}
                hashes.update(
                    (column, layout.image_hash(image)) for column, image in images.items()
                )
                if group != DATA_GROUP:
                    batch = [image[None] for image in images.values()]
                    writers[group].write_batch(_record_batch(batch, self._schemas[group]))
                    continue
                for column, image in images.items():
                    self._buffer(column, len(plan.samples))[number] = image
            row_done()
        labelled = [layout.labels_of(row, plan.split) for row in described]
        columns = [
            self._buffer(name, len(plan.samples))
            if name in self._images
            else [row[name] for row in labelled]
            for name in self._schemas[DATA_GROUP].names
        ]
        writers[DATA_GROUP].write_batch(_record_batch(columns, self._schemas[DATA_GROUP]))
        for writer in writers.values():
            writer.close()
        return described

    def _buffer(self, column: str, rows: int) -> NDArray:
        if column not in self._buffers or len(self._buffers[column]) < rows:
            self._buffers[column] = np.empty((rows, *self._size), _dtype(column))
        return self._buffers[column][:rows]

    def _checked(self, image: NDArray | None, column: str) -> NDArray:
        """The image, after a check of shape and dtype: Arrow takes over its memory unchecked."""
        if image is None or image.shape != self._size or image.dtype != _dtype(column):
            received = "nothing" if image is None else f"{image.dtype} {image.shape}"
            raise BuildError(
                f"column {column}: expected {_dtype(column)} {self._size}, got {received}"
            )
        return image


def _settled(file: IO[bytes]) -> tuple[int, str]:
    """Bytes and hash of a file just written. It is on the disk then, and no longer in the cache,
    where gigabytes of shards would push out everything else."""
    file.flush()
    os.fdatasync(file.fileno())
    digest = file_hash(Path(file.name))
    os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return file.tell(), digest


def _dtype(column: str) -> np.dtype:
    return np.dtype(np.float32 if column in DEPTHS else np.uint8)


def _in_order(plan: ShardPlan, rows: Iterable[Row]) -> Iterator[Row]:
    rows = iter(rows)
    for planned, _, _ in plan.samples:
        row = next(rows, None)
        if row is None or row.sample != planned:
            received = "nothing" if row is None else f"sample {row.sample!r}"
            raise BuildError(f"shard {plan.name}: expected sample {planned!r}, got {received}")
        yield row


def _record_batch(columns: list[Any], schema: pa.Schema) -> pa.RecordBatch:
    """Columns in the schema's order: images as arrays (rows, H, W), used without a copy; all others
    as lists."""
    arrays = [
        pa.array(column, field.type)
        if isinstance(column, list)
        else image_column(column, field.type)
        for column, field in zip(columns, schema, strict=True)
    ]
    return pa.record_batch(arrays, schema=schema)


def image_column(images: NDArray, kind: pa.DataType) -> pa.Array:
    """Images (rows, H, W) as a list of lists, on the same memory."""
    rows, height, width = images.shape
    images = np.ascontiguousarray(images)
    values = pa.Array.from_buffers(
        kind.value_type.value_type, images.size, [None, pa.py_buffer(images)]
    )
    lines = np.arange(rows * height + 1, dtype=np.int64) * width
    if lines[-1] > np.iinfo(np.int32).max:
        raise BuildError(
            f"{rows} images of {height} x {width} px exceed one Arrow batch; use a smaller size"
        )
    inner = pa.ListArray.from_arrays(pa.array(lines.astype(np.int32)), values)
    return pa.ListArray.from_arrays(pa.array(np.arange(rows + 1, dtype=np.int32) * height), inner)


def checked_range_mm(depth_mm: NDArray[np.float32], sample: str) -> tuple[float, float]:
    """Least and greatest depth above 0 of a sample (paper Section 3.3), mm. Raises `BuildError` for
    a map without object pixels, or with a depth that is negative or not finite."""
    if problem := depth_problem(depth_mm):
        raise BuildError(f"sample {sample!r}: its depth map: {problem}")
    return depth_range_mm(depth_mm)
