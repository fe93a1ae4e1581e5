"""The published tree: its names, and a scan that lists its samples and every error in the layout
that names alone show. Only directory entries and PNG headers are read here; contents are checked
when a sample is read (`fpp_ml_bench.loaders.published.importing`). Names that begin with a dot, and
files beside the folders, are ignored."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.constants import (
    OBJECT_NAME,
    OBJECTS,
    PUBLISHED_SPLIT_FOLDERS,
    VIEWS,
    sample_name,
    split_sample_name,
)
from fpp_ml_bench.containers import PNG_GREY, PNG_HEADER_BYTES, PNG_RGB, png_header
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import LayoutError, PredictionError
from fpp_ml_bench.files import opened, visible

TRAINING = "training_datasets"
RAW_SCANS = "fpp_synthetic_dataset"
FRINGE, DEPTH = "fringe", "depth"
INFO = "info_depth_params"
INFO_VARIABLES = ("depth_min", "depth_max")

VARIANT_FOLDERS: dict[Normalisation, str] = {
    "raw": "training_data_depth_raw",
    "global": "training_data_depth_global_normalized",
    "individual": "training_data_depth_individual_normalized",
}
"""Folder of each depth representation; depth in mm is taken from the first that is present."""
BACKGROUND_REMOVED_FOLDERS: dict[Normalisation, str] = {
    name: folder.replace("training_data_depth", "training_data_bgremoved_depth")
    for name, folder in VARIANT_FOLDERS.items()
}
VARIABLES: dict[Normalisation, str] = {
    "raw": "depthMap",
    "global": "depthMapMeters",
    "individual": "depthMapNormalized",
}
WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS = "wrapped_phase.mat", "unwrapped_phase.mat", "z.csv"
WRAPPED_PHASE_VARIABLE, UNWRAPPED_PHASE_VARIABLE = "wph", "uph"
NOT_STORED = (WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS)
"""Files of a raw scan that are computed from its frames; the import ignores them."""

LISTED_PROBLEMS = 50
_KINDS = {FRINGE: ".png", DEPTH: ".mat"}
_EXAMPLE = "power_drill_A60"
_SAMPLE_FILE = re.compile(rf"{OBJECT_NAME.pattern}_({'|'.join(VIEWS)})\.(png|mat)")

_LAYOUT = (
    f"SPLIT/{FRINGE}/OBJECT_VIEW.png and SPLIT/{DEPTH}/OBJECT_VIEW.mat, splits "
    f"{', '.join(PUBLISHED_SPLIT_FOLDERS.values())}, views {', '.join(VIEWS)}"
)
_COLOURS = {PNG_GREY: "grey", PNG_RGB: "RGB", 3: "palette", 4: "grey + alpha", 6: "RGB + alpha"}


def png_size(start: bytes) -> tuple[int, int]:
    """Size (H, W) of an 8-bit grey or RGB PNG, by the first bytes of its file; PredictionError for
    any other."""
    header = png_header(start)
    if header is None:
        raise PredictionError("expected a PNG file, got other content")
    if header.bits != 8:
        raise PredictionError(
            f"expected an 8-bit PNG, got {header.bits} bits per channel; convert it to 8 bits"
        )
    if header.colour not in (PNG_GREY, PNG_RGB):
        colour = _COLOURS.get(header.colour, header.colour)
        raise PredictionError(f"expected a grey PNG, or RGB with equal channels, got {colour}")
    return header.size


def frame_file(index: int) -> str:
    """File name of frame ``index`` in a raw scan."""
    return f"A_{index}.png"


def layout_error(root: object, problems: list[str]) -> LayoutError:
    """The error that lists the problems of a tree, a line each, at most `LISTED_PROBLEMS` of
    them."""
    problems = "\n".join(problems).splitlines()
    shown = problems[:LISTED_PROBLEMS]
    if len(problems) > len(shown):
        shown.append(f"... and {len(problems) - len(shown)} more")
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    return LayoutError("\n  ".join([f"{root}: {count} with the published layout:", *shown]))


@dataclass(frozen=True)
class PublishedSample:
    """Files of a sample: fringe and depth per variant in the tree's order, depth range, raw frames
    in file order."""

    sample: str
    object: str
    view: str
    split: str
    fringes: tuple[Path, ...]
    depths: tuple[Path, ...]
    info: Path | None
    frames: tuple[Path, ...]

    @property
    def files(self) -> tuple[Path, ...]:
        return (*self.fringes, *self.depths, *filter(None, [self.info]), *self.frames)


@dataclass(frozen=True)
class PublishedTree:
    """A tree with a valid layout: image size (H, W), variants present, samples split by split in
    row order."""

    root: Path
    size: tuple[int, int]
    variants: tuple[Normalisation, ...]
    samples: list[PublishedSample]
    has_frames: bool
    ignored: tuple[str, ...]


def _locate(root: Path) -> tuple[Path, Path | None]:
    """Folders of the training data and of the raw scans."""
    if not root.is_dir():
        raise LayoutError(
            f"{root}: no such folder; give the folder that holds {TRAINING}/, or OWNER/NAME of a "
            f"dataset on the "
            "Hugging Face Hub"
        )
    scans = root / RAW_SCANS if (root / RAW_SCANS).is_dir() else None
    training = root / TRAINING if (root / TRAINING).is_dir() else root
    if any((training / folder).is_dir() for folder in VARIANT_FOLDERS.values()):
        return training, scans
    if scans or root.name == RAW_SCANS:
        raise LayoutError(
            f"{root}: raw scans alone have no depth in mm (z.csv is in the reconstruction's own "
            f"units); put them "
            f"beside {TRAINING}/, which holds it"
        )
    if any((training / folder).is_dir() for folder in BACKGROUND_REMOVED_FOLDERS.values()):
        raise LayoutError(
            f"{training}: only background-removed data, without the fringes outside the object; "
            f"add {VARIANT_FOLDERS['raw']}/"
        )
    raise LayoutError(
        f"{root}: expected {TRAINING}/ with one of {', '.join(VARIANT_FOLDERS.values())}, got none "
        f"of them"
    )


def scan_tree(root: Path, frames: int, only: Collection[str] | None) -> PublishedTree:
    """Scan the tree at ``root``, whose raw scans have ``frames`` files. Raises `LayoutError`
    listing all problems. ``root`` holds ``training_datasets/`` and maybe
    ``fpp_synthetic_dataset/``, or is ``training_datasets`` itself. Of the folders of variants and
    raw scans, those that ``only`` names are read; None: all."""
    training, scans = _locate(root)
    scans = scans if only is None or RAW_SCANS in only else None
    read = {
        name: folder for name, folder in VARIANT_FOLDERS.items() if only is None or folder in only
    }
    variants = tuple(name for name, folder in read.items() if (training / folder).is_dir())
    folders, info = [training / VARIANT_FOLDERS[name] for name in variants], training / INFO
    names, problems = PUBLISHED_SPLIT_FOLDERS.values(), list[str]()
    files = {
        file
        for folder in folders
        for file in _files(folder, (names, _KINDS, _SAMPLE_FILE), _LAYOUT, problems)
    }
    expected = set[Path]()
    if info.is_dir():
        files |= _files(info, (names, (DEPTH,), _SAMPLE_FILE), _LAYOUT, problems)
    elif variants == ("individual",):
        problems.append(
            f"{info}: the folder is missing; normalised depth can't be converted to mm without it"
        )
    samples: list[PublishedSample] = []
    for split, name in PUBLISHED_SPLIT_FOLDERS.items():
        parts = [folder / name for folder in folders]
        stems = {
            file.stem
            for file in files
            if file.parent.parent in parts and file.suffix == _KINDS[file.parent.name]
        }
        for stem in sorted(stems, key=_place):
            fringes, depths = (
                tuple(part / kind / f"{stem}{_KINDS[kind]}" for part in parts) for kind in _KINDS
            )
            label, limits = (
                split_sample_name(stem),
                info / name / DEPTH / f"{stem}.mat" if info.is_dir() else None,
            )
            raw = (
                [scans.joinpath(*label, frame_file(index)) for index in range(frames)]
                if scans
                else ()
            )
            samples.append(
                PublishedSample(stem, *label, split, fringes, depths, limits, tuple(raw))
            )
            expected.update(samples[-1].files)
    problems += [f"{file}: belongs to no sample of this split" for file in sorted(files - expected)]
    if scans:
        frame_files = [frame_file(index) for index in range(frames)]
        layout = f"OBJECT/VIEW/ with {frame_files[0]} to {frame_files[-1]}, {', '.join(NOT_STORED)}"
        raw_files = _files(
            scans, (OBJECT_NAME, VIEWS, {*frame_files, *NOT_STORED}), layout, problems
        )
        views = {file.parent for file in raw_files} - {path.parent for path in expected}
        problems += [
            f"{view}: a raw scan without depth; {TRAINING} has no such sample"
            for view in sorted(views)
        ]
        files |= raw_files
    missing = sorted(expected - files)
    problems += [
        f"{folder}: the {'raw scan' if scans in folder.parents else 'folder'} is missing"
        for folder in dict.fromkeys(path.parent for path in missing)
        if not folder.is_dir()
    ]
    problems += [
        f"{path}: is missing, and other files of its sample are there"
        for path in missing
        if path.parent.is_dir()
    ]
    problems += _object_problems(samples)
    if not samples and not problems:
        problems.append(f"{folders[0]}: holds no sample")
    size = _image_size(
        [path for sample in samples for path in (*sample.fringes, *sample.frames) if path in files],
        problems,
    )
    if problems:
        raise layout_error(root, problems)
    ignored = [name for name in BACKGROUND_REMOVED_FOLDERS.values() if (training / name).is_dir()]
    if scans:
        ignored += [
            f"{RAW_SCANS}/*/*/{name}"
            for name in NOT_STORED
            if next(scans.glob(f"*/*/{name}"), None)
        ]
    return PublishedTree(root, size, variants, samples, scans is not None, tuple(ignored))


def _place(stem: str) -> tuple[int, str, int]:
    """Sort key of a sample: the benchmark's objects in their order, then all other objects by name;
    by view."""
    name, view = split_sample_name(stem)
    return OBJECTS.index(name) if name in OBJECTS else len(OBJECTS), name, VIEWS.index(view)


def _files(
    folder: Path,
    levels: Sequence[Collection[str] | re.Pattern[str]],
    layout: str,
    problems: list[str],
) -> set[Path]:
    """Files below a folder whose path has a name of each level; adds a problem for any other file
    or folder, which says what ``layout`` is expected."""
    (names, *below), files = levels, set[Path]()
    for entry in visible(folder, LayoutError):
        fits = names.fullmatch(entry.name) if isinstance(names, re.Pattern) else entry.name in names
        if not fits or entry.is_dir() != bool(below):
            if names is _SAMPLE_FILE and entry.suffix in _KINDS.values():
                problems.append(
                    f"{entry}: expected a name like {_EXAMPLE}{entry.suffix}, views "
                    f"{', '.join(VIEWS)}"
                )
            else:
                problems.append(f"{entry}: does not belong here; expected {layout}")
        elif below:
            files |= _files(entry, below, layout, problems)
        else:
            files.add(entry)
    return files


def _object_problems(samples: list[PublishedSample]) -> list[str]:
    """Objects that are in two splits or lack views."""
    problems, first_files = [], dict[str, dict[str, Path]]()
    for sample in samples:
        first_files.setdefault(sample.object, {}).setdefault(sample.split, sample.fringes[0])
    stems = {sample.sample for sample in samples}
    for name, by_split in first_files.items():
        first, *others = by_split.values()
        if others:
            problems.append(
                f"{first}: object {name} is in two splits, see {', '.join(map(str, others))}"
            )
        if missing := [stem for view in VIEWS if (stem := sample_name(name, view)) not in stems]:
            problems.append(f"{first.parent}: object {name} lacks {', '.join(missing)}")
    return problems


def _image_size(paths: list[Path], problems: list[str]) -> tuple[int, int]:
    """Image size of most PNG headers; adds a problem for every file of another size."""
    sizes: dict[Path, tuple[int, int]] = {}
    for path in paths:
        try:
            with opened(path, links=True) as (stream, _):
                sizes[path] = png_size(stream.read(PNG_HEADER_BYTES))
        except PredictionError as error:
            problems.append(f"{path}: {error}")
    common = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    problems += [
        f"{path}: expected {common[1]} x {common[0]} px as most images here, got {size[1]} x "
        f"{size[0]}"
        for path, size in sizes.items()
        if size != common
    ]
    return common
