"""Whether an Arrow IPC stream has compressed buffers, from the headers of its messages, before anything is unpacked.

A compressed buffer states its own unpacked length, and Arrow allocates that much memory at once. An uncompressed buffer
can't be larger than its file.
"""

import struct

import pyarrow as pa

from fpp_ml_bench.errors import PredictionError

_RECORD_BATCH, _DICTIONARY = 3, 2
_MESSAGE_KIND, _MESSAGE_HEADER = 1, 2
_COMPRESSION = 3
_DICTIONARY_BATCH = 1


def check_uncompressed(stream: pa.Buffer) -> None:
    """Refuse (PredictionError) a stream with a compressed record batch.

    Raises pyarrow's own errors for a damaged stream.
    """
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
    """Offset of field ``number`` of the table at offset ``table``; 0 when the field is absent."""
    vtable = table - struct.unpack_from("<i", metadata, table)[0]
    if vtable < 0 or table < 0:
        raise struct.error("outside")
    slot = 4 + 2 * number
    if slot + 2 > struct.unpack_from("<H", metadata, vtable)[0]:
        return 0
    offset = struct.unpack_from("<H", metadata, vtable + slot)[0]
    return table + offset if offset and table + offset < len(metadata) else 0


def _table(metadata: bytes, table: int, number: int) -> int | None:
    offset = _field(metadata, table, number)
    return offset + struct.unpack_from("<I", metadata, offset)[0] if offset else None
