"""Acceptance quantities from the points of a gauge: least-squares fits, and what they are off by.

Points are those of pixels whose centre is `CROP_PX` and more from the border of the part, as an
operator crops them, and that have an answer. Of each fit the `REJECTED` share of the points that lie
furthest off is left out, and the fit made again; all others count, whatever they are off by.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from fpp_ml_bench.baselines.certify.gauges import Gauge, Surface
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX

Points = NDArray[np.float64]
CROP_PX = EDGE_BAND_PX
"""Pixels beside the border of a part mix surfaces: they are cropped."""
REJECTED = 0.003
"""Share of the points that a fit may leave out: 3 in 1000, as VDI/VDE 2634 part 2 is said to."""
INNER_SHARE = 0.95
"""Of the points whose shell a dispersion is, after ISO 10360-13."""
MOST_RADII = 10.0
"""Of a true radius, that a fitted sphere may have: points that fit a larger one lie on no sphere,
and a plane fits as well."""
FEWEST_POINTS = 100
"""Points of a part below which nothing is fitted."""
RISE = 0.1, 0.9
"""Of a step's height, between which its edge response is measured."""
EDGE_REACH_PX = 12.0
"""Distance from the edge on either side whose pixels are its response."""


@dataclass(frozen=True)
class Quantity:
    """An acceptance quantity: ``symbol``, ``name``, what it is, and its ``unit``."""

    symbol: str
    name: str
    meaning: str
    unit: str = "mm"


QUANTITIES: dict[str, Quantity] = {
    quantity.symbol: quantity
    for quantity in (
        Quantity("PF", "probing, form", "range of the residuals of a fitted sphere"),
        Quantity("PF95", "probing, dispersion", "width of the shell of 95% of a sphere's points"),
        Quantity("PS", "probing, size", "diameter of the fitted sphere less the true one"),
        Quantity("SD", "sphere spacing", "distance of two fitted centres less the true one"),
        Quantity("F", "flatness", "range of the residuals of a fitted plane"),
        Quantity("F95", "flatness, 95%", "width of the layer of 95% of a plane's points"),
        Quantity("H", "step", "fitted height less the true one"),
        Quantity("W", "wedge", "fitted angle less the true one", "degrees"),
        Quantity(
            "L",
            "lengths",
            "distance of two corners of a board less the true one, of pairs half its diagonal apart and more",
        ),
        Quantity("E", "edge response", "distance from 10 to 90% of a step's height", "px"),
    )
}
"""By symbol. Form after VDI/VDE 2634 part 2, whose text was not read: a range over all but
`REJECTED` of the points."""
SYMBOLS = {
    "sphere": ("PF", "PF95", "PS"),
    "ball bar": ("SD",),
    "plane": ("F", "F95"),
    "step": ("H", "E"),
    "wedge": ("W",),
}
"""What is measured of each kind of gauge."""


@dataclass(frozen=True)
class Fit:
    """``values``: centre and radius of a sphere (4,), or the point and normal of a plane (6,), in
    mm; ``residual_mm`` (n,) of the points that were not rejected."""

    values: NDArray[np.float64]
    residual_mm: NDArray[np.float64]

    @property
    def range_mm(self) -> float:
        return float(np.ptp(self.residual_mm))

    @property
    def inner_mm(self) -> float:
        """Width of the shell of `INNER_SHARE` of the points."""
        off = np.abs(self.residual_mm - np.median(self.residual_mm))
        return 2 * float(np.quantile(off, INNER_SHARE))


def fit_plane(points_mm: Points) -> Fit:
    """The plane (point, normal with z < 0) of the points (n, 3) by total least squares."""
    for _ in range(2):
        middle = points_mm.mean(axis=0)
        normal = np.linalg.svd(points_mm - middle, full_matrices=False)[2][2]
        normal = -normal if normal[2] > 0 else normal
        residual = (points_mm - middle) @ normal
        fit = Fit(np.concatenate([middle, normal]), residual)
        points_mm = points_mm[_kept(residual)]
    return fit


def fit_sphere(points_mm: Points) -> Fit:
    """The sphere (centre, radius) of the points (n, 3) by least squares of the distances."""
    for _ in range(2):
        # Linear in |p|^2 = 2 c.p + r^2 - |c|^2, as a start.
        middle = points_mm.mean(axis=0)
        near = points_mm - middle
        terms = np.column_stack([2 * near, np.ones(len(near))])
        start = np.linalg.lstsq(terms, (near * near).sum(axis=1), rcond=None)[0]
        start[3] = np.sqrt(max(start[3] + start[:3] @ start[:3], 1e-12))

        def distances(values: NDArray[np.float64], near: Points = near) -> NDArray[np.float64]:
            return np.asarray(np.linalg.norm(near - values[:3], axis=1) - values[3])

        def slopes(values: NDArray[np.float64], near: Points = near) -> NDArray[np.float64]:
            away = near - values[:3]
            away = away / np.linalg.norm(away, axis=1, keepdims=True)
            return np.column_stack([-away, -np.ones(len(near))])

        solved = least_squares(distances, start, slopes, x_scale="jac", xtol=1e-15, ftol=1e-15)
        fit = Fit(solved.x + np.array([*middle, 0.0]), distances(solved.x))
        points_mm = points_mm[_kept(fit.residual_mm)]
    return fit


def _kept(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """All but the share `REJECTED` of the points, those furthest off."""
    off = np.abs(residual - np.median(residual))
    return np.asarray(off <= np.sort(off)[len(off) - 1 - int(REJECTED * len(off))])


def corners_mm(
    corners_px: NDArray[np.float64], points_mm: NDArray[np.float64], radius_px: float
) -> NDArray[np.float64]:
    """Points (n, 3) in mm at image points (n, 2) of a plane, float64, by the plane of the points
    (H, W, 3) within a radius; NaN with fewer than half of them."""
    points = np.full((len(corners_px), 3), np.nan)
    row, column = np.mgrid[: points_mm.shape[0], : points_mm.shape[1]]
    for number, (x, y) in enumerate(corners_px):
        if not np.isfinite([x, y]).all():
            continue
        reach = int(np.ceil(radius_px))
        window = (
            slice(max(int(y) - reach, 0), int(y) + reach + 2),
            slice(max(int(x) - reach, 0), int(x) + reach + 2),
        )
        near = np.hypot(column[window] - x, row[window] - y) <= radius_px
        own, known = points_mm[window], np.isfinite(points_mm[window]).all(axis=-1) & near
        if known.sum() < max(near.sum() / 2, 6):
            continue
        # Of a plane 1 / z is linear in the image, and so are x / z and y / z.
        terms = np.column_stack(
            [np.ones(known.sum()), column[window][known] - x, row[window][known] - y]
        )
        values = np.column_stack([1 / own[known][:, 2], own[known][:, :2] / own[known][:, 2:]])
        inverse, across, down = np.linalg.lstsq(terms, values, rcond=None)[0][0]
        points[number] = across / inverse, down / inverse, 1 / inverse
    return points


def lengths_off_mm(
    found_mm: NDArray[np.float64], true_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """By how much distances between points (n, 3) differ from the true ones, of all pairs that are
    half the largest true distance apart and more; NaN without one."""
    first, second = np.triu_indices(len(true_mm), 1)
    true = np.linalg.norm(true_mm[second] - true_mm[first], axis=1)
    off = np.linalg.norm(found_mm[second] - found_mm[first], axis=1) - true
    return np.asarray(off[(true >= true.max() / 2) & np.isfinite(off)])


@dataclass(frozen=True)
class Measured:
    """Of a gauge: ``values`` by symbol, None where too few points have an answer; ``asked`` pixels
    and the share ``refused`` of them; ``residual_mm`` float32 (H, W) along the camera's axis, NaN
    elsewhere, for a picture."""

    values: Mapping[str, float | None]
    asked: int
    refused: float
    residual_mm: NDArray[np.float32]


def measure(
    gauge: Gauge,
    part: NDArray[np.int8],
    exact_mm: NDArray[np.float64],
    depth_mm: NDArray[np.floating],
    rays: tuple[NDArray[np.float64], NDArray[np.float64]],
    unit_mm: float = MM_PER_M,
) -> Measured:
    """What a method's depth (H, W), 0 without an answer, makes of ``gauge``, whose numbers are in
    units of ``unit_mm``. ``part`` (H, W): which of its surfaces a pixel sees, -1 for none;
    ``exact_mm``: the true depth there; ``rays``: x and y of every pixel's ray."""
    answered = (depth_mm > 0) & np.isfinite(depth_mm)
    inner = [_cropped(part == number) for number in range(len(gauge.surfaces))]
    asked = np.logical_or.reduce(inner)
    z = np.where(answered, depth_mm, np.nan).astype(np.float64)
    points = np.stack([rays[0] * z, rays[1] * z, z], axis=-1)
    of_parts = [points[where & answered] for where in inner]
    residual = np.where(asked & answered, depth_mm - exact_mm, np.nan).astype(np.float32)
    enough = all(len(part) >= FEWEST_POINTS for part in of_parts)
    values: dict[str, float | None] = dict.fromkeys(SYMBOLS[gauge.kind])
    if enough:
        values |= _values(gauge, of_parts, unit_mm)
        if gauge.kind == "step":
            values["E"] = edge_px(part, depth_mm, of_parts)
    count = int(asked.sum())
    refused = float(1 - (asked & answered).sum() / count) if count else 1.0
    return Measured(values, count, refused, residual)


def _values(gauge: Gauge, points: Sequence[Points], unit_mm: float) -> dict[str, float]:
    """By symbol; none where the points of a sphere lie on no sphere."""
    surfaces = gauge.surfaces
    if surfaces[0].radius_m is not None:
        fits = [fit_sphere(part) for part in points]
        true_mm = unit_mm * surfaces[0].radius_m
        if any(fit.values[3] > MOST_RADII * true_mm for fit in fits):
            return {}
        if gauge.kind == "ball bar":
            apart = np.linalg.norm(fits[1].values[:3] - fits[0].values[:3])
            spacing = unit_mm * np.linalg.norm(surfaces[1].point_m - surfaces[0].point_m)
            return {"SD": float(apart - spacing)}
        size = 2 * (fits[0].values[3] - true_mm)
        return {"PF": fits[0].range_mm, "PF95": fits[0].inner_mm, "PS": float(size)}
    fits = [fit_plane(part) for part in points]
    if gauge.kind == "plane":
        return {"F": fits[0].range_mm, "F95": fits[0].inner_mm}
    if gauge.kind == "wedge":
        # Its faces enclose what is left of 180 degrees between their normals.
        between = _angle_deg(*(fit.values[3:] for fit in fits))
        return {"W": _angle_deg(*_normals(surfaces)) - between}
    # The two planes have a common normal: that of their points, each less its mean.
    common = fit_plane(np.concatenate([part - part.mean(axis=0) for part in points])).values[3:]
    height = abs((points[1].mean(axis=0) - points[0].mean(axis=0)) @ common)
    normal = _normals(surfaces)[0]
    true = unit_mm * abs((surfaces[1].point_m - surfaces[0].point_m) @ normal)
    return {"H": float(height - true)}


def _normals(surfaces: Sequence[Surface]) -> list[NDArray[np.float64]]:
    return [surface.normal for surface in surfaces if surface.normal is not None]


def _angle_deg(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return float(np.rad2deg(np.arccos(np.clip(first @ second, -1, 1))))


def edge_px(
    part: NDArray[np.int8], depth_mm: NDArray[np.floating], points_mm: Sequence[Points]
) -> float | None:
    """Distance in px over which the depth crosses from `RISE` of a step's height to the other,
    across its edge; None where too few pixels there have an answer. The edge is the
    left border of the near part; the response is the median over its length."""
    rows, columns = np.nonzero((part[:, :-1] != 1) & (part[:, 1:] == 1))
    if len(rows) < FEWEST_POINTS:
        return None
    slope, start = np.polyfit(rows, columns + 0.5, 1)
    row, column = np.mgrid[: part.shape[0], : part.shape[1]]
    beside = (column - start - slope * row) / np.hypot(1, slope)
    inside = (row >= rows.min() + CROP_PX) & (row <= rows.max() - CROP_PX)
    near = inside & (np.abs(beside) <= EDGE_REACH_PX) & (depth_mm > 0)
    far_mm, near_mm = (float(np.median(plane[:, 2])) for plane in points_mm)
    if not far_mm > near_mm:
        return None
    share = (far_mm - depth_mm[near]) / (far_mm - near_mm)
    place, steps = beside[near], np.arange(-EDGE_REACH_PX, EDGE_REACH_PX + 0.25, 0.25)
    if len(place) < FEWEST_POINTS:
        return None
    response = np.array(
        [
            np.median(share[np.abs(place - at) <= 0.5])
            if (np.abs(place - at) <= 0.5).any()
            else np.nan
            for at in steps
        ]
    )
    known = np.isfinite(response)
    rising = np.maximum.accumulate(response[known])
    if rising[0] > RISE[0] or rising[-1] < RISE[1]:
        return None
    # Where the response does not rise, the last of equal values counts.
    rising += 1e-9 * np.arange(len(rising))
    low, high = np.interp(RISE, rising, steps[known])
    return float(high - low)


def _cropped(where: NDArray[np.bool_]) -> NDArray[np.bool_]:
    kernel = np.ones((2 * CROP_PX + 1,) * 2, np.uint8)
    # Beyond the image there is nothing of the part.
    border = cv2.copyMakeBorder(where.astype(np.uint8), *(CROP_PX,) * 4, cv2.BORDER_CONSTANT)
    return cv2.erode(border, kernel)[CROP_PX:-CROP_PX, CROP_PX:-CROP_PX] > 0
