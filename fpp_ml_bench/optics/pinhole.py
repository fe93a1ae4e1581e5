"""Pinhole model with lens distortion: the camera, or a projector as an inverse camera.

Pixel centres lie at integer coordinates, so that an image W px wide spans -0.5 to W - 0.5 (OpenCV's convention).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.lens import NO_DISTORTION, Coefficients, distort, is_distorted, undistort

Maps = tuple[NDArray[np.float64], NDArray[np.float64]]

MAX_CONDITION = 2.0**26
"""Largest accepted condition number of the intrinsic matrix, with lengths in image sizes: inverting it then costs half
of double precision's digits. The paper's camera has 3; a focal length of 0.01 px or 10^10 px reaches the limit."""


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
    if len(entries) != count:
        raise RigError(f"{name}: expected {count} numbers, got {len(entries)}")
    return tuple(number(entry, f"{name}[{i}]") for i, entry in enumerate(entries))


@dataclass(frozen=True)
class Pinhole:
    """A camera, or a projector as an inverse camera: size and intrinsics in px, distortion (k1, k2, p1, p2, k3).

    Raises `RigError` for sizes that are not positive integers, focal lengths that are not positive, non-finite values.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Coefficients = NO_DISTORTION

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or not 1 <= value <= 65536:
                raise RigError(f"{name}: expected a whole number of pixels from 1 to 65536, got {value!r}")
            object.__setattr__(self, name, int(value))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, number(getattr(self, name), name, positive=name in ("fx", "fy")))
        object.__setattr__(self, "distortion", numbers(self.distortion, 5, "distortion"))
        self._check_intrinsics()

    def _check_intrinsics(self) -> None:
        w, h = self.width, self.height
        matrix = np.array([[self.fx / w, 0, (self.cx + 0.5) / w], [0, self.fy / h, (self.cy + 0.5) / h], [0, 0, 1]])
        condition = float(np.linalg.cond(matrix)) if np.isfinite(matrix).all() else math.inf
        if not condition <= MAX_CONDITION:
            raise RigError(
                f"fx, fy, cx, cy: the intrinsic matrix {self.fx:g}, {self.fy:g}, {self.cx:g}, {self.cy:g} px of a "
                f"{w} x {h} px image is nearly singular: condition number {condition:.3g}, accepted up to "
                f"{MAX_CONDITION:.3g}; give focal lengths and principal point in px"
            )

    @property
    def is_distorted(self) -> bool:
        return is_distorted(self.distortion)

    def scaled(self, width: int) -> "Pinhole":
        """The same view with ``width`` pixels across: c -> (c + 0.5) s - 0.5, since pixel areas scale, not centres."""
        s = width / self.width
        return replace(
            self,
            width=width,
            height=max(1, round(self.height * s)),
            fx=self.fx * s,
            fy=self.fy * s,
            cx=(self.cx + 0.5) * s - 0.5,
            cy=(self.cy + 0.5) * s - 0.5,
        )

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
        """Ideal normalised coordinates (x, y) of every pixel: two float64 (H, W) read-only maps; the ray is (x, y, 1).

        Pixels whose distortion can't be inverted are NaN. The two latest cameras' maps are kept.
        """
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
