"""Predictions in one Arrow (IPC stream or file) or Parquet file: columns ``sample`` (text) and ``depth`` (floats).

Each row of ``depth`` holds H lists of W values, one list of H W values, or a tensor; float16, float32 or float64.
"""

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fpp_ml_bench.containers import parse_table
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import printable, read_bounded

_FLOATS = {pa.float16(): np.float16, pa.float32(): np.float32, pa.float64(): np.float64}
_SLACK_BYTES, _SLACK_PER_SAMPLE = 1 << 20, 1 << 16
_ADVICE = "write columns sample (text) and depth (list of H lists of W floats) with pyarrow"


def depth_maps(path: Path, samples: Sequence[str], size: tuple[int, int]) -> Callable[[str], tuple[NDArray[Any], str]]:
    """A function from a sample to its map (H, W) and the SHA-256 of the file; PredictionError with the file's name. The
    whole table is held in memory: at most a float64 map per sample."""
    count, pixels = len(samples), size[0] * size[1]
    largest = count * (pixels * 8 + size[0] * 16 + _SLACK_PER_SAMPLE) + _SLACK_BYTES
    try:
        content = read_bounded(path, largest)
        # Twice what is needed, so that an extra row is refused by its name and not by the size of the file.
        try:
            table = parse_table(content, 2 * largest, 2 * count * (pixels + 1))
        except PredictionError as error:
            raise PredictionError(f"{error}; {_ADVICE}") from None
        _check_columns(table.schema)
        rows = _rows(table.column("sample").to_pylist(), samples)
    except PredictionError as error:
        raise PredictionError(f"{printable(str(path), 500)} {error}") from None
    digest = hashlib.sha256(content).hexdigest()

    def depth_map(sample: str) -> tuple[NDArray[Any], str]:
        column = table.column("depth").slice(rows[sample], 1).combine_chunks()
        return _depth_map(column.chunk(0) if isinstance(column, pa.ChunkedArray) else column, size), digest

    return depth_map


def _check_columns(schema: pa.Schema) -> None:
    if sorted(schema.names) != ["depth", "sample"]:
        names = printable(", ".join(schema.names), 120)
        raise PredictionError(f"holds the columns {names}; expected sample and depth: {_ADVICE}")
    if schema.field("sample").type not in (pa.string(), pa.large_string()):
        raise PredictionError(f"column sample: expected text, got {schema.field('sample').type}; {_ADVICE}")
    value = schema.field("depth").type
    while (inner := _item_type(value)) is not None:
        value = inner
    if value not in _FLOATS or value == schema.field("depth").type:
        given = f"got {printable(str(schema.field('depth').type), 80)}"
        why = "whole numbers wrap around, other types are not depth"
        raise PredictionError(f"column depth: expected lists of float16, float32 or float64, {given}; {why}: {_ADVICE}")


def _item_type(value: pa.DataType) -> pa.DataType | None:
    if isinstance(value, pa.BaseExtensionType):
        return value.storage_type
    if pa.types.is_list(value) or pa.types.is_large_list(value) or pa.types.is_fixed_size_list(value):
        return value.value_type
    return None


def _rows(names: list[str], samples: Sequence[str]) -> dict[str, int]:
    """The row of each sample; refuses a table of other samples."""
    rows = {name: row for row, name in enumerate(names)}
    problems = [f"lacks the sample {sample}" for sample in samples if sample not in rows]
    foreign = [name for name in rows if name not in set(samples)]
    problems += [f"holds {printable(name)}, which is no sample of this split" for name in foreign]
    problems += [f"holds the sample {printable(name)} twice" for name in rows if names.count(name) > 1]
    if problems:
        raise PredictionError(f"{'; '.join(problems[:20])}; write one row for each sample")
    return rows


def _depth_map(column: pa.Array, size: tuple[int, int]) -> NDArray[Any]:
    """The (H, W) map in a column of one row."""
    shape: list[int] = []
    values = column
    while _item_type(values.type) is not None:
        if isinstance(values, pa.ExtensionArray):
            values = values.storage
            continue
        if values.null_count:
            raise PredictionError("holds missing values (null); write 0 where nothing was measured")
        lengths = values.value_lengths().unique().to_pylist()
        if len(lengths) != 1:
            raise PredictionError(f"expected rows of one length, got {len(lengths)} different ones; write H x W values")
        shape.append(lengths[0])
        values = values.flatten()
    if values.null_count:
        raise PredictionError("holds missing values (null); write 0 where nothing was measured")
    if tuple(shape) not in (tuple(size), (size[0] * size[1],)):
        raise PredictionError(f"expected shape {size} (H, W), got {tuple(shape)}; predict at that size")
    dtype = np.dtype(_FLOATS[values.type])
    return np.frombuffer(values.buffers()[1], dtype, len(values), values.offset * dtype.itemsize).reshape(size)
