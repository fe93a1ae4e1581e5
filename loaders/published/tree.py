"""The published tree: its names, and a scan that lists its samples and every error in the layout that names alone show.
Only directory entries and PNG headers are read here; contents are checked when a sample is read
(`fpp_ml_bench.loaders.published.importing`). Names that begin with a dot, and files beside the folders, are ignored."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
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
FilesBySplit = dict[str, dict[str, Path]]
"""The files of each split by stem (sample name); keys are this package's split names."""


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
        return (*self.fringes, *self.depths, *([self.info] if self.info else []), *self.frames)


@dataclass(frozen=True)
class PublishedTree:
    """A tree with a valid layout: image size (H, W), variants present, samples per split in row order."""

    root: Path
    size: tuple[int, int]
    variants: tuple[Normalisation, ...]
    samples: dict[str, list[PublishedSample]]
    has_frames: bool
    ignored: tuple[str, ...]

    @cached_property
    def by_name(self) -> dict[str, PublishedSample]:
        return {sample.sample: sample for samples in self.samples.values() for sample in samples}


def _locate(root: Path) -> tuple[Path, Path | None]:
    """Folders of the training data and of the raw scans."""
    if not root.is_dir():
        raise LayoutError(f"{root}: no such folder; give the folder that holds {TRAINING}/")
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


def scan_tree(root: Path, frames: int) -> PublishedTree:
    """Scan the tree at ``root``, whose raw scans have ``frames`` files. Raises `LayoutError` listing all problems.
    ``root`` holds ``training_datasets/`` and maybe ``fpp_synthetic_dataset/``, or is ``training_datasets`` itself."""
    training, scans_folder = _locate(root)
    scan = _Scan(training)
    variants = tuple(name for name, folder in VARIANT_FOLDERS.items() if (training / folder).is_dir())
    files = [scan.variant(training / VARIANT_FOLDERS[name]) for name in variants]
    scan.same_stems(variants, [part[FRINGE] for part in files])
    info = scan.info(files[0][DEPTH], needed=variants == ("individual",))
    scans = scan.raw_scans(scans_folder, files[0][FRINGE], frames) if scans_folder else {}
    samples = {split: scan.samples(split, files, info, scans) for split in PUBLISHED_SPLIT_FOLDERS}
    samples = {split: part for split, part in samples.items() if part}
    everything = [sample for part in samples.values() for sample in part]
    scan.objects(everything)
    if not samples and not scan.problems:
        scan.problems.append(f"{training / VARIANT_FOLDERS[variants[0]]}: holds no sample")
    size = scan.size(everything)
    if scan.problems:
        raise layout_error(root, scan.problems)
    ignored = [name for name in BACKGROUND_REMOVED_FOLDERS.values() if (training / name).is_dir()]
    if scans_folder:
        computed = (name for name in NOT_STORED if next(scans_folder.glob(f"*/*/{name}"), None))
        ignored += [f"{RAW_SCANS}/*/*/{name}" for name in computed]
    return PublishedTree(root, size, variants, samples, scans_folder is not None, tuple(ignored))


class _Scan:
    """Lists files folder by folder, and collects ``problems``, a line each."""

    def __init__(self, training: Path) -> None:
        self.training = training
        self.problems: list[str] = []

    def _foreign(self, entry: Path, expected: str) -> None:
        self.problems.append(f"{entry}: does not belong here; expected {expected}")

    def _folders(self, folder: Path, names: Collection[str], listed: str) -> list[Path]:
        """Folders called ``names`` in a folder; reports everything else in it."""
        folders = []
        for entry in visible(folder, LayoutError):
            if entry.name in names and entry.is_dir():
                folders.append(entry)
            else:
                self._foreign(entry, f"the folders {listed}")
        return folders

    def _files(self, folder: Path, suffix: str) -> dict[str, Path]:
        if not folder.is_dir():
            self.problems.append(f"{folder}: the folder is missing")
            return {}
        files = {}
        for entry in visible(folder, LayoutError):
            name, _, view = entry.stem.rpartition("_")
            if entry.suffix != suffix or not entry.is_file():
                self._foreign(entry, f"files ending in {suffix}")
            elif not OBJECT_NAME.fullmatch(name) or view not in VIEWS:
                self.problems.append(f"{entry}: expected a name like power_drill_A60{suffix}, views {', '.join(VIEWS)}")
            else:
                files[entry.stem] = entry
        return files

    def variant(self, folder: Path) -> dict[str, FilesBySplit]:
        """Fringes and depths of a variant; reports every file without its counterpart."""
        files: dict[str, FilesBySplit] = {kind: {} for kind in _KINDS}
        splits = {published: split for split, published in PUBLISHED_SPLIT_FOLDERS.items()}
        for entry in self._folders(folder, splits, ", ".join(splits)):
            self._folders(entry, _KINDS, " and ".join(_KINDS))
            for kind, suffix in _KINDS.items():
                files[kind][splits[entry.name]] = self._files(entry / kind, suffix)
        for split in files[FRINGE]:
            for kind, other in ((DEPTH, FRINGE), (FRINGE, DEPTH)):
                present = files[other][split]
                target = folder / PUBLISHED_SPLIT_FOLDERS[split] / kind
                self.problems += [
                    f"{target / (stem + _KINDS[kind])}: is missing, {present[stem]} has no {kind}"
                    for stem in sorted(present.keys() - files[kind][split].keys())
                ]
        return files

    def same_stems(self, variants: tuple[Normalisation, ...], fringes: list[FilesBySplit]) -> None:
        """Report samples of the first variant that another variant lacks in the same split, and the reverse."""
        for name, others in zip(variants[1:], fringes[1:], strict=True):
            for split, published in PUBLISHED_SPLIT_FOLDERS.items():
                first, here = fringes[0].get(split, {}).keys(), others.get(split, {}).keys()
                for lacking, holding, stems in ((name, variants[0], first - here), (variants[0], name, here - first)):
                    folder = self.training / VARIANT_FOLDERS[lacking] / published / FRINGE
                    self.problems += [
                        f"{folder / (stem + '.png')}: is missing; {VARIANT_FOLDERS[holding]} has it in {published}"
                        for stem in sorted(stems)
                    ]

    def info(self, depths: FilesBySplit, needed: bool) -> FilesBySplit:
        """Files of the depth ranges, one for each depth; reports the absence of what is ``needed``."""
        folder = self.training / INFO
        if not folder.is_dir():
            if needed:
                reason = "normalised depth can't be converted to mm without it"
                self.problems.append(f"{folder}: the folder is missing; {reason}")
            return {}
        files: FilesBySplit = {}
        split_folders = sorted(PUBLISHED_SPLIT_FOLDERS[split] for split in depths)
        self._folders(folder, split_folders, ", ".join(split_folders))
        for split, expected in depths.items():
            part = folder / PUBLISHED_SPLIT_FOLDERS[split] / DEPTH
            found = files[split] = self._files(part, ".mat")
            if part.is_dir():
                missing, extra = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
                self.problems += [f"{part / (stem + '.mat')}: is missing" for stem in missing]
                self.problems += [f"{found[stem]}: belongs to no sample of this split" for stem in extra]
        return files

    def raw_scans(self, root: Path, fringes: FilesBySplit, frames: int) -> dict[str, tuple[Path, ...]]:
        """Frames of each sample in file order, of which there must be ``frames``."""
        stems_with_depth = {stem for split in fringes.values() for stem in split}
        names = [frame_file(index) for index in range(frames)]
        scans: dict[str, tuple[Path, ...]] = {}
        for folder in visible(root, LayoutError):
            if not folder.is_dir():
                self._foreign(folder, "one folder per object")
                continue
            for view in self._folders(folder, VIEWS, ", ".join(VIEWS)):
                stem = sample_name(folder.name, view.name)
                if stem not in stems_with_depth:
                    self.problems.append(f"{view}: a raw scan without depth; {TRAINING} has no sample {stem}")
                    continue
                present = {entry.name: entry for entry in visible(view, LayoutError)}
                self.problems += [f"{view / name}: is missing" for name in names if name not in present]
                for name in sorted(set(present) - set(names) - set(NOT_STORED)):
                    self._foreign(present[name], f"{names[0]} to {names[-1]}, {', '.join(NOT_STORED)}")
                scans[stem] = tuple(present[name] for name in names if name in present)
        self.problems += [
            f"{root.joinpath(*split_sample_name(stem))}: the raw scan is missing"
            for stem in sorted(stems_with_depth - set(scans))
        ]
        return scans

    def samples(
        self, split: str, files: list[dict[str, FilesBySplit]], info: FilesBySplit, scans: dict[str, tuple[Path, ...]]
    ) -> list[PublishedSample]:
        """Samples of a split: the benchmark's objects in their order, then all other objects by name."""
        samples = []
        for stem in files[0][FRINGE].get(split, {}):
            fringes, depths = (
                tuple(part[kind][split][stem] for part in files if stem in part[kind].get(split, {}))
                for kind in (FRINGE, DEPTH)
            )
            label = split_sample_name(stem)
            more = info.get(split, {}).get(stem), scans.get(stem, ())
            samples.append(PublishedSample(stem, *label, split, fringes, depths, *more))

        def place(sample: PublishedSample) -> tuple[int, str, int]:
            known = OBJECTS.index(sample.object) if sample.object in OBJECTS else len(OBJECTS)
            return known, sample.object, VIEWS.index(sample.view)

        return sorted(samples, key=place)

    def objects(self, samples: list[PublishedSample]) -> None:
        """Report objects that are in two splits or lack views."""
        first_files: dict[str, dict[str, Path]] = {}
        views: dict[str, set[str]] = {}
        for s in samples:
            views.setdefault(s.object, set()).add(s.view)
            first_files.setdefault(s.object, {}).setdefault(s.split, s.fringes[0])
        for name, by_split in first_files.items():
            first, *others = by_split.values()
            if others:
                self.problems.append(f"{first}: object {name} is in two splits, see {', '.join(map(str, others))}")
        for name, seen in views.items():
            if missing := [sample_name(name, view) for view in VIEWS if view not in seen]:
                folder = next(iter(first_files[name].values())).parent
                self.problems.append(f"{folder}: object {name} lacks {', '.join(missing)}")

    def size(self, samples: list[PublishedSample]) -> tuple[int, int]:
        """Image size of most PNG headers; reports every file of another size."""
        sizes: dict[Path, tuple[int, int]] = {}
        for path in (path for sample in samples for path in (*sample.fringes, *sample.frames)):
            try:
                with opened(path, links=True) as (stream, _):
                    sizes[path] = png_size(stream.read(PNG_HEADER_BYTES))
            except PredictionError as error:
                self.problems.append(f"{path}: {error}")
        if not sizes:
            return 0, 0
        common = Counter(sizes.values()).most_common(1)[0][0]
        self.problems += [
            f"{path}: expected {common[1]} x {common[0]} px as most images here, got {size[1]} x {size[0]}"
            for path, size in sizes.items()
            if size != common
        ]
        return common
