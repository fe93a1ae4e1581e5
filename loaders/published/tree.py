"""The published tree: its names, and a scan that lists its samples and every error in the layout that names alone show.
Only directory entries and PNG headers are read here; contents are checked when a sample is read
(`fpp_ml_bench.loaders.published.importing`). Names that begin with a dot, and files beside the folders, are ignored."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.constants import OBJECT_NAME, OBJECTS, PUBLISHED_SPLIT_FOLDERS, VIEWS, sample_name, split_sample_name
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

_COLOURS = {PNG_GREY: "grey", PNG_RGB: "RGB", 3: "palette", 4: "grey + alpha", 6: "RGB + alpha"}


def png_size(start: bytes) -> tuple[int, int]:
    """Size (H, W) of an 8-bit grey or RGB PNG, by the first bytes of its file; PredictionError for any other."""
    header = png_header(start)
    if header is None:
        raise PredictionError("expected a PNG file, got other content")
    if header.bits != 8:
        raise PredictionError(f"expected an 8-bit PNG, got {header.bits} bits per channel; convert it to 8 bits")
    if header.colour not in (PNG_GREY, PNG_RGB):
        colour = _COLOURS.get(header.colour, header.colour)
        raise PredictionError(f"expected a grey PNG, or RGB with equal channels, got {colour}")
    return header.size


def frame_file(index: int) -> str:
    """File name of frame ``index`` in a raw scan."""
    return f"A_{index}.png"


def layout_error(root: object, problems: list[str]) -> LayoutError:
    """The error that lists the problems of a tree, a line each, at most `LISTED_PROBLEMS` of them."""
    problems = "\n".join(problems).splitlines()
    shown = problems[:LISTED_PROBLEMS]
    if len(problems) > len(shown):
        shown.append(f"... and {len(problems) - len(shown)} more")
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    return LayoutError("\n  ".join([f"{root}: {count} with the published layout:", *shown]))


@dataclass(frozen=True)
class PublishedSample:
    """Files of a sample: fringe and depth per variant in the tree's order, depth range, raw frames in file order."""

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
    """A tree with a valid layout: image size (H, W), variants present, samples split by split in row order."""

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
            f"{root}: no such folder; give the folder that holds {TRAINING}/, or OWNER/NAME of a dataset on the "
            "Hugging Face Hub"
        )
    scans = root / RAW_SCANS if (root / RAW_SCANS).is_dir() else None
    training = root / TRAINING if (root / TRAINING).is_dir() else root
    if any((training / folder).is_dir() for folder in VARIANT_FOLDERS.values()):
        return training, scans
    if scans or root.name == RAW_SCANS:
        raise LayoutError(
            f"{root}: raw scans alone have no depth in mm (z.csv is in the reconstruction's own units); put them "
            f"beside {TRAINING}/, which holds it"
        )
    if any((training / folder).is_dir() for folder in BACKGROUND_REMOVED_FOLDERS.values()):
        raise LayoutError(
            f"{training}: only background-removed data, without the fringes outside the object; "
            f"add {VARIANT_FOLDERS['raw']}/"
        )
    raise LayoutError(
        f"{root}: expected {TRAINING}/ with one of {', '.join(VARIANT_FOLDERS.values())}, got none of them"
    )


def scan_tree(root: Path, frames: int, only: Collection[str] | None = None) -> PublishedTree:
    """Scan the tree at ``root``, whose raw scans have ``frames`` files. Raises `LayoutError` listing all problems.
    ``root`` holds ``training_datasets/`` and maybe ``fpp_synthetic_dataset/``, or is ``training_datasets`` itself. Of
    the folders of variants and raw scans, those that ``only`` names are read; None: all."""
    training, scans = _locate(root)
    scans = scans if only is None or RAW_SCANS in only else None
    scan, frame_files = _Scan(), [frame_file(index) for index in range(frames)]
    read = {name: folder for name, folder in VARIANT_FOLDERS.items() if only is None or folder in only}
    variants = tuple(name for name, folder in read.items() if (training / folder).is_dir())
    folders = [training / VARIANT_FOLDERS[name] for name in variants]
    names = PUBLISHED_SPLIT_FOLDERS.values()
    present = {name for folder in folders for name in scan.known(folder, names, f"the folders {', '.join(names)}")}
    info = training / INFO if (training / INFO).is_dir() else None
    if info:
        scan.known(info, present, f"the folders {', '.join(sorted(present))}")
    elif variants == ("individual",):
        reason = "normalised depth can't be converted to mm without it"
        scan.problems.append(f"{training / INFO}: the folder is missing; {reason}")
    samples: list[PublishedSample] = []
    for split, name in PUBLISHED_SPLIT_FOLDERS.items():
        parts = [folder / name for folder in folders]
        ranges = info / name / DEPTH if info else None
        for stem in sorted(scan.stems(parts, ranges) if name in present else (), key=_place):
            fringes, depths = (tuple(part / kind / f"{stem}{_KINDS[kind]}" for part in parts) for kind in _KINDS)
            label, limits = split_sample_name(stem), ranges / f"{stem}.mat" if ranges else None
            raw = [scans.joinpath(*label, name) for name in frame_files] if scans else ()
            samples.append(PublishedSample(stem, *label, split, fringes, depths, limits, tuple(raw)))
    scan.objects(samples)
    if scans:
        scan.raw_scans(scans, {sample.sample for sample in samples}, frame_files)
    if not samples and not scan.problems:
        scan.problems.append(f"{folders[0]}: holds no sample")
    images = [path for sample in samples for path in (*sample.fringes, *sample.frames)]
    size = scan.size([path for path in images if path.exists() or path.is_symlink()])
    if scan.problems:
        raise layout_error(root, scan.problems)
    ignored = [name for name in BACKGROUND_REMOVED_FOLDERS.values() if (training / name).is_dir()]
    if scans:
        ignored += [f"{RAW_SCANS}/*/*/{name}" for name in NOT_STORED if next(scans.glob(f"*/*/{name}"), None)]
    return PublishedTree(root, size, variants, samples, scans is not None, tuple(ignored))


def _place(stem: str) -> tuple[int, str, int]:
    """Sort key of a sample: the benchmark's objects in their order, then all other objects by name; by view."""
    name, view = split_sample_name(stem)
    return OBJECTS.index(name) if name in OBJECTS else len(OBJECTS), name, VIEWS.index(view)


class _Scan:
    """Lists files folder by folder, and collects ``problems``, a line each."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def _foreign(self, entry: Path, expected: str) -> None:
        self.problems.append(f"{entry}: does not belong here; expected {expected}")

    def _entries(self, folder: Path) -> list[Path]:
        if folder.is_dir():
            return visible(folder, LayoutError)
        self.problems.append(f"{folder}: the folder is missing")
        return []

    def known(self, folder: Path, names: Collection[str], expected: str) -> dict[str, Path]:
        """Entries called ``names`` in a folder; reports everything else in it."""
        entries = {entry.name: entry for entry in self._entries(folder)}
        for name in sorted(entries.keys() - names):
            self._foreign(entries.pop(name), expected)
        return entries

    def stems(self, parts: list[Path], ranges: Path | None) -> set[str]:
        """Samples of which the folders ``parts`` of a split hold a fringe or a depth; reports what is not there for
        each of them, and depth ranges in the folder ``ranges`` that belong to none."""
        listed: dict[Path, set[str]] = {}
        for part in parts:
            self.known(part, _KINDS, f"the folders {' and '.join(_KINDS)}")
            listed |= {part / kind: self._named(part / kind) for kind in _KINDS}
        stems = set[str]().union(*listed.values())
        if ranges:
            listed[ranges] = self._named(ranges)
            extra = sorted(listed[ranges] - stems)
            self.problems += [f"{ranges / stem}.mat: belongs to no sample of this split" for stem in extra]
        for folder, present in listed.items():
            for stem in sorted(stems - present):
                other = next(place for place, there in listed.items() if stem in there)
                found = f"{other / stem}{_KINDS[other.name]}"
                self.problems.append(f"{folder / stem}{_KINDS[folder.name]}: is missing; {found} is there")
        return stems

    def _named(self, folder: Path) -> set[str]:
        """Samples with a file in a folder of fringes or depths."""
        suffix, stems = _KINDS[folder.name], set()
        for entry in self._entries(folder):
            name, _, view = entry.stem.rpartition("_")
            if entry.suffix != suffix or not entry.is_file():
                self._foreign(entry, f"files ending in {suffix}")
            elif not OBJECT_NAME.fullmatch(name) or view not in VIEWS:
                self.problems.append(f"{entry}: expected a name like power_drill_A60{suffix}, views {', '.join(VIEWS)}")
            else:
                stems.add(entry.stem)
        return stems

    def raw_scans(self, root: Path, samples: set[str], names: list[str]) -> None:
        """Report what is not a raw scan of frames ``names`` for each of the ``samples``."""
        scans: dict[str, Path] = {}
        for folder in visible(root, LayoutError):
            if not folder.is_dir():
                self._foreign(folder, "one folder per object")
                continue
            views = self.known(folder, VIEWS, f"the folders {', '.join(VIEWS)}")
            scans |= {sample_name(folder.name, name): view for name, view in views.items()}
        for stem, view in scans.items():
            if stem not in samples:
                self.problems.append(f"{view}: a raw scan without depth; {TRAINING} has no sample {stem}")
                continue
            present = self.known(view, {*names, *NOT_STORED}, f"{names[0]} to {names[-1]}, {', '.join(NOT_STORED)}")
            self.problems += [f"{view / name}: is missing" for name in names if name not in present]
        missing = (root.joinpath(*split_sample_name(stem)) for stem in sorted(samples - scans.keys()))
        self.problems += [f"{view}: the raw scan is missing" for view in missing]

    def objects(self, samples: list[PublishedSample]) -> None:
        """Report objects that are in two splits or lack views."""
        first_files: dict[str, dict[str, Path]] = {}
        for sample in samples:
            first_files.setdefault(sample.object, {}).setdefault(sample.split, sample.fringes[0])
        stems = {sample.sample for sample in samples}
        for name, by_split in first_files.items():
            first, *others = by_split.values()
            if others:
                self.problems.append(f"{first}: object {name} is in two splits, see {', '.join(map(str, others))}")
            if missing := [stem for view in VIEWS if (stem := sample_name(name, view)) not in stems]:
                self.problems.append(f"{first.parent}: object {name} lacks {', '.join(missing)}")

    def size(self, paths: list[Path]) -> tuple[int, int]:
        """Image size of most PNG headers; reports every file of another size."""
        sizes: dict[Path, tuple[int, int]] = {}
        for path in paths:
            try:
                with opened(path, links=True) as (stream, _):
                    sizes[path] = png_size(stream.read(PNG_HEADER_BYTES))
            except PredictionError as error:
                self.problems.append(f"{path}: {error}")
        common = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
        self.problems += [
            f"{path}: expected {common[1]} x {common[0]} px as most images here, got {size[1]} x {size[0]}"
            for path, size in sizes.items()
            if size != common
        ]
        return common
