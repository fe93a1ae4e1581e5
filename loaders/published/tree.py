"""The published tree: its names, and a scan that lists its samples and every error in the layout that names alone show.

Only directory entries and PNG headers are read here; contents are checked when a sample is read
(`fpp_ml_bench.loaders.published.importing`). Names that begin with a dot, and files beside the folders, are ignored.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.constants import OBJECTS, PUBLISHED_SPLIT_FOLDERS, VIEWS, sample_name, split_sample_name
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published.png import read_png_header

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
    "raw": "depthMap", "global": "depthMapMeters", "individual": "depthMapNormalized",
}  # fmt: skip
WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS = "wrapped_phase.mat", "unwrapped_phase.mat", "z.csv"
WRAPPED_PHASE_VARIABLE, UNWRAPPED_PHASE_VARIABLE = "wph", "uph"
NOT_STORED = (WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS)
"""Files of a raw scan that are computed from its frames; the import ignores them."""

LISTED_PROBLEMS = 50
_KINDS = {FRINGE: ".png", DEPTH: ".mat"}
FilesBySplit = dict[str, dict[str, Path]]
"""The files of each split by stem (sample name); keys are this package's split names."""


def frame_file(index: int) -> str:
    """File name of frame ``index`` in a raw scan."""
    return f"A_{index}.png"


def label_of(stem: str) -> tuple[str, str] | None:
    """Object and view in a file name without its suffix, None for any other name."""
    try:
        name, view = split_sample_name(stem)
    except ValueError:
        return None
    return (name, view) if view in VIEWS else None


def layout_error(root: object, problems: list[str]) -> LayoutError:
    """The error that lists the problems of a tree, at most `LISTED_PROBLEMS` of them."""
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

    def all_samples(self) -> list[PublishedSample]:
        return [sample for samples in self.samples.values() for sample in samples]


def scan_tree(root: Path, frames: int) -> PublishedTree:
    """Scan the tree at ``root``, whose raw scans have ``frames`` files. Raises `LayoutError` listing all problems.

    ``root`` holds ``training_datasets/`` and maybe ``fpp_synthetic_dataset/``, or is ``training_datasets`` itself.
    """
    return _Scan(root, frames).tree()


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


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise LayoutError(f"{folder}: can't be read ({error.strerror or error})") from error


class _Scan:
    def __init__(self, root: Path, frames: int) -> None:
        self.root, self.frame_count = root, frames
        self.training, self.scans = _locate(root)
        self.problems: list[str] = []

    def tree(self) -> PublishedTree:
        variants = tuple(name for name, folder in VARIANT_FOLDERS.items() if (self.training / folder).is_dir())
        pairs = [self._variant(self.training / VARIANT_FOLDERS[name]) for name in variants]
        self._same_stems(variants, pairs)
        info = self._info(pairs[0][1], needed=variants == ("individual",))
        scans = self._raw_scans(pairs[0][0]) if self.scans else {}
        samples = {split: self._samples(split, pairs, info, scans) for split in PUBLISHED_SPLIT_FOLDERS}
        samples = {split: split_samples for split, split_samples in samples.items() if split_samples}
        self._objects(samples)
        if not samples and not self.problems:
            self.problems.append(f"{self.training / VARIANT_FOLDERS[variants[0]]}: holds no sample")
        size = self._sizes(samples)
        if self.problems:
            raise layout_error(self.root, self.problems)
        return PublishedTree(self.root, size, variants, samples, self.scans is not None, self._ignored())

    def _variant(self, folder: Path) -> tuple[FilesBySplit, FilesBySplit]:
        """Fringes and depths of a variant; reports every file without its counterpart."""
        files: dict[str, FilesBySplit] = {kind: {} for kind in _KINDS}
        splits = {published: split for split, published in PUBLISHED_SPLIT_FOLDERS.items()}
        for entry in _entries(folder):
            if entry.name not in splits or not entry.is_dir():
                self._report_foreign(entry, f"expected the folders {', '.join(splits)}")
                continue
            for part in _entries(entry):
                if part.name not in _KINDS or not part.is_dir():
                    self._report_foreign(part, f"expected the folders {FRINGE} and {DEPTH}")
            for kind, suffix in _KINDS.items():
                files[kind][splits[entry.name]] = self._files(entry / kind, suffix)
        for split in files[FRINGE]:
            fringes, depths = files[FRINGE][split], files[DEPTH][split]
            published = folder / PUBLISHED_SPLIT_FOLDERS[split]
            for stem in sorted(set(fringes) - set(depths)):
                self.problems.append(f"{published / DEPTH / (stem + '.mat')}: is missing, {fringes[stem]} has no depth")
            for stem in sorted(set(depths) - set(fringes)):
                self.problems.append(
                    f"{published / FRINGE / (stem + '.png')}: is missing, {depths[stem]} has no fringe"
                )
        return files[FRINGE], files[DEPTH]

    def _files(self, folder: Path, suffix: str) -> dict[str, Path]:
        if not folder.is_dir():
            self.problems.append(f"{folder}: the folder is missing")
            return {}
        files = {}
        for entry in _entries(folder):
            if entry.suffix != suffix or not entry.is_file():
                self._report_foreign(entry, f"expected files ending in {suffix}")
            elif label_of(entry.stem) is None:
                self.problems.append(f"{entry}: expected a name like power_drill_A60{suffix}, views {', '.join(VIEWS)}")
            else:
                files[entry.stem] = entry
        return files

    def _report_foreign(self, entry: Path, expected: str) -> None:
        self.problems.append(f"{entry}: does not belong here; {expected}")

    def _same_stems(self, variants: tuple[Normalisation, ...], pairs: list[tuple[FilesBySplit, FilesBySplit]]) -> None:
        """Report samples of the first variant that another variant lacks in the same split, and the reverse."""
        for name, (fringes, _) in zip(variants[1:], pairs[1:], strict=True):
            for split, published in PUBLISHED_SPLIT_FOLDERS.items():
                first_stems, stems_here = set(pairs[0][0].get(split, {})), set(fringes.get(split, {}))
                for lacking, holding, stems in (
                    (name, variants[0], first_stems - stems_here),
                    (variants[0], name, stems_here - first_stems),
                ):
                    folder = self.training / VARIANT_FOLDERS[lacking] / published / FRINGE
                    self.problems += [
                        f"{folder / (stem + '.png')}: is missing; {VARIANT_FOLDERS[holding]} has it in {published}"
                        for stem in sorted(stems)
                    ]

    def _info(self, depths: FilesBySplit, needed: bool) -> FilesBySplit:
        folder = self.training / INFO
        if not folder.is_dir():
            if needed:
                self.problems.append(
                    f"{folder}: the folder is missing; normalised depth can't be converted to mm without it"
                )
            return {}
        files: FilesBySplit = {}
        split_folders = {PUBLISHED_SPLIT_FOLDERS[split] for split in depths}
        for entry in _entries(folder):
            if entry.name not in split_folders:
                self._report_foreign(entry, f"expected the folders {', '.join(sorted(split_folders))}")
        for split, expected in depths.items():
            part = folder / PUBLISHED_SPLIT_FOLDERS[split] / DEPTH
            files[split] = self._files(part, ".mat")
            if part.is_dir():
                missing, extra = set(expected) - set(files[split]), set(files[split]) - set(expected)
                self.problems += [f"{part / (stem + '.mat')}: is missing" for stem in sorted(missing)]
                self.problems += [f"{files[split][stem]}: belongs to no sample of this split" for stem in sorted(extra)]
        return files

    def _raw_scans(self, fringes: FilesBySplit) -> dict[str, tuple[Path, ...]]:
        root = self.scans
        if root is None:
            return {}
        stems_with_depth = {stem for split in fringes.values() for stem in split}
        scans: dict[str, tuple[Path, ...]] = {}
        for folder in _entries(root):
            if not folder.is_dir():
                self._report_foreign(folder, "expected one folder per object")
                continue
            for view in _entries(folder):
                stem = sample_name(folder.name, view.name)
                if view.name not in VIEWS or not view.is_dir():
                    self._report_foreign(view, f"expected the folders {', '.join(VIEWS)}")
                elif stem not in stems_with_depth:
                    self.problems.append(f"{view}: a raw scan without depth; {TRAINING} has no sample {stem}")
                else:
                    scans[stem] = self._frames(view)
        self.problems += [
            f"{root / label[0] / label[1]}: the raw scan is missing"
            for stem in sorted(stems_with_depth - set(scans)) if (label := label_of(stem))
        ]  # fmt: skip
        return scans

    def _frames(self, folder: Path) -> tuple[Path, ...]:
        names = [frame_file(index) for index in range(self.frame_count)]
        present = {entry.name: entry for entry in _entries(folder)}
        self.problems += [f"{folder / name}: is missing" for name in names if name not in present]
        for name in sorted(set(present) - set(names) - set(NOT_STORED)):
            self._report_foreign(present[name], f"expected {names[0]} to {names[-1]}, {', '.join(NOT_STORED)}")
        return tuple(present[name] for name in names if name in present)

    def _samples(
        self,
        split: str,
        pairs: list[tuple[FilesBySplit, FilesBySplit]],
        info: FilesBySplit,
        scans: dict[str, tuple[Path, ...]],
    ) -> list[PublishedSample]:
        samples = []
        for stem in pairs[0][0].get(split, {}):
            label = label_of(stem)
            if label is None:
                continue
            files = [(fringes.get(split, {}).get(stem), depths.get(split, {}).get(stem)) for fringes, depths in pairs]
            samples.append(
                PublishedSample(
                    stem, *label, split,
                    tuple(fringe for fringe, _ in files if fringe), tuple(depth for _, depth in files if depth),
                    info.get(split, {}).get(stem), scans.get(stem, ()),
                )
            )  # fmt: skip
        return sorted(samples, key=lambda sample: (*_row_order(sample.object), VIEWS.index(sample.view)))

    def _objects(self, samples: dict[str, list[PublishedSample]]) -> None:
        """Report objects that are in two splits or lack views."""
        first_samples: dict[str, dict[str, PublishedSample]] = {}
        views: dict[str, set[str]] = {}
        for sample in (sample for split_samples in samples.values() for sample in split_samples):
            views.setdefault(sample.object, set()).add(sample.view)
            first_samples.setdefault(sample.object, {}).setdefault(sample.split, sample)
        for name, by_split in first_samples.items():
            first_file, *more_files = (sample.fringes[0] for sample in by_split.values())
            if more_files:
                self.problems.append(
                    f"{first_file}: object {name} is in two splits, see {', '.join(map(str, more_files))}"
                )
        for name, object_views in views.items():
            if missing := [view for view in VIEWS if view not in object_views]:
                stems = ", ".join(sample_name(name, view) for view in missing)
                self.problems.append(
                    f"{next(iter(first_samples[name].values())).fringes[0].parent}: object {name} lacks {stems}"
                )

    def _sizes(self, samples: dict[str, list[PublishedSample]]) -> tuple[int, int]:
        """Image size of most PNG headers; reports every file of another size."""
        sizes: dict[Path, tuple[int, int]] = {}
        for sample in (sample for split_samples in samples.values() for sample in split_samples):
            for path in (*sample.fringes, *sample.frames):
                try:
                    sizes[path] = read_png_header(path).size
                except LayoutError as error:
                    self.problems.append(str(error))
        if not sizes:
            return 0, 0
        common = Counter(sizes.values()).most_common(1)[0][0]
        self.problems += [
            f"{path}: expected {common[1]} x {common[0]} px as most images here, got {size[1]} x {size[0]}"
            for path, size in sizes.items() if size != common
        ]  # fmt: skip
        return common

    def _ignored(self) -> tuple[str, ...]:
        names = [name for name in BACKGROUND_REMOVED_FOLDERS.values() if (self.training / name).is_dir()]
        if self.scans:
            computed = (name for name in NOT_STORED if next(self.scans.glob(f"*/*/{name}"), None))
            names += [f"{RAW_SCANS}/*/*/{name}" for name in computed]
        return tuple(names)


def _row_order(name: str) -> tuple[int, str]:
    """Sort key of rows: the benchmark's objects in their order, then all other objects by name."""
    return (OBJECTS.index(name) if name in OBJECTS else len(OBJECTS)), name
