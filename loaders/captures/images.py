"""Frames that a camera captured: lossless image files of 8 to 16 bits, in the order of their names;
and a scanner's captures in folders, ``{object}/{view}/`` or ``{object}/``, with the split that each
object belongs to."""

import re
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fpp_ml_bench.constants import GREY_LEVELS, OBJECT_NAME, SPLITS, VIEW_NAME, sample_name
from fpp_ml_bench.containers import LARGEST_BYTES, StoredImage, parse_image
from fpp_ml_bench.errors import BuildError, CaptureError, LayoutError, PredictionError
from fpp_ml_bench.files import file_content, read_yaml, visible
from fpp_ml_bench.schema import StrictModel, Text, validate

_CHANNELS = "red", "green", "blue"
_LUMINANCE, _MEAN = (0.299, 0.587, 0.114), (1 / 3, 1 / 3, 1 / 3)
"""Weights of the channels; luminance as in Rec. 601 and OpenCV's conversion to grey."""
COLOURS = "luminance", *_CHANNELS, "mean"
SUFFIXES = (".png", ".bmp", ".tif", ".tiff")
_OTHER_IMAGES = (
    ".jpg",
    ".jpeg",
    ".jpe",
    ".jp2",
    ".webp",
    ".gif",
    ".pgm",
    ".ppm",
    ".exr",
    ".hdr",
    ".raw",
    ".dng",
)
_MODES = ("L", "LA", "I", "I;16", "I;16L", "I;16B", "RGB", "RGBA", "P", "PA")
_WHOLE_BITS = (8, 10, 12, 14, 16)
CAPTURE_AGAIN = "capture or copy it again"
LOSSY = "compressed with loss (JPEG), and its blocks distort the phase"
LOSSLESS = "capture the frames as PNG, BMP or TIFF"
_THREADS = 2
"""Each has a process that reads (`fpp_ml_bench.containers`)."""
_QUARTER_TURNS, _MIRRORED = {3: 2, 4: 2, 5: -1, 6: -1, 7: 1, 8: 1}, (2, 4, 5, 7)
"""What makes an image upright, by its EXIF orientation: a turn to the left, then left and right
exchanged."""


@dataclass(frozen=True)
class CapturedFrames:
    """``frames`` (N, H, W): uint8 grey levels, or float32 grey levels of 0 to 255 where the files
    have more than 8 bits or channels were weighted; ``files`` in the same order. ``full_scale``:
    the stored level that became 255. ``note`` says what was assumed about it, "" where nothing
    was. ``lossy``: files that are compressed with loss."""

    frames: NDArray[Any]
    files: tuple[Path, ...]
    full_scale: int = GREY_LEVELS
    note: str = ""
    lossy: tuple[Path, ...] = ()

    @property
    def names(self) -> list[str]:
        return [file.name for file in self.files]


class _Image(NamedTuple):
    levels: NDArray[Any]
    """uint8, uint16, or float32 where channels were weighted; (H, W)."""
    bits: int
    """Of a stored level, as the file says."""
    used: int
    """Bitwise or of all stored levels."""
    lossy: bool


def read_frames(
    source: str | Path | Sequence[str | Path],
    *,
    count: int | None = None,
    bits: int | None = None,
    colour: str | None = None,
    lossy: bool = False,
) -> CapturedFrames:
    """The frames in ``source``, which is as in `frame_files`.

    ``count``: how many there must be. ``bits``: 8 to 16, of the camera, where the files have 16;
    they may be the low or the high bits. By default: where all levels are multiples of 4 or more,
    high bits; else the fewest of 8, 10, 12, 14, 16 bits that hold all levels; the result's ``note``
    says which. ``colour``: which of `COLOURS` to take where channels differ. ``lossy``: read JPEG,
    too, and name it in the result. Raises `CaptureError` naming the file for anything but complete,
    lossless images of one size and bit depth, for levels
    that need more than ``bits``, and for colour without ``colour``."""
    check_options(bits, colour)
    files = frame_files(source)
    if count is not None and len(files) != count:
        first, last = files[0].name, files[-1].name
        raise CaptureError(
            f"{files[0].parent}: expected {count} frames, found {len(files)} ({first} to {last}); "
            "capture what is missing, or give a pattern that matches the frames only"
        )
    with ThreadPoolExecutor(_THREADS) as pool:
        images = list(pool.map(lambda file: _read(file, colour, lossy), files))
    first_image = images[0]
    for file, image in zip(files, images, strict=True):
        if (image.levels.shape, image.bits) != (first_image.levels.shape, first_image.bits):
            raise CaptureError(
                f"{file}: expected {_kind(first_image)} as in {files[0].name}, found "
                f"{_kind(image)}; give the frames "
                "of one capture"
            )
    used = int(np.bitwise_or.reduce([image.used for image in images]))
    full_scale, note = _full_scale(used, first_image.bits, bits, files[0].parent)
    compressed = tuple(file for file, image in zip(files, images, strict=True) if image.lossy)
    if all(image.levels.dtype == np.uint8 for image in images):
        frames = np.stack([image.levels for image in images])
        return CapturedFrames(frames, tuple(files), lossy=compressed)
    frames = np.empty((len(images), *first_image.levels.shape), np.float32)
    for index, image in enumerate(images):
        frames[index] = image.levels * (np.float64(GREY_LEVELS) / full_scale)
    return CapturedFrames(frames, tuple(files), full_scale, note, compressed)


def check_options(bits: int | None, colour: str | None) -> None:
    """Raise `CaptureError` for options that `read_frames` does not take."""
    if colour is not None and colour not in COLOURS:
        raise CaptureError(f"colour: expected {', '.join(COLOURS)}, got {colour!r}")
    if bits is not None and (type(bits) is not int or not 8 <= bits <= 16):
        raise CaptureError(f"bits: expected a whole number from 8 to 16, got {bits!r}")


def frame_files(source: str | Path | Sequence[str | Path]) -> list[Path]:
    """The image files of ``source``: a folder, a pattern such as ``scan/frame_*.png`` or
    ``scan/*/*.png``, a file, or a list of files, which keeps its order. The others are in natural
    order: frame_2 before frame_10. Hidden files, and in a folder those that are no images by their
    suffix, are left out. Raises `CaptureError` where there is none, for images in a folder of a
    form that can't be read, and for names that give no order (frame_1 and frame_01)."""
    if not isinstance(source, str | Path):
        files = [Path(file) for file in source]
        if not files:
            raise CaptureError("expected a list of image files, got an empty one")
        return files
    path, forms = Path(source), ", ".join(SUFFIXES)
    if path.is_dir():
        files = _images(path, (*SUFFIXES, *_OTHER_IMAGES))
        if not files:
            cure = "give the frames' folder"
            if folders := _folders(path):
                cure += (
                    f", such as {folders[0]}, or a pattern of all in their order: '{path}/*/*.png'"
                )
            raise CaptureError(
                f"{path}: expected a folder with images ({forms}), found none; {cure}"
            )
    elif path.is_file():
        return [path]
    elif set("*?[") & set(
        str(path.relative_to(base := next(filter(Path.is_dir, path.parents), Path())))
    ):
        files = [file for file in base.glob(str(path.relative_to(base))) if file.is_file()]
        files = [file for file in files if not re.search(r"(^|/)\.", str(file.relative_to(base)))]
        if not files:
            advice = "check it and the folder's name; it has to match files, as 'scan/*/*.png' does"
            raise CaptureError(f"{source}: no file matches this pattern; {advice}")
    else:
        raise CaptureError(
            f"{path}: expected a folder, an image or a pattern such as scan/*.png, found nothing "
            f"there"
        )
    keys = {file: natural_key(str(file.with_suffix(""))) for file in files}
    files.sort(key=lambda file: (keys[file], str(file)))
    for file, following in pairwise(files):
        if keys[file] == keys[following]:
            raise CaptureError(
                f"{file}: {following.name} has the same name or number, so the frames have no "
                f"order; remove one of "
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
            raise CaptureError(
                f"{where}: expected levels of {bits} bits, found images of 8 bits; leave bits out"
            )
        return GREY_LEVELS, ""
    if bits is not None:
        low = (1 << bits) - 1
        high = low << (16 - bits)
        if used & ~low and used & ~high:
            raise CaptureError(
                f"{where}: expected levels of {bits} bits, 0 to {low} or multiples of "
                f"{1 << (16 - bits)}, found levels "
                f"that use the bits {used:b}; leave bits out, or give the camera's"
            )
        return (high, "") if used & ~low else (low, "")
    if stored_bits < 16:
        return (1 << stored_bits) - 1, ""
    shift = min((used & -used).bit_length() - 1, 8) if used else 0
    if shift >= 2:
        note = (
            f"all levels are multiples of {1 << shift}: taken as {16 - shift} bits, shifted up by "
            f"{shift}"
        )
        return (1 << 16) - (1 << shift), note
    assumed = next(whole for whole in _WHOLE_BITS if used < 1 << whole)
    return (1 << assumed) - 1, f"no level is above {(1 << assumed) - 1}: taken as {assumed} bits"


def _read(file: Path, colour: str | None, lossy: bool) -> _Image:
    """An image as grey levels, checked; ``lossy``: compressed with loss, too."""
    forms, suffix = "expected a PNG, BMP or TIFF image", file.suffix.lower()
    if suffix in _OTHER_IMAGES and suffix not in (".jpg", ".jpeg", ".jpe"):
        raise CaptureError(
            f"{file}: {forms}, found a {file.suffix} file; convert it without loss, or leave it out"
        )
    if not file.is_file():
        raise CaptureError(
            f"{file}: {forms}, found {'a folder' if file.is_dir() else 'nothing there'}"
        )
    content = file_content(file, LARGEST_BYTES, CaptureError, CAPTURE_AGAIN)
    if not content:
        raise CaptureError(f"{file}: {forms}, found a file of 0 bytes; {CAPTURE_AGAIN}")
    try:
        image = parse_image(content)
    except PredictionError as error:
        raise CaptureError(f"{file}: {error}; {CAPTURE_AGAIN}") from None
    levels = np.atleast_3d(image.levels)
    alpha = levels.shape[2] in (2, 4)
    if image.lossy and not lossy:
        raise CaptureError(f"{file}: is {LOSSY}; {LOSSLESS}")
    if problem := _problem(image, levels[..., -1] if alpha else None):
        raise CaptureError(f"{file}: {problem}")
    levels = np.rot90(
        levels[..., :-1] if alpha else levels, _QUARTER_TURNS.get(image.orientation, 0)
    )
    if image.orientation in _MIRRORED:
        levels = np.fliplr(levels)
    return _Image(
        _grey(levels, colour, file),
        image.bits,
        int(np.bitwise_or.reduce(levels, axis=None)),
        image.lossy,
    )


def _problem(image: StoredImage, alpha: NDArray[Any] | None) -> str | None:
    """Why an image is no frame, and what to do."""
    if image.images != 1:
        return f"expected one image, found {image.images}; write each frame to its own file"
    if image.mode not in _MODES or not 8 <= image.bits <= 16:
        kind = f"mode {image.mode} of {image.bits} bits; write whole grey levels"
        return f"expected grey levels or RGB of 8 to 16 bits, found {kind}"
    if image.bits > 8 and image.white_is_0:
        return "the TIFF stores white as 0 (photometric 0); write it with black as 0"
    if image.transparent or (alpha is not None and (alpha < (1 << image.bits) - 1).any()):
        return "has transparent pixels; write it without an alpha channel"
    return None


def _grey(levels: NDArray[Any], colour: str | None, file: Path) -> NDArray[Any]:
    """(H, W): the channel, where all are equal, or what ``colour`` says."""
    if (levels == levels[..., :1]).all():
        return np.ascontiguousarray(levels[..., 0])
    if colour is None:
        raise CaptureError(
            f"{file}: the colour channels differ; say which to take by colour "
            f"({', '.join(COLOURS)})"
        )
    if colour in _CHANNELS:
        return np.ascontiguousarray(levels[..., _CHANNELS.index(colour)])
    red, green, blue = np.moveaxis(levels, -1, 0)
    of_red, of_green, of_blue = _LUMINANCE if colour == "luminance" else _MEAN
    return (of_red * red + of_green * green + of_blue * blue).astype(np.float32)


SINGLE_VIEW = "single"
"""View of an object whose folder holds the frames themselves."""


@dataclass(frozen=True)
class Capture:
    """The frames of one view, in order."""

    object: str
    view: str
    folder: Path
    files: tuple[Path, ...]

    @property
    def sample(self) -> str:
        return sample_name(self.object, self.view)


class Splits(StrictModel):
    """Objects of each split, as a YAML file lists them."""

    train: list[Text] = Field(default_factory=list)
    validation: list[Text] = Field(default_factory=list)
    test: list[Text] = Field(default_factory=list)


def read_splits(file: Path) -> Splits:
    """The splits of a YAML file with lists of objects under train, validation and test. Raises
    `BuildError` naming the file and every key that is wrong."""
    return validate(
        Splits, read_yaml(file, BuildError), file, f"list of {', '.join(SPLITS)}", BuildError
    )


def split_captures(captures: Iterable[Capture], splits: Splits | None) -> dict[str, list[Capture]]:
    """The captures of each split that has any; all in ``test`` without ``splits``. Raises
    `BuildError` for an object in two splits or twice in one, in none, or without captures."""
    captures = list(captures)
    if splits is None:
        return {"test": captures}
    objects = list(dict.fromkeys(capture.object for capture in captures))
    places: dict[str, list[str]] = {}
    for split in SPLITS:
        for name in getattr(splits, split):
            places.setdefault(name, []).append(split)
    problems = [
        f"object {name!r} is listed under {' and '.join(split_names)}; keep it in one split"
        for name, split_names in places.items()
        if len(split_names) > 1
    ]
    problems += [
        f"object {name!r} has no captures; remove it" for name in places if name not in objects
    ]
    problems += [
        f"object {name!r} is in no split; add it" for name in objects if name not in places
    ]
    if problems:
        raise BuildError(
            "\n  ".join(
                [f"splits: expected each of {len(objects)} objects in one split", *problems]
            )
        )
    by_split = {split: [c for c in captures if places[c.object] == [split]] for split in SPLITS}
    return {split: chosen for split, chosen in by_split.items() if chosen}


def find_captures(root: Path, frames: int) -> list[Capture]:
    """The captures below ``root``, of ``frames`` images each, by object and view in the order of
    their names. Names that begin with a dot and other files are left out. Raises `CaptureError`
    with a line for each folder that is no capture."""
    if not root.is_dir():
        raise CaptureError(
            f"{root}: expected a folder with a folder of frames for each object, found none there"
        )
    problems: list[str] = []
    if _images(root):
        problems.append(
            f"{root}: holds frames itself; move the frames of each object into a folder of its name"
        )
    captures: list[Capture] = []
    for folder in _folders(root):
        views = _folders(folder)
        with listed(problems):
            if not OBJECT_NAME.fullmatch(folder.name):
                raise CaptureError(
                    f"{folder}: expected an object name of letters, digits, - and _; rename the "
                    f"folder"
                )
            if views and _images(folder):
                raise CaptureError(
                    f"{folder}: holds frames and folders; give a folder of frames for each view, "
                    f"or frames alone"
                )
            for view in views or [folder]:
                with listed(problems):
                    captures.append(
                        _capture(folder.name, view, view.name if views else SINGLE_VIEW, frames)
                    )
    if not captures and not problems:
        problems.append(
            f"{root}: holds no folder of an object; expected {root / 'OBJECT' / 'VIEW'} with the "
            f"frames"
        )
    if problems:
        raise CaptureError("\n  ".join(problems))
    return captures


def _capture(name: str, folder: Path, view: str, frames: int) -> Capture:
    if not VIEW_NAME.fullmatch(view):
        suggested = f", such as {view.replace('_', '-')}" if "_" in view else ""
        raise CaptureError(
            f"{folder}: expected a view name of letters, digits and - (no _){suggested}; rename "
            f"the folder"
        )
    files = frame_files(folder)
    if len(files) != frames:
        raise CaptureError(
            f"{folder}: expected the {frames} frames of the rig's sequence, found {len(files)} "
            f"({files[0].name} to "
            f"{files[-1].name}); capture what is missing, or give the rig that took them"
        )
    return Capture(name, view, folder, tuple(files))


@contextmanager
def listed(problems: list[str]) -> Iterator[None]:
    """Add a `LayoutError` or `CaptureError` inside the block to ``problems``."""
    try:
        yield
    except (LayoutError, CaptureError) as error:
        problems.append(str(error))


def _folders(folder: Path) -> list[Path]:
    folders = [path for path in visible(folder, CaptureError) if path.is_dir()]
    return sorted(folders, key=lambda path: natural_key(path.name))


def _images(folder: Path, suffixes: Sequence[str] = SUFFIXES) -> list[Path]:
    return [
        path
        for path in visible(folder, CaptureError)
        if path.is_file() and path.suffix.lower() in suffixes
    ]
