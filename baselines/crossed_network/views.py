"""The views that crossed-net learns from: training objects in lights that are drawn at random, rendered once and kept.

A light is drawn stage by stage of the image formation: exposure, noise, ambient light, response, defocus, blur, albedo
maps, gloss, shadows. Each serves several views, so that two of them can be united into one image. The validation views
are the validation objects in two lights of the benchmark.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import exp, log
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M, OBJECTS, VIEWS, split_of
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.loaders.render import BuildSettings, Light, Studio, named_light, solid_mesh
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics import Rig
from fpp_ml_bench.pool import mapping

VALIDATION_LIGHTS = ("paper", "workshop")


@dataclass(frozen=True)
class Group:
    """Views (object, view) of one split in one light."""

    name: str
    light: Light
    views: tuple[tuple[str, str], ...]
    split: str = "train"


@dataclass(frozen=True)
class View:
    """A rendered view: ``grey`` uint8 (H, W), the crossed frame; ``depth_mm`` float32 (H, W), exact, 0 = background;
    ``void`` bool (H, W): unlit or mixed pixels, which have no depth to learn."""

    name: str
    object_name: str
    group: str
    grey: NDArray[np.uint8]
    depth_mm: NDArray[np.float32]
    void: NDArray[np.bool_]


def drawn_light(random: np.random.Generator) -> Light:
    """A light drawn from ``random``, from nearly that of the paper to a poor workshop's."""

    def even(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    def by_ratio(low: float, high: float) -> float:
        return exp(even(log(low), log(high)))

    def now_and_then(share: float, value: float, otherwise: float) -> float:
        return value if random.random() < share else otherwise

    full_well_e = by_ratio(4000, 32500)
    noise_grey = by_ratio(0.1, 6.0)
    textures = str(random.choice(("none", "by_kind", "checks"), p=(0.35, 0.5, 0.15)))
    return named_light("paper").model_copy(update={"name": "drawn"}).changed(
        "projector", response=now_and_then(0.4, even(1.0, 2.4), 1.0), pixel_blur_px=even(0, 0.6),
        defocus_px=now_and_then(0.6, even(0, 4.5), 0.0), falloff=int(random.choice((0, 2))),
    ).changed(
        "surface", albedo=even(0.4, 0.92), gloss=now_and_then(0.5, even(0.05, 0.4), 0.0), roughness=even(0.18, 0.9),
        textures=textures, contrast=0.0 if textures == "none" else even(0.1, 0.9),
    ).changed("bounces", shadows=bool(random.random() < 0.5)).changed(
        "camera", blur_px=now_and_then(0.6, even(0, 2.2), 0.0), falloff=int(random.choice((0, 4))),
        exposure=by_ratio(0.17, 2.5), black_grey=even(0, 3), full_well_e=full_well_e,
        read_noise_e=noise_grey * full_well_e / GREY_LEVELS, bits=int(random.choice((8, 10))),
        response=now_and_then(0.3, even(0.75, 1.25), 1.0),
    ).changed(
        ambient_grey=by_ratio(1.5, 70), calibration_px=now_and_then(0.3, even(0.02, 0.3), 0.0),
    )  # fmt: skip


def groups_of(lights: int, views_a_light: int, seed: int) -> list[Group]:
    """The groups to render: training objects in the paper's light, every second view, then in ``lights`` drawn ones,
    and the validation objects in `VALIDATION_LIGHTS`."""
    training, validation = ([name for name in OBJECTS if split_of(name) == split] for split in ("train", "validation"))
    plain = tuple((name, VIEWS[(number + 2 * turn) % len(VIEWS)])
                  for number, name in enumerate(training) for turn in range(len(VIEWS) // 2))  # fmt: skip
    groups = [Group("paper", named_light("paper"), plain)]
    for number in range(lights):
        random = np.random.default_rng([seed, number])
        names = random.choice(training, views_a_light, replace=False)
        views = tuple((str(name), VIEWS[int(random.integers(len(VIEWS)))]) for name in names)
        groups.append(Group(f"drawn-{number:03d}", drawn_light(random), views))
    for light in VALIDATION_LIGHTS:
        views = tuple((name, view) for name in validation for view in VIEWS[::2])
        groups.append(Group(f"validation-{light}", named_light(light), views, "validation"))
    return groups


def render(
    groups: list[Group], rig: Rig, folder: Path, workers: int, progress: Callable[[int], None] = lambda views: None
) -> None:
    """Render what ``folder`` does not hold yet, a file a view. Raises `TrainingError` for a folder that can't be
    written."""
    missing = [group for group in groups if not all(_file(folder, group, *view).exists() for view in group.views)]
    progress(sum(len(group.views) for group in groups) - sum(len(group.views) for group in missing))
    if not missing:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainingError(f"{folder}: can't be written ({error.strerror})") from error
    with mapping((rig, folder), workers) as mapped:
        for count in mapped(_render_group, missing):
            progress(count)


def _render_group(work: tuple[Rig, Path], group: Group) -> int:
    rig, folder = work
    objects = tuple(sorted({name for name, _ in group.views}))
    studio = Studio(BuildSettings(rig=rig, objects=objects, light=group.light))
    (frame, *_) = rig.sequence.crossed_frames
    shape = rig.camera.height, rig.camera.width
    for name, view in group.views:
        scene = studio.trace(solid_mesh(name), view)
        studio.expose(scene, (frame,))
        depth_mm = np.zeros(shape, np.float32)
        depth_mm.ravel()[scene.hits.pixels] = scene.hits.depth_m * MM_PER_M
        void = (studio.flags(scene)[0] & VOID) != 0
        file = _file(folder, group, name, view)
        temporary = file.with_name(f".{file.name}.{os.getpid()}.tmp")
        try:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, grey=studio.frame(frame), depth_mm=depth_mm, void=void)
            temporary.replace(file)
        except OSError as error:
            temporary.unlink(missing_ok=True)
            raise TrainingError(f"{file}: can't be written ({error.strerror}); free some space") from error
    return len(group.views)


def read(folder: Path, groups: list[Group], split: str) -> Iterator[View]:
    """The rendered views of a split, group after group. Raises `TrainingError` for a file that can't be read."""
    for group in groups:
        for name, view in group.views if group.split == split else ():
            file = _file(folder, group, name, view)
            try:
                with np.load(file, allow_pickle=False) as arrays:
                    maps = arrays["grey"], arrays["depth_mm"], arrays["void"]
            except (OSError, ValueError, KeyError, EOFError) as error:
                words = f"can't be read ({error}); delete it and run the same command again"
                raise TrainingError(f"{file}: {words}") from None
            yield View(f"{name}_{view}", name, group.name, *maps)


def _file(folder: Path, group: Group, name: str, view: str) -> Path:
    return folder / f"{group.name}-{name}-{view}.npz"
