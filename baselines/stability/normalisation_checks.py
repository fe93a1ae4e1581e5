"""Checks of the normalisations: flat, tiny, full, empty and extreme depth maps, forward and back."""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.stability.case import Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.roundoff import U32, U64
from fpp_ml_bench.depth import Normalisation, denormalise, normalise, object_mask
from fpp_ml_bench.errors import DatasetError
from fpp_ml_bench.evaluation.score import scored_pair

SIDE = 24
_TINY = 2.0**-149


def depth_map(kind: str, low_mm: float, span_mm: float) -> NDArray[np.float64]:
    """A depth map of 24 x 24 px in mm: the object's depths from ``low_mm`` to ``low_mm + span_mm``."""
    depth = np.zeros((SIDE, SIDE))
    if kind == "one pixel":
        depth[7, 11] = low_mm
    elif kind == "flat plane":
        depth[4:20, 4:20] = low_mm
    elif kind in ("full frame", "part"):
        inside = np.s_[:, :] if kind == "full frame" else np.s_[3:21, 5:19]
        shape = depth[inside].shape
        depth[inside] = low_mm + span_mm * np.linspace(0, 1, shape[0] * shape[1]).reshape(shape)
    return depth


def _range(depth: NDArray) -> tuple[float, float]:
    inside = depth[object_mask(depth)]
    return (float(inside.min()), float(inside.max())) if inside.size else (0.0, 0.0)


def round_trip(name: Normalisation, kind: str, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """Depth through a float32 representation and back, on the object."""
    depth = depth_map(kind, low_mm, span_mm).astype(stored)
    low, high = _range(depth)
    representation = normalise(depth, name, low, high)
    back = denormalise(representation, name, low, high)
    inside = object_mask(depth)
    legal = np.isfinite(representation).all() and (representation[~inside] == 0).all()
    if name == "individual":
        legal &= bool((representation >= 0).all() and (representation <= 1).all())
    if not legal:
        return Outcome(np.inf, 0.0, note="a representation that is not finite, not 0 outside or not in [0, 1]")
    if not inside.any():
        return worst(representation, 0.0)
    exact = depth[inside].astype(np.float64)
    if name == "individual":
        bound = 4 * U32 * (exact - low) + 4 * U64 * exact + _TINY * (high - low)
        ulp = 0.0
    else:
        bound, ulp = 2 * U32 * exact + 2 * U64 * exact, _TINY * (1000.0 if name == "global" else 1.0)
    return worst(back[inside] - exact, bound + ulp)


def forward(kind: str, low_mm: float, span_mm: float, stored: str) -> Outcome:
    """The individual representation itself, against the quotient in float64 or better."""
    depth = depth_map(kind, low_mm, span_mm).astype(stored)
    low, high = _range(depth)
    inside = object_mask(depth)
    exact = (depth[inside].astype(np.longdouble) - low) / (np.longdouble(high) - low) if high > low else 0.0
    representation = normalise(depth, "individual", low, high)[inside]
    bound = np.asarray(4 * U32 * exact, float) + _TINY
    return worst(np.asarray(representation - exact, float), bound)


def foreign_range(low_mm: float, span_mm: float) -> Outcome:
    """A range from a file in double precision that is not a float32 number, like published depth_params."""
    depth = depth_map("part", low_mm, span_mm)
    low, high = low_mm + span_mm * 1e-9, low_mm + span_mm * (1 - 1e-9)
    representation = normalise(depth.astype(np.float32), "individual", low, high)
    inside = object_mask(depth)
    exact = (depth.astype(np.float32)[inside].astype(np.longdouble) - low) / (np.longdouble(high) - low)
    bound = np.asarray(4 * U32 * np.abs(exact), float) + _TINY
    return worst(np.asarray(representation[inside] - exact, float), bound)


def impossible_range(low_mm: float, high_mm: float) -> Outcome:
    depth = depth_map("part", 1500.0, 100.0)
    return refusal(lambda: normalise(depth, "individual", low_mm, high_mm), ValueError)


def scored(kind: str, mode: str) -> Outcome:
    """The evaluator's conversion of normalised predictions to mm."""
    target = depth_map(kind, 1700.0, 200.0).astype(np.float32)
    values = np.where(object_mask(target), np.float32(0.5), np.float32(0.0))
    try:
        prediction, _ = scored_pair(values, target, "normalised", mode, "sample")  # type: ignore[arg-type]
    except DatasetError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    inside = object_mask(target)
    low, high = _range(target)
    exact = 0.5 * (high - low) + (low if mode == "standard" else 0.0)
    return worst(prediction[inside] - exact, 4 * U64 * high) if inside.any() else worst(prediction, 0.0)
