"""A type test: the generator photographs gauges before a rig, or a user a board, a method measures
them, and a certificate says what came of it.

Nothing here is traceable to a standard of length, and nothing conforms to a guideline by it.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
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
    FEWEST_POINTS,
    QUANTITIES,
    REJECTED,
    Measured,
    corners_mm,
    fit_plane,
    lengths_off_mm,
    measure,
)
from fpp_ml_bench.baselines.method import Method, checked
from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.projector_points import nearest_px
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.errors import CaptureError, DecodeError, PredictionError
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.captures.images import read_frames
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
CORNER_SHARE = 0.4
"""Radius around a corner whose points tell where it is, in distances to the next corner."""
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
    """What a type test found. ``truth``: of the gauges, in words; ``simulated``: whether they are
    the generator's. ``volume_mm``: near and far end, and diagonal; ``sizes_mm`` of the gauges by
    name; ``seconds``: of one capture, the median."""

    truth: str
    simulated: bool
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
class Seen:
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
    _check(method, limits or {})
    studio, rig = Studio(settings), settings.rig
    unit_mm, volume = MM_PER_M * settings.object_scale, Volume.of(settings.unit_rig)
    results: list[Measured] = []
    repeats: dict[str, list[float]] = {}
    pictures: dict[str, Sequence[Picture]] = {}
    seconds: list[float] = []

    used = method.frames_used or (0,)

    def answered(seen: Seen, capture: int) -> Measured:
        frames = seen.frames(capture)
        started = perf_counter()
        answer = method.answer(frames)
        seconds.append(perf_counter() - started)
        checked(answer, seen.part.shape, method.title)
        return measure(
            seen.gauge, seen.part, seen.exact_mm, answer.depth, rig.camera.rays(), unit_mm
        )

    for gauge in gauges(settings.unit_rig):
        seen = before_camera(studio, gauge, used)
        result = answered(seen, 0)
        results.append(result)
        if gauge.position == 0:
            image = seen.frames(0)[used[0]]
            pictures[gauge.kind] = _pictures(seen.part >= 0, image, result.residual_mm)
            several = [result, *(answered(seen, number) for number in range(1, captures))]
            for symbol in result.values:
                values = [each.values[symbol] for each in several]
                repeats[symbol] = [value for value in values if value is not None]
        progress(1)
    sizes = {"sphere diameter": DIAMETER, "sphere spacing": SPACING, "plane": LENGTH, "step": STEP}
    return Certificate(
        "simulated: the gauges, their light and their true sizes are the generator's",
        True,
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
        _lines(results, repeats, limits or {}),
        datetime.now(UTC).isoformat(timespec="seconds"),
        describe_hardware(),
        pictures=pictures,
    )


def _check(method: Method, limits: Mapping[str, float]) -> None:
    if method.units != "mm":
        raise PredictionError(
            f"{method.title}: predicts normalised depth; gauges are measured in mm"
        )
    if method.uses_ground_truth_mask:
        raise PredictionError(f"{method.title}: is given the object's mask; a gauge gives none")
    for symbol in limits:
        if symbol not in QUANTITIES:
            raise PredictionError(f"limit of {symbol}: expected one of {', '.join(QUANTITIES)}")


def certify_board(
    method: Method,
    rig: Rig,
    folders: Sequence[Path],
    board: Board,
    colour: str | None = None,
    limits: Mapping[str, float] | None = None,
    progress: Callable[[int], None] = lambda poses: None,
) -> Certificate:
    """Test ``method`` on captures of a real ``board`` in the poses ``folders``, each with all frames
    of the rig's sequence: flatness of the board, and distances of its corners. Raises
    `CaptureError` and `CalibrationError` naming the pose whose frames can't be read or show no
    board."""
    _check(method, limits or {})
    results: list[Measured] = []
    pictures: dict[str, Sequence[Picture]] = {}
    seconds: list[float] = []
    x, y = rig.camera.rays()
    for folder in folders:
        capture = read_frames(folder, count=len(rig.sequence), colour=colour)
        grey = np.clip(np.rint(capture.frames), 0, GREY_LEVELS).astype(np.uint8)
        if grey.shape[1:] != x.shape:
            raise CaptureError(
                f"{folder}: frames of {grey.shape[2]} x {grey.shape[1]} px, and the rig has a camera "
                f"of {rig.camera.width} x {rig.camera.height} px; give the rig that took them"
            )
        started = perf_counter()
        try:
            depth = method.answer(list(grey)).depth.astype(np.float64)
        except DecodeError as error:
            raise PredictionError(f"{folder}: {error}") from error
        seconds.append(perf_counter() - started)
        lit = rig.sequence.white
        image = grey[lit] if lit is not None else np.rint(grey.mean(axis=0)).astype(np.uint8)
        corners_px = board.find(image, f"pose {folder.name}")
        hull = np.zeros(x.shape, np.uint8)
        outline = cv2.convexHull(corners_px[np.isfinite(corners_px).all(axis=1)].astype(np.float32))
        cv2.fillConvexPoly(hull, np.rint(outline).astype(np.int32), 1)
        asked, answered = hull > 0, (depth > 0) & np.isfinite(depth)
        z = np.where(asked & answered, depth, np.nan)
        points = np.stack([x * z, y * z, z], axis=-1)
        of_board = points[asked & answered]
        values: dict[str, float | None] = dict.fromkeys(("F", "F95", "L"))
        residual = np.full(x.shape, np.nan, np.float32)
        if len(of_board) >= FEWEST_POINTS:
            fit = fit_plane(of_board)
            values |= {"F": fit.range_mm, "F95": fit.inner_mm}
            residual = ((points - fit.values[:3]) @ fit.values[3:]).astype(np.float32)
            radius_px = CORNER_SHARE * float(np.median(nearest_px(corners_px)))
            off = lengths_off_mm(corners_mm(corners_px, points, radius_px), board.points_mm())
            if off.size:
                values["L"] = float(off[np.abs(off).argmax()])
        refused = float(1 - (asked & answered).sum() / asked.sum())
        results.append(Measured(values, int(asked.sum()), refused, residual))
        if not pictures:
            pictures[folder.name] = _pictures(asked, image, residual)
        progress(1)
    near, far = rig.working_range_mm
    return Certificate(
        f"a board, {board}, whose corners are taken to be where it says, and which is taken to be flat",
        False,
        method.title,
        dict(method.settings),
        len(method.frames_used),
        median(seconds),
        rig.to_dict(),
        "as captured",
        rig.calibration_px,
        (near, far, Volume.of(rig).diagonal_m * MM_PER_M),
        {"board": float(np.ptp(board.points_mm(), axis=0).max()), "spacing": board.spacing_mm},
        1,
        _lines(results, {}, limits or {}),
        datetime.now(UTC).isoformat(timespec="seconds"),
        describe_hardware(),
        pictures=pictures,
    )


def before_camera(studio: Studio, gauge: Gauge, used: Sequence[int]) -> Seen:
    rig, traced = studio.rig, TracedGauge(gauge)
    hits = traced.primary(PixelRays.of(rig.camera))
    shape = (rig.camera.height, rig.camera.width)
    part, exact_mm = np.full(shape, -1, np.int8), np.zeros(shape)
    part.ravel()[hits.pixels] = gauge.part[hits.triangle]
    exact_mm.ravel()[hits.pixels] = hits.depth_m * MM_PER_M * studio.settings.object_scale
    distance_m = float(gauge.mesh.vertices_m[:, 2].mean())
    seed, name = studio.settings.seed, gauge.mesh.name
    scene = studio.lit(gauge.mesh, traced, hits, distance_m, 0.0, np.zeros(3), (seed, name, 0))

    def frames(capture: int) -> list[NDArray[np.uint8] | None]:
        # Captures differ in their exposure and noise, not in their light.
        stream = (seed, name, capture)
        again = replace(scene, stream=stream, brightness=studio.brightness(stream))
        studio.expose(again, tuple(used))
        taken: list[NDArray[np.uint8] | None] = [None] * len(rig.sequence)
        for index in used:
            taken[index] = studio.frame(index).copy()
        return taken

    return Seen(gauge, part, exact_mm, frames)


def _pictures(
    where: NDArray[np.bool_], image: NDArray[Any] | None, residual_mm: NDArray[np.float32]
) -> Sequence[Picture]:
    """The frame and what the answer is off by, around the pixels ``where``; `THUMBNAIL_PX`
    square."""
    rows, columns = (np.flatnonzero(where.any(axis=axis)) for axis in (1, 0))
    side = max(np.ptp(rows), np.ptp(columns)) // 2 + 1
    row, column = (rows[0] + rows[-1]) // 2, (columns[0] + columns[-1]) // 2
    off = np.abs(residual_mm[np.isfinite(residual_mm)])
    most = max(float(np.quantile(off, 0.98)) if off.size else 0.0, 1e-6)

    def square(maps: NDArray[Any]) -> NDArray[Any]:
        padded = np.pad(maps.astype(np.float32), side, constant_values=np.nan)
        cut = padded[row : row + 2 * side, column : column + 2 * side]
        return cv2.resize(cut, (THUMBNAIL_PX,) * 2, interpolation=cv2.INTER_NEAREST)

    shown = np.zeros_like(residual_mm) if image is None else image
    return [
        Picture(square(shown), high=GREY_LEVELS),
        Picture(square(residual_mm), ERROR_COLOURS, -most, most),
    ]


def _lines(
    results: Sequence[Measured], repeats: Mapping[str, Sequence[float]], limits: Mapping[str, float]
) -> tuple[Line, ...]:
    symbols = [
        symbol for symbol in QUANTITIES if any(symbol in result.values for result in results)
    ]
    return tuple(_line(symbol, results, repeats.get(symbol, ()), limits) for symbol in symbols)


def _line(
    symbol: str, results: Sequence[Measured], repeats: Sequence[float], limits: Mapping[str, float]
) -> Line:
    quantity = QUANTITIES[symbol]
    of_symbol = [result for result in results if symbol in result.values]
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
        f"{kind}\n\N{PLUS-MINUS SIGN}{picture[1].high:.2g} mm": picture
        for kind, picture in certificate.pictures.items()
    }
    html = page(
        "fpp_ml_bench.baselines.certify",
        "certificate.html",
        "Simulated type test" if certificate.simulated else "Test on a board",
        "h2 { margin-top: 1.5rem } "
        "td.words, th[scope=row], th[scope=col]:first-child { text-align: left }",
        test=certificate,
        rig=json.dumps(dict(certificate.rig)),
        coverage=COVERAGE,
        crop=CROP_PX,
        rejected=REJECTED,
        wedge=WEDGE_DEG,
        pictures=data_uri(gallery(kinds, ("frame", "error"), 2.4)),
    )
    content = json.dumps(certificate.content(), indent=1, allow_nan=False) + "\n"
    write_atomically(out / PAGE, html)
    write_atomically(out / JSON, content.encode("utf-8"))
    return out / PAGE, out / JSON
