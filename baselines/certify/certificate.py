"""A simulated type test: the generator photographs gauges before a rig, a method measures them, and
a certificate says what came of it.

The truth is that of the generator: nothing here is traceable to a standard of length, and nothing
conforms to a guideline by it.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import fmean, median, stdev
from time import perf_counter
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench import __version__
from fpp_ml_bench.baselines.certify.gauges import (
    DIAMETER,
    LENGTH,
    SPACING,
    STEP,
    WEDGE_DEG,
    Gauge,
    TracedGauge,
    Volume,
    gauges,
)
from fpp_ml_bench.baselines.certify.quantities import (
    CROP_PX,
    QUANTITIES,
    REJECTED,
    Measured,
    measure,
)
from fpp_ml_bench.baselines.method import Method, checked
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.render.light import Light, load_light
from fpp_ml_bench.loaders.render.raycast import PixelRays
from fpp_ml_bench.loaders.render.scene import BuildSettings, light_of_volume, volume_scale
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.machine import Hardware, describe_hardware
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.style import ERROR_COLOURS, Picture, data_uri, gallery, page

COVERAGE = 2.0
"""k of the expanded uncertainty: 95% of a normal distribution."""
CAPTURES = 20
"""Of one gauge of each kind in its first position: the repeatability is their standard deviation."""
THUMBNAIL_PX = 240
PAGE, JSON = "certificate.html", "certificate.json"
Verdict = Literal["within", "beyond", "undecided", ""]


def scenes_of(rig: Rig, light: str | Path) -> BuildSettings:
    """The scenes of a type test: ``light`` by name or file on gauges that are matte and of one
    colour, in the volume of ``rig``."""
    scale = volume_scale(rig)
    chosen: Light = light_of_volume(load_light(light), rig, scale)
    plain = chosen.changed("surface", gloss=0.0, textures="none", contrast=0.0)
    return BuildSettings(rig, ("mug",), light=plain, object_scale=scale)


@dataclass(frozen=True)
class Line:
    """A quantity of a certificate, in ``unit``: its ``largest`` value (by amount) over the
    ``positions`` that have one, the others being ``missing``, their ``mean`` and standard deviation
    ``spread``; ``repeatability``, a standard deviation, and ``expanded``, the uncertainty at k =
    `COVERAGE` of one capture; the mean share of asked pixels that were ``refused``; the ``limit``
    that was given, and the ``verdict`` by ISO 14253-1: within or beyond only where the uncertainty
    leaves no doubt."""

    symbol: str
    name: str
    meaning: str
    unit: str
    positions: int
    missing: int
    largest: float | None
    mean: float | None
    spread: float | None
    repeatability: float | None
    expanded: float | None
    refused: float
    limit: float | None = None
    verdict: Verdict = ""


@dataclass(frozen=True)
class Certificate:
    """What a type test found. ``volume_mm``: near and far end, and diagonal; ``sizes_mm`` of the
    gauges by name; ``seconds``: of one capture, the median."""

    method: str
    settings: Mapping[str, Any]
    frames: int
    seconds: float
    rig: Mapping[str, Any]
    light: str
    calibration_px: float
    volume_mm: tuple[float, float, float]
    sizes_mm: Mapping[str, float]
    captures: int
    lines: tuple[Line, ...]
    created: str
    hardware: Hardware
    package: str = __version__
    pictures: Mapping[str, Sequence[Picture]] = field(default_factory=dict, compare=False)

    def content(self) -> dict[str, Any]:
        """Plain data, without the pictures."""
        plain = asdict(self)
        del plain["pictures"]
        return plain


@dataclass(frozen=True)
class _Seen:
    """A gauge before the camera: which of its surfaces a pixel sees, and the true depth there."""

    gauge: Gauge
    part: NDArray[np.int8]
    exact_mm: NDArray[np.float64]
    frames: Callable[[int], list[NDArray[np.uint8] | None]]


def certify(
    method: Method,
    settings: BuildSettings,
    light: str,
    captures: int = CAPTURES,
    limits: Mapping[str, float] | None = None,
    progress: Callable[[int], None] = lambda gauges: None,
) -> Certificate:
    """Test ``method`` in the scenes of ``settings`` (`scenes_of`). ``limits``: largest permitted
    errors by symbol; ``progress`` is called after every gauge. Raises `PredictionError` for a method
    whose answers are no millimetres and for a limit of an unknown quantity, `BuildError` for a rig
    in whose volume the gauges don't fit."""
    if method.units != "mm":
        raise PredictionError(
            f"{method.title}: predicts normalised depth; gauges are measured in mm"
        )
    for symbol in limits or {}:
        if symbol not in QUANTITIES:
            raise PredictionError(f"limit of {symbol}: expected one of {', '.join(QUANTITIES)}")
    studio, rig = Studio(settings), settings.rig
    unit_mm, volume = MM_PER_M * settings.object_scale, Volume.of(settings.unit_rig)
    found: list[tuple[Gauge, Measured]] = []
    repeats: dict[str, list[float]] = {}
    pictures: dict[str, Sequence[Picture]] = {}
    seconds: list[float] = []

    def answered(seen: _Seen, capture: int) -> Measured:
        frames = seen.frames(capture)
        started = perf_counter()
        answer = method.answer(frames)
        seconds.append(perf_counter() - started)
        checked(answer, seen.part.shape, method.title)
        return measure(
            seen.gauge, seen.part, seen.exact_mm, answer.depth, rig.camera.rays(), unit_mm
        )

    for gauge in gauges(settings.unit_rig):
        seen = _seen(studio, gauge, method.frames_used)
        result = answered(seen, 0)
        found.append((gauge, result))
        if gauge.position == 0:
            pictures[gauge.kind] = _pictures(seen, result, method.frames_used[0])
            several = [result, *(answered(seen, number) for number in range(1, captures))]
            for symbol in result.values:
                values = [one.values[symbol] for one in several]
                repeats[symbol] = [value for value in values if value is not None]
        progress(1)
    lines = [_line(symbol, found, repeats.get(symbol, []), limits or {}) for symbol in QUANTITIES]
    sizes = {"sphere diameter": DIAMETER, "sphere spacing": SPACING, "plane": LENGTH, "step": STEP}
    return Certificate(
        method.title,
        dict(method.settings),
        len(method.frames_used),
        median(seconds),
        rig.to_dict(),
        light,
        settings.light.calibration_px,
        (*rig.working_range_mm, volume.diagonal_m * unit_mm),
        {name: share * volume.diagonal_m * unit_mm for name, share in sizes.items()},
        captures,
        tuple(lines),
        datetime.now(UTC).isoformat(timespec="seconds"),
        describe_hardware(),
        pictures=pictures,
    )


def _seen(studio: Studio, gauge: Gauge, used: Sequence[int]) -> _Seen:
    rig, traced = studio.rig, TracedGauge(gauge)
    hits = traced.primary(PixelRays.of(rig.camera))
    shape = (rig.camera.height, rig.camera.width)
    part, exact_mm = np.full(shape, -1, np.int8), np.zeros(shape)
    part.ravel()[hits.pixels] = gauge.part[hits.triangle]
    exact_mm.ravel()[hits.pixels] = hits.depth_m * MM_PER_M * studio.settings.object_scale
    distance_m = float(gauge.mesh.vertices_m[:, 2].mean())

    def frames(capture: int) -> list[NDArray[np.uint8] | None]:
        stream = (studio.settings.seed, gauge.mesh.name, capture)
        scene = studio.lit(gauge.mesh, traced, hits, distance_m, 0.0, np.zeros(3), stream)
        studio.expose(scene, tuple(used))
        taken: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
        for index in used:
            taken[index] = studio.frame(index).copy()
        return taken

    return _Seen(gauge, part, exact_mm, frames)


def _pictures(seen: _Seen, result: Measured, frame: int) -> Sequence[Picture]:
    """The frame and what the answer is off by along the axis, around the gauge; `THUMBNAIL_PX`
    square."""
    rows, columns = (np.flatnonzero((seen.part >= 0).any(axis=axis)) for axis in (1, 0))
    side = max(np.ptp(rows), np.ptp(columns)) // 2 + 1
    row, column = (rows[0] + rows[-1]) // 2, (columns[0] + columns[-1]) // 2
    image = seen.frames(0)[frame]
    off = np.abs(result.residual_mm[np.isfinite(result.residual_mm)])
    most = max(float(np.quantile(off, 0.98)) if off.size else 0.0, 1e-6)

    def square(maps: NDArray[Any]) -> NDArray[Any]:
        padded = np.pad(maps.astype(np.float32), side, constant_values=np.nan)
        cut = padded[row : row + 2 * side, column : column + 2 * side]
        return cv2.resize(cut, (THUMBNAIL_PX,) * 2, interpolation=cv2.INTER_NEAREST)

    assert image is not None
    return [
        Picture(square(image), high=GREY_LEVELS),
        Picture(square(result.residual_mm), ERROR_COLOURS, -most, most),
    ]


def _line(
    symbol: str,
    found: Sequence[tuple[Gauge, Measured]],
    repeats: Sequence[float],
    limits: Mapping[str, float],
) -> Line:
    quantity = QUANTITIES[symbol]
    of_symbol = [result for _, result in found if symbol in result.values]
    values = [v for result in of_symbol if (v := result.values[symbol]) is not None]
    deviation = stdev(repeats) if len(repeats) > 1 else None
    expanded = None if deviation is None else COVERAGE * deviation
    largest = max(values, key=abs) if values else None
    missing, limit = len(of_symbol) - len(values), limits.get(symbol)
    return Line(
        symbol,
        quantity.name,
        quantity.meaning,
        quantity.unit,
        len(values),
        missing,
        largest,
        fmean(values) if values else None,
        stdev(values) if len(values) > 1 else None,
        deviation,
        expanded,
        fmean(result.refused for result in of_symbol),
        limit,
        _verdict(largest, expanded, limit, missing),
    )


def _verdict(
    largest: float | None, expanded: float | None, limit: float | None, missing: int
) -> Verdict:
    if limit is None:
        return ""
    if largest is None or expanded is None or missing:
        return "undecided"
    if abs(largest) + expanded <= limit:
        return "within"
    return "beyond" if abs(largest) - expanded > limit else "undecided"


def write_certificate(certificate: Certificate, out: Path) -> tuple[Path, Path]:
    """The certificate as a page and as JSON in the folder ``out``; their paths."""
    out.mkdir(parents=True, exist_ok=True)
    kinds = {
        f"{kind}\n+-{picture[1].high:.2g} mm": picture
        for kind, picture in certificate.pictures.items()
    }
    html = page(
        "fpp_ml_bench.baselines.certify",
        "certificate.html",
        "Simulated type test",
        "td.words, th[scope=row], th[scope=col]:first-child { text-align: left }",
        test=certificate,
        rig=json.dumps(dict(certificate.rig)),
        coverage=COVERAGE,
        crop=CROP_PX,
        rejected=REJECTED,
        wedge=WEDGE_DEG,
        pictures=data_uri(gallery(kinds, ("frame", "error along the axis"), 2.4)),
    )
    content = json.dumps(certificate.content(), indent=1, allow_nan=False) + "\n"
    write_atomically(out / PAGE, html)
    write_atomically(out / JSON, content.encode("utf-8"))
    return out / PAGE, out / JSON
