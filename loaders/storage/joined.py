"""``load_dataset``: joins the column groups of a configuration on the memory-mapped files, without a copy.

Plain ``datasets.load_dataset`` copies what it reads into its cache, and its Arrow builder can't leave columns out. Here
the groups' tables are joined column by column; a frame is read from disk only when its row is.
"""

from pathlib import Path
from typing import TYPE_CHECKING, overload

from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.loaders.sample import config_columns, features, stored_groups
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics import CONFIGS

if TYPE_CHECKING:
    from datasets import Dataset, DatasetDict


@overload
def load_dataset(folder: str | Path, config: str = ..., *, split: str) -> "Dataset": ...
@overload
def load_dataset(folder: str | Path, config: str = ..., split: None = ...) -> "DatasetDict": ...
def load_dataset(folder: str | Path, config: str = "single_shot", split: str | None = None) -> "Dataset | DatasetDict":
    """Open a built or imported dataset folder as a ``datasets.Dataset``, or every split as a ``DatasetDict``.

    Parameters
    ----------
    folder : dataset folder written by ``fpp-bench build`` or ``fpp-bench import``.
    config : ``single_shot`` (frame 0), ``horizontal``, ``vertical``, ``sinusoidal`` or ``all``. Columns: ``sample,
        object, view, split``, one uint8 (H, W) ``frame_NN`` column per frame, ``depth`` and, for generated data,
        ``depth_exact`` (float32 (H, W), mm, 0 = background), ``depth_min``, ``depth_max`` (mm).
    split : ``train``, ``validation`` or ``test``; None for all of them.

    Raises `DatasetError` for a folder that is not a finished dataset, an unknown or unstored configuration or split.

    Examples
    --------
    >>> train = load_dataset("data/mini", "single_shot", split="train")        # doctest: +SKIP
    >>> train.with_format("numpy")[0]["depth"].max()                            # doctest: +SKIP
    """
    dataset = DatasetFolder(folder)
    if config not in CONFIGS:
        raise DatasetError(f"unknown configuration {config!r}; there are {', '.join(CONFIGS)}")
    if config not in dataset.configs:
        raise DatasetError(
            f"{folder}: configuration {config!r} is not stored; this dataset has {', '.join(dataset.configs)}. Build "
            f"it with --frames {config} or --frames all"
        )
    if split is not None:
        dataset.samples(split)
        if split not in dataset.splits:
            raise DatasetError(f"split {split!r}: expected one of {', '.join(dataset.splits)}, or None for all")
        return _joined_split(dataset, config, split)
    from datasets import DatasetDict

    return DatasetDict({name: _joined_split(dataset, config, name) for name in dataset.splits})


def _joined_split(dataset: DatasetFolder, config: str, split: str) -> "Dataset":
    from datasets import Dataset, DatasetInfo, Features
    from datasets.splits import NamedSplit
    from datasets.table import ConcatenationTable, MemoryMappedTable, concat_tables

    columns = config_columns(dataset.sequence, config, dataset.has_exact)
    tables = []
    for group in stored_groups(dataset.sequence, dataset.manifest.stored):
        shards = [s for s in dataset.manifest.shards if s.split == split and s.group == group]
        files = [MemoryMappedTable.from_file(str(dataset.path / shard.path)) for shard in shards]
        names = [name for name in files[0].column_names if name in columns]
        if names:
            tables.append(concat_tables([file.select(names) for file in files], axis=0))
    table = tables[0] if len(tables) == 1 else ConcatenationTable.from_tables(tables, axis=1)
    info = DatasetInfo(
        features=Features.from_dict(features(columns, dataset.size)), config_name=config,
        dataset_name="fpp-ml-bench",
    )  # fmt: skip
    # `datasets` caches later transforms by this fingerprint: it depends on the data, not on the path.
    fingerprint = f"{dataset.fingerprint[:16]}-{config}-{split}"
    return Dataset(table.select(columns), info=info, split=NamedSplit(split), fingerprint=fingerprint)
