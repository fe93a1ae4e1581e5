"""Scanning a published tree: which samples it holds, in which files, and every breach of its layout that names show.

Nothing but directory entries and PNG headers is read here; contents are checked when a sample is
(`fpp_ml_bench.loaders.published_sample`). Names that begin with a dot are left aside, as are files beside the folders.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench.constants import OBJECTS, PUBLISHED_SPLIT_FOLDERS, VIEWS, sample_name
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.loaders.published_layout import (
    BACKGROUND_REMOVED_FOLDERS,
    DEPTH,
    FRINGE,
    INFO,
    NOT_STORED,
    RAW_SCANS,
    TRAINING,
    VARIANT_FOLDERS,
    frame_file,
    label_of,
    refuse,
)  # fmt: skip
from fpp_ml_bench.loaders.published_png import read_png_header
from fpp_ml_bench.normalisation import Normalisation

_KINDS = {FRINGE: ".png", DEPTH: ".mat"}
Placed = dict[str, dict[str, Path]]
"""Per split (ours), the files of its samples by stem."""


@dataclass(frozen=True)
class PublishedSample:
    """Files of one sample: fringe and depth per variant in the tree's order, depth range, raw frames in file order."""

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
    """A tree whose layout holds: image size (H, W), variants present, samples per split in row order."""

    root: Path
    size: tuple[int, int]
    variants: tuple[Normalisation, ...]
    samples: dict[str, list[PublishedSample]]
    has_frames: bool
    ignored: tuple[str, ...]

    def all_samples(self) -> list[PublishedSample]:
        return [sample for samples in self.samples.values() for sample in samples]


def scan_tree(root: Path, frames: int) -> PublishedTree:
    """Scan the tree at ``root``, whose raw scans have ``frames`` files. Raises `LayoutError` with every breach found.

    ``root`` holds ``training_datasets/`` and maybe ``fpp_synthetic_dataset/``, or is ``training_datasets`` itself.
    """
    return _Scan(root, frames).tree()


def _locate(root: Path) -> tuple[Path, Path | None]:
    """Folders of the training data and of the raw scans."""
    if not root.is_dir():
        raise LayoutError(f"{root}: no such folder; give the one that holds {TRAINING}/")
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
            f"{training}: only background-removed data, which lack the fringes outside the object; "
            f"add {VARIANT_FOLDERS['raw']}/"
        )
    raise LayoutError(f"{root}: expected {TRAINING}/ with one of {', '.join(VARIANT_FOLDERS.values())}, found none")


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
        samples = {split: found for split, found in samples.items() if found}
        self._objects(samples)
        if not samples and not self.problems:
            self.problems.append(f"{self.training / VARIANT_FOLDERS[variants[0]]}: holds no sample")
        size = self._sizes(samples)
        if self.problems:
            raise refuse(self.root, self.problems)
        return PublishedTree(self.root, size, variants, samples, self.scans is not None, self._ignored())

    def _variant(self, folder: Path) -> tuple[Placed, Placed]:
        """Fringes and depths of one variant, each paired with the other."""
        found: dict[str, Placed] = {kind: {} for kind in _KINDS}
        ours = {published: split for split, published in PUBLISHED_SPLIT_FOLDERS.items()}
        for entry in _entries(folder):
            if entry.name not in ours or not entry.is_dir():
                self._extra(entry, f"expected the folders {', '.join(ours)}")
                continue
            for part in _entries(entry):
                if part.name not in _KINDS or not part.is_dir():
                    self._extra(part, f"expected the folders {FRINGE} and {DEPTH}")
            for kind, suffix in _KINDS.items():
                found[kind][ours[entry.name]] = self._files(entry / kind, suffix)
        for split in found[FRINGE]:
            fringes, depths = found[FRINGE][split], found[DEPTH][split]
            published = folder / PUBLISHED_SPLIT_FOLDERS[split]
            for stem in sorted(set(fringes) - set(depths)):
                self.problems.append(f"{published / DEPTH / (stem + '.mat')}: is missing, {fringes[stem]} has no depth")
            for stem in sorted(set(depths) - set(fringes)):
                self.problems.append(
                    f"{published / FRINGE / (stem + '.png')}: is missing, {depths[stem]} has no fringe"
                )
        return found[FRINGE], found[DEPTH]

    def _files(self, folder: Path, suffix: str) -> dict[str, Path]:
        if not folder.is_dir():
            self.problems.append(f"{folder}: the folder is missing")
            return {}
        files = {}
        for entry in _entries(folder):
            if entry.suffix != suffix or not entry.is_file():
                self._extra(entry, f"expected files ending in {suffix}")
            elif label_of(entry.stem) is None:
                self.problems.append(f"{entry}: expected a name like power_drill_A60{suffix}, views {', '.join(VIEWS)}")
            else:
                files[entry.stem] = entry
        return files

    def _extra(self, entry: Path, expected: str) -> None:
        self.problems.append(f"{entry}: does not belong here; {expected}")

    def _same_stems(self, variants: tuple[Normalisation, ...], pairs: list[tuple[Placed, Placed]]) -> None:
        """Every variant must hold the samples of the first, in the same split."""
        for name, (fringes, _) in zip(variants[1:], pairs[1:], strict=True):
            for split, published in PUBLISHED_SPLIT_FOLDERS.items():
                first, other = set(pairs[0][0].get(split, {})), set(fringes.get(split, {}))
                for here, there, stems in ((name, variants[0], first - other), (variants[0], name, other - first)):
                    folder = self.training / VARIANT_FOLDERS[here] / published / FRINGE
                    self.problems += [
                        f"{folder / (stem + '.png')}: is missing, though {VARIANT_FOLDERS[there]} has it in {published}"
                        for stem in sorted(stems)
                    ]

    def _info(self, depths: Placed, needed: bool) -> Placed:
        folder = self.training / INFO
        if not folder.is_dir():
            if needed:
                self.problems.append(f"{folder}: the folder is missing; without it normalised depth has no mm")
            return {}
        placed: Placed = {}
        known = {PUBLISHED_SPLIT_FOLDERS[split] for split in depths}
        for entry in _entries(folder):
            if entry.name not in known:
                self._extra(entry, f"expected the folders {', '.join(sorted(known))}")
        for split, expected in depths.items():
            part = folder / PUBLISHED_SPLIT_FOLDERS[split] / DEPTH
            placed[split] = self._files(part, ".mat")
            if part.is_dir():
                missing, extra = set(expected) - set(placed[split]), set(placed[split]) - set(expected)
                self.problems += [f"{part / (stem + '.mat')}: is missing" for stem in sorted(missing)]
                self.problems += [
                    f"{placed[split][stem]}: belongs to no sample of this split" for stem in sorted(extra)
                ]
        return placed

    def _raw_scans(self, fringes: Placed) -> dict[str, tuple[Path, ...]]:
        root = self.scans
        if root is None:
            return {}
        known = {stem for split in fringes.values() for stem in split}
        scans: dict[str, tuple[Path, ...]] = {}
        for folder in _entries(root):
            if not folder.is_dir():
                self._extra(folder, "expected one folder an object")
                continue
            for view in _entries(folder):
                stem = sample_name(folder.name, view.name)
                if view.name not in VIEWS or not view.is_dir():
                    self._extra(view, f"expected the folders {', '.join(VIEWS)}")
                elif stem not in known:
                    self.problems.append(f"{view}: a raw scan without depth; {TRAINING} has no {stem}")
                else:
                    scans[stem] = self._frames(view)
        self.problems += [
            f"{root / label[0] / label[1]}: the raw scan is missing"
            for stem in sorted(known - set(scans)) if (label := label_of(stem))
        ]  # fmt: skip
        return scans

    def _frames(self, folder: Path) -> tuple[Path, ...]:
        names = [frame_file(index) for index in range(self.frame_count)]
        present = {entry.name: entry for entry in _entries(folder)}
        self.problems += [f"{folder / name}: is missing" for name in names if name not in present]
        for name in sorted(set(present) - set(names) - set(NOT_STORED)):
            self._extra(present[name], f"expected {names[0]} to {names[-1]}, {', '.join(NOT_STORED)}")
        return tuple(present[name] for name in names if name in present)

    def _samples(
        self, split: str, pairs: list[tuple[Placed, Placed]], info: Placed, scans: dict[str, tuple[Path, ...]]
    ) -> list[PublishedSample]:
        found = []
        for stem in pairs[0][0].get(split, {}):
            label = label_of(stem)
            if label is None:
                continue
            both = [(fringes.get(split, {}).get(stem), depths.get(split, {}).get(stem)) for fringes, depths in pairs]
            found.append(
                PublishedSample(
                    stem, *label, split,
                    tuple(fringe for fringe, _ in both if fringe), tuple(depth for _, depth in both if depth),
                    info.get(split, {}).get(stem), scans.get(stem, ()),
                )
            )  # fmt: skip
        return sorted(found, key=lambda sample: (*_place(sample.object), VIEWS.index(sample.view)))

    def _objects(self, samples: dict[str, list[PublishedSample]]) -> None:
        """An object has all its views, in one split."""
        first: dict[str, dict[str, PublishedSample]] = {}
        views: dict[str, set[str]] = {}
        for sample in (sample for found in samples.values() for sample in found):
            views.setdefault(sample.object, set()).add(sample.view)
            first.setdefault(sample.object, {}).setdefault(sample.split, sample)
        for name, by_split in first.items():
            here, *others = (sample.fringes[0] for sample in by_split.values())
            if others:
                self.problems.append(f"{here}: object {name} is in two splits, see {', '.join(map(str, others))}")
        for name, seen in views.items():
            if missing := [view for view in VIEWS if view not in seen]:
                stems = ", ".join(sample_name(name, view) for view in missing)
                self.problems.append(
                    f"{next(iter(first[name].values())).fringes[0].parent}: object {name} lacks {stems}"
                )

    def _sizes(self, samples: dict[str, list[PublishedSample]]) -> tuple[int, int]:
        """Image size that most PNG headers say; every other file is a problem."""
        sizes: dict[Path, tuple[int, int]] = {}
        for sample in (sample for found in samples.values() for sample in found):
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
            found = (name for name in NOT_STORED if next(self.scans.glob(f"*/*/{name}"), None))
            names += [f"{RAW_SCANS}/*/*/{name}" for name in found]
        return tuple(names)


def _place(name: str) -> tuple[int, str]:
    """Order of rows: the benchmark's objects in theirs, others after them by name."""
    return (OBJECTS.index(name) if name in OBJECTS else len(OBJECTS)), name
