"""The images that fringe-net learns from: training objects photographed by drawn rigs in drawn
lights, each with the true phases of its carriers, and where the object is.

A *setting* is one rig in one light with a few objects before it, alone and united
(`scenes.with_unions`). Its images are cut to the surroundings of the object, and to a part elsewhere
where the empty scene misfits most, which a mask must not take for an object. The rig is scaled so
that the objects fit its volume as they are: phases do not depend on the unit of length.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from io import BytesIO
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.fringe_net import empty_scene_channel
from fpp_ml_bench.baselines.learned.scenes import (
    View,
    drawn_light,
    photographed,
    with_unions,
)
from fpp_ml_bench.baselines.learned.warp import signs_of, steps_and_signs
from fpp_ml_bench.baselines.phase.empty_scene import Background, CrossedEmptyScene, EmptyScene
from fpp_ml_bench.baselines.phase.geometry import (
    CalibrationLayer,
    Carriers,
    Crop,
    Image,
    Mask,
    stride_of,
    wrapped,
)
from fpp_ml_bench.baselines.phase.local_fit import Demodulator
from fpp_ml_bench.baselines.training.engine import Display
from fpp_ml_bench.coding.phase_shift import wrapped_phase
from fpp_ml_bench.constants import OBJECTS, VIEWS, split_of
from fpp_ml_bench.depth import depth_edges
from fpp_ml_bench.design.rigs import drawn_rig
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings, volume_scale
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.rig import Rig, middle_m
from fpp_ml_bench.optics.sequence import DIRECTIONS
from fpp_ml_bench.pool import mapping

Fringes = Literal["crossed", "horizontal", "vertical"]
MARGIN_PERIODS = 2.0
"""Of the part around the object, in periods: what a window of the network reaches."""
FAR_PX = 224
"""Side of the part elsewhere, in px."""
EDGE_POINTS = 2000
"""Pixels of interest that an image holds, as centres of training windows."""
PAPER_EVERY = 8
"""Every so many settings the rig is the paper's, which most users measure with."""
VALIDATION_LIGHTS = ("paper", "workshop")
"""Of the validation objects, one a rig in turn."""
VALIDATION_VIEWS = 2
"""Views of each validation object in each of its settings."""
OUTSIDE, OBJECT, NEITHER = 0, 1, 2
"""Labels of a pixel: background, object, and void or beyond the image."""


@dataclass(frozen=True)
class Setting:
    """``views`` (object, view) of one ``split`` before a rig in a light."""

    name: str
    rig: Rig
    light: Light
    views: tuple[tuple[str, str], ...]
    split: str = "train"


@dataclass(frozen=True)
class FringeImage:
    """A part (h, w) of an image of ``fringes``, K carriers. ``grey`` uint8; ``misfit`` float16: of
    the empty scene, arcsinh of standard deviations over 4, all 0 where no plane is ``shown``;
    ``label`` uint8; ``phase_rad`` float16 (K, h, w), wrapped, and ``bright`` float16 (h, w), the
    modulation of a full fringe in grey levels, of object pixels; ``edges`` int16 (n, 2): rows and
    columns beside depth edges and silhouettes; ``step_rad`` (K, 2): change of the phases per px
    along x and y at the standoff; ``signs`` (K,): 1 where a phase grows with nearness."""

    name: str
    setting: str
    fringes: Fringes
    grey: NDArray[np.uint8]
    misfit: NDArray[np.float16]
    shown: bool
    label: NDArray[np.uint8]
    phase_rad: NDArray[np.float16]
    bright: NDArray[np.float16]
    edges: NDArray[np.int16]
    step_rad: NDArray[np.float64]
    signs: NDArray[np.float64]

    @property
    def period_px(self) -> float:
        """Of the longer carrier."""
        return float((2 * np.pi / np.linalg.norm(self.step_rad, axis=1)).max())


def settings_of(rigs: int, views_a_rig: int, validation_rigs: int, seed: int) -> list[Setting]:
    """``rigs`` with training objects, and ``validation_rigs``, drawn from other numbers, with the
    validation objects, in the lights `VALIDATION_LIGHTS` in turn; last the paper's rig in both."""
    training, validation = (
        [name for name in OBJECTS if split_of(name) == split] for split in ("train", "validation")
    )
    settings = []
    for number in range(rigs):
        random = np.random.default_rng([seed, number])
        rig = crossed_rig() if number % PAPER_EVERY == PAPER_EVERY - 1 else drawn_rig(random)
        light = drawn_light(random)
        if number % 3 == 0:  # one matte material
            light = light.changed("surface", gloss=0.0, textures="none", contrast=0.0)
        chosen = random.choice(training, views_a_rig, replace=False)
        views = tuple((str(name), VIEWS[int(random.integers(len(VIEWS)))]) for name in chosen)
        settings.append(_setting(f"train-{number:03d}", rig, light, views, "train"))
    for number in range(validation_rigs + len(VALIDATION_LIGHTS)):
        random = np.random.default_rng([seed, number, 1])
        rig = drawn_rig(random) if number < validation_rigs else crossed_rig()
        light = named_light(VALIDATION_LIGHTS[number % len(VALIDATION_LIGHTS)])
        views = tuple(
            (name, VIEWS[(number + 3 * turn) % len(VIEWS)])
            for name in validation
            for turn in range(VALIDATION_VIEWS)
        )
        settings.append(_setting(f"validation-{number:02d}", rig, light, views, "validation"))
    return settings


def _setting(
    name: str, rig: Rig, light: Light, views: tuple[tuple[str, str], ...], split: str
) -> Setting:
    """In the unit of length in which the objects fit the rig; the lens is focused on its middle."""
    fitted = rig.times(1 / volume_scale(rig))
    light = light.changed("projector", focus_m=middle_m(fitted.working_range_mm))
    return Setting(name, fitted, light.changed(calibration_px=0.0), views, split)


def render_settings(
    settings: Sequence[Setting], folder: Path, unions: int, workers: int, show: bool
) -> None:
    """Photograph and measure what ``folder`` does not hold yet, a file a setting. ``show``:
    progress on stderr. Raises OSError where ``folder`` can't be written."""
    missing = [setting for setting in settings if not _file(folder, setting).exists()]
    with Display("rendering settings", len(missing), show) as display:
        if missing:
            folder.mkdir(parents=True, exist_ok=True)
            with mapping((folder, unions), workers) as mapped:
                for _ in mapped(_render, missing):
                    display.step(1)


def read_images(settings: Sequence[Setting], folder: Path, split: str) -> Iterator[FringeImage]:
    """The images of a split. Raises `TrainingError` for a file that can't be read."""
    for setting in settings:
        if setting.split != split:
            continue
        file = _file(folder, setting)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                maps = {key: arrays[key] for key in arrays.files}
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            words = f"can't be read ({error}); delete it and run the same command again"
            raise TrainingError(f"{file}: {words}") from None
        for number in range(int(maps["count"])):
            part: dict[str, Any] = {
                entry.name: maps[f"{number}-{entry.name}"] for entry in fields(FringeImage)
            }
            part |= {key: str(part[key]) for key in ("name", "setting", "fringes")}
            yield FringeImage(**part | {"shown": bool(part["shown"])})


def _file(folder: Path, setting: Setting) -> Path:
    return folder / f"{setting.name}.npz"


def _render(work: tuple[Path, int], setting: Setting) -> None:
    folder, unions = work
    content: dict[str, Any] = {}
    images = list(_images(setting, unions if setting.split == "train" else 0))
    for number, image in enumerate(images):
        content |= {f"{number}-{e.name}": getattr(image, e.name) for e in fields(FringeImage)}
    buffer = BytesIO()
    np.savez_compressed(buffer, count=len(images), **content)
    write_atomically(_file(folder, setting), buffer.getvalue(), sync=False)


def _images(setting: Setting, unions: int) -> Iterator[FringeImage]:
    """Of every view and union the crossed frame, and one of the others in turn; of validation views
    all three."""
    rig, sequence = setting.rig, setting.rig.sequence
    objects = tuple(sorted({name for name, _ in setting.views}))
    studio = Studio(
        BuildSettings(rig=rig, objects=objects, light=setting.light, placement="varied")
    )
    steps = sequence.sinusoids("horizontal")
    taken = (sequence.crossed_frames[0], *(sequence.sinusoids(way)[0] for way in DIRECTIONS))
    every = tuple(sorted({*taken, *steps}))
    photographs = []
    for name, view in setting.views:
        stack, depth_mm, flags = photographed(studio, name, view, every)
        by_frame = dict(zip(every, stack, strict=True))
        _, bright, _ = wrapped_phase(
            [by_frame[step] for step in steps], rig.shifts_rad("horizontal"), np.float32
        )
        frames = np.stack([*(by_frame[frame] for frame in taken), bright]).astype(np.float16)
        void = (flags & VOID) != 0
        photographs.append(View(f"{name}_{view}", name, setting.name, frames, depth_mm, void))
    kinds: list[_Crossed | _Line] = [_Crossed(rig), *(_Line(rig, way) for way in DIRECTIONS)]
    for number, seen in enumerate(with_unions(photographs, unions, studio.settings.seed)):
        if not seen.target.any():
            continue
        others = (1, 2) if setting.split == "validation" else (1 + number % 2,)
        for which in (0, *others):
            yield from kinds[which].cut(seen, seen.frames[which], seen.frames[3], number)


class _Kind(ABC):
    """One kind of fringes of a rig: ``fringes``, and their carriers."""

    fringes: Fringes
    period_px: float
    step_rad: NDArray[np.float64]
    signs: NDArray[np.float64]

    @abstractmethod
    def background(self, grey: NDArray[np.uint8]) -> Background:
        """The empty scene fitted to a frame (H, W)."""

    @abstractmethod
    def phases(self, depth_mm: NDArray) -> NDArray:
        """Phases (K, H, W) of a depth."""

    def cut(
        self, view: View, frame: NDArray, bright: NDArray, number: int
    ) -> Iterator[FringeImage]:
        """The parts of a frame (H, W)."""
        grey = np.rint(frame.astype(np.float32)).astype(np.uint8)
        background = self.background(grey)
        misfit = empty_scene_channel(
            background.residual, background.noise_grey, background.shown
        ).astype(np.float16)
        label = np.where(view.void, NEITHER, np.where(view.target, OBJECT, OUTSIDE))
        label = label.astype(np.uint8)
        phases = wrapped(self.phases(np.where(view.depth_mm > 0, view.depth_mm, 1000.0)))
        truth = np.where(view.target, phases, 0).astype(np.float16)
        edges = depth_edges(view.depth_mm)
        for crop in self._crops(view.target, np.abs(misfit).astype(np.float32)):
            places = np.argwhere(edges[crop]).astype(np.int16)
            order = np.random.default_rng(number).permutation(len(places))[:EDGE_POINTS]
            yield FringeImage(
                name=view.name,
                setting=view.group,
                fringes=self.fringes,
                grey=grey[crop],
                misfit=misfit[crop],
                shown=background.shown,
                label=label[crop],
                phase_rad=truth[:, *crop],
                bright=np.where(view.target, bright, 0).astype(np.float16)[crop],
                edges=places[order],
                step_rad=self.step_rad,
                signs=self.signs,
            )

    def _crops(self, target: Mask, misfit: Image) -> list[Crop]:
        margin = int(np.ceil(MARGIN_PERIODS * self.period_px))
        around = []
        for axis in (1, 0):
            places = np.flatnonzero(target.any(axis=axis))
            around.append(slice(max(int(places[0]) - margin, 0), int(places[-1]) + 1 + margin))
        near: Crop = (around[0], around[1])
        elsewhere = cv2.blur(misfit, (FAR_PX // 2, FAR_PX // 2))
        elsewhere[near] = -1
        row, column = np.unravel_index(int(elsewhere.argmax()), elsewhere.shape)
        if elsewhere[row, column] < 0:
            return [near]
        starts = [
            int(np.clip(place - FAR_PX // 2, 0, max(length - FAR_PX, 0)))
            for place, length in zip((row, column), misfit.shape, strict=True)
        ]
        return [near, (slice(starts[0], starts[0] + FAR_PX), slice(starts[1], starts[1] + FAR_PX))]


class _Crossed(_Kind):
    fringes = "crossed"

    def __init__(self, rig: Rig) -> None:
        if rig.crossed is None:
            raise TrainingError("expected a rig with crossed frames")
        self.carriers = carriers = Carriers.of(rig, rig.crossed)
        self.period_px, self.step_rad = carriers.period_px, carriers.step_rad
        self.signs = signs_of(carriers.gain)
        stride = stride_of(self.period_px)
        self._demodulator = Demodulator(carriers, stride)
        self._scene = CrossedEmptyScene(carriers, stride)

    def background(self, grey: NDArray[np.uint8]) -> Background:
        image = grey.astype(np.float32)
        return self._scene(image, self._demodulator(image))

    def phases(self, depth_mm: NDArray) -> NDArray:
        return self.carriers.phases(self.carriers.nearness(depth_mm))


class _Line(_Kind):
    def __init__(self, rig: Rig, way: Literal["horizontal", "vertical"]) -> None:
        self.fringes = way
        self.layer = CalibrationLayer.of(rig, way)
        self.period_px = rig.image_px_per_period(way)
        self._scene = EmptyScene(rig, self.layer, self.period_px, None, None)
        self.step_rad, self.signs = steps_and_signs(rig, self.layer)

    def background(self, grey: NDArray[np.uint8]) -> Background:
        return self._scene.fit(grey)

    def phases(self, depth_mm: NDArray) -> NDArray:
        return self.layer.absolute_phase(depth_mm)[None]
