"""The views that fringe-net learns from: objects in lights that are drawn at random, alone and
united.

A light is drawn stage by stage of the image formation: exposure, noise, ambient light, response,
defocus, blur, albedo maps, gloss, shadows. Each serves several views, so that some of them can be
united into one image: the nearest surface of two or three objects at every pixel, for depth jumps
and creases that no single object has. All share rig and light, so a union is what the rig would
capture of all of them (they may intersect), except for the shadows that they cast on one another.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from math import exp, log

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.view import Studio

SHADOW_GREY = 6.0
"""Grey levels by which a background must be darker than the other to count as an object's shadow on
the plane."""
MOST_OBJECTS = 3
"""Objects in one union, at most."""


@dataclass(frozen=True)
class View:
    """A rendered view: ``frames`` float16 (n, H, W), grey levels; ``depth_mm`` float32 (H, W),
    exact, 0 = background; ``void`` bool (H, W): unlit or mixed pixels, which have no depth to learn;
    ``united``: it joins several objects."""

    name: str
    object_name: str
    group: str
    frames: NDArray[np.float16]
    depth_mm: NDArray[np.float32]
    void: NDArray[np.bool_]
    united: bool = False

    @property
    def target(self) -> NDArray[np.bool_]:
        """Object pixels that are not void."""
        return (self.depth_mm > 0) & ~self.void


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
