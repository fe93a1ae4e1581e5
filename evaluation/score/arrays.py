"""Scoring arrays in memory, by the rules for a folder of predictions."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation import protocol, result
from fpp_ml_bench.evaluation.score.sample_scores import score_sample
from fpp_ml_bench.evaluation.score.sigma_scores import SigmaSample, score_sigma
from fpp_ml_bench.evaluation.score.units import declared_units, in_mm, value_problems
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.sample import Flag, void_pixels

Maps = NDArray[Any] | Sequence[NDArray[Any]]


def evaluate_arrays(
    predictions: Maps,
    targets: Maps,
    flags: Maps | None = None,
    sigma: Maps | None = None,
    objects: Sequence[str] | None = None,
    edge_band_px: int = protocol.EDGE_BAND_PX,
    units: str | None = None,
) -> "result.ArrayScores":
    """Score depth in mm, 0 = background or not measured, against depth in mm, 0 = background: floats (N, H, W), or N
    maps (H, W) that may differ in size. Pixels that a masked array of targets masks count in no set. ``flags``: whole
    numbers, bits of `loaders.sample.Flag`, whose void pixels count in no set. ``sigma``: the standard uncertainty in
    mm, 0 where none is stated. ``objects``: what each sample shows; samples of the same object are not independent, and
    the intervals are over objects (by default, each sample is its own). ``units``: ``mm`` or ``m``, of all depths and
    sigma; must be said where a target reaches less than 10.

    Raises PredictionError, naming the sample by its number, for numbers or shapes that differ, for what is no real
    float or not finite, for a negative sigma or target, for masked predictions, for flags that are no such bits, and
    for depths that look like another unit."""
    count = len(_sequence("targets", targets))
    columns = {"predictions": predictions, "targets": targets, "flags": flags, "sigma": sigma, "objects": objects}
    for name, values in columns.items():
        if values is not None and len(_sequence(name, values)) != count:
            raise PredictionError(f"{name}: expected {count}, one for each target, got {len(values)}")  # type: ignore[arg-type]
    if count == 0:
        raise PredictionError("targets: expected one depth map or more, got none")
    names = [printable(str(name)) for name in objects] if objects is not None else [f"sample {n}" for n in range(count)]
    rows: list[dict[str, Any]] = []
    stated: dict[str, SigmaSample] = {}
    for number in range(count):
        try:
            maps = {
                name: _array(name, values[number])  # type: ignore[index]
                for name, values in columns.items()
                if name != "objects" and values is not None
            }
            row, uncertainty = _scored(edge_band_px=edge_band_px, units=units, **maps)
        except PredictionError as error:
            raise PredictionError(f"sample {number}: {error}") from None
        rows.append({"sample": f"sample {number}", "object": names[number], **row})
        if uncertainty is not None:
            stated[f"sample {number}"] = uncertainty
    return result.array_scores(rows, stated)


def _sequence(name: str, values: Any) -> Any:
    """``values``, if they are a sequence of maps or names."""
    shape = getattr(values, "shape", None)
    if isinstance(values, (str, bytes)) or not hasattr(values, "__len__") or (shape is not None and len(shape) == 2):
        got = type(values).__name__ if shape is None else f"one map {tuple(shape)}"
        raise PredictionError(f"{name}: expected an array (N, H, W) or a list of maps (H, W), got {got}")
    return values


def _array(name: str, values: Any) -> NDArray[Any]:
    """A map as an array; a mask stays where its meaning is clear, with the targets."""
    try:
        array = np.asanyarray(values)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists; tensors with a gradient, or of a GPU
        raise PredictionError(f"{name}: expected an array (H, W), got {type(values).__name__}: {error}") from None
    if not np.ma.is_masked(array):
        return np.asarray(array)
    if name != "targets":
        advice = (
            f"write 0 where nothing is known ({name}.filled(0)); to leave pixels out of every score, mask the targets"
        )
        raise PredictionError(f"{name}: a masked array, and what a masked pixel means is not known; {advice}")
    return array


def _void(targets: NDArray[Any], flags: NDArray[Any] | None) -> NDArray[np.bool_]:
    """Pixels that count in no set: those masked in the targets, and those flagged."""
    void = np.ma.getmaskarray(targets)
    if flags is None:
        return void
    if flags.shape != targets.shape or flags.dtype.kind not in "iu":
        advice = "; to leave pixels out of every score, mask the targets" if flags.dtype.kind == "b" else ""
        raise PredictionError(
            f"flags: expected whole numbers {targets.shape}, got {flags.dtype} {flags.shape}; they are the column "
            f"flags of a dataset, bits that mark void pixels, not a mask{advice}"
        )
    most = sum(Flag)
    if not 0 <= flags.min() <= flags.max() <= most:
        bits = ", ".join(f"{flag.value} {(flag.name or '').lower()}" for flag in Flag)
        value = flags.max() if flags.max() > most else flags.min()
        raise PredictionError(f"flags: expected sums of {bits}, got {value}; a mask of valid pixels is no flags")
    return void | void_pixels(flags.astype(np.uint8))


def _scored(
    predictions: NDArray[Any],
    targets: NDArray[Any],
    edge_band_px: int,
    flags: NDArray[Any] | None = None,
    sigma: NDArray[Any] | None = None,
    units: str | None = None,
) -> tuple[dict[str, Any], SigmaSample | None]:
    for name, values in (("predictions", predictions), ("targets", targets), ("sigma", sigma)):
        if values is not None and values.dtype.kind != "f":
            raise PredictionError(f"{name}: expected real floats, got {values.dtype}")
        if values is not None and (values.ndim != 2 or values.shape != targets.shape or values.size == 0):
            raise PredictionError(f"{name}: expected a map (H, W) of the target's size, got {values.shape}")
    void = _void(targets, flags)
    targets = np.ma.filled(targets, 0)
    for name, values in (("targets", targets), ("sigma", sigma)):
        if values is not None and not (values.min() >= 0 and np.isfinite(values.max())):
            raise PredictionError(f"{name}: expected finite mm of 0 and more")
    declared = declared_units(float(targets.max()), units)
    digest = hashlib.sha256(np.ascontiguousarray(predictions).data).hexdigest()
    targets, largest_mm = in_mm(targets, declared), in_mm(targets.max(), declared)
    if problems := value_problems(predictions, targets, float(largest_mm), declared):
        raise PredictionError(f"the prediction {problems[0]}")
    predictions = in_mm(predictions, declared)
    scores = score_sample(predictions, targets, edge_band_px, void)
    uncertainty = None if sigma is None else score_sigma(predictions, targets, in_mm(sigma, declared), void)
    return {"prediction_sha256": digest, **scores.pixels(), **scores.metrics()}, uncertainty
