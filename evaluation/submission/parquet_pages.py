"""The unpacked size of a Parquet file, added up from its page headers before anything is unpacked.

The footer states an unpacked size, and so does every page. The two need not agree, and a reader allocates memory page
by page. So the headers of all pages (Thrift, compact protocol) are read first.
"""

import struct
from typing import Any

from fpp_ml_bench.errors import PredictionError

_DATA, _INDEX, _DICTIONARY, _DATA_V2 = 0, 1, 2, 3
_HEADERS = {_DATA: 5, _DICTIONARY: 7, _DATA_V2: 8}
_MAX_DEPTH = 8


def check_pages(metadata: Any, content: bytes, largest_bytes: int, largest_values: int) -> None:
    """Refuse (PredictionError) a file whose footer or pages state an unpacked size above these limits.

    ``metadata`` is pyarrow's ``FileMetaData`` of ``content``.
    """
    total = values = 0
    for group in range(metadata.num_row_groups):
        for column in range(metadata.num_columns):
            chunk = metadata.row_group(group).column(column)
            starts = [chunk.data_page_offset, chunk.dictionary_page_offset]
            start = min(position for position in starts if position is not None)
            stop = start + chunk.total_compressed_size
            if not 0 < start <= stop <= len(content):
                raise PredictionError("is damaged: its columns lie outside of it; write it again with pyarrow")
            page_bytes, page_values = _pages(content, start, stop)
            total += max(chunk.total_uncompressed_size, page_bytes)
            values += max(chunk.num_values, page_values)
    if total > largest_bytes or values > largest_values:
        raise PredictionError(
            f"would unpack to {total} bytes and {values} values, expected at most {largest_bytes} and "
            f"{largest_values} for this split; write one float32 map per sample"
        )


def _pages(content: bytes, start: int, stop: int) -> tuple[int, int]:
    """Bytes and values that the pages from offset ``start`` to ``stop`` unpack to."""
    total = values = 0
    while start < stop:
        try:
            header, start = _struct(content, start, 0)
        except (IndexError, struct.error):
            raise PredictionError("has a damaged page header; write it again with pyarrow") from None
        kind, unpacked, packed = header.get(1), header.get(2), header.get(3)
        if not (isinstance(kind, int) and isinstance(unpacked, int) and isinstance(packed, int)):
            raise PredictionError("has a damaged page header; write it again with pyarrow")
        if min(unpacked, packed) < 0:
            raise PredictionError("has a damaged page header; write it again with pyarrow")
        total += unpacked
        page_header = header.get(_HEADERS.get(kind, 0))
        count = page_header.get(1) if isinstance(page_header, dict) else 0
        if kind in (_DATA, _DATA_V2):
            values += max(count, 0) if isinstance(count, int) else 0
        start += packed
    return total, values


def _struct(content: bytes, offset: int, depth: int) -> tuple[dict[int, Any], int]:
    """Fields of a compact-protocol struct by number, and the offset after it."""
    if depth > _MAX_DEPTH:
        raise IndexError("nested too deeply")
    fields: dict[int, Any] = {}
    number = 0
    while True:
        byte = content[offset]
        offset += 1
        if byte == 0:
            return fields, offset
        step, kind = byte >> 4, byte & 0x0F
        if step:
            number += step
        else:
            number, offset = _zigzag(content, offset)
        fields[number], offset = _value(content, offset, kind, depth)


def _value(content: bytes, offset: int, kind: int, depth: int) -> tuple[Any, int]:
    if kind in (1, 2):  # true, false: the type is the value
        return kind == 1, offset
    if kind == 3:
        return content[offset], offset + 1
    if kind in (4, 5, 6):
        return _zigzag(content, offset)
    if kind == 7:
        return None, offset + 8
    if kind == 8:
        length, offset = _varint(content, offset)
        return None, offset + length
    if kind == 12:
        return _struct(content, offset, depth + 1)
    raise IndexError("a type that no page header has")


def _varint(content: bytes, offset: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = content[offset]
        offset += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, offset
        shift += 7
        if shift > 63:
            raise IndexError("a number too long")


def _zigzag(content: bytes, offset: int) -> tuple[int, int]:
    value, offset = _varint(content, offset)
    return (value >> 1) ^ -(value & 1), offset
