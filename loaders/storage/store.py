"""Reading a dataset folder: single images, or all as a ``datasets.Dataset`` on memory maps.

The evaluator, the classical method, the torch dataset and the pictures read through
`DatasetFolder`, which needs only NumPy and pyarrow. Plain ``datasets.load_dataset`` copies what it
reads into its cache, and its Arrow builder can't leave columns out; `load_dataset` joins the tables
of the column groups, and a frame is read only when its row is.
"""

import io
import mmap
import os
import weakref
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import CONFIGS, SPLITS, TRAIN
from fpp_ml_bench.depth import RangeRule, object_mask
from fpp_ml_bench.errors import DatasetError, PredictionError
from fpp_ml_bench.files import cause_of, opened, printable
from fpp_ml_bench.loaders import sample as layout
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTH,
    DEPTH_EXACT,
    DEPTHS,
    FLAGS,
    LABELS,
    NAMES,
    RANGE,
    TRUTH,
    Flag,
    config_columns,
    exact_void,
    void_pixels,
)
from fpp_ml_bench.loaders.storage.manifest import MANIFEST, ShardFile, damage_of, read_manifest
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.optics.sequence import AnySequence
from fpp_ml_bench.options import did_you_mean

if TYPE_CHECKING:
    import pyarrow as pa
    from datasets import Dataset, DatasetDict

ALL_SPLITS = "all"
_METADATA_BYTES = 1 << 20
"""What pyarrow reads at once is a body if it is larger: the metadata of a shard are 10 kB."""


class DatasetFolder:
    """A finished dataset folder, built or imported. Raises `DatasetError` for any other folder.
    Images are read-only, and only those that are used are read. Instances pickle by path, so worker
    processes open the files themselves."""

    def __init__(self, path: str | Path, check: bool = True, truth: bool = True) -> None:
        """With ``check`` off, the folder opens even if some of its files are missing or cut. With
        ``truth`` off it is what methods are given: of samples outside the training split no depth,
        flags, range and measurements."""
        self.path, self.truth = Path(path), truth
        manifest = read_manifest(self.path)
        self.fingerprint = manifest.fingerprint
        """SHA-256 of the data's content, 64 hex digits."""
        shown = {
            split: rows
            if truth or split == TRAIN
            else [{key: row[key] for key in NAMES} for row in rows]
            for split, rows in manifest.samples.items()
        }
        self.manifest = replace(manifest, samples=shown)
        self._opened: dict[str, OpenShard] = {}
        self._latest: tuple[str, dict[str, NDArray]] = "", {}
        """The sample that was read last, and its images by column: they are often asked for
        again."""
        for shard in self.manifest.shards if check else ():
            if damage := damage_of(self.path, shard, whole=False):
                raise DatasetError(damage)

    def forget(self, shard: ShardFile) -> None:
        """Close a file."""
        self._opened.pop(shard.path, None)

    def __reduce__(self) -> tuple[type["DatasetFolder"], tuple[Path, bool, bool]]:
        return DatasetFolder, (self.path, True, self.truth)

    def without_truth(self) -> "DatasetFolder":
        """The dataset as methods are given it."""
        return DatasetFolder(self.path, check=False, truth=False) if self.truth else self

    @property
    def content(self) -> dict[str, str]:
        """``split/column`` -> hash of its decoded values, by the manifest; `fpp-bench verify` reads
        the images."""
        return self.manifest.content

    def check_content(self, content: Mapping[str, str], made: str) -> None:
        """Raise `DatasetError` for a ``split/column`` of ``content`` whose hash is another here;
        columns that are not stored here don't tell. ``made``: the folder of predictions of data
        with that content."""
        changed = next(
            (name for name, digest in content.items() if self.content.get(name, digest) != digest),
            None,
        )
        if changed is not None:
            made = printable(made, 500)
            raise DatasetError(
                f"{self.path}: is not what {made} was predicted from, {printable(changed)} is "
                f"another now; give the "
                f"dataset: fpp-eval {made} DATASET, or predict again"
            )

    def content_hash(self, split: str, column: str, hashes: Mapping[str, str]) -> tuple[str, str]:
        """``split/column``, and the hash of its images, of which ``hashes`` are those of the
        samples (`image_hash`). Raises `DatasetError` where the manifest has another: the files were
        changed after it was written."""
        name, digest = f"{split}/{column}", layout.column_hash(hashes)
        if digest != self.content.get(name):
            raise DatasetError(
                f"{self.path}: {column} of split {split} is not what {MANIFEST} says, so it was "
                f"changed or damaged; "
                "run: fpp-bench verify, and build or copy the dataset again"
            )
        return name, digest

    @property
    def size(self) -> tuple[int, int]:
        """Image height and width in px."""
        return self.manifest.size

    @cached_property
    def rig(self) -> Rig:
        """The rig whose camera took the images."""
        return rig_from_dict(self.manifest.rig)

    @property
    def sequence(self) -> AnySequence:
        return self.manifest.sequence

    @property
    def configs(self) -> tuple[str, ...]:
        """Configurations whose frames are stored here."""
        return self.manifest.configs

    @property
    def has_exact(self) -> bool:
        """Whether the dataset has ``depth_exact`` (generated data; published data has decoded depth
        only)."""
        return self.manifest.exact

    @cached_property
    def splits(self) -> dict[str, list[str]]:
        """Sample names of each split in row order."""
        return self.manifest.splits

    @cached_property
    def _position(self) -> dict[str, tuple[str, int]]:
        return {
            sample: (split, row)
            for split, names in self.splits.items()
            for row, sample in enumerate(names)
        }

    def samples(self, split: str) -> list[str]:
        """Sample names of ``split``, or of every split in turn for ``all``. Raises `DatasetError`
        for other names."""
        if split == ALL_SPLITS:
            return [name for part in SPLITS for name in self.splits.get(part, [])]
        if split not in self.splits:
            raise DatasetError(
                f"{self.path}: no split {split!r}; there are {', '.join(self.splits)} and "
                f"{ALL_SPLITS}"
            )
        return list(self.splits[split])

    def split_of_sample(self, sample: str) -> str:
        """Split that holds ``sample``. Raises `DatasetError` for an unknown sample."""
        return self._find(sample)[0]

    def measured(self, sample: str) -> dict:
        """The builder's measurements of a sample: labels, cover, distance, and the ground-truth
        error if available."""
        split, row = self._find(sample)
        return self.manifest.samples[split][row]

    def samples_by_object(self, split: str) -> dict[str, list[str]]:
        """The samples of each object of ``split``, in the order of `samples`."""
        views: dict[str, list[str]] = {}
        for sample in self.samples(split):
            views.setdefault(self.measured(sample)["object"], []).append(sample)
        return views

    def _find(self, sample: str) -> tuple[str, int]:
        if sample not in self._position:
            raise DatasetError(
                f"{self.path}: no sample {sample!r}; {did_you_mean(sample, self._position)}"
            )
        return self._position[sample]

    def depth_mm(self, sample: str, column: str = DEPTH) -> NDArray[np.float32]:
        """Depth map of a sample, float32 (H, W) in mm, 0 = background: ``depth``, or
        ``depth_exact`` if stored."""
        if column not in DEPTHS:
            raise DatasetError(
                f"unknown depth column {column!r}; there are {DEPTH} and {DEPTH_EXACT}"
            )
        if column == DEPTH_EXACT and not self.has_exact:
            raise DatasetError(
                f"{self.path}: has no {DEPTH_EXACT} ({self.manifest.origin} data); use {DEPTH}"
            )
        return self._image(sample, DATA_GROUP, column)

    def flags(self, sample: str) -> NDArray[np.uint8]:
        """What is special about each pixel: bits of `loaders.sample.Flag`, uint8 (H, W); of
        generated data."""
        if not self.has_exact:
            raise DatasetError(f"{self.path}: has no {FLAGS} ({self.manifest.origin} data)")
        return self._image(sample, DATA_GROUP, FLAGS)

    @property
    def real_set(self) -> str | None:
        """Name of the set of public captures that it was imported as (`captures.real`)."""
        described = self.manifest.settings.get("set")
        return printable(str(described["name"]), 100) if isinstance(described, dict) else None

    def void(self, sample: str, column: str = DEPTH) -> NDArray[np.bool_]:
        """Pixels that count in no score against ``column``, bool (H, W): of ``depth_exact``
        `exact_void`, of ``depth`` `void_pixels`, with surface that has no decoded depth. In data
        without flags all that is not decoded of a real set (`captures.real`), else none."""
        if not self.has_exact:
            if self.manifest.settings.get("undecoded") == "void":
                return self.depth_mm(sample) == 0
            return np.zeros(self.size, dtype=bool)
        if column == DEPTH_EXACT:
            return exact_void(self.flags(sample))
        return void_pixels(
            self.flags(sample), self.depth_mm(sample), self.depth_mm(sample, DEPTH_EXACT)
        )

    def left_out(
        self, sample: str, rule: RangeRule, column: str = DEPTH
    ) -> NDArray[np.bool_] | None:
        """Pixels that the depth range by ``rule`` leaves out of ``column``, bool (H, W), None for
        none: the void ones; and of the exact depth what has no decoded one, because methods are
        given the range of ``depth``."""
        if rule == "valid":
            return self.void(sample)
        return ~object_mask(self.depth_mm(sample)) if column == DEPTH_EXACT else None

    def unlit_mm(self, sample: str) -> NDArray[np.float32]:
        """Exact depth of the surface that the camera sees and the projector does not light, or too
        weakly (`Flag`), float32 (H, W) in mm, 0 everywhere else. Raises `DatasetError` for data
        without flags."""
        unlit = (self.flags(sample) & np.uint8(Flag.UNLIT | Flag.WEAK)) != 0
        return np.where(unlit, self.depth_mm(sample, DEPTH_EXACT), np.float32(0))

    def frame(self, sample: str, index: int) -> NDArray[np.uint8]:
        """One captured frame, uint8 (H, W). Raises `DatasetError` when the dataset does not store
        it."""
        for group, frames in self.manifest.groups.items():
            if index in frames:
                return self._image(sample, group, self.sequence.frames[index].column)
        raise DatasetError(
            f"{self.path}: frame {index} is not stored here (configurations: "
            f"{', '.join(self.configs)}); build with "
            "--config all"
        )

    def frames(self, sample: str, indices: Iterable[int]) -> list[NDArray[np.uint8]]:
        """Several frames of a sample, each uint8 (H, W), in the order of ``indices``."""
        return [self.frame(sample, index) for index in indices]

    def release(self, sample: str) -> None:
        """Release the memory of a sample's images that were read. Arrays in use stay valid."""
        if self._latest[0] == sample:
            self._latest = "", {}

    def _image(self, sample: str, group: str, column: str) -> NDArray:
        if self._latest[0] != sample:
            self._latest = sample, {}
        images = self._latest[1]  # other threads may be at other samples
        if column not in images:
            split, row = self._find(sample)
            if column in self._hidden(split):
                raise DatasetError(
                    f"{self.path}: {column} of {sample} is truth of the {split} split, and methods "
                    f"are given that of "
                    f"the {TRAIN} split alone; open the dataset outside the method to look at it"
                )
            for shard in self.manifest.shards:
                if (
                    shard.split == split
                    and shard.group == group
                    and 0 <= row - shard.first_row < shard.rows
                ):
                    images[column] = self.opened(shard).image(column, row - shard.first_row)
                    break
            else:
                raise DatasetError(
                    f"{self.path}: no file holds row {row} of {group} in {split}; run: fpp-bench "
                    f"verify"
                )
        return images[column]

    def opened(self, shard: ShardFile) -> "OpenShard":
        """A file of the dataset, opened for reading."""
        if shard.path not in self._opened:
            self._opened[shard.path] = OpenShard(
                self.path / shard.path, self.size, self._hidden(shard.split)
            )
        return self._opened[shard.path]

    def _hidden(self, split: str) -> tuple[str, ...]:
        """The columns of ``split`` that are not given."""
        return () if self.truth or split == TRAIN else TRUTH


class OpenShard:
    """An Arrow file, of whose columns parts are read, but ``hidden`` ones: ``types`` are
    `stored_types`, and ``rows`` are those of the file. Raises `DatasetError` naming the file where
    it can't be read.

    It is read and not mapped: a mapped file that is cut meanwhile would end the process (SIGBUS).
    And every length and offset in it is compared with the file and the images' ``size`` (H, W)
    before anything follows it."""

    def __init__(self, path: Path, size: tuple[int, int], hidden: Collection[str] = ()) -> None:
        import pyarrow as pa

        self.path, self._size = path, size
        self._parts: dict[str, list[tuple[int, list[tuple[int, int]]]]] = {}
        """Of each column and record batch its rows, and its buffers' places in the file, each a
        start and bytes."""
        self._starts: dict[str, list[tuple[int, int]]] = {}
        try:
            with opened(path, links=True) as (stream, _):
                self._file = os.dup(stream.fileno())
            weakref.finalize(self, os.close, self._file)
            skeleton = _Skeleton(self._file)
            plain = pa.ipc.IpcReadOptions(use_threads=False, ensure_native_endian=False)
            batches = list(pa.ipc.open_stream(pa.PythonFile(skeleton, mode="r"), options=plain))
            for batch in batches:
                for name, column in zip(batch.schema.names, batch.columns, strict=True):
                    if name in hidden:
                        continue
                    buffers = [skeleton.place(buffer) for buffer in column.buffers()]
                    self._parts.setdefault(name, []).append((batch.num_rows, buffers))
        except (pa.ArrowException, PredictionError, OSError, ValueError) as error:
            raise DatasetError(
                f"{path}: can't be read as Arrow ({error}); run: fpp-bench verify"
            ) from error
        self.rows = sum(batch.num_rows for batch in batches)
        types = stored_types(batches[0].schema) if batches else []
        self.types = [(name, kind) for name, kind in types if name not in hidden]

    def image(self, column: str, row: int) -> NDArray:
        """The image of a row of the file, uint8 or float32 (H, W), read only."""
        height, width = self._size
        dtype = self._dtype(column)
        for rows, start in self._images(column):
            if row < rows:
                pixels = self._read(
                    start + row * height * width * dtype.itemsize, height * width, dtype
                )
                return pixels.reshape(self._size)
            row -= rows
        raise DatasetError(f"{self.path}: fewer rows than its manifest says; run: fpp-bench verify")

    def column(self, name: str, first: int, rows: int) -> "pa.Array":
        """So many rows from ``first`` on of a column, as they are stored."""
        import pyarrow as pa

        from fpp_ml_bench.loaders.storage.shards import (
            image_column,
        )  # imports pyarrow, which takes 0.2 s

        kind = dict(self.types)[name]
        if pa.types.is_list(kind):
            return image_column(
                np.stack([self.image(name, row) for row in range(first, first + rows)]), kind
            )
        parts = []
        for count, places in self._parts[name]:
            buffers = [pa.py_buffer(self._read(*place, np.dtype(np.uint8))) for place in places]
            try:
                array = pa.Array.from_buffers(
                    kind, count, [buffer if buffer.size else None for buffer in buffers]
                )
                array.validate(full=True)
            except (pa.ArrowException, ValueError) as error:
                raise self._fault(name, f"leads behind its end or is damaged ({error})") from error
            parts.append(array)
        return pa.concat_arrays(parts).slice(first, rows)

    def check(self) -> None:
        """Raise `DatasetError` for a length or an offset that leads elsewhere, in any column."""
        for name, _ in self.types:
            self._images(name) if name not in (*LABELS, *RANGE) else self.column(name, 0, self.rows)

    def _dtype(self, column: str) -> np.dtype:
        import pyarrow as pa

        kind = dict(self.types).get(column)
        for dtype in (np.dtype(np.uint8), np.dtype(np.float32)):
            if kind == pa.list_(pa.list_(pa.from_numpy_dtype(dtype))):
                return dtype
        raise self._fault(column, "is missing or holds no images")

    def _images(self, column: str) -> list[tuple[int, int]]:
        """Rows of each batch, and where in the file the first one's pixels begin."""
        if column not in self._starts:
            (height, width), dtype, index = self._size, self._dtype(column), np.dtype(np.int32)
            starts = []
            for rows, (_, outer, _, inner, _, (start, size)) in self._parts[column]:
                lists, pixels = (
                    ((outer, rows, height), (inner, rows * height, width)),
                    rows * height * width,
                )
                fits = size >= pixels * dtype.itemsize and all(
                    size >= (count + 1) * index.itemsize
                    and np.array_equal(
                        self._read(at, count + 1, index), np.arange(count + 1) * length
                    )
                    for (at, size), count, length in lists
                )
                if not fits:
                    raise self._fault(column, f"does not hold images of {height} x {width} px")
                starts.append((rows, start))
            self._starts[column] = starts
        return self._starts[column]

    def _read(self, start: int, count: int, dtype: np.dtype) -> NDArray:
        values = np.empty(count, dtype)
        view, done = memoryview(values.view(np.uint8).data), 0
        while done < len(view):
            try:
                length = os.preadv(self._file, [view[done:]], start + done)
            except OSError as error:
                raise DatasetError(f"{self.path}: can't be read ({cause_of(error)})") from error
            if not length:
                cut = f"was cut to {os.fstat(self._file).st_size} bytes while it was read"
                raise DatasetError(f"{self.path}: {cut}; build or copy the dataset again")
            done += length
        values.flags.writeable = False
        return values

    def _fault(self, column: str, problem: str) -> DatasetError:
        return DatasetError(f"{self.path}: column {column} {problem}; run: fpp-bench verify")


def stored_types(schema: "pa.Schema") -> "list[tuple[str, pa.DataType]]":
    """Columns and what they are stored as, whether or not `datasets` has registered its array
    extension."""
    return [(field.name, getattr(field.type, "storage_type", field.type)) for field in schema]


class _Skeleton(io.RawIOBase):
    """A file for pyarrow, which reads its metadata. In the place of a large body it gets memory
    that holds nothing and takes none: from where the buffers of its columns begin in it, `place`
    tells where they are in the file."""

    def __init__(self, file: int) -> None:
        self._file, self._size, self._position = file, os.fstat(file).st_size, 0
        self._given: list[tuple[NDArray[np.uint8], int, int]] = []
        """What pyarrow was given, its address in memory, and its place in the file."""

    def readable(self) -> bool:
        return True

    def read(self, count: int = -1) -> Any:
        count = min(count, max(self._size - self._position, 0))
        if count <= _METADATA_BYTES:
            content: Any = os.pread(self._file, count, self._position)
        else:
            content = mmap.mmap(
                -1, count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, prot=mmap.PROT_READ
            )
        given = np.frombuffer(content, np.uint8)
        self._given.append((given, given.ctypes.data, self._position))
        self._position += len(content)
        return content

    def place(self, buffer: "pa.Buffer | None") -> tuple[int, int]:
        """Where in the file a buffer begins, and its bytes, 0 for none. ValueError for one that the
        file lacks."""
        if buffer is None or not buffer.size:
            return 0, 0
        for content, address, position in self._given:
            start = buffer.address - address
            if start >= 0 and start + buffer.size <= len(content):
                return position + start, buffer.size
        raise ValueError("a buffer that is compressed, or leads elsewhere")


def load_dataset(
    folder: str | Path, config: str = "single_shot", split: str | None = None
) -> "Dataset | DatasetDict":
    """Open a dataset folder as a ``datasets.Dataset`` on the memory-mapped shards.

    Parameters
    ----------
    folder : str or Path
        Dataset written by ``fpp-bench build`` or ``fpp-bench import``.
    config : {"single_shot", "crossed", "first_frames", "horizontal", "vertical", "sinusoidal",
        "all"}
        Which frames: the first one, the crossed ones of a rig that has them, these and the first of each
        direction, those of a direction, all sinusoids, or the whole sequence.
    split : {"train", "validation", "test"}, optional
        None for all of them, as a ``DatasetDict``.

    Returns
    -------
    datasets.Dataset or datasets.DatasetDict
        Columns ``sample``, ``object``, ``view``, ``split``; a uint8 (H, W) column ``frame_NN`` for each frame;
        ``depth`` and, for generated data, ``depth_exact`` (float32 (H, W), mm, 0 = background); ``depth_min`` and
        ``depth_max`` (mm).

    Raises
    ------
    DatasetError
        For a folder that is no finished dataset, and for an unknown or unstored configuration or split.

    Examples
    --------
    >>> import fpp_ml_bench as fpp
    >>> test = fpp.load_dataset("data/mini", "single_shot", split="test")
    >>> row = test.with_format("numpy")[0]
    >>> row["frame_00"].shape == row["depth"].shape
    True
    """
    dataset = DatasetFolder(folder)
    if config not in CONFIGS:
        raise DatasetError(f"unknown configuration {config!r}; there are {', '.join(CONFIGS)}")
    if config not in dataset.configs:
        raise DatasetError(
            f"{folder}: configuration {config!r} is not stored; this dataset has "
            f"{', '.join(dataset.configs)}. Build "
            f"it with --config {config} or --config all"
        )
    if split is not None:
        dataset.samples(split)
        if split not in dataset.splits:
            raise DatasetError(
                f"split {split!r}: expected one of {', '.join(dataset.splits)}, or None for all"
            )
        return _joined_split(dataset, config, split)
    from datasets import DatasetDict

    return DatasetDict({name: _joined_split(dataset, config, name) for name in dataset.splits})


def _joined_split(dataset: DatasetFolder, config: str, split: str) -> "Dataset":
    from datasets import Dataset, DatasetInfo, Features
    from datasets.splits import NamedSplit
    from datasets.table import ConcatenationTable, MemoryMappedTable, concat_tables

    columns = config_columns(dataset.sequence, config, dataset.has_exact)
    tables = []
    for group in dataset.manifest.groups:
        shards = [s for s in dataset.manifest.shards if s.split == split and s.group == group]
        for shard in shards:
            dataset.opened(shard).check()  # `datasets` trusts the offsets in a file
        files = [MemoryMappedTable.from_file(str(dataset.path / shard.path)) for shard in shards]
        names = [name for name in files[0].column_names if name in columns]
        if names:
            tables.append(concat_tables([file.select(names) for file in files], axis=0))
    table = tables[0] if len(tables) == 1 else ConcatenationTable.from_tables(tables, axis=1)
    described = Features.from_dict(layout.features(columns, dataset.size))
    info = DatasetInfo(features=described, config_name=config, dataset_name="fpp-ml-bench")
    # `datasets` caches later transforms by this fingerprint: it depends on the data, not on the
    # path.
    fingerprint = f"{dataset.fingerprint[:16]}-{config}-{split}"
    return Dataset(
        table.select(columns), info=info, split=NamedSplit(split), fingerprint=fingerprint
    )
