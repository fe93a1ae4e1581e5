"""Frames that a camera captured: lossless image files of 8 to 16 bits, in the order of their names.

Pillow decodes them, since it refuses files that are cut off where OpenCV returns part of an image. It reduces colour of
16 bits to 8, which OpenCV therefore decodes, after Pillow found the file complete.
"""

import io
import re
import struct
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import CaptureError, LayoutError
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.published import png_chunks

COLOURS = {
    "luminance": (0.299, 0.587, 0.114),
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "mean": (1 / 3, 1 / 3, 1 / 3),
}
"""Weights of red, green and blue; luminance as in Rec. 601 and OpenCV's conversion to grey."""
SUFFIXES = (".png", ".bmp", ".tif", ".tiff")
_OTHER_IMAGES = (".jpg", ".jpeg", ".jpe", ".jp2", ".webp", ".gif", ".pgm", ".ppm", ".exr", ".hdr", ".raw", ".dng")
_LOSSY = ("jpeg", "tiff_jpeg", "webp")
_GREY_MODES, _COLOUR_MODES = ("L", "LA", "I", "I;16", "I;16L", "I;16B"), ("RGB", "RGBA", "P", "PA")
_WHOLE_BITS = (8, 10, 12, 14, 16)
_LARGEST_BYTES = 1 << 30
_BITS_PER_SAMPLE, _PHOTOMETRIC = 258, 262
_THREADS = 4
_ORIENTATION = 274
_UPRIGHT: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    2: np.fliplr,
    3: lambda levels: np.rot90(levels, 2),
    4: np.flipud,
    5: lambda levels: np.swapaxes(levels, 0, 1),
    6: lambda levels: np.rot90(levels, -1),
    7: lambda levels: np.swapaxes(np.rot90(levels, 2), 0, 1),
    8: np.rot90,
}
"""What makes an image upright, by its EXIF orientation."""


@dataclass(frozen=True)
class CapturedFrames:
    """``frames`` (N, H, W): uint8 grey levels, or float32 grey levels of 0 to 255 where the files have more than 8 bits
    or channels were weighted; ``files`` in the same order. ``full_scale``: the stored level that became 255. ``note``
    says what was assumed about it, "" where nothing was."""

    frames: NDArray[Any]
    files: tuple[Path, ...]
    full_scale: int = GREY_LEVELS
    note: str = ""


class _Image(NamedTuple):
    levels: NDArray[Any]
    """uint8, uint16, or float32 where channels were weighted; (H, W)."""
    bits: int
    """Of a stored level, as the file says."""
    used: int
    """Bitwise or of all stored levels."""


def read_frames(
    source: str | Path | Sequence[str | Path],
    *,
    count: int | None = None,
    bits: int | None = None,
    colour: str | None = None,
) -> CapturedFrames:
    """The frames in ``source``, which is as in `frame_files`.

    ``count``: how many there must be. ``bits``: 8 to 16, of the camera, where the files have 16; they may be the low or
    the high bits. By default: where all levels are multiples of 4 or more, high bits; else the fewest of 8, 10, 12, 14,
    16 bits that hold all levels; the result's ``note`` says which. ``colour``: which of `COLOURS` to take where
    channels differ. Raises `CaptureError` naming the file for anything but complete, lossless images of one size and
    bit depth, for levels that need more than ``bits``, and for colour without ``colour``."""
    check_options(bits, colour)
    files = frame_files(source)
    if count is not None and len(files) != count:
        first, last = files[0].name, files[-1].name
        raise CaptureError(
            f"{files[0].parent}: expected {count} frames, found {len(files)} ({first} to {last}); "
            "capture what is missing, or give a pattern that matches the frames only"
        )
    with warnings.catch_warnings(), ThreadPoolExecutor(_THREADS) as pool:
        warnings.simplefilter("ignore")  # of Pillow, about files that are refused below
        images = list(pool.map(lambda file: _read(file, colour), files))
    first_image = images[0]
    for file, image in zip(files, images, strict=True):
        if (image.levels.shape, image.bits) != (first_image.levels.shape, first_image.bits):
            raise CaptureError(
                f"{file}: expected {_kind(first_image)} as in {files[0].name}, found {_kind(image)}; give the frames "
                "of one capture"
            )
    used = int(np.bitwise_or.reduce([image.used for image in images]))
    full_scale, note = _full_scale(used, first_image.bits, bits, files[0].parent)
    weighted = any(image.levels.dtype == np.float32 for image in images)
    if full_scale == GREY_LEVELS and first_image.bits == 8 and not weighted:
        return CapturedFrames(np.stack([image.levels for image in images]), tuple(files))
    frames = np.empty((len(images), *first_image.levels.shape), np.float32)
    for index, image in enumerate(images):
        frames[index] = image.levels * (np.float64(GREY_LEVELS) / full_scale)
    return CapturedFrames(frames, tuple(files), full_scale, note)


def check_options(bits: int | None, colour: str | None) -> None:
    """Raise `CaptureError` for options that `read_frames` does not take."""
    if colour is not None and colour not in COLOURS:
        raise CaptureError(f"colour: expected {', '.join(COLOURS)}, got {colour!r}")
    if bits is not None and (isinstance(bits, bool) or not isinstance(bits, int) or not 8 <= bits <= 16):
        raise CaptureError(f"bits: expected a whole number from 8 to 16, got {bits!r}")


def frame_files(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """The image files of ``source``: a folder, a pattern for names in a folder such as ``scan/frame_*.png``, a file, or
    a list of files, which keeps its order. The others are in natural order: frame_2 before frame_10. Hidden files, and
    in a folder those that are no images by their suffix, are left out. Raises `CaptureError` where there is none, for
    images in a folder of a form that can't be read, and for names that give no order (frame_1 and frame_01)."""
    if not isinstance(source, str | Path):
        files = [Path(file) for file in source]
        if not files:
            raise CaptureError("expected a list of image files, got an empty one")
        return files
    path, forms = Path(source), ", ".join(SUFFIXES)
    if path.is_dir():
        files = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
        files = [file for file in files if file.suffix.lower() in (*SUFFIXES, *_OTHER_IMAGES)]
        if not files:
            raise CaptureError(f"{path}: expected a folder with images ({forms}), found none; give the frames' folder")
    elif path.is_file():
        return [path]
    elif set(path.name) & set("*?["):
        files = [file for file in path.parent.glob(path.name) if file.is_file() and not file.name.startswith(".")]
        if not files:
            raise CaptureError(f"{source}: no file matches this pattern; check it and the folder's name")
    else:
        raise CaptureError(f"{path}: expected a folder, an image or a pattern such as scan/*.png, found nothing there")
    files.sort(key=lambda file: (natural_key(str(file.with_suffix(""))), str(file)))
    for file, following in pairwise(files):
        if natural_key(str(file.with_suffix(""))) == natural_key(str(following.with_suffix(""))):
            raise CaptureError(
                f"{file}: {following.name} has the same name or number, so the frames have no order; remove one of "
                "them, or give a pattern or a list of files"
            )
    return files


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key in which numbers count as numbers."""
    parts = re.split(r"([0-9]+)", name.casefold())
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _kind(image: _Image) -> str:
    height, width = image.levels.shape
    return f"{width} x {height} px of {image.bits} bits"


def _full_scale(used: int, stored_bits: int, bits: int | None, where: Path) -> tuple[int, str]:
    """The level that counts as white, and what was assumed."""
    if stored_bits == 8:
        if bits not in (None, 8):
            raise CaptureError(f"{where}: expected levels of {bits} bits, found images of 8 bits; leave bits out")
        return GREY_LEVELS, ""
    if bits is not None:
        low = (1 << bits) - 1
        high = low << (16 - bits)
        if used & ~low and used & ~high:
            raise CaptureError(
                f"{where}: expected levels of {bits} bits, 0 to {low} or multiples of {1 << (16 - bits)}, found levels "
                f"that use the bits {used:b}; leave bits out, or give the camera's"
            )
        return (high, "") if used & ~low else (low, "")
    if stored_bits < 16:
        return (1 << stored_bits) - 1, ""
    shift = min((used & -used).bit_length() - 1, 8) if used else 0
    if shift >= 2:
        note = f"all levels are multiples of {1 << shift}: taken as {16 - shift} bits, shifted up by {shift}"
        return (1 << 16) - (1 << shift), note
    assumed = next(whole for whole in _WHOLE_BITS if used < 1 << whole)
    return (1 << assumed) - 1, f"no level is above {(1 << assumed) - 1}: taken as {assumed} bits"


def _read(file: Path, colour: str | None) -> _Image:
    """An image as grey levels, checked."""
    from PIL import Image

    forms = "expected a PNG, BMP or TIFF image"
    if file.suffix.lower() in _OTHER_IMAGES and file.suffix.lower() not in (".jpg", ".jpeg", ".jpe"):
        raise CaptureError(f"{file}: {forms}, found a {file.suffix} file; convert it without loss, or leave it out")
    try:
        if not file.is_file():
            raise CaptureError(f"{file}: {forms}, found {'a folder' if file.is_dir() else 'nothing there'}")
        if not 0 < (size := file.stat().st_size) <= _LARGEST_BYTES:
            raise CaptureError(f"{file}: {forms}, found a file of {size} bytes; capture or copy it again")
        content = file.read_bytes()
    except OSError as error:
        raise CaptureError(f"{file}: can't be read ({error.strerror or error})") from error
    try:
        image = Image.open(io.BytesIO(content), formats=("PNG", "BMP", "TIFF", "JPEG"))
        if image.format in ("JPEG", "MPO") or image.info.get("compression") in _LOSSY:
            lossy = "is compressed with loss (JPEG), and its blocks distort the phase"
            raise CaptureError(f"{file}: {lossy}; capture the frames as PNG, BMP or TIFF")
        if getattr(image, "n_frames", 1) != 1:
            raise CaptureError(f"{file}: expected one image, found {image.n_frames}; write each frame to its own file")  # type: ignore[attr-defined]
        _check_complete(content, image.format, file)
        orientation = image.getexif().get(_ORIENTATION, 1)
        image.load()
        bits = _stored_bits(image, content)
        levels = _levels(image, content, bits, orientation, file)
    except CaptureError:
        raise
    except Exception as error:  # Pillow's readers raise errors of any kind on damaged files
        damaged = f"found a file that is cut off, damaged or of another form ({printable(str(error), 100)})"
        raise CaptureError(f"{file}: {forms}, {damaged}; capture or copy it again") from error
    return _Image(_grey(levels, colour, file), bits, int(np.bitwise_or.reduce(levels, axis=None)))


def _check_complete(content: bytes, form: str | None, file: Path) -> None:
    """What Pillow lets pass: wrong checksums and a missing end of a PNG, a BMP shorter than it says."""
    if form == "PNG":
        try:
            complete = [kind for kind, _ in png_chunks(content)][-1:] == [b"IEND"]
        except LayoutError as error:
            raise CaptureError(f"{file}: the PNG {error}; capture or copy it again") from error
        if not complete:
            raise CaptureError(f"{file}: the PNG is cut off; capture or copy it again")
    elif form == "BMP" and len(content) < (expected := struct.unpack("<I", content[2:6])[0]):
        raise CaptureError(
            f"{file}: the BMP is cut off: expected {expected} bytes, found {len(content)}; copy it again"
        )


def _stored_bits(image: Any, content: bytes) -> int:
    """Bits of a stored level or palette entry, as the file says."""
    if image.format == "PNG":
        return 8 if image.mode in ("P", "PA") else content[24]
    if image.format == "TIFF":
        return max(image.tag_v2.get(_BITS_PER_SAMPLE, (1,)))
    pixel_bits = struct.unpack("<H", content[28:30])[0]
    return 5 if pixel_bits == 16 else min(pixel_bits, 8)


def _levels(image: Any, content: bytes, bits: int, orientation: int, file: Path) -> NDArray[Any]:
    """Stored levels uint8 or uint16 (H, W), or (H, W, 3) red, green, blue, upright by the EXIF ``orientation``; opaque
    alpha dropped."""
    upright = _UPRIGHT.get(orientation, lambda levels: levels)
    if image.mode not in _GREY_MODES + _COLOUR_MODES or not 8 <= bits <= 16:
        kind = f"mode {image.mode} of {bits} bits; write whole grey levels"
        raise CaptureError(f"{file}: expected grey levels or RGB of 8 to 16 bits, found {kind}")
    if image.format == "TIFF" and bits > 8 and image.tag_v2.get(_PHOTOMETRIC) == 0:
        raise CaptureError(f"{file}: the TIFF stores white as 0 (photometric 0); write it with black as 0")
    transparent = CaptureError(f"{file}: has transparent pixels; write it without an alpha channel")
    if "transparency" in image.info:
        raise transparent
    if bits > 8 and image.mode in (*_COLOUR_MODES, "LA"):
        import cv2

        stored = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if stored is None or stored.dtype != np.uint16 or stored.shape[:2] != image.size[::-1]:
            raise CaptureError(f"{file}: colour of {bits} bits that OpenCV can't decode; write it as grey levels")
        levels = stored[..., [2, 1, 0, *range(3, stored.shape[2])]]
    else:
        shown = image.convert("RGBA" if image.mode == "PA" else "RGB") if image.mode in ("P", "PA") else image
        levels = np.asarray(shown).astype(np.uint16 if bits > 8 else np.uint8)
    if image.format != "TIFF":  # Pillow and OpenCV turn a TIFF themselves
        levels = upright(levels)
    if levels.ndim == 3 and levels.shape[2] in (2, 4):
        opaque = (1 << bits) - 1
        if not (levels[..., -1] == opaque).all():
            raise transparent
        levels = levels[..., 0] if levels.shape[2] == 2 else levels[..., :3]
    return levels


def _grey(levels: NDArray[Any], colour: str | None, file: Path) -> NDArray[Any]:
    """(H, W): the channel, where all are equal, or what ``colour`` says."""
    if levels.ndim == 2:
        return levels
    red, green, blue = np.moveaxis(levels, -1, 0)
    if np.array_equal(red, green) and np.array_equal(green, blue):
        return np.ascontiguousarray(red)
    if colour is None:
        raise CaptureError(f"{file}: the colour channels differ; say which to take by colour ({', '.join(COLOURS)})")
    if colour in ("red", "green", "blue"):
        return np.ascontiguousarray(levels[..., ("red", "green", "blue").index(colour)])
    weights = COLOURS[colour]
    return (weights[0] * red + weights[1] * green + weights[2] * blue).astype(np.float32)
