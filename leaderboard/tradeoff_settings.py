"""The settings that are compared: every number of steps, every filter of the phase route, precisions, image sizes."""

from collections.abc import Iterator
from functools import partial

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.methods import Method, method
from fpp_ml_bench.constants import TEST_OBJECTS
from fpp_ml_bench.decoding import Directions
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.frames import DIRECTIONS
from fpp_ml_bench.leaderboard.tradeoff_measure import Setting
from fpp_ml_bench.leaderboard.tradeoff_precision import DecodeInType
from fpp_ml_bench.leaderboard.tradeoff_views import PhotographedViews, StoredViews
from fpp_ml_bench.rig import Rig

WAYS: tuple[Directions, ...] = ("vertical", "horizontal", "both")
FEW_FRAMES, QUICK_FRAMES = (2, 3, 4, 6, 9), (3,)
"""Frames of one direction that the phase route is also given, without Gray code."""
WINDOWS = ((0.25, 0.2), (0.5, 0.4), (0.7, 0.55))
"""First and second window of the phase route in fringe periods, beside its own (0.35, 0.27)."""
SIZES, QUICK_SIZES = (240, 480, 960, 1920), (240, 480)
SIZE_OBJECTS = ("power_drill", "wooden_boards")
"""Small scenes of the sizes: a concave object and a flat one."""


def classical_settings(views: StoredViews, threads: int, quick: bool = False) -> Iterator[Setting]:
    """N = 3 to all captured steps, of vertical, horizontal and both directions."""
    most = views.rig.sequence.steps
    counts = sorted({3, min(6, most), most}) if quick else range(3, most + 1)
    for way in WAYS:
        for steps in counts:
            make = partial(ClassicalMethod, views.rig, way, steps, threads)
            yield Setting(f"classical-{way}-{steps:02d}", "classical", f"classical N={steps}, {way}", make, views)


def phase_settings(views: StoredViews, quick: bool = False) -> Iterator[Setting]:
    """The phase route: direction, what chooses the order, frames, windows of its filters."""
    rig = views.rig

    def one(key: str, title: str, note: str | None = None, **options: object) -> Setting:
        return Setting(f"phase-{key}", "phase", f"phase {title}", _phase(rig, options), views, note=note)

    for way in DIRECTIONS:
        yield one(way, way, direction=way)
        yield one(f"{way}-no-shading", f"{way}, no shading", direction=way, shading=False)
    for way in DIRECTIONS:
        for count in (number for number in (QUICK_FRAMES if quick else FEW_FRAMES) if number <= rig.sequence.steps):
            yield one(f"{way}-{count}", f"{way}, {count} frames", direction=way, frames=count)
    if not quick:
        told = "told that objects stand near the rig's standoff, which is true of fixed placement"
        yield one("standoff", "horizontal, standoff", told, prior="standoff")
        masked = "pixels of confidence below 0.5 are masked"
        yield one("masked", "horizontal, confident only", masked, min_confidence=0.5)
        for first, second in WINDOWS:
            title = f"horizontal, windows {first:g}/{second:g}"
            yield one(f"window-{first:g}", title, first_window=first, second_window=second)


def _phase(rig: Rig, options: dict[str, object]) -> "partial[Method]":
    return partial(method, "phase", rig, **options)


def precision_settings(views: StoredViews, quick: bool = False) -> Iterator[Setting]:
    """The decoder's arithmetic in float32 and in float64, for few and for all steps."""
    most = views.rig.sequence.steps
    for steps in (most,) if quick else (3, most):
        for dtype in ("float32", "float64"):
            make = partial(DecodeInType, views.rig, "vertical", steps, dtype)
            yield Setting(f"precision-{steps:02d}-{dtype}", "precision", f"NumPy {dtype}, N={steps}", make, views)


def size_settings(rig: Rig, threads: int, quick: bool = False) -> Iterator[Setting]:
    """Small scenes photographed by ``rig`` at each image size, by all steps, by few, and from one fringe."""
    most = rig.sequence.steps
    for size in QUICK_SIZES if quick else SIZES:
        scaled = rig.scaled(size)
        try:
            scaled.check_sampling()
        except FppBenchError:
            continue  # coarser than the fringes allow: no dataset of this rig has such a size
        views = PhotographedViews(scaled, [name for name in SIZE_OBJECTS if name in TEST_OBJECTS])
        for way, steps in (("both", most), ("vertical", 3)):
            make = partial(ClassicalMethod, scaled, way, steps, threads)  # type: ignore[arg-type]
            yield Setting(f"size-{size:04d}-{way}-{steps}", "sizes", f"classical N={steps}, {way}", make, views)
        phase = _phase(scaled, {"direction": "horizontal"})
        yield Setting(f"size-{size:04d}-phase", "sizes", "phase horizontal", phase, views)
