"""Pinhole model with lens distortion: the camera, or a projector as an inverse camera.

Pixel centres lie at integer coordinates, so that an image W px wide spans -0.5 to W - 0.5, and the
lens is one of OpenCV's models (calib3d), by the number of its coefficients,
`distortion_polynomial`:

    5    k1, k2, p1, p2, k3    radial and tangential
    8    ..., k4, k5, k6       the radial factor is a ratio, with 1 + k4 r^2 + k5 r^4 + k6 r^6 below
    12   ..., s1, s2, s3, s4   thin prism
    14   ..., tau_x, tau_y     sensor tilted about its axes, in rad

The lens folds back beyond some radius; a point out there has no image, and `distort` and
`undistort` answer NaN for it.
"""

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.coding.code import number, numbers, require, whole

Coefficients = tuple[float, ...]
"""5, 8, 12 or 14 of them."""
Maps = tuple[NDArray[np.float64], NDArray[np.float64]]

INVERSE_TOLERANCE = 1e-12
"""Largest accepted error of the inverse, distorted again, in normalised units: 2e-9 px at the
paper's focal length."""
COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
"""With four, k3 is 0."""
MAX_ITERATIONS = 50
START_TABLE = 4096
MAX_CONDITION = 2.0**26
"""Of the intrinsic matrix, with lengths in image sizes: inverting it then costs half of double
precision's digits. The paper's camera has 3; a focal length of 0.01 px or 10^10 px reaches the
limit."""


def is_distorted(coefficients: Coefficients) -> bool:
    return any(c != 0.0 for c in coefficients)


def fold_radius_squared(coefficients: Coefficients) -> float:
    """r^2 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6), or its ratio to 1 + k4 r^2 + k5 r^4 + k6 r^6,
    stops growing or becomes infinite; ``inf`` where it never does."""
    k1, k2, _, _, k3 = coefficients[:5]
    if any(coefficients[5:8]):
        above, below = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([*coefficients[7:4:-1], 1.0])
        # The numerator of d/dr of r above / below, in r^2.
        slope = above * below + np.poly1d([2.0, 0.0]) * (
            above.deriv() * below - above * below.deriv()
        )
        roots = np.concatenate([_roots(slope.coeffs), _roots(below.coeffs)])
    else:
        roots = _roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = [root.real for root in roots if abs(root.imag) <= 1e-9 * abs(root) and root.real > 0]
    # The root finder's last digits differ between processors; where the fold is counts to eleven.
    return float(f"{min(real, default=math.inf):.11g}")


def _roots(polynomial: Iterable[float]) -> NDArray:
    """Its roots; a coefficient that is too small to divide by moves none of them to where a float
    reaches."""
    return np.roots([0.0 if abs(c) < 1e-100 else c for c in polynomial])


def _radial(r2: NDArray, coefficients: Coefficients) -> NDArray:
    k1, k2, _, _, k3 = coefficients[:5]
    above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return above / _below(r2, coefficients) if len(coefficients) > 5 else above


def _below(r2: NDArray, coefficients: Coefficients) -> NDArray:
    k4, k5, k6 = coefficients[5:8]
    return 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))


def _twice_radial_slope(r2: NDArray, radial: NDArray, coefficients: Coefficients) -> NDArray:
    """2 d radial / d r^2."""
    k1, k2, _, _, k3 = coefficients[:5]
    above = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))
    if len(coefficients) == 5:
        return above
    k4, k5, k6 = coefficients[5:8]
    return (above - 2.0 * radial * (k4 + r2 * (2.0 * k5 + 3.0 * k6 * r2))) / _below(
        r2, coefficients
    )


def _tilt(coefficients: Coefficients) -> NDArray[np.float64]:
    """(3, 3): projects what an upright sensor sees onto the tilted one, along the rays."""
    (cx, sx), (cy, sy) = ((math.cos(tau), math.sin(tau)) for tau in coefficients[12:])
    turn = np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])
    return (
        np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
        @ turn
    )


def _through(matrix: NDArray, x: NDArray, y: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Normalised coordinates through a projective map, and their divisor: not positive behind the
    sensor."""
    u, v, ahead = (float(row[0]) * x + float(row[1]) * y + float(row[2]) for row in matrix)
    return u / ahead, v / ahead, ahead


def distortion_polynomial(x: NDArray, y: NDArray, coefficients: Coefficients) -> Maps:
    """The model without a look at its fold: arithmetic only, so that arrays of any library pass
    through."""
    _, _, p1, p2, _ = coefficients[:5]
    r2, cross = x * x + y * y, x * y
    radial = _radial(r2, coefficients)
    xd = x * radial + 2.0 * p1 * cross + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * cross
    if len(coefficients) > 8:
        s1, s2, s3, s4 = coefficients[8:12]
        xd, yd = xd + r2 * (s1 + r2 * s2), yd + r2 * (s3 + r2 * s4)
    if len(coefficients) > 12:
        xd, yd, _ = _through(_tilt(coefficients), xd, yd)
    return xd, yd


def distort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Maps:
    """Distorted normalised coordinates of ideal ones (any equal shapes), float64; NaN beyond the
    fold of the model."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not is_distorted(coefficients):
        return x.copy(), y.copy()
    with np.errstate(invalid="ignore", over="ignore"):
        xd, yd = distortion_polynomial(x, y, coefficients)
        folded = ~(x * x + y * y < fold_radius_squared(coefficients))
        if len(coefficients) > 12:
            tilt = _tilt(coefficients)
            folded |= ~(_through(tilt, *distortion_polynomial(x, y, coefficients[:12]))[2] > 0)
    return np.where(folded, np.nan, xd), np.where(folded, np.nan, yd)


def _radial_start(
    xd: NDArray[np.float64], yd: NDArray[np.float64], coefficients: Coefficients
) -> Maps:
    """Points whose radial distortion alone is that of (xd, yd), to a few digits; at the fold for
    those beyond it."""
    measured = np.sqrt(xd * xd + yd * yd)
    farthest = float(np.max(measured, initial=0.0, where=np.isfinite(measured)))
    fold, reach = math.sqrt(fold_radius_squared(coefficients)), farthest
    for _ in range(
        MAX_ITERATIONS
    ):  # a radius that is distorted beyond all of the points, or the fold
        if (
            reach >= fold
            or float(reach * _radial(np.array(reach * reach), coefficients)) >= farthest
        ):
            break
        reach *= 2
    radius = np.linspace(0.0, min(reach, fold), START_TABLE)
    distorted = radius * _radial(radius * radius, coefficients)
    if not distorted[-1] >= distorted[-2]:  # just beyond a pole
        distorted[-1] = np.inf
    shrink = np.interp(measured, distorted, radius) / np.where(measured > 0, measured, 1.0)
    return xd * shrink, yd * shrink


def undistort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Maps:
    """Ideal normalised coordinates of distorted ones, float64; NaN where none within the fold
    reproduces the input to `INVERSE_TOLERANCE`. Newton's method from the inverse of the radial
    part, read off a table: from the distorted point itself it overshoots where the polynomial
    flattens out, and misses points that have an inverse."""
    xd, yd = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not is_distorted(coefficients):
        return xd.copy(), yd.copy()
    upright, (_, _, p1, p2, _) = coefficients[:12], coefficients[:5]
    with np.errstate(all="ignore"):
        xu, yu = xd, yd
        if len(coefficients) > 12:
            xu, yu, _ = _through(np.linalg.inv(_tilt(coefficients)), xd, yd)
        xi, yi = _radial_start(xu, yu, upright)
        for _ in range(MAX_ITERATIONS):
            fx, fy = distortion_polynomial(xi, yi, upright)
            ex, ey = fx - xu, fy - yu
            r2 = xi * xi + yi * yi
            radial = _radial(r2, upright)
            slope = _twice_radial_slope(r2, radial, upright)
            jxx = radial + slope * xi * xi + 2.0 * p1 * yi + 6.0 * p2 * xi
            jyy = radial + slope * yi * yi + 6.0 * p1 * yi + 2.0 * p2 * xi
            jxy = jyx = slope * xi * yi + 2.0 * p1 * xi + 2.0 * p2 * yi
            if len(upright) > 8:
                prism_x, prism_y = (2.0 * (upright[i] + 2.0 * upright[i + 1] * r2) for i in (8, 10))
                jxx, jxy, jyx, jyy = (
                    jxx + prism_x * xi,
                    jxy + prism_x * yi,
                    jyx + prism_y * xi,
                    jyy + prism_y * yi,
                )
            determinant = jxx * jyy - jxy * jyx
            dx, dy = (jyy * ex - jxy * ey) / determinant, (jxx * ey - jyx * ex) / determinant
            xi, yi = xi - dx, yi - dy
            if not np.any(np.maximum(np.abs(dx), np.abs(dy)) > 1e-15):
                break
        fx, fy = distort(xi, yi, coefficients)
        good = np.maximum(np.abs(fx - xd), np.abs(fy - yd)) <= INVERSE_TOLERANCE
    return np.where(good, xi, np.nan), np.where(good, yi, np.nan)


@dataclass(frozen=True)
class Pinhole:
    """Size and intrinsics in px, distortion as in this module's docstring; to four coefficients k3
    = 0 is added. Raises `RigError` for sizes that are not positive integers, focal lengths that are
    not positive, non-finite values, another number of coefficients."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, whole(getattr(self, name), name, 1, 65536))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(
                self, name, number(getattr(self, name), name, positive=name in ("fx", "fy"))
            )
        distortion = numbers(self.distortion, COEFFICIENT_COUNTS, "distortion")
        object.__setattr__(
            self, "distortion", distortion if len(distortion) > 4 else (*distortion, 0.0)
        )
        w, h = self.width, self.height
        matrix = np.array(
            [
                [self.fx / w, 0, (self.cx + 0.5) / w],
                [0, self.fy / h, (self.cy + 0.5) / h],
                [0, 0, 1],
            ]
        )
        condition = float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.inf
        require(
            condition <= MAX_CONDITION,
            f"fx, fy, cx, cy: the intrinsic matrix {self.fx:g}, {self.fy:g}, {self.cx:g}, "
            f"{self.cy:g} px of a {w} x "
            f"{h} px image is nearly singular: condition number {condition:.3g}, accepted up to "
            f"{MAX_CONDITION:.3g}; "
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
        """The same view with ``width`` pixels across: c -> (c + 0.5) s - 0.5, since pixel areas
        scale, not centres."""
        s = width / self.width
        (fx, fy), (cx, cy) = (f * s for f in self.focal), ((c + 0.5) * s - 0.5 for c in self.centre)
        return replace(
            self, width=width, height=max(1, round(self.height * s)), fx=fx, fy=fy, cx=cx, cy=cy
        )

    def normalised(self, u: ArrayLike, v: ArrayLike) -> Maps:
        """Ideal normalised coordinates (x, y) of pixels (u, v), float64; NaN where the lens model
        has no inverse."""
        x = (np.asarray(u, dtype=np.float64) - self.cx) / self.fx
        y = (np.asarray(v, dtype=np.float64) - self.cy) / self.fy
        return undistort(x, y, self.distortion)

    def pixels(self, x: ArrayLike, y: ArrayLike) -> Maps:
        """Pixels (u, v) of ideal normalised coordinates, float64; NaN beyond the fold of the lens
        model."""
        xd, yd = distort(x, y, self.distortion)
        return xd * self.fx + self.cx, yd * self.fy + self.cy

    def rays(self) -> Maps:
        """Ideal normalised coordinates (x, y) of every pixel, NaN where the distortion can't be
        inverted: two float64 (H, W) read-only maps; the ray is (x, y, 1). The two latest cameras'
        maps are kept."""
        return _rays(self)

    def holds(
        self, u: NDArray[np.float64], v: NDArray[np.float64], inset_px: float = 0.0
    ) -> NDArray[np.bool_]:
        """Which pixels (u, v) lie on the image, so far from its border or farther; the outer pixels
        are on it as a whole, and NaN is not. Bool of their shape."""
        low, right, bottom = inset_px - 0.5, self.width - 0.5, self.height - 0.5
        return (u >= low) & (u <= right - inset_px) & (v >= low) & (v <= bottom - inset_px)

    def grid(self, count: int) -> Maps:
        """Ideal normalised coordinates (x, y) of ``count`` times ``count`` pixels, evenly over the
        image from corner to corner, (count, count) each."""
        lengths = self.width, self.height
        return self.normalised(*np.meshgrid(*(np.linspace(0, n - 1, count) for n in lengths)))

    def project(self, points_m: ArrayLike) -> Maps:
        """Pixels (u, v) of points (..., 3) in this device's frame, metres; NaN for points at or
        behind the centre."""
        points = np.asarray(points_m, dtype=np.float64)
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        depth = np.where(z > 0, z, np.nan)
        return self.pixels(x / depth, y / depth)


@lru_cache(maxsize=2)
def _rays(pinhole: Pinhole) -> Maps:
    u, v = np.meshgrid(
        np.arange(pinhole.width, dtype=np.float64), np.arange(pinhole.height, dtype=np.float64)
    )
    maps = pinhole.normalised(u, v)
    for axis in maps:
        axis.setflags(write=False)
    return maps
