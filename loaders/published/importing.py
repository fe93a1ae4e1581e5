"""Importing a published tree into the dataset format, through the same crash-safe assembly as a
build. `SampleReader` reads a sample, fringe, depth in mm and raw frames, with every check on their
contents. And what a tree's raw scans and depths say about the rig, whose pitch and projector are
not published."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.calibration.projection import MOST_PX, DepthView, view_from_frames
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.containers import from_file, parse_image, parse_matrix
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.depth import (
    NODATA_FAR,
    Normalisation,
    denormalise,
    depth_problem,
    depth_range_mm,
    nodata_problem,
    object_mask,
    without_nodata,
)
from fpp_ml_bench.depth_readings import UNITS_MM, another_reading, glance
from fpp_ml_bench.errors import CaptureError, DecodeError, LayoutError, PredictionError, RigError
from fpp_ml_bench.loaders.captures.images import listed
from fpp_ml_bench.loaders.published import tree as published_tree
from fpp_ml_bench.loaders.published.order import (
    AUTO,
    FrameOrder,
    check_order,
    find_order,
    parse_order,
)
from fpp_ml_bench.loaders.published.tree import (
    VARIABLES,
    VARIANT_FOLDERS,
    PublishedSample,
    PublishedTree,
)
from fpp_ml_bench.loaders.sample import SINGLE_SHOT_FRAME, Row
from fpp_ml_bench.loaders.storage.assembly import Assembly, Progress, assemble, forget_outdated
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import ShardPlan, plan_shards
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict

IMPORTED = "imported"
_CHECK_THREADS = 2
_MOST_SCANS_TRIED = 6
AGREEING_MM = 1.0
"""Largest median difference between a tree's depth and what its own rig decodes from its frames:
twice the error of the benchmark's ground truth."""
_LEAST_PX_A_VIEW = 2000
AGREEMENT_MM = 0.01
"""Accepted difference between variants of a depth map: float32 in m is exact to 0.0001 mm, and a
wrong unit or file differs by mm."""
_UNIT_SLACK = 10.0
_ROUNDING = 1e-6
_SHOWN_MISFITS = 3


def read_grey_png(path: Path) -> NDArray[np.uint8]:
    """Grey levels of an 8-bit PNG, uint8 (H, W); RGB is accepted where its three channels are
    equal. Raises `LayoutError` naming the file when it is not a PNG, is cut off or damaged, has
    another bit depth or colour type, or its channels differ."""
    return from_file(_grey_levels, path, LayoutError)


def _grey_levels(content: bytes) -> NDArray[np.uint8]:
    published_tree.png_size(content)
    image = parse_image(content)
    if image.transparent:
        raise PredictionError("has transparent colours; expected plain grey levels")
    levels = np.atleast_3d(image.levels)
    if (levels != levels[..., :1]).any():
        raise PredictionError("an RGB image whose channels differ; expected grey levels")
    return np.ascontiguousarray(levels[..., 0])


def read_matrix(path: Path, variable: str) -> NDArray:
    """Variable ``variable`` of a MATLAB file as `containers.parse_matrix`; `LayoutError` naming the
    file."""
    return from_file(parse_matrix, path, LayoutError, variable)


def read_scalar(path: Path, variable: str) -> float:
    """A scalar that MATLAB stores as a 1 x 1 matrix. Raises `LayoutError` as `read_matrix`, or for
    another shape."""
    matrix = read_matrix(path, variable)
    if matrix.shape != (1, 1) or not np.isfinite(matrix).all():
        shape = " x ".join(map(str, matrix.shape))
        raise LayoutError(
            f"{path}: {variable}: expected a finite number stored as 1 x 1, got {shape} "
            f"{matrix.dtype}"
        )
    return float(matrix[0, 0])


@dataclass(frozen=True)
class RowReader:
    """Picklable source of an import's rows: reads and checks one sample after the other.
    ``samples``: what `read` takes, by sample; each has its ``files``."""

    samples: Mapping[str, Any]
    rig: Rig

    def read(self, sample: Any) -> Row:
        """The row of one of ``samples``. Raises `LayoutError` or `CaptureError` for a wrong
        file."""
        raise NotImplementedError

    def __call__(self, plan: ShardPlan, folder: Path) -> Iterator[Row]:
        for name, _, _ in plan.samples:
            yield self.read(self.samples[name])

    def refusal(self, problems: list[str]) -> Exception:
        """The error that lists the problems of all samples."""
        raise NotImplementedError


Reader = TypeVar("Reader", bound=RowReader)


def import_plan(
    reader: Reader, plans: list[ShardPlan], origin: str, settings: dict[str, Any], stored: str
) -> Assembly[Reader]:
    """What there is to do for a dataset of ``reader``'s rows, with ``stored`` frames of its rig."""
    camera, generator = reader.rig.camera, {"name": "fpp-ml-bench", "version": __version__}
    size = camera.height, camera.width
    manifest = Manifest(
        origin, generator, settings, reader.rig.to_dict(), size, stored, exact=False
    )
    return Assembly(plans, reader, manifest)


def import_rows(
    folder: Path, plan: Assembly[RowReader], workers: int, progress: Progress = lambda rows: None
) -> Manifest:
    """Write the planned dataset into ``folder``, or go on with one that was interrupted. When a
    sample can't be read, all others are tried too, and the reader's refusal of all problems is
    raised, a `LayoutError` or `CaptureError`. Raises `BuildError` as a build does, and when a file
    changed after ``folder`` was finished."""
    reader = plan.rows

    def problems_of(sample: Any) -> list[str]:
        problems: list[str] = []
        with listed(problems):
            reader.read(sample)
        return problems

    forget_outdated(folder, plan.plans, lambda name: reader.samples[name].files)
    try:
        return assemble(folder, plan, workers, progress)
    except (LayoutError, CaptureError) as error:
        with ThreadPoolExecutor(_CHECK_THREADS) as pool:
            problems = [
                line for lines in pool.map(problems_of, reader.samples.values()) for line in lines
            ]
        raise reader.refusal(problems or [str(error)]) from error


@dataclass(frozen=True)
class Source:
    """Where a tree was downloaded from: the dataset ``repository`` of the Hugging Face Hub at
    ``commit``. ``folders`` are those of its variants and raw scans that were asked for; a cache may
    hold parts of others."""

    repository: str
    commit: str
    folders: tuple[str, ...]


@dataclass(frozen=True)
class SampleReader(RowReader):
    """Reads the samples of ``tree``. ``order`` None: raw frames are only checked, not read as
    frames of a sequence. ``nodata``: the value of depth files where no surface is, in their unit;
    None where it is 0."""

    tree: PublishedTree
    order: FrameOrder | None
    nodata: float | None = None

    def refusal(self, problems: list[str]) -> LayoutError:
        return published_tree.layout_error(self.tree.root, problems)

    def read(self, sample: PublishedSample) -> Row:
        """The sample's row, depth float32 mm, 0 = background. Raises `LayoutError` with a line for
        each wrong file."""
        problems: list[str] = []
        images: dict[Path, NDArray[np.uint8]] = {}
        for path in (*sample.fringes, *sample.frames):
            with listed(problems):
                images[path] = read_grey_png(path)
        first, *copies = sample.fringes
        problems += [
            f"{path}: expected the same image as {first}, got another image"
            for path in copies
            if {first, path} <= images.keys() and not np.array_equal(images[path], images[first])
        ]
        depth_mm = self._depth_mm(sample, problems)
        frames = {SINGLE_SHOT_FRAME: images[first]} if first in images else {}
        if self.order is not None and images.keys() >= {first, *sample.frames}:
            files = [images[path] for path in sample.frames]
            if not np.array_equal(files[0], images[first]):
                problems.append(f"{sample.frames[0]}: differs from the single-shot input {first}")
            problems += self._misfits(sample, files, self.order)
            ordered = self.order.frames(self.rig.paper_sequence)
            frames = {frame.index: image for frame, image in zip(ordered, files, strict=True)}
        if problems or depth_mm is None:
            raise LayoutError("\n".join(problems))
        return Row(sample.sample, sample.object, sample.view, frames, depth_mm, None)

    def _misfits(
        self, sample: PublishedSample, files: list[NDArray[np.uint8]], order: FrameOrder
    ) -> list[str]:
        misfits = check_order(files, order, self.rig)
        if not misfits:
            return []
        fitting = find_order(files, self.rig)
        hint = "it fits no named order" if fitting is None else f"it has the order {fitting.name}"
        more = (
            f" (and {len(misfits) - _SHOWN_MISFITS} more)" if len(misfits) > _SHOWN_MISFITS else ""
        )
        shown = "; ".join(misfits[:_SHOWN_MISFITS])
        return [
            f"{sample.frames[0].parent}: not in frame order {order.name}, {hint}: {shown}{more}"
        ]

    def _depth_mm(self, sample: PublishedSample, problems: list[str]) -> NDArray[np.float32] | None:
        """Depth from the first variant; the other variants and the depth range must agree with
        it."""
        limits: tuple[float, float] | None = None
        if sample.info is not None:
            with listed(problems):
                limits = _range_mm(sample.info)
        files = dict(zip(self.tree.variants, sample.depths, strict=True))
        maps: dict[Normalisation, NDArray[np.float64]] = {}
        for variant, path in files.items():
            if limits is not None or variant != "individual":
                with listed(problems):
                    maps[variant] = self._to_mm(path, variant, limits or (0.0, 0.0))
        first, *others = files
        if first not in maps:
            return None
        depth_mm = maps[first].astype(np.float32)
        for variant in others:
            difference_mm = (
                _disagreement_mm(maps[variant], depth_mm, variant) if variant in maps else 0.0
            )
            if difference_mm > AGREEMENT_MM:
                problems.append(
                    f"{files[variant]}: differs from {files[first]} by up to {difference_mm:.3f} "
                    f"mm; expected at "
                    f"most {AGREEMENT_MM} mm"
                )
        if limits is not None and first != "individual":
            actual = depth_range_mm(depth_mm)
            if np.abs(np.subtract(actual, limits)).max() > AGREEMENT_MM:
                problems.append(
                    f"{sample.info}: gives {limits[0]:.3f} to {limits[1]:.3f} mm, but "
                    f"{files[first]} has "
                    f"{actual[0]:.3f} to {actual[1]:.3f} mm"
                )
        return depth_mm

    def _to_mm(
        self, path: Path, variant: Normalisation, limits: tuple[float, float]
    ) -> NDArray[np.float64]:
        values = without_nodata(read_matrix(path, VARIABLES[variant]), self.nodata)
        height, width = self.tree.size
        if values.shape != (height, width):
            raise LayoutError(
                f"{path}: expected {height} x {width} like the images, got {values.shape}"
            )
        near, far = self.rig.working_range_mm
        reach = {"raw": far, "global": far / MM_PER_M, "individual": 1.0}[variant]
        if problem := nodata_problem(values, reach, NODATA_FAR) or depth_problem(values):
            raise LayoutError(f"{path}: {problem}")
        if variant == "individual" and values.max() > 1 + _ROUNDING:
            raise LayoutError(f"{path}: expected values in [0, 1], got up to {values.max():g}")
        depth_mm = np.where(object_mask(values), denormalise(values, variant, *limits), 0.0)
        low, high = depth_range_mm(depth_mm)
        outside = high < near or low > far
        fitting = [
            size
            for size in UNITS_MM.values()
            if outside and near <= low * size and high * size <= far
        ]
        if fitting or low < near / _UNIT_SLACK or high > far * _UNIT_SLACK:
            unit = "m" if variant == "global" else "mm"
            cure = (
                f" (times {fitting[0]:g} it fits); write {unit}" if fitting else f"; write {unit}"
            )
            raise LayoutError(
                f"{path}: depths of {low:.4g} to {high:.4g} mm when {VARIABLES[variant]} is read "
                f"in {unit}; the "
                f"working range is {near:g} to {far:g} mm, so the file has another unit{cure}, or "
                f"give the rig (--rig)"
            )
        return depth_mm


def _range_mm(info: Path) -> tuple[float, float]:
    low, high = (read_scalar(info, name) for name in published_tree.INFO_VARIABLES)
    if not 0 < low <= high:
        raise LayoutError(f"{info}: expected 0 < depth_min <= depth_max, got {low} and {high}")
    return low, high


def _disagreement_mm(
    variant_mm: NDArray[np.float64], depth_mm: NDArray[np.float32], variant: Normalisation
) -> float:
    expected = depth_mm.astype(np.float64)
    if variant == "individual":
        # By the paper's rule, pixels at the sample's least depth are 0 in this variant.
        expected[expected == expected[object_mask(expected)].min()] = 0.0
    return float(np.abs(variant_mm - expected).max())


def plan_import(
    root: Path,
    rig: Rig | None = None,
    frame_order: str = AUTO,
    source: Source | None = None,
    nodata: float | None = None,
) -> Assembly[SampleReader]:
    """Scan the tree at ``root`` and determine how it is read. ``rig``: the rig that took the
    images; None assumes the paper's rig, scaled to the image size. ``frame_order``: see
    `FrameOrder`; ``auto`` determines it from the first sample's images, and checks all others
    against it. ``source``: where the tree was downloaded from. ``nodata``: as `SampleReader`.
    Raises `LayoutError` listing all files that break the layout, `RigError` for a rig of another
    image size."""
    order = parse_order(frame_order)
    frames = len((rig or paper_rig()).sequence)
    tree = published_tree.scan_tree(root, frames, None if source is None else source.folders)
    rig_used = _rig_for(tree, rig)
    if not tree.has_frames:
        order = None
    elif order is None:
        order = _order_of(tree, rig_used)
    stored = "all" if tree.has_frames else "single_shot"
    by_split: dict[str, dict[str, list[tuple[str, str, str]]]] = {}
    for s in tree.samples:
        by_split.setdefault(s.split, {}).setdefault(s.object, []).append(
            (s.sample, s.object, s.view)
        )
    plans = [plan for split, objects in by_split.items() for plan in plan_shards(split, objects)]
    settings = {
        "layout": "published",
        "depth_from": VARIANT_FOLDERS[tree.variants[0]],
        "depth_checked_against": [VARIANT_FOLDERS[name] for name in tree.variants[1:]],
        "frame_order": order.name if order else None,
        "rig_assumed": rig is None,
        "ignored": list(tree.ignored),
        "objects": {split: list(objects) for split, objects in by_split.items()},
        **({} if source is None else {"repository": source.repository, "commit": source.commit}),
        **({} if nodata is None else {"nodata": str(nodata)}),
    }
    reader = SampleReader({s.sample: s for s in tree.samples}, rig_used, tree, order, nodata)
    return import_plan(reader, plans, IMPORTED, settings, stored)


def import_notes(manifest: Manifest) -> list[str]:
    """Notes about a finished import for the user, one sentence each."""
    settings = manifest.settings
    notes = [f"depth taken from {settings['depth_from']}"]
    if "repository" in settings:
        notes[0] += f" of dataset {settings['repository']} at commit {settings['commit']}"
    if settings["depth_checked_against"]:
        notes[0] += f", checked against {', '.join(settings['depth_checked_against'])}"
    if settings["depth_from"] == VARIANT_FOLDERS["individual"]:
        lost = (
            "pixels at a sample's least depth can't be told from background; they became background"
        )
        notes.append(f"in this variant, {lost}")
    if settings["rig_assumed"]:
        notes.append(
            "the rig is assumed to be the paper's, scaled to the image size; give --rig if it is "
            "another"
        )
    if settings["frame_order"]:
        notes.append(f"frame order of the raw scans: {settings['frame_order']}")
        order = parse_order(settings["frame_order"])
        first_file = (order or FrameOrder()).frames(rig_from_dict(manifest.rig).paper_sequence)[0]
        if first_file.index != SINGLE_SHOT_FRAME:
            notes.append(
                f"the published single-shot input, A_0.png, is a {first_file.direction} fringe, "
                f"stored in column "
                f"{first_file.column}; configuration single_shot holds the first horizontal frame"
            )
    if settings["ignored"]:
        notes.append(
            f"not imported, because computed from the stored data: {', '.join(settings['ignored'])}"
        )
    return notes


def _rig_for(tree: PublishedTree, rig: Rig | None) -> Rig:
    height, width = tree.size
    if rig is None:
        if height != width:
            images = f"images of {width} x {height} px"
            raise RigError(
                f"{tree.root}: {images} are not square like the paper's; give the rig with --rig"
            )
        return paper_rig(width)
    if (rig.camera.height, rig.camera.width) != tree.size:
        raise RigError(
            f"rig: its camera has {rig.camera.width} x {rig.camera.height} px, the images of "
            f"{tree.root} have "
            f"{width} x {height}; give the rig that took them"
        )
    return rig


def _order_of(tree: PublishedTree, rig: Rig) -> FrameOrder:
    """Frame order of the first readable raw scan that fits a named order; tries a few, as the first
    may be broken."""
    refusals = []
    for sample in tree.samples[:_MOST_SCANS_TRIED]:
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
            f"{sample.frames[0].parent}: fits no named frame order. Mismatch with the paper's "
            f"order: {misfits[0]}"
        )
    hint = (
        "the order is checked with the rig's axes, given by --rig or else the paper's; for a "
        "projector that is turned, "
        "give a rough rig, from which fpp-bench calibrate --from-depth TREE --camera ROUGH finds "
        "the exact one"
    )
    raise published_tree.layout_error(tree.root, [*refusals, hint])


def tree_views(
    reader: SampleReader, threads: int = 1, progress: Progress = lambda views: None
) -> list[DepthView]:
    """Phase and depth of all samples of a tree, some pixels of each. ``reader``: that of
    `plan_import`; of its rig, camera, sequence and frame order are used. ``progress`` is called
    with numbers of views read. Raises `LayoutError` for a tree without raw scans or a file that is
    wrong, `DecodeError` for frames that can't be decoded."""
    if reader.order is None:
        raise LayoutError(
            f"{reader.tree.root}: has no raw scans; the rig is found from all frames of a view, in "
            f"{published_tree.RAW_SCANS}/"
        )
    samples = list(reader.samples.values())
    most_px = max(_LEAST_PX_A_VIEW, MOST_PX // len(samples))

    def view(sample: PublishedSample) -> DepthView:
        row = reader.read(sample)
        measured = view_from_frames(sample.sample, _frames(row), row.depth_mm, reader.rig, most_px)
        progress(1)
        return measured

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(view, samples))


def depth_difference_mm(reader: SampleReader) -> float | None:
    """Median difference (absolute, mm) between the first sample's depth and what ``reader.rig``
    decodes from its frames; inf where it decodes less than half of the pixels or none, None for a
    tree without raw scans."""
    if reader.order is None:
        return None
    row = reader.read(next(iter(reader.samples.values())))
    try:
        decoded_mm = decode_stack(_frames(row), reader.rig, mask=object_mask(row.depth_mm)).depth_mm
    except DecodeError:
        return float("inf")
    both = object_mask(decoded_mm) & object_mask(row.depth_mm)
    if 2 * np.count_nonzero(both) < np.count_nonzero(object_mask(row.depth_mm)):
        return float("inf")
    return float(np.median(np.abs(decoded_mm[both].astype(np.float64) - row.depth_mm[both])))


def depth_reading(reader: SampleReader) -> str | None:
    """`another_reading` of the depth of a tree's first samples, by what ``reader.rig`` decodes from
    their frames."""
    seen = []
    for sample in list(reader.samples.values())[:_MOST_SCANS_TRIED]:
        row = reader.read(sample)
        with suppress(DecodeError):
            decoded_mm = decode_stack(_frames(row), reader.rig).depth_mm
            seen.append(glance(sample.sample, row.depth_mm, decoded_mm, None, reader.rig.camera))
    return another_reading("the tree's depth", seen)


def holds_whole_numbers(reader: SampleReader) -> bool:
    """Whether the depth of the first sample is stored as whole numbers, so that it is rounded."""
    first = next(iter(reader.samples.values()))
    return read_matrix(first.depths[0], VARIABLES[reader.tree.variants[0]]).dtype.kind in "iu"


def _frames(row: Row) -> list[NDArray[np.uint8]]:
    return [row.frames[index] for index in sorted(row.frames)]
