"""A dataset as Parquet: one file per shard with all columns, so no pixel is stored twice, and a
reader reads no others.

Two forms of the same rows. `write_parquet` exports arrays, from which ``datasets.load_dataset(OUT,
CONFIG)`` opens every configuration: frames are dictionary-coded bytes. `write_shard` writes what
the Hub's viewer shows: frames are ``Image`` columns of PNG, which is lossless, and
``depth_preview`` is a small picture for people. In both, depth is an Array2D of float32, the same
bits, whose bytes are split by significance, which suits smooth floats. Only one row group of a file
is in memory at a time.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fpp_ml_bench.containers import png_bytes
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.files import whole_file, write_atomically
from fpp_ml_bench.loaders import sample as layout
from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTH,
    DEPTHS,
    LABELS,
    PIXEL_MAPS,
    PREVIEW,
    RANGE,
    config_columns,
)
from fpp_ml_bench.loaders.storage.card import card, card_config, default_licence
from fpp_ml_bench.loaders.storage.croissant import FILE as CROISSANT_FILE
from fpp_ml_bench.loaders.storage.croissant import croissant
from fpp_ml_bench.loaders.storage.manifest import ShardFile, damage_of
from fpp_ml_bench.loaders.storage.shards import arrow_schema
from fpp_ml_bench.loaders.storage.store import DatasetFolder

PREVIEW_PX = 240
"""Longest side of a preview."""
_NEAREST, _FARTHEST = 255, 64
_SHOWN = 4
_GROUP_BYTES, _VIEWER_GROUP_BYTES = 1 << 28, 200_000_000
"""Raw bytes of a row group; the Hub's viewer reads whole groups and refuses those above 286 MiB."""
_MOST_ROWS_PER_GROUP = 24
_LEVEL = 3
"""Of zstd: a fifth smaller than level 1, hardly slower; level 6: 7% smaller, 1.5 times the time."""
_LEAF = ".list.element.list.element"
_TEXT = """\
Exported from the dataset with fingerprint
`{fingerprint}`.

```python
import datasets
train = datasets.load_dataset("THIS FOLDER", "{config}", split="{split}")
```

Configurations: {names}. A configuration reads only its own columns.
"""


def columns(dataset: DatasetFolder, config: str | None = None) -> list[str]:
    """Columns of a configuration as published, or of the files (None): those of the dataset, and
    the preview."""
    names = (
        dataset.manifest.columns()
        if config is None
        else config_columns(dataset.sequence, config, dataset.has_exact)
    )
    place = names.index(DEPTH)
    return [*names[:place], PREVIEW, *names[place:]]


def card_configs(
    dataset: DatasetFolder, identity: str, files: Mapping[str, object], preview: bool
) -> list[Any]:
    """The configurations as a card lists them; ``files`` are a pattern or names for each split."""
    configs = []
    for config in dataset.configs:
        names = [name for name in columns(dataset, config) if preview or name != PREVIEW]
        described = card_config(config, identity, files, default=config == dataset.configs[0])
        configs.append({**described, "columns": names})
    return configs


def data_shards(dataset: DatasetFolder) -> dict[str, ShardFile]:
    """Path of every Parquet file below the export or repository, and the shard whose rows it
    holds."""
    shards = [shard for shard in dataset.manifest.shards if shard.group == DATA_GROUP]
    return {
        f"data/{shard.split}-{Path(shard.path).stem.removeprefix(f'{DATA_GROUP}-')}.parquet": shard
        for shard in shards
    }


def write_parquet(
    dataset: DatasetFolder,
    folder: Path,
    splits: list[str],
    threads: int,
    rows_done: Callable[[int], None],
) -> None:
    """Write ``splits`` of a dataset into ``folder``: Parquet under ``data/`` and the card that
    opens it. Raises ``OSError`` when the disk can't be written. Each thread writes a shard and
    holds one of its row groups in memory."""
    (folder / "data").mkdir(parents=True, exist_ok=True)
    files = [
        (folder / name, shard)
        for name, shard in data_shards(dataset).items()
        if shard.split in splits
    ]
    with ThreadPoolExecutor(threads) as pool:  # the first error cancels what has not begun
        list(pool.map(lambda file: write_shard(dataset, file[1], file[0], rows_done), files))
    # Exports of the same dataset with different splits must not share a cache entry.
    identity = sha256(" ".join([dataset.fingerprint, *splits]).encode()).hexdigest()
    configs = card_configs(
        dataset, identity, {split: f"data/{split}-*.parquet" for split in splits}, preview=False
    )
    names = ", ".join(f"`{config}`" for config in dataset.configs)
    text = _TEXT.format(
        fingerprint=dataset.fingerprint, config=dataset.configs[0], split=splits[0], names=names
    )
    rows = sum(len(dataset.samples(split)) for split in splits)
    described = layout.features(
        [name for name in columns(dataset) if name != PREVIEW], dataset.size
    )
    licence = default_licence(dataset.manifest)
    metadata = croissant(dataset.manifest, described, splits, licence)
    write_atomically(folder / CROISSANT_FILE, metadata)
    write_atomically(folder / "README.md", card(dataset.manifest, configs, ", Parquet", rows, text))


def write_shard(
    dataset: DatasetFolder,
    shard: ShardFile,
    out: Path,
    done: Callable[[int], None],
    picture_threads: int | None = None,
) -> None:
    """Write the rows of one data shard, all columns: arrays, or with ``picture_threads``, by so
    many threads, what the Hub's viewer shows. The file appears complete or not at all. Raises
    `DatasetError` where a file of the dataset no longer has its checksum, ``OSError`` for a failed
    write."""
    parts = [
        part
        for part in dataset.manifest.shards
        if (part.split, part.first_row) == (shard.split, shard.first_row)
    ]
    for part in parts:
        if damage := damage_of(dataset.path, part):
            raise DatasetError(damage)
    viewer = picture_threads is not None
    names = columns(dataset) if viewer else dataset.manifest.columns()
    pictures = [name for name in names if viewer and (name == PREVIEW or name.startswith("frame_"))]
    schema = arrow_schema(published_features(dataset) if viewer else dataset.manifest.features())
    stored = {
        name: file
        for file in map(dataset.opened, [shard] if viewer else parts)
        for name, _ in file.types
    }
    samples = dataset.splits[shard.split][shard.first_row : shard.first_row + shard.rows]
    group_bytes = _VIEWER_GROUP_BYTES if viewer else _GROUP_BYTES
    rows = max(1, min(_MOST_ROWS_PER_GROUP, group_bytes // dataset.manifest.row_bytes))
    out.parent.mkdir(parents=True, exist_ok=True)
    try:
        with (
            whole_file(out) as file,
            ThreadPoolExecutor(picture_threads) as pool,
            pq.ParquetWriter(file, schema, **_settings(names, pictures, viewer)) as writer,
        ):
            for first in range(0, len(samples), rows):
                group = samples[first : first + rows]
                cells = {
                    name: file.column(name, first, len(group)) for name, file in stored.items()
                }
                for name in pictures:
                    contents = pool.map(partial(_png, dataset, column=name), group)
                    encoded = [{"bytes": content, "path": None} for content in contents]
                    cells[name] = pa.array(encoded, schema.field(name).type)
                table = pa.Table.from_arrays([cells[name] for name in names], schema=schema)
                writer.write_table(table, row_group_size=len(group))
                done(len(group))
    except pa.ArrowException as error:
        raise OSError(f"{out.name}: {error}") from error
    finally:
        for part in parts:
            dataset.forget(part)  # else the files of all shards would stay open


def _settings(names: list[str], pictures: list[str], viewer: bool) -> dict[str, Any]:
    """How columns are packed. The range of grey levels of an image is of no use to a reader; a PNG
    is compressed."""
    depths = [name + _LEAF for name in names if name in DEPTHS]
    values = [name for name in names if name in (*LABELS, *RANGE)]
    packed = {
        "use_content_defined_chunking": True,  # a changed row changes few bytes on the Hub
        "write_page_index": True,
        "compression_level": _LEVEL,
        "column_encoding": dict.fromkeys(depths, "BYTE_STREAM_SPLIT"),
    }
    if not viewer:
        images = [name + _LEAF for name in names if name not in (*values, *DEPTHS)]
        return {
            **packed,
            "compression": "zstd",
            "use_dictionary": [*LABELS, *images],
            "write_statistics": values,
        }
    plain = [*values, *(name + _LEAF for name in names if name in PIXEL_MAPS)]
    compressed = [*plain, *depths]
    whole = [f"{name}.{part}" for name in pictures for part in ("bytes", "path")]
    return {
        **packed,
        "compression_level": dict.fromkeys(compressed, _LEVEL),
        "compression": {**dict.fromkeys(compressed, "zstd"), **dict.fromkeys(whole, "none")},
        "use_dictionary": list(LABELS),
        "write_statistics": plain,
    }


def published_features(dataset: DatasetFolder) -> dict[str, dict[str, Any]]:
    """The `columns` of the files as published, as `sample.features`; frames and preview are
    images."""
    names = columns(dataset)
    pictures = {
        name: {"_type": "Image"} for name in names if name == PREVIEW or name.startswith("frame_")
    }
    return {**layout.features(names, dataset.size), **pictures}


def _png(dataset: DatasetFolder, sample: str, column: str) -> bytes:
    """A frame, or the preview, as PNG. Noisy fringes have no repetition to search for: with Huffman
    coding alone the files are 22% smaller than at OpenCV's level 1, and decode 1.7 times as fast
    (measured)."""
    depth = column == PREVIEW
    image = (
        preview(dataset.depth_mm(sample))
        if depth
        else dataset.frame(sample, int(column.removeprefix("frame_")))
    )
    return png_bytes(image, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)


def preview(depth_mm: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Picture of a depth map float32 (H, W) in mm: uint8, at most `PREVIEW_PX` a side; nearest
    white, background black. Scaled to the object's own range, so it is for looking only."""
    step = -(-max(depth_mm.shape) // PREVIEW_PX)
    small = depth_mm[::step, ::step].astype(np.float64)
    inside = object_mask(small)
    if not inside.any():
        return np.zeros(small.shape, dtype=np.uint8)
    near, far = small[inside].min(), small[inside].max()
    share = (small - near) / max(far - near, np.finfo(np.float64).tiny)
    return np.where(inside, np.rint(_NEAREST - share * (_NEAREST - _FARTHEST)), 0).astype(np.uint8)


def overview(dataset: DatasetFolder) -> bytes:
    """PNG of the first views of up to `_SHOWN` objects: the first frame above the depth, near
    yellow and far blue."""
    first_views = {
        row["object"]: row["sample"]
        for rows in dataset.manifest.samples.values()
        for row in reversed(rows)
    }
    panels = []
    for sample in list(first_views.values())[-_SHOWN:]:
        shades = preview(dataset.depth_mm(sample))
        frame = np.asarray(dataset.frame(sample, dataset.sequence.config("single_shot")[0]))
        small = cv2.resize(frame, shades.shape[::-1], interpolation=cv2.INTER_AREA)
        share = np.clip((shades.astype(float) - _FARTHEST) / (_NEAREST - _FARTHEST), 0, 1)
        depth = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)
        depth[shades == 0] = 0
        panels.append(np.vstack([cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), depth]))
    return png_bytes(np.hstack(panels))
