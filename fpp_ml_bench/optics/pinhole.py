"""Pinhole model with lens distortion: the camera, or a projector as an inverse camera.

Pixel centres lie at integer coordinates, so that an image W px wide spans -0.5 to W - 0.5, and the lens is OpenCV's
model with the coefficients (k1, k2, p1, p2, k3), `distortion_polynomial`. It folds back beyond some radius; a point out
there has no image, and `distort` and `undistort` answer NaN for it.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.errors import RigError

Coefficients = tuple[float, float, float, float, float]
Maps = tuple[NDArray[np.float64], NDArray[np.float64]]

INVERSE_TOLERANCE = 1e-12
"""Largest accepted error of the inverse, distorted again, in normalised units: 2e-9 px at the paper's focal length."""
MAX_ITERATIONS = 50
START_TABLE = 4096
MAX_CONDITION = 2.0**26
"""Of the intrinsic matrix, with lengths in image sizes: inverting it then costs half of double precision's digits. The
paper's camera has 3; a focal length of 0.01 px or 10^10 px reaches the limit."""


def is_distorted(coefficients: Coefficients) -> bool:
    return any(c != 0.0 for c in coefficients)


def fold_radius_squared(coefficients: Coefficients) -> float:
    """r^2 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing, ``inf`` where it never does."""
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = [root.real for root in roots if abs(root.imag) <= 1e-9 * abs(root) and root.real > 0]
    # The root finder's last digits differ between processors; where the fold is counts to eleven.
    return float(f"{min(real, default=math.inf):.11g}")


def _radial(r2: NDArray, coefficients: Coefficients) -> NDArray:
    k1, k2, _, _, k3 = coefficients
    return 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))


def distortion_polynomial(x: NDArray, y: NDArray, coefficients: Coefficients) -> Maps:
    """The model without a look at its fold: arithmetic only, so that arrays of any library pass through."""
    _, _, p1, p2, _ = coefficients
    r2, cross = x * x + y * y, x * y
    radial = _radial(r2, coefficients)
    return (
        x * radial + 2.0 * p1 * cross + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * cross,
    )


def distort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Maps:
    """Distorted normalised coordinates of ideal ones (any equal shapes), float64; NaN beyond the fold of the model."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not is_distorted(coefficients):
        return x.copy(), y.copy()
    with np.errstate(invalid="ignore", over="ignore"):
        xd, yd = distortion_polynomial(x, y, coefficients)
        folded = ~(x * x + y * y < fold_radius_squared(coefficients))
    return np.where(folded, np.nan, xd), np.where(folded, np.nan, yd)


def _radial_start(xd: NDArray[np.float64], yd: NDArray[np.float64], coefficients: Coefficients) -> Maps:
    """Points whose radial distortion alone is that of (xd, yd), to a few digits; at the fold for those beyond it."""
    measured = np.sqrt(xd * xd + yd * yd)
    farthest = float(np.max(measured, initial=0.0, where=np.isfinite(measured)))
    fold, reach = math.sqrt(fold_radius_squared(coefficients)), farthest
    for _ in range(MAX_ITERATIONS):  # a radius that is distorted beyond all of the points, or the fold
        if reach >= fold or float(reach * _radial(np.array(reach * reach), coefficients)) >= farthest:
            break
        reach *= 2
    radius = np.linspace(0.0, min(reach, fold), START_TABLE)
    distorted = radius * _radial(radius * radius, coefficients)
    shrink = np.interp(measured, distorted, radius) / np.where(measured > 0, measured, 1.0)
    return xd * shrink, yd * shrink


def undistort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Maps:
    """Ideal normalised coordinates of distorted ones, float64; NaN where none within the fold reproduces the input to
    `INVERSE_TOLERANCE`. Newton's method from the inverse of the radial part, read off a table: from the distorted point
    itself it overshoots where the polynomial flattens out, and misses points that have an inverse."""
    xd, yd = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not is_distorted(coefficients):
        return xd.copy(), yd.copy()
    k1, k2, p1, p2, k3 = coefficients
    with np.errstate(all="ignore"):
        xi, yi = _radial_start(xd, yd, coefficients)
        for _ in range(MAX_ITERATIONS):
            fx, fy = distortion_polynomial(xi, yi, coefficients)
            ex, ey = fx - xd, fy - yd
            r2 = xi * xi + yi * yi
            radial = _radial(r2, coefficients)
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
            jxx = radial + slope * xi * xi + 2.0 * p1 * yi + 6.0 * p2 * xi
            jyy = radial + slope * yi * yi + 6.0 * p1 * yi + 2.0 * p2 * xi
            jxy = slope * xi * yi + 2.0 * p1 * xi + 2.0 * p2 * yi
            determinant = jxx * jyy - jxy * jxy
            dx, dy = (jyy * ex - jxy * ey) / determinant, (jxx * ey - jxy * ex) / determinant
            xi, yi = xi - dx, yi - dy
            if not np.any(np.maximum(np.abs(dx), np.abs(dy)) > 1e-15):
                break
        fx, fy = distort(xi, yi, coefficients)
        good = np.maximum(np.abs(fx - xd), np.abs(fy - yd)) <= INVERSE_TOLERANCE
    return np.where(good, xi, np.nan), np.where(good, yi, np.nan)


def require(met: object, message: str) -> None:
    """Raise `RigError` with ``message`` unless ``met``."""
    if not met:
        raise RigError(message)


def number(value: object, name: str, *, positive: bool = False) -> float:
    """``value`` as a finite float; raises `RigError` naming the key for anything else (text, booleans, NaN)."""
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise RigError(f"{name}: expected a number, got {value!r}")
    if not math.isfinite(value) or (positive and value <= 0):
        raise RigError(f"{name}: expected a {'positive ' if positive else ''}finite number, got {value!r}")
    return float(value)


def numbers(value: object, count: int, name: str) -> tuple[float, ...]:
    """``value`` as ``count`` finite floats; raises `RigError` naming the key and the entry."""
    if isinstance(value, str | bytes | dict) or not isinstance(value, Iterable):
        raise RigError(f"{name}: expected {count} numbers, got {value!r}")
    entries = list(value)
    require(len(entries) == count, f"{name}: expected {count} numbers, got {len(entries)}")
    return tuple(number(entry, f"{name}[{i}]") for i, entry in enumerate(entries))


@dataclass(frozen=True)
class Pinhole:
    """Size and intrinsics in px, distortion (k1, k2, p1, p2, k3). Raises `RigError` for sizes that are not positive
    integers, focal lengths that are not positive, non-finite values."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 1 <= value <= 65536:
                raise RigError(f"{name}: expected a whole number of pixels from 1 to 65536, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, number(getattr(self, name), name, positive=name in ("fx", "fy")))
        object.__setattr__(self, "distortion", numbers(self.distortion, 5, "distortion"))
        w, h = self.width, self.height
        matrix = np.array([[self.fx / w, 0, (self.cx + 0.5) / w], [0, self.fy / h, (self.cy + 0.5) / h], [0, 0, 1]])
        condition = float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.inf
        require(
            condition <= MAX_CONDITION,
            f"fx, fy, cx, cy: the intrinsic matrix {self.fx:g}, {self.fy:g}, {self.cx:g}, {self.cy:g} px of a {w} x "
            f"{h} px image is nearly singular: condition number {condition:.3g}, accepted up to {MAX_CONDITION:.3g}; "
            "give focal lengths and principal point in px",
        )

    @property
    def is_distorted(self) -> bool:
        return is_distorted(self.distortion)

    @property
    def focal(self) -> tuple[float, float]:
        return self.fx, self.fy

    @property
    def centre(self) -> tuple[float, float]:
        return self.cx, self.cy

    def to_dict(self) -> dict[str, Any]:
        return {**asdict(self), "distortion": list(self.distortion)}

    def scaled(self, width: int) -> "Pinhole":
        """The same view with ``width`` pixels across: c -> (c + 0.5) s - 0.5, since pixel areas scale, not centres."""
        s = width / self.width
        (fx, fy), (cx, cy) = (f * s for f in self.focal), ((c + 0.5) * s - 0.5 for c in self.centre)
        return replace(self, width=width, height=max(1, round(self.height * s)), fx=fx, fy=fy, cx=cx, cy=cy)

    def normalised(self, u: ArrayLike, v: ArrayLike) -> Maps:
        """Ideal normalised coordinates (x, y) of pixels (u, v), float64; NaN where the lens model has no inverse."""
        x = (np.asarray(u, dtype=np.float64) - self.cx) / self.fx
        y = (np.asarray(v, dtype=np.float64) - self.cy) / self.fy
        return undistort(x, y, self.distortion)

    def pixels(self, x: ArrayLike, y: ArrayLike) -> Maps:
        """Pixels (u, v) of ideal normalised coordinates, float64; NaN beyond the fold of the lens model."""
        xd, yd = distort(x, y, self.distortion)
        return xd * self.fx + self.cx, yd * self.fy + self.cy

    def rays(self) -> Maps:
        """Ideal normalised coordinates (x, y) of every pixel, NaN where the distortion can't be inverted: two float64
        (H, W) read-only maps; the ray is (x, y, 1). The two latest cameras' maps are kept."""
        return _rays(self)

    def project(self, points_m: ArrayLike) -> Maps:
        """Pixels (u, v) of points (..., 3) in this device's frame, metres; NaN for points at or behind the centre."""
        points = np.asarray(points_m, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        depth = np.where(z > 0, z, np.nan)
        return self.pixels(x / depth, y / depth)


@lru_cache(maxsize=2)
def _rays(pinhole: Pinhole) -> Maps:
    u, v = np.meshgrid(np.arange(pinhole.width, dtype=np.float64), np.arange(pinhole.height, dtype=np.float64))
    maps = pinhole.normalised(u, v)
    for axis in maps:
        axis.setflags(write=False)
    return maps
