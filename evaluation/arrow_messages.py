"""Whether an Arrow IPC stream has compressed buffers: read off its messages' headers, before anything is unpacked.

A compressed buffer begins with a length of its own choosing, for which Arrow takes memory at once. An uncompressed one
can't be larger than the file it lies in.
"""

import struct

import pyarrow as pa

from fpp_ml_bench.errors import PredictionError

_RECORD_BATCH, _DICTIONARY = 3, 2
_MESSAGE_KIND, _MESSAGE_HEADER = 1, 2
_COMPRESSION = 3
_DICTIONARY_BATCH = 1


def check_uncompressed(stream: pa.Buffer) -> None:
    """Refuse (PredictionError) a stream with a compressed record batch. pyarrow's errors for a damaged one pass on."""
    reader = pa.BufferReader(stream)
    while True:
        try:
            message = pa.ipc.read_message(reader)
        except EOFError:
            return
        try:
            compressed = _compressed(message.metadata.to_pybytes())
        except struct.error:
            raise PredictionError("has a damaged Arrow message; write it again with pyarrow") from None
        if compressed:
            raise PredictionError(
                "is compressed Arrow; write it with compression='uncompressed', or as Parquet (which may be compressed)"
            )


def _compressed(metadata: bytes) -> bool:
    """Whether a message's FlatBuffers header (Arrow's Message.fbs) is a batch with a BodyCompression."""
    message = struct.unpack_from("<I", metadata, 0)[0]
    kind_at = _field(metadata, message, _MESSAGE_KIND)
    kind = metadata[kind_at] if kind_at else 0
    header = _table(metadata, message, _MESSAGE_HEADER)
    if kind == _DICTIONARY and header is not None:
        header = _table(metadata, header, _DICTIONARY_BATCH)
    elif kind != _RECORD_BATCH:
        return False
    return header is not None and _field(metadata, header, _COMPRESSION) != 0


def _field(metadata: bytes, table: int, number: int) -> int:
    """Where field ``number`` of the table at ``table`` lies; 0 when it is absent."""
    slots = table - struct.unpack_from("<i", metadata, table)[0]
    if slots < 0 or table < 0:
        raise struct.error("outside")
    place = 4 + 2 * number
    if place + 2 > struct.unpack_from("<H", metadata, slots)[0]:
        return 0
    offset = struct.unpack_from("<H", metadata, slots + place)[0]
    return table + offset if offset and table + offset < len(metadata) else 0


def _table(metadata: bytes, table: int, number: int) -> int | None:
    place = _field(metadata, table, number)
    return place + struct.unpack_from("<I", metadata, place)[0] if place else None
