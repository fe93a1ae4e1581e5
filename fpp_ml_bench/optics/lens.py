"""Lens distortion: OpenCV's five-parameter model and its inverse, in normalised image coordinates.

With r^2 = x^2 + y^2 and coefficients (k1, k2, p1, p2, k3)::

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y_d = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

The polynomial folds back beyond some radius; a point out there has no image, and both functions answer NaN for it.
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Coefficients = tuple[float, float, float, float, float]
Pair = tuple[NDArray[np.float64], NDArray[np.float64]]

NO_DISTORTION: Coefficients = (0.0, 0.0, 0.0, 0.0, 0.0)
INVERSE_TOLERANCE = 1e-12
"""Largest accepted error of the inverse, distorted again, in normalised units: 2e-9 px at the paper's focal length."""
MAX_ITERATIONS = 50
START_TABLE = 4096


def is_distorted(coefficients: Coefficients) -> bool:
    return any(c != 0.0 for c in coefficients)


def fold_radius_squared(coefficients: Coefficients) -> float:
    """r^2 at which r (1 + k1 r^2 + k2 r^4 + k3 r^6) stops growing, ``inf`` where it never does."""
    k1, k2, _, _, k3 = coefficients
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    real = [root.real for root in roots if abs(root.imag) <= 1e-9 * abs(root) and root.real > 0]
    # The root finder's last digits differ between processors; where the fold is counts to eleven.
    return float(f"{min(real, default=math.inf):.11g}")


def distortion_polynomial(x: NDArray, y: NDArray, coefficients: Coefficients) -> Pair:
    """The model itself, without a look at its fold: arithmetic only, so that arrays of any library pass through."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    cross = x * y
    return (
        x * radial + 2.0 * p1 * cross + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * cross,
    )


def distort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Pair:
    """Distorted normalised coordinates of ideal ones (any equal shapes), float64; NaN beyond the fold of the model."""
    x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not is_distorted(coefficients):
        return x.copy(), y.copy()
    with np.errstate(invalid="ignore", over="ignore"):
        xd, yd = distortion_polynomial(x, y, coefficients)
        folded = ~(x * x + y * y < fold_radius_squared(coefficients))
    return np.where(folded, np.nan, xd), np.where(folded, np.nan, yd)


def _radial_start(xd: NDArray[np.float64], yd: NDArray[np.float64], coefficients: Coefficients) -> Pair:
    """Points whose radial distortion alone is that of (xd, yd), to a few digits; at the fold for those beyond it."""
    k1, k2, _, _, k3 = coefficients
    measured = np.sqrt(xd * xd + yd * yd)
    farthest = float(np.max(measured, initial=0.0, where=np.isfinite(measured)))
    fold = math.sqrt(fold_radius_squared(coefficients))

    def distorted(r: NDArray[np.float64]) -> NDArray[np.float64]:
        r2 = r * r
        return r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))

    reach = farthest
    for _ in range(MAX_ITERATIONS):  # a radius that is distorted beyond all of the points, or the fold
        if reach >= fold or float(distorted(np.array(reach))) >= farthest:
            break
        reach *= 2
    radius = np.linspace(0.0, min(reach, fold), START_TABLE)
    shrink = np.interp(measured, distorted(radius), radius) / np.where(measured > 0, measured, 1.0)
    return xd * shrink, yd * shrink


def undistort(x: ArrayLike, y: ArrayLike, coefficients: Coefficients) -> Pair:
    """Ideal normalised coordinates of distorted ones, by Newton's method in float64, checked by distorting again.

    Newton starts at the inverse of the radial part, read off a table: from the distorted point itself it overshoots
    where the polynomial flattens out, and misses points that have an inverse. Where no ideal point within the fold
    reproduces the input to `INVERSE_TOLERANCE`, both coordinates are NaN.
    """
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
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
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
