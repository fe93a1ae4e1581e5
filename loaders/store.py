"""Reading a dataset folder by memory map: zero-copy views of single images, with nothing but NumPy and pyarrow loaded.

This is what the evaluator, the classical method, the torch dataset and the pictures read through.
`fpp_ml_bench.load_dataset` opens the same files as a ``datasets.Dataset``.
"""

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import SPLITS
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.frames import Sequence
from fpp_ml_bench.loaders.manifest import Manifest, ShardFile, read_manifest
from fpp_ml_bench.loaders.schema import DATA_GROUP, DEPTH, DEPTH_EXACT, available_configs, stored_groups
from fpp_ml_bench.pixel_sets import object_mask

if TYPE_CHECKING:
    import pyarrow as pa

    from fpp_ml_bench.rig import Rig

ALL_SPLITS = "all"


class DatasetFolder:
    """A finished dataset folder, built or imported. Raises `DatasetError` for any other folder.

    Images come out as read-only memory-mapped views: a frame costs what is read of it. Instances pickle by path, so
    worker processes map the files anew.
    """

    def __init__(self, path: str | Path) -> None:
        self._hold(Path(path), read_manifest(Path(path)))
        for shard in self.manifest.shards:
            file = self.path / shard.path
            size = file.stat().st_size if file.is_file() else None
            if size != shard.bytes:
                came = "it is missing" if size is None else f"it has {size}"
                raise DatasetError(f"{file}: expected {shard.bytes} bytes, {came}; build or copy the dataset again")

    def _hold(self, path: Path, manifest: Manifest) -> None:
        self.path = path
        self.manifest = manifest
        self._batches: dict[str, list[pa.RecordBatch]] = {}
        self._images: dict[tuple[str, str], list[NDArray]] = {}
        self._maps: dict[str, pa.Buffer] = {}

    @classmethod
    def unchecked(cls, path: Path, manifest: Manifest) -> "DatasetFolder":
        """The folder opened although some of its files may be missing; for `fpp_ml_bench.loaders.verify`."""
        opened = cls.__new__(cls)
        opened._hold(path, manifest)
        return opened

    def forget(self, shard: ShardFile) -> None:
        """Let go of the maps of one file."""
        self._batches.pop(shard.path, None)
        self._maps.pop(shard.path, None)
        for key in [key for key in self._images if key[0] == shard.path]:
            del self._images[key]

    def __reduce__(self) -> tuple[type["DatasetFolder"], tuple[Path]]:
        return DatasetFolder, (self.path,)

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the data's content, 64 hex digits."""
        return self.manifest.fingerprint

    @property
    def size(self) -> tuple[int, int]:
        """Image height and width in px."""
        return self.manifest.size

    @cached_property
    def rig(self) -> "Rig":
        """The rig whose camera took the images."""
        from fpp_ml_bench.rig_io import rig_from_dict

        return rig_from_dict(self.manifest.rig)

    @cached_property
    def sequence(self) -> Sequence:
        return Sequence(**self.manifest.rig["sequence"])

    @property
    def configs(self) -> tuple[str, ...]:
        """Configurations whose frames are stored here."""
        return available_configs(self.sequence, self.manifest.stored)

    @property
    def has_exact(self) -> bool:
        """Whether ``depth_exact`` is known (generated data; published data has decoded depth only)."""
        return self.manifest.exact

    @cached_property
    def splits(self) -> dict[str, list[str]]:
        """Sample names of each split in row order."""
        return self.manifest.splits

    @cached_property
    def _place(self) -> dict[str, tuple[str, int]]:
        return {sample: (split, row) for split, names in self.splits.items() for row, sample in enumerate(names)}

    def samples(self, split: str) -> list[str]:
        """Sample names of ``split``, or of every split in turn for ``all``. Raises `DatasetError` for another name."""
        if split == ALL_SPLITS:
            return [name for part in SPLITS for name in self.splits.get(part, [])]
        if split not in self.splits:
            raise DatasetError(f"{self.path}: no split {split!r}; there are {', '.join(self.splits)} and {ALL_SPLITS}")
        return list(self.splits[split])

    def split_of_sample(self, sample: str) -> str:
        """Split that holds ``sample``. Raises `DatasetError` for an unknown sample."""
        return self._find(sample)[0]

    def measured(self, sample: str) -> dict:
        """What the builder measured of a sample: labels, cover, distance, ground-truth error where known."""
        split, row = self._find(sample)
        return self.manifest.samples[split][row]

    def _find(self, sample: str) -> tuple[str, int]:
        if sample not in self._place:
            from difflib import get_close_matches

            near = get_close_matches(sample, self._place, n=3)
            hint = f"; near it: {', '.join(near)}" if near else ""
            raise DatasetError(f"{self.path}: no sample {sample!r}{hint}")
        return self._place[sample]

    def depth_mm(self, sample: str, column: str = DEPTH) -> NDArray[np.float32]:
        """Depth map of a sample, float32 (H, W) in mm, 0 = background: ``depth``, or ``depth_exact`` where known."""
        if column not in (DEPTH, DEPTH_EXACT):
            raise DatasetError(f"no depth column is called {column!r}; there are {DEPTH} and {DEPTH_EXACT}")
        if column == DEPTH_EXACT and not self.has_exact:
            raise DatasetError(f"{self.path}: has no {DEPTH_EXACT} ({self.manifest.origin} data); use {DEPTH}")
        return self._image(sample, DATA_GROUP, column)

    def target_mm(self, sample: str, column: str = DEPTH) -> NDArray[np.float32]:
        """What a prediction is scored against, float32 (H, W) in mm, 0 = background.

        The object is the same set of pixels for either column, those with a decoded ``depth``: a surface that the
        projector does not reach has no ground truth in this benchmark. ``depth_exact`` only gives them exact values.
        """
        depth_mm = self.depth_mm(sample)
        if column == DEPTH:
            return depth_mm
        return np.where(object_mask(depth_mm), self.depth_mm(sample, column), np.float32(0))

    def frame(self, sample: str, index: int) -> NDArray[np.uint8]:
        """One captured frame, uint8 (H, W). Raises `DatasetError` when the dataset does not store it."""
        for group, frames in stored_groups(self.sequence, self.manifest.stored).items():
            if index in frames:
                return self._image(sample, group, self.sequence.frames[index].column)
        raise DatasetError(
            f"{self.path}: frame {index} is not stored here (configurations: {', '.join(self.configs)}); build with "
            "--frames all"
        )

    def frames(self, sample: str, indices: "tuple[int, ...] | range | list[int]") -> list[NDArray[np.uint8]]:
        """Several frames of a sample, each uint8 (H, W), in the order asked."""
        return [self.frame(sample, index) for index in indices]

    def release(self, sample: str) -> None:
        """Let go of the memory of a sample's images, those that were read. Views of them stay valid.

        Whoever goes through a split calls it after each sample, and his memory does not grow with their number.
        """
        from fpp_ml_bench.loaders.mapped_pages import let_go

        split, row = self._find(sample)
        for shard in self.manifest.shards:
            whole = self._maps.get(shard.path)
            if whole is None or shard.split != split or not 0 <= row - shard.first_row < shard.rows:
                continue
            for column in self.record_batches(shard)[0].schema.names:
                if (shard.path, column) in self._images:
                    let_go(self._row_of(shard, column, row), whole.address, whole.size)
            if row - shard.first_row == shard.rows - 1:
                self.forget(shard)  # what stands between its images stays mapped as long as the file is

    def _image(self, sample: str, group: str, column: str) -> NDArray:
        split, row = self._find(sample)
        return self._row_of(self._shard(split, group, row), column, row)

    def _row_of(self, shard: ShardFile, column: str, row: int) -> NDArray:
        """Image of row ``row`` of the split in one of its files."""
        row -= shard.first_row
        for images in self.column_images(shard, column):
            if row < len(images):
                return images[row]
            row -= len(images)
        raise DatasetError(f"{self.path / shard.path}: fewer rows than its manifest says; run: fpp-bench verify")

    def _shard(self, split: str, group: str, row: int) -> ShardFile:
        for shard in self.manifest.shards:
            if shard.split == split and shard.group == group and 0 <= row - shard.first_row < shard.rows:
                return shard
        raise DatasetError(f"{self.path}: no file holds row {row} of {group} in {split}; run: fpp-bench verify")

    def record_batches(self, shard: ShardFile) -> "list[pa.RecordBatch]":
        """Record batches of one file, memory-mapped."""
        if shard.path not in self._batches:
            import pyarrow as pa

            path = self.path / shard.path
            try:
                mapped = pa.memory_map(str(path), "r")
                whole = mapped.read_buffer()
                self._batches[shard.path] = list(pa.ipc.open_stream(whole))
                self._maps[shard.path] = whole
            except (pa.ArrowException, OSError) as error:
                raise DatasetError(f"{path}: can't be read as Arrow ({error}); run: fpp-bench verify") from error
        return self._batches[shard.path]

    def column_images(self, shard: ShardFile, column: str) -> list[NDArray]:
        """A column of one file as images: per record batch one read-only view (rows, H, W)."""
        key = shard.path, column
        if key not in self._images:
            try:
                self._images[key] = [self._views(batch.column(column)) for batch in self.record_batches(shard)]
            except (ValueError, KeyError, AttributeError) as error:
                height, width = self.size
                raise DatasetError(
                    f"{self.path / shard.path}: column {column} does not hold images of {height} x {width} px "
                    f"({error}); run: fpp-bench verify"
                ) from error
        return self._images[key]

    def _views(self, column: "pa.Array") -> NDArray:
        storage = getattr(column, "storage", column)  # an Array2D extension where `datasets` has been imported
        flat = storage.values.values
        dtype = np.dtype(np.uint8 if flat.type.bit_width == 8 else np.float32)
        # Not flat.to_numpy(): that imports pandas where it is installed, which takes longer than scoring a test split.
        pixels = np.frombuffer(flat.buffers()[1], dtype, len(flat), flat.offset * dtype.itemsize)
        return pixels.reshape(len(storage), *self.size)
