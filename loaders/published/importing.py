"""Importing a published tree into the dataset format, through the same crash-safe assembly as a build."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import BuildError, LayoutError, RigError
from fpp_ml_bench.loaders.published.layout import VARIANT_FOLDERS, layout_error
from fpp_ml_bench.loaders.published.order import AUTO, FrameOrder, check_order, find_order, parse_order
from fpp_ml_bench.loaders.published.png import read_grey_png
from fpp_ml_bench.loaders.published.reading import SampleReader
from fpp_ml_bench.loaders.published.tree import PublishedSample, PublishedTree, scan_tree
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME, stored_frames
from fpp_ml_bench.loaders.storage import (
    MANIFEST,
    WORK_FOLDER,
    Assembly,
    Manifest,
    Progress,
    Receipt,
    Row,
    ShardPlan,
    ShardWriter,
    assemble,
    plan_shards,
)
from fpp_ml_bench.optics import Rig, Sequence, paper_rig

IMPORTED = "imported"
_CHECK_THREADS = 4
_MOST_SCANS_TRIED = 6


@dataclass(frozen=True)
class ImportShard:
    """Picklable work of a shard: read and check its samples' files and write the rows, holding one sample in memory."""

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
class ImportPlan:
    """An import that is ready to start: the scanned tree, its reader and the dataset to assemble."""

    tree: PublishedTree
    reader: SampleReader
    assembly: Assembly


def plan_import(root: Path, rig: Rig | None = None, frame_order: str = AUTO) -> ImportPlan:
    """Scan the tree at ``root`` and determine how it is read.

    ``rig``: the rig that took the images; None assumes the paper's rig, scaled to the image size.
    ``frame_order``: see `fpp_ml_bench.loaders.published.order`; ``auto`` determines it from the first sample's images,
    and all other samples are checked against it.

    Raises `LayoutError` listing all files that break the layout, `RigError` for a rig of another image size.
    """
    order = parse_order(frame_order)
    tree = scan_tree(root, len((rig or paper_rig()).sequence))
    rig_used = _rig_for(tree, rig)
    if not tree.has_frames:
        order = None
    elif order is None:
        order = _order_of(tree, rig_used)
    reader = SampleReader(tree.size, tree.variants, rig_used, order)
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
            "objects": {
                split: list(dict.fromkeys(s.object for s in samples)) for split, samples in tree.samples.items()
            },
        },
        rig=rig_used.to_dict(),
        size=tree.size,
        stored=stored,
        exact=False,
        samples={},
        shards=[],
    )
    work = ImportShard({sample.sample: sample for sample in tree.all_samples()}, reader, stored)
    # One byte a frame and one float32 depth map.
    bytes_per_row = tree.size[0] * tree.size[1] * (len(stored_frames(rig_used.sequence, stored)) + 4)
    return ImportPlan(tree, reader, Assembly(plans, work, manifest, bytes_per_row))


def import_tree(folder: Path, plan: ImportPlan, workers: int, progress: Progress = lambda rows: None) -> Manifest:
    """Write the planned import into ``folder``, or resume an interrupted import.

    Contents are checked as they are read. When a file is wrong, all others are checked too, so that the `LayoutError`
    lists every wrong file. Raises `BuildError` as a build does, and when the tree changed after ``folder`` was
    finished.
    """
    _refuse_changed(folder, plan.tree)
    _drop_stale_receipts(folder, plan)
    try:
        return assemble(folder, plan.assembly, workers, progress)
    except LayoutError as error:
        with ThreadPoolExecutor(_CHECK_THREADS) as pool:
            problems_by_sample = list(pool.map(plan.reader.problems, plan.tree.all_samples()))
        problems = [line for lines in problems_by_sample for line in lines]
        raise layout_error(plan.tree.root, problems or str(error).splitlines()) from error


def import_notes(manifest: Manifest) -> list[str]:
    """Notes about a finished import for the user, one sentence each."""
    settings = manifest.settings
    notes = [f"depth taken from {settings['depth_from']}"]
    if settings["depth_checked_against"]:
        notes[0] += f", checked against {', '.join(settings['depth_checked_against'])}"
    if settings["depth_from"] == VARIANT_FOLDERS["individual"]:
        notes.append(
            "in this variant, pixels at a sample's least depth can't be told from background; they became background"
        )
    if settings["rig_assumed"]:
        notes.append("the rig is assumed to be the paper's, scaled to the image size; give --rig if it is another")
    if settings["frame_order"]:
        notes.append(f"frame order of the raw scans: {settings['frame_order']}")
        order = parse_order(settings["frame_order"])
        sequence = Sequence(**manifest.rig["sequence"])
        first_file = (order or FrameOrder()).frames(sequence)[0]
        if first_file.index != SINGLE_SHOT_FRAME:
            notes.append(
                f"the published single-shot input, A_0.png, is a {first_file.direction} fringe, stored in column "
                f"{first_file.column}; configuration single_shot holds the first horizontal frame"
            )
    if settings["ignored"]:
        notes.append(f"not imported, because computed from the stored data: {', '.join(settings['ignored'])}")
    return notes


def _rig_for(tree: PublishedTree, rig: Rig | None) -> Rig:
    height, width = tree.size
    if rig is None:
        if height != width:
            raise RigError(
                f"{tree.root}: images of {width} x {height} px are not square like the paper's; give the rig with --rig"
            )
        return paper_rig(width)
    if (rig.camera.height, rig.camera.width) != tree.size:
        raise RigError(
            f"rig: its camera has {rig.camera.width} x {rig.camera.height} px, the images of {tree.root} have "
            f"{width} x {height}; give the rig that took them"
        )
    return rig


def _order_of(tree: PublishedTree, rig: Rig) -> FrameOrder:
    """Frame order of the first readable raw scan that fits a named order; tries a few, as the first may be broken."""
    refusals = []
    for sample in tree.all_samples()[:_MOST_SCANS_TRIED]:
        try:
            files = [read_grey_png(path) for path in sample.frames]
        except LayoutError as error:
            refusals.append(str(error))
            continue
        order = find_order(files, rig)
        if order is not None:
            return order
        misfits = check_order(files, FrameOrder(), rig)
        refusals.append(
            f"{sample.frames[0].parent}: fits no named frame order. Mismatch with the paper's order: {misfits[0]}"
        )
    raise layout_error(tree.root, refusals)


def _changed_ns(path: Path) -> int:
    """When a file last changed, in ns. Unlike the modification time alone, copying or setting times can't reset it."""
    status = path.stat()
    return max(status.st_ctime_ns, status.st_mtime_ns)


def _refuse_changed(folder: Path, tree: PublishedTree) -> None:
    manifest_path = folder / MANIFEST
    if not manifest_path.is_file():
        return
    finished = manifest_path.stat().st_mtime_ns
    for sample in tree.all_samples():
        for path in sample.files:
            if _changed_ns(path) > finished:
                raise BuildError(
                    f"{folder}: holds a finished import, and {path} changed after it; give another folder or delete it"
                )


def _drop_stale_receipts(folder: Path, plan: ImportPlan) -> None:
    """Delete receipts of shards of which a source file changed after the shard was written; they are read again."""
    samples = {sample.sample: sample for sample in plan.tree.all_samples()}
    for shard_plan in plan.assembly.plans:
        receipt = folder / WORK_FOLDER / f"{shard_plan.name}.json"
        if receipt.is_file():
            written = receipt.stat().st_mtime_ns
            files = (path for stem, _, _ in shard_plan.samples for path in samples[stem].files)
            if any(_changed_ns(path) > written for path in files):
                receipt.unlink(missing_ok=True)
