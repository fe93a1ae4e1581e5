"""The pixel sets on which scores are reported, the depth edges that split the object set, and
normalised depth."""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import FULL_SIZE, MM_PER_M
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.skipping import skipping_enabled

DEPTH_EDGE_JUMP_MM = 10.0
"""A step between 4-neighbours above this is a depth edge at 960 px (a surface tilted by 85 degrees
from the image plane); it grows with the pixel footprint at other sizes."""
Normalisation = Literal["raw", "global", "individual"]
NORMALISATIONS: tuple[Normalisation, ...] = ("raw", "global", "individual")
RangeRule = Literal["object", "valid"]
"""The pixels over which a sample's depth range is taken: all of the object, as in the paper, or
those not void."""
NODATA_SHARE = 0.01
"""Share of a map's pixels that must hold exactly the same value before it can be a mark for no
surface. By reason, not by trial: wrong depths that differ from all others are single pixels."""
NODATA_LEAST_PX = 30
"""Pixels that must hold it, whichever is more: in small maps the share alone would be a few
pixels."""
NODATA_FAR = 3.0
"""How many times farther than what can be measured such a mark is: a wall behind a scene may be
twice as far."""
NODATA_DECADE = 10.0
"""How many times farther than all other depths, or nearer, it is where that reach is unknown. The
marks of renderers and sensors (9999, 65504, 65535, 1e10) are farther."""
NODATA_ADVICE = "write 0 where no surface is, or give the value that says so as nodata"
_BLOCK = 1 << 16
"""Values in a block whose least and largest are taken at once: at most 512 KiB, which stay in the
cache."""
_SMALLEST = float(np.finfo(np.float32).tiny)
"""Smallest span that is divided by in single precision, the smallest normal number of float32:
below, float32 loses digits."""
_LARGEST = float(np.finfo(np.float32).max)
"""Largest number of float32: depths and spans beyond it are computed in float64."""


def object_mask(depth_mm: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Pixels of the object, bool (H, W): target depth above 0 mm, for statistics, masks and scores
    (paper 5.3.2)."""
    return depth_mm > 0


def depth_problem(depth: NDArray[np.floating]) -> str | None:
    """What is wrong with a depth map (H, W) of an object, a sentence, or None: depths that are not
    finite or below 0, or none above 0."""
    for wrong, are in ((~np.isfinite(depth), "NaN or infinite"), (depth < 0, "negative")):
        if wrong.any():
            return f"{np.count_nonzero(wrong)} pixels are {are}; {NODATA_ADVICE}"
    return None if object_mask(depth).any() else "no pixel is above 0, so there is no object"


def without_nodata(depth: NDArray, nodata: float | None) -> NDArray:
    """A depth map (H, W) with 0 where it holds exactly the value ``nodata`` (NaN: any NaN), rounded
    as the map is; the map itself where that is None, or the map holds no real numbers. Raises
    `PredictionError` for no number."""
    if nodata is None or depth.dtype.kind not in "fiu":
        return depth
    if not isinstance(nodata, int | float | np.number):
        raise PredictionError(f"nodata: expected a number, got {type(nodata).__name__}")
    with np.errstate(over="ignore"):
        value = np.float64(nodata).astype(depth.dtype if depth.dtype.kind == "f" else np.float64)
    return np.where(
        np.isnan(depth) if np.isnan(value) else depth == value, depth.dtype.type(0), depth
    )


def nodata_problem(
    depth: NDArray[np.floating], reach: float = 0.0, apart: float = NODATA_DECADE
) -> str | None:
    """Why a value of a finite depth map (H, W) must be a mark for pixels without a surface, a
    sentence, or None. A mark is exactly the same at many pixels, and negative, or ``apart`` times
    farther than what can be measured: ``reach`` in the map's unit, or where that is not known (0)
    all other depths. Where it is not known, also one that is a decade nearer than all others. A map
    of a single depth says nothing about itself."""
    low, high = extremes(depth)
    for value in (high, low):
        there = depth == value
        share = np.count_nonzero(there) / depth.size
        if not value or share < max(NODATA_SHARE, NODATA_LEAST_PX / depth.size):
            continue
        others = depth[~there & object_mask(depth)]
        near, far = extremes(others) if others.size else (0.0, 0.0)
        far = reach or far
        if (
            (value < 0 < near)
            or 0 < far * apart < value
            or (not reach and 0 < value * NODATA_DECADE < near)
        ):
            shown = f"{100 * share:.0f}% of the pixels are exactly {value:.6g}, far from all depths"
            return f"{shown}: a value for background? {NODATA_ADVICE}"
    return None


def shape_problem(shape: Sequence[int], size: tuple[int, int]) -> str | None:
    """How a ``shape`` differs from the ``size`` (H, W) of a map, and what to do, a sentence, or
    None."""
    if tuple(shape) == tuple(size):
        return None
    # A hostile header may hold an integer too long for Python to print at all.
    text = "(" + ", ".join(str(n) if abs(n) < 10**18 else "more than 10^18" for n in shape) + ")"
    cure = "predict at that size"
    if tuple(n for n in shape if n != 1) == tuple(size):
        cure = "it has an axis too many; write np.squeeze(depth)"
    elif len(shape) != 2:
        cure = "write the map of depth alone, without other axes or channels"
    elif tuple(shape) == tuple(size[::-1]):
        cure = "it looks transposed; write depth.T"
    return f"expected shape {tuple(size)} (H, W), got {text}; {cure}"


def extremes(values: NDArray[np.floating]) -> tuple[float, float]:
    """The smallest and the largest value of a map (H, W) that is not empty, NaN if it holds any;
    read once, in blocks that stay in the cache."""
    flat = values.ravel(order="K")
    blocks = [flat[start : start + _BLOCK] for start in range(0, flat.size, _BLOCK)]
    ends = np.array([(block.min(), block.max()) for block in blocks], dtype=np.float64)
    return float(ends[:, 0].min()), float(ends[:, 1].max())


def edge_jump_mm(size_px: int) -> float:
    """Depth step in mm that counts as an edge in an image ``size_px`` wide."""
    return DEPTH_EDGE_JUMP_MM * FULL_SIZE / size_px


def depth_edges(depth_mm: NDArray[np.floating], jump_mm: float | None = None) -> NDArray[np.bool_]:
    """Pixels beside a depth edge, bool (H, W). An edge runs between an object pixel and a
    background pixel beside it (4-neighbours), or between two object pixels whose depths differ by
    more than ``jump_mm`` (default: `edge_jump_mm` of the width). Both pixels are marked."""
    jump = edge_jump_mm(depth_mm.shape[1]) if jump_mm is None else jump_mm
    inside = object_mask(depth_mm)
    edge = np.zeros(depth_mm.shape, dtype=bool)
    for depth, within, marked in ((depth_mm, inside, edge), (depth_mm.T, inside.T, edge.T)):
        step = np.abs(depth[1:] - depth[:-1]) > jump
        step = (step & within[:-1] & within[1:]) | (within[:-1] != within[1:])
        marked[:-1] |= step
        marked[1:] |= step
    return edge


def object_box(inside: NDArray[np.bool_]) -> tuple[slice, slice] | None:
    """Rows and columns of a mask (H, W) and one pixel around it: they hold every depth edge of an
    object with this mask. None for an empty mask; the whole image where `skipping_enabled` says
    no."""
    rows = np.flatnonzero(inside.any(axis=1))
    if not rows.size:
        return None
    if not skipping_enabled():
        return np.s_[0 : inside.shape[0], 0 : inside.shape[1]]
    columns = np.flatnonzero(inside[rows[0] : rows[-1] + 1].any(axis=0))
    return np.s_[max(rows[0] - 1, 0) : rows[-1] + 2, max(columns[0] - 1, 0) : columns[-1] + 2]


def object_near_edges(
    depth_mm: NDArray, bands_px: Sequence[int], jump_mm: float | None = None
) -> list[NDArray]:
    """For each of several bands the object pixels nearer than it to one of `depth_edges`, bool (H,
    W). By dilation, which for a narrow band is several times faster than a distance transform, and
    needs no OpenCV (slower to import than ten samples to score)."""
    near_edge = [np.zeros(depth_mm.shape, dtype=bool) for _ in bands_px]
    inside = object_mask(depth_mm)
    if (box := object_box(inside)) is None:
        return near_edge
    edge = depth_edges(
        depth_mm[box], edge_jump_mm(depth_mm.shape[1]) if jump_mm is None else jump_mm
    )
    for band, band_px in zip(near_edge, bands_px, strict=True):
        if band_px > 0:
            band[box] = _dilated(edge, band_px) & inside[box]
    return near_edge


def _dilated(edge: NDArray[np.bool_], band_px: int) -> NDArray[np.bool_]:
    """Pixels nearer than ``band_px`` to a pixel of ``edge``; both (h, w). Rows lie behind each
    other with a gap between them that takes what a shift pushes over their ends, so that every step
    is over memory without jumps."""
    height, width = edge.shape
    step = width + min(band_px - 1, width - 1)
    padded = np.zeros((height, step), dtype=bool)
    padded[:, :width] = edge
    source = padded.reshape(-1)
    run, half = source.copy(), 0  # source, dilated sideways by half
    band = np.zeros_like(source)
    for dy in range(min(band_px, height) - 1, -1, -1):
        # Widest sideways offset still inside the open disk dx^2 + dy^2 < band^2; it grows as dy
        # shrinks.
        limit = min(math.isqrt(band_px * band_px - 1 - dy * dy), width - 1)
        while half < limit:
            half += 1
            run[half:] |= source[:-half]
            run[:-half] |= source[half:]
        down = dy * step
        band[: band.size - down] |= run[down:]
        band[down:] |= run[: band.size - down]
    return band.reshape(height, step)[:, :width]


def depth_range_mm(
    depth_mm: NDArray[np.floating], void: NDArray[np.bool_] | None = None
) -> tuple[float, float]:
    """Least and greatest depth of the object in a map (H, W), in mm, of its pixels that are not
    ``void`` if there are any. Raises ``ValueError`` for a map without an object."""
    inside = object_mask(depth_mm)
    valid = inside if void is None else inside & ~void
    depths = depth_mm[valid if valid.any() else inside]
    if not depths.size:
        raise ValueError("the depth map holds no object, so it has no depth range")
    return float(depths.min()), float(depths.max())


def _check(name: str) -> None:
    if name not in NORMALISATIONS:
        raise ValueError(f"unknown normalisation {name!r}; there are {', '.join(NORMALISATIONS)}")


def normalise(
    depth_mm: NDArray[np.floating],
    name: Normalisation,
    depth_min_mm: float,
    depth_max_mm: float,
    out: NDArray[np.floating] | None = None,
) -> NDArray:
    """Depth map in mm, 0 = background, to the representation ``name``: in ``out`` if given, else
    float32, same shape. In single precision where depth and range are float32: the difference of
    two such depths within a factor of two is exact (Sterbenz), and the division rounds once. Else
    in float64, rounded at the end. Raises ``ValueError`` for an unknown name or a range that is not
    finite and ordered."""
    _check(name)
    result = np.empty(depth_mm.shape, dtype=np.float32) if out is None else out
    if name == "raw":
        result[...] = depth_mm
    elif name == "global":
        np.divide(depth_mm, np.float32(MM_PER_M), out=result, casting="same_kind")
    else:
        span = _span(depth_min_mm, depth_max_mm)
        single = abs(depth_min_mm) <= _LARGEST and float(np.float32(depth_min_mm)) == float(
            depth_min_mm
        )
        if span == 0:
            result[...] = 0
        elif single and depth_mm.dtype.itemsize <= 4 and _SMALLEST <= span <= _LARGEST:
            np.subtract(depth_mm, np.float32(depth_min_mm), out=result, casting="same_kind")
            result /= np.float32(span)
            result *= object_mask(depth_mm)
        else:
            share = (depth_mm.astype(np.float64) - float(depth_min_mm)) / span
            result[...] = np.where(object_mask(depth_mm), share, 0.0)
    return result


def denormalise(
    values: NDArray, name: Normalisation, depth_min_mm: float, depth_max_mm: float
) -> NDArray[np.float64]:
    """A network's output in the representation ``name`` back to mm, float64; ``ValueError`` as
    `normalise`. Under ``individual`` every pixel goes through the same affine map: 0 becomes D_min
    (paper Section 5.3.2)."""
    _check(name)
    depth = values.astype(np.float64)
    if name == "individual":
        return depth * _span(depth_min_mm, depth_max_mm) + float(depth_min_mm)
    return depth * MM_PER_M if name == "global" else depth


def _span(depth_min_mm: float, depth_max_mm: float) -> float:
    low, high = float(depth_min_mm), float(depth_max_mm)
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise ValueError(
            f"expected a finite depth range with depth_min <= depth_max, got {low} to {high} mm"
        )
    return high - low
