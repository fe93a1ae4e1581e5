"""Every score of the protocol, written anew from PROTOCOL.md in extended precision by sorting and
masking. No code is that of the package."""

from fractions import Fraction

import mpmath
import numpy as np
from scipy import ndimage

LONG = np.longdouble
COVERED = (68, 95, 99)


def edges_of(target):
    """Pixels beside a depth edge, from shifted copies: written anew from PROTOCOL.md."""
    jump = 10.0 * 960 / target.shape[1]
    marked = np.zeros(target.shape, bool)
    for axis, length in enumerate(target.shape):
        for place in range(length - 1):
            first, second = (np.take(target, place + step, axis) for step in (0, 1))
            crossed = ((first > 0) != (second > 0)) | (
                (first > 0) & (second > 0) & (np.abs(second - first) > jump)
            )
            for step in (0, 1):
                index = [slice(None)] * 2
                index[axis] = place + step
                marked[tuple(index)] |= crossed
    return marked


def sample_scores(prediction, target, band, void, unlit, charge=None):
    """All scores in float128 by sorting and masking; None for an empty set."""
    error = prediction.astype(LONG) - target.astype(LONG)
    inside, outside, edges = (target > 0) & ~void, (target == 0) & ~void, edges_of(target)
    distance = (
        ndimage.distance_transform_edt(~edges) if edges.any() else np.full(target.shape, np.inf)
    )
    valid = inside & (prediction > 0)

    def mae(pixels):
        return np.abs(error[pixels]).mean() if pixels.any() else None

    def rmse(pixels):
        return np.sqrt((error[pixels] ** 2).mean()) if pixels.any() else None

    def share(part, whole):
        return LONG(np.count_nonzero(part)) / np.count_nonzero(whole) if whole.any() else None

    core, near = inside & (distance >= band), inside & (distance < band)
    wide, deep = inside & (distance < 8), inside & (distance >= 8)
    scores = {
        "overall_mae_mm": mae(~void),
        "overall_rmse_mm": rmse(~void),
        "object_mae_mm": mae(inside),
        "object_rmse_mm": rmse(inside),
        "background_mae_mm": mae(outside),
        "background_rmse_mm": rmse(outside),
        "object_interior_mae_mm": mae(core),
        "object_interior_rmse_mm": rmse(core),
        "object_edge_mae_mm": mae(near),
        "object_edge_rmse_mm": rmse(near),
        "object_valid_mae_mm": mae(valid),
        "object_interior_valid_mae_mm": mae(valid & core),
        "object_edge_share": share(near, inside),
        "object_missing_share": share(inside & ~valid, inside),
        "object_interior_missing_share": share(core & ~valid, core),
        "object_wide_band_mae_mm": mae(wide),
        "object_wide_interior_mae_mm": mae(deep),
        "object_wide_band_share": share(wide, inside),
        "object_bias_mm": error[inside].mean() if inside.any() else None,
        "object_valid_bias_mm": error[valid].mean() if valid.any() else None,
    }
    if charge is not None and inside.any():
        cost, surface = np.where(prediction > 0, np.abs(error), LONG(charge)), target > 0
        invented = np.count_nonzero(outside & (prediction > 0))
        for name, pixels in (("two_sided", inside), ("two_sided_with_void", surface)):
            total = cost[pixels].sum() + invented * LONG(charge)
            scores[f"{name}_mae_mm"] = total / np.count_nonzero(pixels)
        scores["invented_share"] = LONG(invented) / np.count_nonzero(inside)
    dark = unlit > 0
    far = np.abs(prediction.astype(LONG) - unlit.astype(LONG))
    lit = dark & (prediction > 0)
    if (
        inside.any()
        and (span := target[inside].astype(LONG).max() - target[inside].astype(LONG).min()) > 0
    ):
        scores["object_mae_range_share"] = mae(inside) / span
    scores["void_share"] = LONG(np.count_nonzero(void)) / void.size
    if dark.any():
        scores |= {
            "unlit_mae_mm": far[dark].mean(),
            "unlit_rmse_mm": np.sqrt((far[dark] ** 2).mean()),
        }
        scores["unlit_missing_share"] = share(dark & ~lit, dark)
    if lit.any():
        scores["unlit_valid_mae_mm"] = far[lit].mean()
    ordered, signed = np.sort(np.abs(error[inside])), np.sort(error[inside])

    def quantile(values, level):
        place = LONG(level) * (values.size - 1)
        low = int(np.floor(place))
        high = min(low + 1, values.size - 1)
        return values[low] + (values[high] - values[low]) * (place - low)

    some = bool(ordered.size)
    scores["object_median_mm"] = quantile(ordered, LONG(1) / 2) if some else None
    scores["object_p95_mm"] = quantile(ordered, LONG(95) / 100) if some else None
    scores["object_max_mm"] = ordered[-1] if some else None
    for limit in (1, 2, 5, 10):
        scores[f"object_within_{limit}mm_share"] = share(
            ordered <= limit, np.ones(ordered.size, bool)
        )
    scores["object_shift_free_mae_mm"] = (
        np.abs(signed - quantile(signed, LONG(1) / 2)).mean() if some else None
    )
    return scores


def gaussian_quantile(coverage):
    return LONG(mpmath.nstr(mpmath.sqrt(2) * mpmath.erfinv(mpmath.mpf(str(coverage))), 25))


def left_out(values, order, share, pixels):
    """Sum of ``values`` once ``share`` of ``pixels`` is left out, largest ``order`` first, equals
    in equal parts, over the other pixels."""
    weights, budget = np.zeros(values.size, LONG), share * pixels
    for key in sorted(set(order), reverse=True):
        group = order == key
        count = int(np.count_nonzero(group))
        taken = min(budget, Fraction(count))
        budget -= taken
        kept = 1 - taken / count
        weights[group] = LONG(kept.numerator) / LONG(kept.denominator)
    rest = (1 - share) * pixels
    return (weights * values).sum() * rest.denominator / rest.numerator


def sigma_scores(prediction, target, sigma, void, charge=None):
    """Every score in extended precision, from PROTOCOL.md."""
    inside = (target > 0) & ~void
    depth, true, spread = (values[inside].astype(LONG) for values in (prediction, target, sigma))
    error = np.abs(depth - true)
    stated = (depth > 0) & (spread > 0)
    scores = {"unstated_share": LONG(np.count_nonzero(~stated)) / stated.size}
    unsure, cost = np.where(stated, spread, np.inf), error
    if charge is not None:
        invented = sigma[(target == 0) & ~void & (prediction > 0)].astype(LONG)
        cost = np.append(np.where(depth > 0, error, LONG(charge)), [LONG(charge)] * invented.size)
        unsure = np.append(unsure, np.where(invented > 0, invented, np.inf))
    for name, values, finish in (
        ("mae_mm", cost, lambda mean: mean),
        ("rmse_mm", cost**2, np.sqrt),
    ):
        gaps = []
        for step in range(20):
            share = Fraction(step, 20)
            pair = [finish(left_out(values, order, share, error.size)) for order in (unsure, cost)]
            gaps.append(pair[0] - pair[1])
            if step == 1:
                scores[f"sure_{name}"] = pair[0]
        scores[f"ause_{name}"] = sum(gaps) / 20
    error, spread = error[stated], spread[stated]
    for percent in COVERED:
        scores[f"coverage_{percent}"] = (
            LONG(np.count_nonzero(error <= gaussian_quantile(percent / 100) * spread)) / error.size
        )
    ordered = np.sort(spread)
    scores["sigma_mean_mm"] = spread.mean()
    scores["sigma_median_mm"] = (ordered[(error.size - 1) // 2] + ordered[error.size // 2]) / 2
    floored = np.maximum(spread, LONG("0.01"))
    ratio = np.minimum(error / floored, LONG(10))
    scores["nll"] = (
        np.log(floored) + np.log(2 * LONG("3.14159265358979323846")) / 2 + ratio**2 / 2
    ).mean()
    return scores
