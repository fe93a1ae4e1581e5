"""The views that the learned methods learn from: objects in lights that are drawn at random,
rendered and kept.

A light is drawn stage by stage of the image formation: exposure, noise, ambient light, response,
defocus, blur, albedo maps, gloss, shadows. Each serves several views, so that some of them can be
united into one image: the nearest surface of two or three objects at every pixel, for depth jumps
and creases that no single object has. All share rig and light, so a union is what the rig would
capture of all of them (they may intersect), except for the shadows that they cast on one another.
The validation views are the validation objects in two lights of the benchmark, and in drawn ones.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from hashlib import sha256
from io import BytesIO
from itertools import groupby
from math import exp, log
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.training.engine import Display
from fpp_ml_bench.coding.phase_shift import wrapped_phase
from fpp_ml_bench.constants import GREY_LEVELS, OBJECTS, VIEWS, split_of
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction
from fpp_ml_bench.pool import mapping

VALIDATION_LIGHTS = ("paper", "workshop")
DRAWN_VALIDATION_VIEWS = 3  # of validation objects in each light that is drawn for them
SHADOW_GREY = 6.0
"""Grey levels by which a background must be darker than the other to count as an object's shadow on
the plane."""
MOST_OBJECTS = 3  # objects in one union, at most


@dataclass(frozen=True)
class Group:
    """Views (object, view) of one split in one light."""

    name: str
    light: Light
    views: tuple[tuple[str, str], ...]
    split: str = "train"


@dataclass(frozen=True)
class View:
    """A rendered view: ``frames`` uint8 (n, H, W), those that were asked for, or float16 with the
    numerators and denominators of decoded phases behind them, in grey levels; ``depth_mm`` float32
    (H, W), exact, 0 = background; ``void`` bool (H, W): unlit or mixed pixels, which have no depth
    to learn; ``united``: it joins several objects."""

    name: str
    object_name: str
    group: str
    frames: NDArray[np.uint8 | np.float16]
    depth_mm: NDArray[np.float32]
    void: NDArray[np.bool_]
    united: bool = False

    @property
    def target(self) -> NDArray[np.bool_]:
        """Object pixels that are not void."""
        return (self.depth_mm > 0) & ~self.void

    def part(self, crop: tuple[slice, slice]) -> "View":
        """The view cut to ``crop``."""
        frames = self.frames[:, *crop]
        return replace(self, frames=frames, depth_mm=self.depth_mm[crop], void=self.void[crop])


def photographed(
    studio: Studio, name: str, view: str, frames: tuple[int, ...]
) -> tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.uint8]]:
    """An object in a view as a ``studio`` sees it, with the rig, light and seed of its settings:
    ``frames`` (indices in the rig's sequence) uint8 (n, H, W), exact depth in mm float32 (H, W), 0
    = background, and the pixels' `Flag`."""
    scene = studio.trace(solid_mesh(name), view)
    studio.expose(scene, frames)
    images = np.stack([studio.frame(frame) for frame in frames])
    return images, studio.exact_mm(scene), studio.flags(scene)[0]


HELD_OUT = ("camera-blur", "dark-paint")
"""Axes of `fpp-bench robustness` that no drawn light has, so that they tell what a method does in
trouble that it never learned: one of the optics, one of the surface. Of the optics, camera blur is
the one whose kin, defocus, is still drawn."""


def drawn_light(random: np.random.Generator) -> Light:
    """A light drawn from ``random``, from nearly that of the paper to a poor workshop's; without
    what is `HELD_OUT`."""

    def even(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def by_ratio(low: float, high: float) -> float:
        return exp(even(log(low), log(high)))

    def now_and_then(share: float, value: float, otherwise: float) -> float:
        return value if random.random() < share else otherwise

    full_well_e = by_ratio(4000, 32500)
    noise_grey = by_ratio(0.1, 6.0)
    textures = str(random.choice(("none", "by_kind", "checks"), p=(0.35, 0.5, 0.15)))
    return (
        named_light("paper")
        .model_copy(update={"name": "drawn"})
        .changed(
            "projector",
            response=now_and_then(0.4, even(1.0, 2.4), 1.0),
            pixel_blur_px=even(0, 0.6),
            defocus_px=now_and_then(0.6, even(0, 4.5), 0.0),
            falloff=int(random.choice((0, 2))),
        )
        .changed(
            "surface",
            albedo=even(0.4, 0.92),
            gloss=now_and_then(0.5, even(0.05, 0.4), 0.0),
            roughness=even(0.18, 0.9),
            textures=textures,
            contrast=0.0 if textures == "none" else even(0.1, 0.9),
        )
        .changed("bounces", shadows=bool(random.random() < 0.5))
        .changed(
            "camera",
            falloff=int(random.choice((0, 4))),
            exposure=by_ratio(0.17, 2.5),
            black_grey=even(0, 3),
            full_well_e=full_well_e,
            read_noise_e=noise_grey * full_well_e / GREY_LEVELS,
            bits=int(random.choice((8, 10))),
            response=now_and_then(0.3, even(0.75, 1.25), 1.0),
        )
        .changed(
            ambient_grey=by_ratio(1.5, 70),
            calibration_px=now_and_then(0.3, even(0.02, 0.3), 0.0),
        )
    )


def groups_of(
    lights: int, views_a_light: int, seed: int, textured_every: int = 1, validation_lights: int = 0
) -> list[Group]:
    """The groups to render: training objects in the paper's light, every second view, then in
    ``lights`` drawn ones, and the validation objects in `VALIDATION_LIGHTS` and in
    ``validation_lights`` drawn ones. Every ``textured_every``-th drawn light has the albedo maps
    and the gloss that were drawn; the others show one matte material."""
    training, validation = (
        [name for name in OBJECTS if split_of(name) == split] for split in ("train", "validation")
    )
    plain = tuple(
        (name, VIEWS[(number + 2 * turn) % len(VIEWS)])
        for number, name in enumerate(training)
        for turn in range(len(VIEWS) // 2)
    )

    def drawn(number: int, names: list[str], count: int, split: str) -> Group:
        random = np.random.default_rng([seed, number] if split == "train" else [seed, number, 1])
        chosen = random.choice(names, count, replace=False)
        views = tuple((str(name), VIEWS[int(random.integers(len(VIEWS)))]) for name in chosen)
        light, textured = drawn_light(random), number % textured_every == textured_every - 1
        if not textured:
            light = light.changed("surface", gloss=0.0, textures="none", contrast=0.0)
        stem = ("drawn" if textured else "plain") if split == "train" else f"{split}-drawn"
        return Group(f"{stem}-{number:03d}", light, views, split)

    groups = [Group("paper", named_light("paper"), plain)]
    groups += [drawn(number, training, views_a_light, "train") for number in range(lights)]
    for light in VALIDATION_LIGHTS:
        views = tuple((name, view) for name in validation for view in VIEWS[::2])
        groups.append(Group(f"validation-{light}", named_light(light), views, "validation"))
    groups += [
        drawn(n, validation, DRAWN_VALIDATION_VIEWS, "validation") for n in range(validation_lights)
    ]
    return groups


def fingerprint_of(recipe: dict[str, Any], groups: list[Group]) -> str:
    """SHA-256 of a training's recipe and of the views that it renders."""
    views = [
        [group.name, group.split, group.light.model_dump(mode="json"), group.views]
        for group in groups
    ]
    return sha256(json.dumps([recipe, views], sort_keys=True).encode()).hexdigest()


def render_views(
    groups: list[Group],
    rig: Rig,
    frames: tuple[int, ...],
    folder: Path,
    workers: int,
    show: bool = False,
    decoded: tuple[Direction, ...] = (),
) -> None:
    """Render what ``folder`` does not hold yet of ``frames`` (indices in the rig's sequence), a
    file a view, and behind them numerator and denominator of the phase that all steps of the
    directions ``decoded`` tell. ``show``: progress on stderr. Raises OSError where ``folder`` can't
    be written."""
    missing = [
        group
        for group in groups
        if not all(_file(folder, group, *view).exists() for view in group.views)
    ]
    with Display("rendering views", sum(len(group.views) for group in missing), show) as display:
        if missing:
            folder.mkdir(parents=True, exist_ok=True)
            with mapping((rig, frames, folder, decoded), workers) as mapped:
                for count in mapped(_render_group, missing):
                    display.step(count)


def _render_group(
    work: tuple[Rig, tuple[int, ...], Path, tuple[Direction, ...]], group: Group
) -> int:
    rig, frames, folder, decoded = work
    steps = [rig.sequence.sinusoids(direction) for direction in decoded]
    objects = tuple(sorted({name for name, _ in group.views}))
    studio = Studio(BuildSettings(rig=rig, objects=objects, light=group.light))
    for name, view in group.views:
        every = tuple(sorted({*frames, *(step for each in steps for step in each)}))
        stack, depth_mm, flags = photographed(studio, name, view, every)
        taken = dict(zip(every, stack, strict=True))
        images = np.stack([taken[frame] for frame in frames])
        for direction, each in zip(decoded, steps, strict=True):
            phase, modulation, _ = wrapped_phase(
                [taken[step] for step in each], rig.shifts_rad(direction), np.float32
            )
            images = np.concatenate([images, modulation * [np.sin(phase), np.cos(phase)]]).astype(
                np.float16
            )
        content = BytesIO()
        np.savez_compressed(content, frames=images, depth_mm=depth_mm, void=(flags & VOID) != 0)
        write_atomically(_file(folder, group, name, view), content.getvalue(), sync=False)
    return len(group.views)


def read_views(folder: Path, groups: list[Group], split: str) -> Iterator[View]:
    """The rendered views of a split, group after group. Raises `TrainingError` for a file that
    can't be read."""
    for group in groups:
        for name, view in group.views if group.split == split else ():
            file = _file(folder, group, name, view)
            try:
                with np.load(file, allow_pickle=False) as arrays:
                    maps = arrays["frames"], arrays["depth_mm"], arrays["void"]
            except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
                words = f"can't be read ({error}); delete it and run the same command again"
                raise TrainingError(f"{file}: {words}") from None
            yield View(f"{name}_{view}", name, group.name, *maps)


def _file(folder: Path, group: Group, name: str, view: str) -> Path:
    return folder / f"{group.name}-{name}-{view}.npz"


def with_unions(views: Iterable[View], unions: int, seed: int) -> Iterator[View]:
    """``views``, group after group, each followed by ``unions`` for each of its views with others
    of the group."""
    made = 0
    for _, members in groupby(views, lambda view: view.group):
        group = []
        for view in members:
            group.append(view)
            yield view
        objects, by_name = (
            {view.name: view.object_name for view in group},
            {view.name: view for view in group},
        )
        for number, view in enumerate(group):
            for copy in range(unions):
                random = np.random.default_rng([seed, made, number, copy])
                others = [by_name[name] for name in companions(objects, view.name, random)]
                if others:
                    yield united([view, *others])
        made += len(group)


def united(views: list[View]) -> View:
    """All objects of ``views`` together. The nearest surface counts; without one, the first image's
    background, or another image's where it is in shadow."""
    ranges = np.stack([np.where(view.depth_mm > 0, view.depth_mm, np.inf) for view in views])
    nearest = ranges.argmin(axis=0)[None]
    depth, void = (
        np.take_along_axis(maps, nearest, axis=0)[0]
        for maps in (ranges, np.stack([v.void for v in views]))
    )
    stacked = np.stack([view.frames for view in views])
    frames, darkest = np.take_along_axis(stacked, nearest[:, None], axis=0)[0], stacked.min(axis=0)
    empty = np.isinf(depth)
    shadow = empty & (darkest.astype(np.float32) + SHADOW_GREY < frames)
    return replace(
        views[0],
        name="+".join(view.name for view in views),
        frames=np.where(shadow, darkest, frames),
        depth_mm=np.where(empty, 0.0, depth).astype(np.float32),
        void=void,
        united=True,
    )


def companions(objects: Mapping[str, str], view: str, random: np.random.Generator) -> list[str]:
    """One or two views of objects that differ from that of ``view`` and from each other; fewer if
    there are none. ``objects``: the object of every view to choose from."""
    members = [view]
    for _ in range(int(random.integers(1, MOST_OBJECTS))):
        shown = {objects[member] for member in members}
        candidates = [member for member, object_name in objects.items() if object_name not in shown]
        if candidates:
            members.append(candidates[int(random.integers(len(candidates)))])
    return members[1:]
