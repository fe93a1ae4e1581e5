"""A scanner's captures in folders, ``{object}/{view}/`` or ``{object}/``, and the split that each object belongs to."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pydantic import Field

from fpp_ml_bench.constants import OBJECT_NAME, SPLITS, VIEW_NAME, sample_name
from fpp_ml_bench.errors import BuildError, CaptureError
from fpp_ml_bench.files import read_yaml
from fpp_ml_bench.loaders.captures.images import SUFFIXES, frame_files, natural_key
from fpp_ml_bench.schema import StrictModel, Text, validate

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
    """The splits of a YAML file with lists of objects under train, validation and test. Raises `BuildError` naming the
    file and every key that is wrong."""
    return validate(Splits, read_yaml(file, BuildError), file, f"list of {', '.join(SPLITS)}", BuildError)


def split_captures(captures: Iterable[Capture], splits: Splits | None) -> dict[str, list[Capture]]:
    """The captures of each split that has any; all in ``test`` without ``splits``. Raises `BuildError` for an object in
    two splits or twice in one, in none, or without captures."""
    captures = list(captures)
    if splits is None:
        return {"test": captures}
    objects = list(dict.fromkeys(capture.object for capture in captures))
    places: dict[str, list[str]] = {}
    for split in SPLITS:
        for name in getattr(splits, split):
            places.setdefault(name, []).append(split)
    problems = [
        f"object {name!r} is listed under {' and '.join(found)}; keep it in one split"
        for name, found in places.items()
        if len(found) > 1
    ]
    problems += [f"object {name!r} has no captures; remove it" for name in places if name not in objects]
    problems += [f"object {name!r} is in no split; add it" for name in objects if name not in places]
    if problems:
        raise BuildError("\n  ".join([f"splits: expected each of {len(objects)} objects in one split", *problems]))
    by_split = {split: [c for c in captures if places[c.object] == [split]] for split in SPLITS}
    return {split: chosen for split, chosen in by_split.items() if chosen}


def find_captures(root: Path, frames: int) -> list[Capture]:
    """The captures below ``root``, of ``frames`` images each, by object and view in the order of their names. Names
    that begin with a dot and other files are left out. Raises `CaptureError` with a line for each folder that is no
    capture."""
    if not root.is_dir():
        raise CaptureError(f"{root}: expected a folder with a folder of frames for each object, found none there")
    problems: list[str] = []
    if _images(root):
        problems.append(f"{root}: holds frames itself; move the frames of each object into a folder of its name")
    captures: list[Capture] = []
    for folder in _folders(root):
        if not OBJECT_NAME.fullmatch(folder.name):
            problems.append(f"{folder}: expected an object name of letters, digits, - and _; rename the folder")
            continue
        captures += _of_object(folder, frames, problems)
    if not captures and not problems:
        problems.append(f"{root}: holds no folder of an object; expected {root / 'OBJECT' / 'VIEW'} with the frames")
    if problems:
        raise CaptureError("\n  ".join(problems))
    return captures


def _of_object(folder: Path, frames: int, problems: list[str]) -> Iterable[Capture]:
    views = _folders(folder)
    if views and _images(folder):
        problems.append(f"{folder}: holds frames and folders; give a folder of frames for each view, or frames alone")
        return
    for view in views or [folder]:
        name = view.name if views else SINGLE_VIEW
        if not VIEW_NAME.fullmatch(name):
            suggested = f", such as {name.replace('_', '-')}" if "_" in name else ""
            problems.append(
                f"{view}: expected a view name of letters, digits and - (no _){suggested}; rename the folder"
            )
            continue
        try:
            files = frame_files(view)
        except CaptureError as error:
            problems.append(str(error))
            continue
        if len(files) != frames:
            problems.append(
                f"{view}: expected the {frames} frames of the rig's sequence, found {len(files)} ({files[0].name} to "
                f"{files[-1].name}); capture what is missing, or give the rig that took them"
            )
            continue
        yield Capture(folder.name, name, view, tuple(files))


def _folders(folder: Path) -> list[Path]:
    found = [path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")]
    return sorted(found, key=lambda path: (natural_key(path.name), path.name))


def _images(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.is_file() and path.suffix.lower() in SUFFIXES]
