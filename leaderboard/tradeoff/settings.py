"""The settings that are compared: numbers of steps, filters of the phase route, precisions, image sizes."""

from collections.abc import Iterator
from functools import partial

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Method, load_method
from fpp_ml_bench.constants import TEST_OBJECTS
from fpp_ml_bench.decoding import Directions
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.leaderboard.tradeoff.measure import Setting
from fpp_ml_bench.leaderboard.tradeoff.precision import DecodeInType
from fpp_ml_bench.leaderboard.tradeoff.views import PhotographedViews, StoredViews
from fpp_ml_bench.optics import DIRECTIONS, Rig

CLASSICAL_DIRECTIONS: tuple[Directions, ...] = ("vertical", "horizontal", "both")
FEW_FRAMES, QUICK_FRAMES = (2, 3, 4, 6, 9), (3,)
"""Frames of one direction that the phase route is also given, without Gray code."""
WINDOWS = ((0.25, 0.2), (0.5, 0.4), (0.7, 0.55))
"""First and second window of the phase route in fringe periods, besides the default (0.35, 0.27)."""
SIZES, QUICK_SIZES = (240, 480, 960, 1920), (240, 480)
SIZE_OBJECTS = ("power_drill", "wooden_boards")
"""Objects of the image sizes: a concave and a flat object."""


def classical_settings(views: StoredViews, threads: int, quick: bool = False) -> Iterator[Setting]:
    """N = 3 to all captured steps, of vertical, horizontal and both directions."""
    all_steps = views.rig.sequence.steps
    counts = sorted({3, min(6, all_steps), all_steps}) if quick else range(3, all_steps + 1)
    for direction in CLASSICAL_DIRECTIONS:
        for steps in counts:
            make = partial(ClassicalMethod, views.rig, direction, steps, threads)
            yield Setting(
                f"classical-{direction}-{steps:02d}", "classical", f"classical N={steps}, {direction}", make, views
            )


def phase_settings(views: StoredViews, quick: bool = False) -> Iterator[Setting]:
    """The phase route: direction, cues for the fringe order, frames, windows of its filters."""
    rig = views.rig

    def setting(key: str, title: str, note: str | None = None, **options: object) -> Setting:
        return Setting(f"phase-{key}", "phase", f"phase {title}", _phase(rig, options), views, note=note)

    for direction in DIRECTIONS:
        yield setting(direction, direction, direction=direction)
        yield setting(f"{direction}-no-shading", f"{direction}, no shading", direction=direction, shading=False)
    for direction in DIRECTIONS:
        for count in (number for number in (QUICK_FRAMES if quick else FEW_FRAMES) if number <= rig.sequence.steps):
            yield setting(f"{direction}-{count}", f"{direction}, {count} frames", direction=direction, frames=count)
    if not quick:
        standoff_note = "assumes objects near the rig's standoff distance, which holds for fixed placement"
        yield setting("standoff", "horizontal, standoff", standoff_note, prior="standoff")
        mask_note = "pixels of confidence below 0.5 are masked"
        yield setting("masked", "horizontal, confident only", mask_note, min_confidence=0.5)
        for first, second in WINDOWS:
            title = f"horizontal, windows {first:g}/{second:g}"
            yield setting(f"window-{first:g}", title, first_window=first, second_window=second)


def _phase(rig: Rig, options: dict[str, object]) -> "partial[Method]":
    return partial(load_method, "phase", rig, **options)


def precision_settings(views: StoredViews, quick: bool = False) -> Iterator[Setting]:
    """The decoder's arithmetic in float32 and in float64, for few and for all steps."""
    all_steps = views.rig.sequence.steps
    for steps in (all_steps,) if quick else (3, all_steps):
        for dtype in ("float32", "float64"):
            make = partial(DecodeInType, views.rig, "vertical", steps, dtype)
            yield Setting(f"precision-{steps:02d}-{dtype}", "precision", f"NumPy {dtype}, N={steps}", make, views)


def size_settings(rig: Rig, threads: int, quick: bool = False) -> Iterator[Setting]:
    """Small scenes photographed by ``rig`` at each image size, by all steps, by few, and from one fringe."""
    all_steps = rig.sequence.steps
    for size in QUICK_SIZES if quick else SIZES:
        scaled = rig.scaled(size)
        try:
            scaled.check_sampling()
        except FppBenchError:
            continue  # coarser than the fringes allow: no dataset of this rig has such a size
        views = PhotographedViews(scaled, [name for name in SIZE_OBJECTS if name in TEST_OBJECTS])
        for direction, steps in (("both", all_steps), ("vertical", 3)):
            make = partial(ClassicalMethod, scaled, direction, steps, threads)  # type: ignore[arg-type]
            yield Setting(
                f"size-{size:04d}-{direction}-{steps}", "sizes", f"classical N={steps}, {direction}", make, views
            )
        phase = _phase(scaled, {"direction": "horizontal"})
        yield Setting(f"size-{size:04d}-phase", "sizes", "phase horizontal", phase, views)
