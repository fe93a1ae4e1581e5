"""Importing a published tree into the dataset format, through the same crash-safe assembly as a build."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import BuildError, LayoutError, RigError
from fpp_ml_bench.frames import Sequence
from fpp_ml_bench.loaders.assemble import Assembly, Progress, Receipt, assemble
from fpp_ml_bench.loaders.manifest import MANIFEST, WORK_FOLDER, Manifest
from fpp_ml_bench.loaders.published_layout import VARIANT_FOLDERS, refuse
from fpp_ml_bench.loaders.published_order import AUTO, FrameOrder, check_order, find_order, parse_order
from fpp_ml_bench.loaders.published_png import read_grey_png
from fpp_ml_bench.loaders.published_sample import SampleReader
from fpp_ml_bench.loaders.published_tree import PublishedSample, PublishedTree, scan_tree
from fpp_ml_bench.loaders.schema import SINGLE_SHOT_FRAME, stored_frames
from fpp_ml_bench.loaders.shards import Row, ShardPlan, ShardWriter, plan_shards
from fpp_ml_bench.rig import Rig, paper_rig

IMPORTED = "imported"
_SURVEY_THREADS = 4
_TRIED_SCANS = 6


@dataclass(frozen=True)
class ImportShard:
    """Picklable work of one shard: read its samples' files, check them, write the rows; one sample is held."""

    samples: dict[str, PublishedSample]
    reader: SampleReader
    stored: str

    def __call__(self, folder: Path, scratch: Path, plan: ShardPlan, row_done: Callable[[], None]) -> Receipt:
        sequence = self.reader.rig.sequence
        writer = ShardWriter(folder, scratch, plan, sequence, self.stored, False, self.reader.size)
        return writer.write(self._rows(plan), row_done)

    def _rows(self, plan: ShardPlan) -> Iterator[Row]:
        for stem, _, _ in plan.samples:
            yield self.reader.read(self.samples[stem])


@dataclass(frozen=True)
class Import:
    """An import that may start: the tree as scanned and what is to be assembled from it."""

    tree: PublishedTree
    reader: SampleReader
    assembly: Assembly


def plan_import(root: Path, rig: Rig | None = None, frame_order: str = AUTO) -> Import:
    """Scan the tree at ``root`` and settle how it is read.

    ``rig``: the rig that took the images; without one the paper's is assumed, scaled to the image size.
    ``frame_order``: see `fpp_ml_bench.loaders.published_order`; ``auto`` finds it on the first sample's images,
    and every other sample is held to it.

    Raises `LayoutError` listing every file that breaks the layout, `RigError` for a rig of another image size.
    """
    order = parse_order(frame_order)
    tree = scan_tree(root, len((rig or paper_rig()).sequence))
    used = _rig_for(tree, rig)
    if not tree.has_frames:
        order = None
    elif order is None:
        order = _found_order(tree, used)
    reader = SampleReader(tree.size, tree.variants, used, order)
    stored = "all" if tree.has_frames else "single_shot"
    plans = []
    for split, samples in tree.samples.items():
        objects: dict[str, list[tuple[str, str, str]]] = {}
        for sample in samples:
            objects.setdefault(sample.object, []).append((sample.sample, sample.object, sample.view))
        plans += plan_shards(split, objects)
    manifest = Manifest(
        origin=IMPORTED,
        generator={"name": "fpp-ml-bench", "version": __version__},
        settings={
            "layout": "published",
            "depth_from": VARIANT_FOLDERS[tree.variants[0]],
            "depth_checked_against": [VARIANT_FOLDERS[name] for name in tree.variants[1:]],
            "frame_order": order.name if order else None,
            "rig_assumed": rig is None,
            "ignored": list(tree.ignored),
            "objects": {split: list(dict.fromkeys(s.object for s in found)) for split, found in tree.samples.items()},
        },
        rig=used.to_dict(),
        size=tree.size,
        stored=stored,
        exact=False,
        samples={},
        shards=[],
    )
    work = ImportShard({sample.sample: sample for sample in tree.all_samples()}, reader, stored)
    # One byte a frame and one float32 depth map.
    bytes_per_row = tree.size[0] * tree.size[1] * (len(stored_frames(used.sequence, stored)) + 4)
    return Import(tree, reader, Assembly(plans, work, manifest, bytes_per_row))


def import_tree(folder: Path, planned: Import, workers: int, progress: Progress = lambda rows: None) -> Manifest:
    """Write the planned import into ``folder``, or go on with one that was interrupted.

    Contents are checked as they are read; when a file is wrong, all the others are checked too, so that the one
    `LayoutError` lists every offender. Raises `BuildError` as a build does, and when the tree changed after ``folder``
    was finished.
    """
    _refuse_changed(folder, planned.tree)
    _drop_stale_receipts(folder, planned)
    try:
        return assemble(folder, planned.assembly, workers, progress)
    except LayoutError as error:
        with ThreadPoolExecutor(_SURVEY_THREADS) as pool:
            found = list(pool.map(planned.reader.problems, planned.tree.all_samples()))
        problems = [line for lines in found for line in lines]
        raise refuse(planned.tree.root, problems or str(error).splitlines()) from error


def import_notes(manifest: Manifest) -> list[str]:
    """What a person should know of a finished import, a sentence each."""
    settings = manifest.settings
    notes = [f"depth taken from {settings['depth_from']}"]
    if settings["depth_checked_against"]:
        notes[0] += f", checked against {', '.join(settings['depth_checked_against'])}"
    if settings["depth_from"] == VARIANT_FOLDERS["individual"]:
        notes.append("pixels at a sample's least depth can't be told from background there: they became background")
    if settings["rig_assumed"]:
        notes.append("the rig is assumed to be the paper's, scaled to the image size; give --rig where it is another")
    if settings["frame_order"]:
        notes.append(f"frame order of the raw scans: {settings['frame_order']}")
        order = parse_order(settings["frame_order"])
        sequence = Sequence(**manifest.rig["sequence"])
        first = (order or FrameOrder()).frames(sequence)[0]
        if first.index != SINGLE_SHOT_FRAME:
            notes.append(
                f"the published single-shot input, A_0.png, is a {first.direction} fringe and stands in column "
                f"{first.column}; configuration single_shot holds the first horizontal frame"
            )
    if settings["ignored"]:
        notes.append(f"left aside, they follow from what is stored: {', '.join(settings['ignored'])}")
    return notes


def _rig_for(tree: PublishedTree, rig: Rig | None) -> Rig:
    height, width = tree.size
    if rig is None:
        if height != width:
            raise RigError(
                f"{tree.root}: images of {width} x {height} px are not the paper's square ones; give the rig with --rig"
            )
        return paper_rig(width)
    if (rig.camera.height, rig.camera.width) != tree.size:
        raise RigError(
            f"rig: its camera has {rig.camera.width} x {rig.camera.height} px, the images of {tree.root} have "
            f"{width} x {height}; give the rig that took them"
        )
    return rig


def _found_order(tree: PublishedTree, rig: Rig) -> FrameOrder:
    """Order of the first raw scan that can be read and has one; a few are tried, the first may be a broken one."""
    refusals = []
    for sample in tree.all_samples()[:_TRIED_SCANS]:
        try:
            files = [read_grey_png(path) for path in sample.frames]
        except LayoutError as error:
            refusals.append(str(error))
            continue
        order = find_order(files, rig)
        if order is not None:
            return order
        misfits = check_order(files, FrameOrder(), rig)
        refusals.append(f"{sample.frames[0].parent}: fits no frame order known here. Of the paper's: {misfits[0]}")
    raise refuse(tree.root, refusals)


def _changed_ns(path: Path) -> int:
    """When a file last changed in any way. Unlike its modification time this is not copied along or set back."""
    status = path.stat()
    return max(status.st_ctime_ns, status.st_mtime_ns)


def _refuse_changed(folder: Path, tree: PublishedTree) -> None:
    standing = folder / MANIFEST
    if not standing.is_file():
        return
    finished = standing.stat().st_mtime_ns
    for sample in tree.all_samples():
        for path in sample.files:
            if _changed_ns(path) > finished:
                raise BuildError(
                    f"{folder}: holds a finished import, and {path} changed after it; give another folder or delete it"
                )


def _drop_stale_receipts(folder: Path, planned: Import) -> None:
    """A shard of an interrupted import is read again when one of its files changed after it was written."""
    samples = {sample.sample: sample for sample in planned.tree.all_samples()}
    for plan in planned.assembly.plans:
        receipt = folder / WORK_FOLDER / f"{plan.name}.json"
        if receipt.is_file():
            written = receipt.stat().st_mtime_ns
            files = (path for stem, _, _ in plan.samples for path in samples[stem].files)
            if any(_changed_ns(path) > written for path in files):
                receipt.unlink(missing_ok=True)
