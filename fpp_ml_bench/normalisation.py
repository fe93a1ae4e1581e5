"""The three representations of depth that the paper trains on, and the way back to mm (paper Section 3.3).

========== =============================== ==================================
name       forward                         back
========== =============================== ==================================
raw        D (mm)                          D
global     D / 1000 (m)                    1000 D
individual (D - D_min) / (D_max - D_min)   D (D_max - D_min) + D_min
========== =============================== ==================================

Background stays 0 in all three. Under ``individual`` the pixels at D_min also become exactly 0 and can no longer be
told from background; this is the paper's rule. A flat depth map (D_max == D_min) would divide by zero; its object
becomes 0 like every pixel at D_min, and comes back as D_min.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.pixel_sets import object_mask

Normalisation = Literal["raw", "global", "individual"]
NORMALISATIONS: tuple[Normalisation, ...] = ("raw", "global", "individual")

_SMALLEST, _LARGEST = float(np.finfo(np.float32).tiny), float(np.finfo(np.float32).max)


def _check(name: str) -> None:
    if name not in NORMALISATIONS:
        raise ValueError(f"unknown normalisation {name!r}; there are {', '.join(NORMALISATIONS)}")


def normalise(
    depth_mm: NDArray[np.floating], name: Normalisation, depth_min_mm: float, depth_max_mm: float,
    out: NDArray[np.floating] | None = None,
) -> NDArray:  # fmt: skip
    """Depth map in mm, 0 = background, to the representation ``name``: in ``out`` if given, else float32, same shape.

    Single precision loses nothing where depth and range are float32: the difference of two such depths within a factor
    of two of each other is exact (Sterbenz), and the division rounds once. Any other range, or depths of higher
    precision, would lose digits by being rounded first: these are computed in float64 and rounded at the end.
    Raises ``ValueError`` for an unknown name or a range that is not finite and ordered.
    """
    _check(name)
    result = np.empty(depth_mm.shape, dtype=np.float32) if out is None else out
    if name == "raw":
        result[...] = depth_mm
    elif name == "global":
        np.divide(depth_mm, np.float32(MM_PER_M), out=result, casting="same_kind")
    else:
        span = _span(depth_min_mm, depth_max_mm)
        if span == 0:
            result[...] = 0
        elif depth_mm.dtype.itemsize <= 4 and _is_single(depth_min_mm) and _SMALLEST <= span <= _LARGEST:
            np.subtract(depth_mm, np.float32(depth_min_mm), out=result, casting="same_kind")
            result /= np.float32(span)
            result *= object_mask(depth_mm)
        else:
            share = (depth_mm.astype(np.float64) - float(depth_min_mm)) / span
            result[...] = np.where(object_mask(depth_mm), share, 0.0)
    return result


def denormalise(values: NDArray, name: Normalisation, depth_min_mm: float, depth_max_mm: float) -> NDArray[np.float64]:
    """A network's output in the representation ``name`` back to mm; float64 of the same shape.

    Under ``individual`` every pixel goes through the same affine map, so a predicted 0 becomes D_min (paper Section
    5.3.2). Raises ``ValueError`` as `normalise`.
    """
    _check(name)
    depth = values.astype(np.float64)
    if name == "raw":
        return depth
    if name == "global":
        return depth * MM_PER_M
    return depth * _span(depth_min_mm, depth_max_mm) + float(depth_min_mm)


def _is_single(value: float) -> bool:
    """Whether float32 holds ``value`` exactly."""
    return abs(value) <= _LARGEST and float(np.float32(value)) == float(value)


def _span(depth_min_mm: float, depth_max_mm: float) -> float:
    low, high = float(depth_min_mm), float(depth_max_mm)
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise ValueError(f"expected a finite depth range with depth_min <= depth_max, got {low} to {high} mm")
    return high - low
