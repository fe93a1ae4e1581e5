"""Exporting a dataset as Parquet, from which plain ``datasets.load_dataset(OUT, CONFIG)`` opens every configuration.

There is one file per shard with all columns, so no pixel is stored twice. The card's ``columns:`` list the columns of
each configuration, and a reader of Parquet reads no others. Compression is zstd; frames are dictionary-coded bytes, and
depth has its bytes split by significance, which suits smooth floats.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.loaders.sample import (
    DATA_GROUP,
    DEPTH,
    DEPTH_EXACT,
    LABELS,
    RANGE,
    arrow_schema,
    config_columns,
    stored_frames,
)
from fpp_ml_bench.loaders.storage.card import CARD_HEAD, data_version
from fpp_ml_bench.loaders.storage.manifest import Manifest, ShardFile
from fpp_ml_bench.loaders.storage.store import DatasetFolder

if TYPE_CHECKING:
    import pyarrow as pa

ROW_GROUP_BYTES = 1 << 28
"""Rows are written, and read by ``datasets``, in groups of about this size before compression."""
_MOST_ROWS_PER_GROUP = 24
_CARD = """\
{configs}
---
# FPP-ML-Bench dataset ({origin}), Parquet

{rows} samples of {height} x {width} px; depth in mm, 0 = background. Exported from the dataset with fingerprint
`{fingerprint}`.

```python
import datasets
train = datasets.load_dataset("THIS FOLDER", "{config}", split="{split}")
```

Configurations: {names}. A configuration reads only its own columns.
"""


def write_parquet(
    dataset: DatasetFolder, folder: Path, splits: list[str], threads: int = 1,
    rows_done: Callable[[int], None] = lambda rows: None,
) -> None:  # fmt: skip
    """Write ``splits`` of a dataset into ``folder``: Parquet under ``data/`` and the card that opens it.

    Raises ``OSError`` when the disk can't be written. Each thread writes a shard and holds one of its row groups in
    memory.
    """
    manifest = dataset.manifest
    shards = [shard for shard in manifest.shards if shard.group == DATA_GROUP and shard.split in splits]
    (folder / "data").mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(threads) as pool:
        jobs = []
        for shard in shards:
            stem = Path(shard.path).stem.removeprefix(f"{DATA_GROUP}-")
            path = folder / "data" / f"{shard.split}-{stem}.parquet"
            jobs.append(pool.submit(_write_shard, dataset, shard, path, rows_done))
        try:
            for job in as_completed(jobs):
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    (folder / "README.md").write_text(_card(dataset, splits), encoding="utf-8")


def all_columns(dataset: DatasetFolder) -> list[str]:
    """Every column that the dataset stores, in the order of the widest configuration."""
    frames = (dataset.sequence.frames[i].column for i in stored_frames(dataset.sequence, dataset.manifest.stored))
    return [*LABELS, *frames, DEPTH, *([DEPTH_EXACT] if dataset.has_exact else []), *RANGE]


def _write_shard(dataset: DatasetFolder, shard: ShardFile, path: Path, rows_done: Callable[[int], None]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = all_columns(dataset)
    schema = arrow_schema(columns, dataset.size)
    table = _joined_table(dataset, shard, schema)
    depths = [name for name in columns if name in (DEPTH, DEPTH_EXACT)]
    leaf = ".list.element.list.element"
    rows = _rows_per_group(dataset)
    try:
        with pq.ParquetWriter(
            path,
            schema,
            compression="zstd",
            compression_level=3,  # a fifth smaller than level 1, hardly slower; level 6: 7% smaller, 1.5 times the time
            use_dictionary=[
                name if name in LABELS else name + leaf for name in columns if name not in (*depths, *RANGE)
            ],
            column_encoding={name + leaf: "BYTE_STREAM_SPLIT" for name in depths},
            # The range of grey levels of an image is of no use to a reader.
            write_statistics=[*LABELS, *RANGE],
        ) as writer:
            for first in range(0, table.num_rows, rows):
                part = table.slice(first, rows)
                writer.write_table(part, row_group_size=rows)
                rows_done(part.num_rows)
    except pa.ArrowException as error:
        raise OSError(f"{path.name}: {error}") from error


def _joined_table(dataset: DatasetFolder, shard: ShardFile, schema: "pa.Schema") -> "pa.Table":
    """The columns of all groups for the rows of a data shard, on the memory-mapped files."""
    import pyarrow as pa

    columns: dict[str, pa.ChunkedArray] = {}
    for part in dataset.manifest.shards:
        if (part.split, part.first_row, part.rows) == (shard.split, shard.first_row, shard.rows):
            batches = dataset.record_batches(part)
            for name in batches[0].schema.names:
                # An Array2D extension where `datasets` has been imported; the lists it stores are the same.
                arrays = (batch.column(name) for batch in batches)
                columns[name] = pa.chunked_array([getattr(array, "storage", array) for array in arrays])
    return pa.Table.from_arrays([columns[name] for name in schema.names], schema=schema)


def _rows_per_group(dataset: DatasetFolder) -> int:
    height, width = dataset.size
    frames = len(stored_frames(dataset.sequence, dataset.manifest.stored))
    row_bytes = height * width * (frames + (8 if dataset.has_exact else 4))
    return max(1, min(_MOST_ROWS_PER_GROUP, ROW_GROUP_BYTES // row_bytes))


def _card(dataset: DatasetFolder, splits: list[str]) -> str:
    import yaml

    manifest: Manifest = dataset.manifest
    # Exports of the same dataset with different splits must not share a cache entry.
    identity = sha256(" ".join([manifest.fingerprint, *splits]).encode()).hexdigest()
    configs = [
        {
            "config_name": config,
            **({"default": True} if config == dataset.configs[0] else {}),
            "version": data_version(identity),
            "data_files": [{"split": split, "path": f"data/{split}-*.parquet"} for split in splits],
            "columns": config_columns(dataset.sequence, config, dataset.has_exact),
        }
        for config in dataset.configs
    ]
    return CARD_HEAD + _CARD.format(
        configs=yaml.safe_dump(configs, sort_keys=False, width=120).rstrip(),
        origin=manifest.origin,
        rows=sum(len(dataset.samples(split)) for split in splits),
        height=dataset.size[0],
        width=dataset.size[1],
        fingerprint=manifest.fingerprint,
        config=dataset.configs[0],
        split=splits[0],
        names=", ".join(f"`{config}`" for config in dataset.configs),
    )
