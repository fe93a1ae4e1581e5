"""Predictions as 16-bit grey PNG: depth is level x ``png_mm_per_level``, level 0 is background."""

import hashlib
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import read_bounded

LEVELS = 65535
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_FILE_BYTES = 1 << 20
_ADVICE = "write 16-bit grey levels (cv2.imwrite of a uint16 array)"


def read_png(path: Path, size: tuple[int, int], mm_per_level: float | None) -> tuple[NDArray[Any], str]:
    """Depth (H, W) float64 in mm and the SHA-256 of the file; PredictionError as `read_prediction`.

    The header, every checksum and the unpacked length are checked before the image is decoded. A level of 65535 is
    refused: there a depth that does not fit was cut off.
    """
    if mm_per_level is None:
        raise PredictionError("has no scale: give png_mm_per_level, the mm of one level, in submission.yaml")
    content = read_bounded(path, size[0] * size[1] * 2 + _FILE_BYTES)
    _check(content, size)
    import cv2

    levels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if levels is None or levels.dtype != np.uint16 or levels.shape != size:
        raise PredictionError(f"can't be decoded as a 16-bit grey PNG; {_ADVICE}")
    if levels.max() == LEVELS:
        raise PredictionError(
            f"reaches level {LEVELS}, where depth above {LEVELS * mm_per_level:g} mm is cut off; use a larger "
            "png_mm_per_level"
        )
    return levels.astype(np.float64) * mm_per_level, hashlib.sha256(content).hexdigest()


def _check(content: bytes, size: tuple[int, int]) -> None:
    if not content.startswith(_SIGNATURE) or content[12:16] != b"IHDR" or len(content) < 33:
        raise PredictionError(f"is no PNG file; {_ADVICE}")
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    if (height, width) != size:
        raise PredictionError(f"expected shape {size} (H, W), got ({height}, {width}); predict at that size")
    if bits != 16 or colour != 0 or interlaced:
        raise PredictionError(
            f"has {bits} bits per channel, colour type {colour}, interlacing {interlaced}; expected 16, 0 and 0: "
            + _ADVICE
        )
    kinds, packed = [], []
    for kind, data in _chunks(memoryview(content)):
        kinds.append(kind)
        if kind == b"IDAT":
            packed.append(data)
    if kinds[-1:] != [b"IEND"] or kinds.count(b"IHDR") != 1 or not packed or b"tRNS" in kinds:
        raise PredictionError(f"is cut off or damaged; {_ADVICE}")
    expected = height * (2 * width + 1)
    unpacker = zlib.decompressobj()
    try:
        length = len(unpacker.decompress(b"".join(packed), expected + 1))
    except zlib.error:
        raise PredictionError(f"is damaged: its pixels can't be unpacked; {_ADVICE}") from None
    if length != expected:
        more = "more than " if length > expected else ""
        raise PredictionError(f"unpacks to {more}{min(length, expected)} bytes, expected {expected}; {_ADVICE}")


def _chunks(view: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    offset = len(_SIGNATURE)
    while offset < len(view):
        length = struct.unpack(">I", view[offset : offset + 4])[0] if len(view) - offset >= 12 else len(view)
        stop = offset + 12 + length
        if stop > len(view):
            raise PredictionError(f"is cut off; {_ADVICE}")
        if zlib.crc32(view[offset + 4 : stop - 4]) != struct.unpack(">I", view[stop - 4 : stop])[0]:
            raise PredictionError(f"is damaged, a checksum does not match; {_ADVICE}")
        kind = bytes(view[offset + 4 : offset + 8])
        yield kind, view[offset + 8 : stop - 4]
        offset = stop
        if kind == b"IEND":
            if offset != len(view):
                raise PredictionError(f"has foreign bytes after the image; {_ADVICE}")
            return
