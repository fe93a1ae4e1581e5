"""Predictions as 16-bit grey PNG: depth is level x ``png_mm_per_level``, level 0 is background."""

import hashlib
import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

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
    if problem := _problem(content, size):
        raise PredictionError(problem)
    try:
        levels = np.asarray(Image.open(io.BytesIO(content), formats=["PNG"])).astype(np.uint16)
    except (OSError, SyntaxError, ValueError):
        raise PredictionError(f"can't be decoded as a 16-bit grey PNG; {_ADVICE}") from None
    if levels.max() == LEVELS:
        raise PredictionError(
            f"reaches level {LEVELS}, where depth above {LEVELS * mm_per_level:g} mm is cut off; use a larger "
            "png_mm_per_level"
        )
    return levels.astype(np.float64) * mm_per_level, hashlib.sha256(content).hexdigest()


def _problem(content: bytes, size: tuple[int, int]) -> str | None:
    """What Pillow would not refuse: another kind of PNG, wrong checksums, too many pixels, foreign bytes."""
    if not content.startswith(_SIGNATURE) or content[12:16] != b"IHDR" or len(content) < 33:
        return f"is no PNG file; {_ADVICE}"
    width, height, bits, colour, _, _, interlaced = struct.unpack(">IIBBBBB", content[16:29])
    if (height, width) != size:
        return f"expected shape {size} (H, W), got ({height}, {width}); predict at that size"
    if bits != 16 or colour != 0 or interlaced:
        return (
            f"has {bits} bits per channel, colour type {colour}, interlacing {interlaced}; expected 16, 0 and 0: "
            + _ADVICE
        )
    kinds: list[bytes] = []
    packed: list[bytes] = []
    offset = len(_SIGNATURE)
    while offset < len(content) and kinds[-1:] != [b"IEND"]:
        if len(content) - offset < 12:
            return f"is cut off; {_ADVICE}"
        length, kind = struct.unpack_from(">I4s", content, offset)
        end = offset + 12 + length
        if end > len(content):
            return f"is cut off; {_ADVICE}"
        if zlib.crc32(content[offset + 4 : end - 4]) != struct.unpack(">I", content[end - 4 : end])[0]:
            return f"is damaged, a checksum does not match; {_ADVICE}"
        if kind == b"IDAT":
            packed.append(content[offset + 8 : end - 4])
        kinds.append(kind)
        offset = end
    if kinds[-1:] != [b"IEND"] or kinds.count(b"IHDR") != 1 or not packed or b"tRNS" in kinds:
        return f"is cut off or damaged; {_ADVICE}"
    if offset != len(content):
        return f"has foreign bytes after the image; {_ADVICE}"
    expected = height * (2 * width + 1)
    try:
        unpacked = len(zlib.decompressobj().decompress(b"".join(packed), expected + 1))
    except zlib.error:
        return f"is damaged: its pixels can't be unpacked; {_ADVICE}"
    if unpacked != expected:
        more = "more than " if unpacked > expected else ""
        return f"unpacks to {more}{min(unpacked, expected)} bytes, expected {expected}; {_ADVICE}"
    return None
