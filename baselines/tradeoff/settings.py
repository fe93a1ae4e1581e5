"""What a run measures: the settings that are compared, the views that they are measured on, and the plan. `networks`
has the networks, `ladders` the costs that grow."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Frames, Method
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.baselines.tradeoff.ladders import Ladder, package_ladders
from fpp_ml_bench.baselines.tradeoff.points import COSTS, GROUPS, Group
from fpp_ml_bench.coding import MIN_MODULATION, Limits, decode_cells
from fpp_ml_bench.constants import MM_PER_M, sample_name, split_sample_name
from fpp_ml_bench.decoding import Directions, plain_plan
from fpp_ml_bench.depth import RangeRule
from fpp_ml_bench.errors import DatasetError, DecodeError, FppBenchError
from fpp_ml_bench.loaders.render import BuildSettings, Studio, solid_mesh
from fpp_ml_bench.loaders.sample import Row, exact_void, void_pixels
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import DIRECTIONS, Direction, Rig

VIEWS_AN_OBJECT, QUICK_VIEWS = 2, 1
CLASSICAL_DIRECTIONS: tuple[Directions, ...] = ("vertical", "horizontal", "both")
FEW_FRAMES, QUICK_FRAMES = (2, 3, 4, 6, 9), (3,)
"""Frames of one direction that the phase route is also given, without Gray code."""
WINDOWS = ((0.25, 0.2), (0.5, 0.4), (0.7, 0.55))
"""First and second window of the phase route in fringe periods, besides the default (0.35, 0.27)."""
SIZES, QUICK_SIZES = (240, 480, 960, 1920), (240, 480)
SIZE_OBJECTS, SIZE_VIEW = ("power_drill", "wooden_boards"), "A60"
"""Objects and view of the image sizes: a concave and a flat object."""


@dataclass
class StoredViews:
    """Views ``names`` of a dataset, against the exact depth where it is known."""

    opened: DatasetFolder
    names: Sequence[str]

    @property
    def rig(self) -> Rig:
        return self.opened.rig

    @property
    def target(self) -> str:
        return "depth_exact" if self.opened.has_exact else "depth"

    def frames(self, method: Method, name: str) -> Frames:
        """The sequence as ``method`` may see it, in memory."""
        return captured_frames(self.opened, method, name)

    def target_mm(self, name: str) -> NDArray[np.float32]:
        """Depth float32 (H, W) in mm to score against, 0 = background."""
        return self.opened.target_mm(name, self.target)

    def void(self, name: str) -> NDArray[np.bool_]:
        """Pixels bool (H, W) that count in no set."""
        return self.opened.void(name, self.target)

    def left_out(self, name: str, rule: RangeRule) -> NDArray[np.bool_] | None:
        """Pixels bool (H, W) that the depth range by ``rule`` leaves out; None for none."""
        return self.opened.left_out(name, rule, self.target)


def choose_views(opened: DatasetFolder, per_object: int, split: str = "test") -> StoredViews:
    """``per_object`` views of each object of ``split``, spread over its views, in row order. `DatasetError` for a split
    without samples."""
    samples_by_object: dict[str, list[str]] = {}
    for sample in opened.samples(split):
        samples_by_object.setdefault(split_sample_name(sample)[0], []).append(sample)
    if not samples_by_object:
        raise DatasetError(f"{opened.path}: split {split} holds no sample; there is nothing to measure")
    chosen: list[str] = []
    for number, names in enumerate(samples_by_object.values()):
        count = min(per_object, len(names))
        # Each object begins one view later, so that the views differ between objects.
        places = {(number + position * len(names) // count) % len(names) for position in range(count)}
        chosen += [names[place] for place in sorted(places)]
    return StoredViews(opened, chosen)


@dataclass
class PhotographedViews:
    """`SIZE_OBJECTS` in one view each, rendered into memory as ``build`` would, at ``rig``'s size."""

    rig: Rig
    names = tuple(sample_name(name, SIZE_VIEW) for name in SIZE_OBJECTS)

    def frames(self, method: Method, name: str) -> Frames:
        frames = self._rows[name].frames
        return [frames[i] if i in method.frames_used else None for i in range(len(self.rig.sequence))]

    def target_mm(self, name: str) -> NDArray[np.float32]:
        return np.asarray(self._rows[name].depth_exact_mm)

    def void(self, name: str) -> NDArray[np.bool_]:
        return exact_void(np.asarray(self._rows[name].flags))

    def left_out(self, name: str, rule: RangeRule) -> NDArray[np.bool_] | None:
        return void_pixels(np.asarray(self._rows[name].flags)) if rule == "valid" else None

    @cached_property
    def _rows(self) -> dict[str, Row]:
        rows = {}
        for name in SIZE_OBJECTS:
            # A studio of its own for each view: the frames are its memory, which the next view would overwrite.
            row = Studio(BuildSettings(self.rig, SIZE_OBJECTS)).photograph(solid_mesh(name), SIZE_VIEW)
            rows[row.sample] = row
        return rows


@dataclass(frozen=True)
class Setting:
    """``make`` builds the method when the setting is measured, on ``views``. ``scored`` False: time alone, for an
    untrained network."""

    key: str
    group: Group
    title: str
    make: Callable[[], Method]
    views: StoredViews | PhotographedViews
    scored: bool = True
    note: str | None = None


@dataclass(frozen=True)
class TradeoffSettings:
    """Settings of a run: ``only`` these groups (of `GROUPS` and `COSTS`; empty: all), ``runs``: a folder with further
    trainings, ``widths`` of untrained UNets and ``views`` of each test object (None: the defaults)."""

    dataset: Path
    out: Path
    only: Sequence[str] = ()
    quick: bool = False
    threads: int = 1
    clock: Literal["wall", "processor"] = "wall"
    views: int | None = None
    runs: Path | None = None
    widths: Sequence[int] | None = None


def _classical(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    """N = 3 to all captured steps, of vertical, horizontal and both directions."""
    most = views.rig.sequence.steps
    for direction in CLASSICAL_DIRECTIONS:
        for steps in sorted({3, min(6, most), most}) if run.quick else range(3, most + 1):
            make = partial(ClassicalMethod, views.rig, direction=direction, steps=steps, threads=run.threads)
            title = f"classical N={steps}, {direction}"
            yield Setting(f"classical-{direction}-{steps:02d}", "classical", title, make, views)


def _phase(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    """The phase route: direction, cues for the fringe order, frames, windows of its filters."""

    def setting(key: str, title: str, note: str | None = None, **options: object) -> Setting:
        make = partial(load_method, "phase", views.rig, **options)
        return Setting(f"phase-{key}", "phase", f"phase {title}", make, views, note=note)

    for direction in DIRECTIONS:
        yield setting(direction, direction, direction=direction)
        yield setting(f"{direction}-no-shading", f"{direction}, no shading", direction=direction, shading=False)
    for direction, count in product(DIRECTIONS, QUICK_FRAMES if run.quick else FEW_FRAMES):
        if count <= views.rig.sequence.steps:
            yield setting(f"{direction}-{count}", f"{direction}, {count} frames", direction=direction, frames=count)
    if run.quick:
        return
    note = "assumes objects near the rig's standoff distance, which holds for fixed placement"
    yield setting("standoff", "horizontal, standoff", note, prior="standoff")
    note = "pixels of confidence below 0.5 are masked"
    yield setting("masked", "horizontal, confident only", note, min_confidence=0.5)
    for first, second in WINDOWS:
        title = f"horizontal, windows {first:g}/{second:g}"
        yield setting(f"window-{first:g}", title, first_window=first, second_window=second)


def _networks(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    from fpp_ml_bench.baselines.tradeoff.networks import network_settings  # torch takes a second

    return network_settings(views, run)


def _precision(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    """The decoder's arithmetic in float32 and in float64, for few and for all steps."""
    most = views.rig.sequence.steps
    for steps, dtype in product((most,) if run.quick else (3, most), ("float32", "float64")):
        make = partial(DecodeInType, views.rig, "vertical", steps, dtype=dtype)
        yield Setting(f"precision-{steps:02d}-{dtype}", "precision", f"NumPy {dtype}, N={steps}", make, views)


def _sizes(views: StoredViews, run: TradeoffSettings) -> Iterator[Setting]:
    """Small scenes photographed at each image size, by all steps, by few, and from one fringe."""
    choices: tuple[tuple[Directions, int], ...] = (("both", views.rig.sequence.steps), ("vertical", 3))
    for size in QUICK_SIZES if run.quick else SIZES:
        scaled = views.rig.scaled(size)
        try:
            scaled.check_sampling()
        except FppBenchError:
            continue  # coarser than the fringes allow: no dataset of this rig has such a size
        photographed = PhotographedViews(scaled)
        for direction, steps in choices:
            make = partial(ClassicalMethod, scaled, direction=direction, steps=steps, threads=run.threads)
            title = f"classical N={steps}, {direction}"
            yield Setting(f"size-{size:04d}-{direction}-{steps}", "sizes", title, make, photographed)
        phase = partial(load_method, "phase", scaled, direction="horizontal")
        yield Setting(f"size-{size:04d}-phase", "sizes", "phase horizontal", phase, photographed)


class DecodeInType(ClassicalMethod):
    """The classical decoder's formulas for one direction in plain NumPy, every array in ``dtype``. The package decodes
    in float64. This is the same arithmetic (paper Eqs. 1 and 2, fringe order, triangulation from one projector
    coordinate), so that two runs differ only in the type. A pixel that is too dark, has an ambiguous code, or lies
    outside the working range gets 0. Raises `DecodeError` for a distorted projector, whose inverse is iterated in
    float64."""

    def __init__(self, rig: Rig, direction: Direction, steps: int, dtype: str) -> None:
        super().__init__(rig, direction, steps)
        if rig.projector.is_distorted:
            raise DecodeError("float32 against float64 is compared for a projector without distortion; this rig's has")
        self.number: Callable[[Any], Any] = np.dtype(dtype).type
        self.plan = plain_plan(rig, direction, steps, Limits())
        # Axis of the projector's image across the fringes; components of R (x, y, 1) along it and forward, (H, W).
        self.axis = 0 if direction == "vertical" else 1
        x, y = (axis.astype(dtype) for axis in rig.camera.rays())
        rotation = rig.R.astype(dtype)
        self.rays = [rotation[row, 0] * x + rotation[row, 1] * y + rotation[row, 2] for row in (self.axis, 2)]

    def predict(self, frames: Frames) -> NDArray[np.float32]:
        plan, number, dtype = self.plan, self.number, self.rays[0].dtype
        grey = [frame for index in plan.frames if (frame := frames[index]) is not None]
        if len(grey) != len(plan.frames):
            raise DecodeError(f"expected the {len(plan.frames)} frames {plan.frames}, {len(grey)} were captured")
        sums = np.zeros((3, *grey[0].shape), dtype)
        for image, weights in zip(grey, plan.weights.T.astype(dtype), strict=False):
            levels = image.astype(dtype)
            for total, weight in zip(sums, weights, strict=True):
                total += weight * levels
        mean, cosine, sine = sums
        modulation = np.sqrt(cosine * cosine + sine * sine)
        cells, trusted = decode_cells(np.stack(grey[len(plan.sinusoids) :]), mean, modulation)
        turn = number(2 * np.pi)
        phase = -np.arctan2(sine, cosine)
        centre = plan.centres_rad.astype(dtype)[np.minimum(cells, len(plan.centres_rad) - 1)]
        absolute = phase + turn * np.floor((centre - phase) / turn + number(0.5))
        coordinate_px, valid = absolute * number(plan.pitch_px / (2 * np.pi)), trusted & (modulation >= MIN_MODULATION)
        axis, device, t_m = self.axis, self.rig.projector, self.rig.t
        ideal = (coordinate_px - number((device.cx, device.cy)[axis])) / number((device.fx, device.fy)[axis])
        across, forward = self.rays
        near, far = self.rig.working_range_mm
        with np.errstate(all="ignore"):
            depth_mm = (ideal * number(t_m[2]) - number(t_m[axis])) / (across - ideal * forward) * number(MM_PER_M)
            return np.where(valid & (depth_mm >= near) & (depth_mm <= far), depth_mm, 0).astype(np.float32)


@dataclass(frozen=True)
class Plan:
    """The settings and ladders to measure, and the views."""

    opened: DatasetFolder
    views: StoredViews
    settings: list[Setting]
    ladders: list[Ladder]


def planned(run: TradeoffSettings, more_ladders: Sequence[Ladder] = ()) -> Plan:
    """The plan of a run; ``more_ladders`` are measured with this room's own. Nothing is measured yet. Raises
    DatasetError for a folder that is no dataset or has no test split, WeightsError for a ``runs`` that is no folder."""
    opened = DatasetFolder(run.dataset)
    views = choose_views(opened, run.views or (QUICK_VIEWS if run.quick else VIEWS_AN_OBJECT))
    makers: dict[Group, Callable[[StoredViews, TradeoffSettings], Iterator[Setting]]] = {
        "classical": _classical,
        "phase": _phase,
        "networks": _networks,
        "precision": _precision,
        "sizes": _sizes,
    }
    groups = [group for group in GROUPS if not run.only or group in run.only]
    settings = [setting for group in groups for setting in makers[group](views, run)]
    costs = not run.only or COSTS in run.only
    return Plan(opened, views, settings, package_ladders(views.rig, run.quick, more_ladders) if costs else [])
