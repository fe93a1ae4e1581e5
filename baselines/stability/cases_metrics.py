"""Metrics: 1e10 pixels, magnitudes from 1e-30 to 1e30 and beyond, subnormals, cancellation, merged states."""

from fpp_ml_bench.baselines.stability import metrics_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family

EXACT = "exact sums"
BLOCKED = "6 sqrt(9600) u: a block of 9600 px in float64, random roundings; blocks are added exactly"
WORST = "9600 u: one float64 block's worst case; blocks are added exactly"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "metrics"
    return [
        *family(
            group, "streamed pixels", check.streamed,
            {"scale_mm": (1e-30, 1.0, 1e30), "pixels": (1e6, 1e8, 1e10)},
            computes="MAE and RMSE of merged states of 10^6 px, 20 kinds of block", reference=EXACT,
            predicts="6 sqrt(9600 + 6 merges) u: random roundings, 6 a merge, since a state is a rounded mean",
            unit="relative",
        ),
        *family(
            group, "magnitude", check.magnitude,
            {"scale_mm": (1.0, 1e-30, 1e30, 1e-130, 1e140, 1e-160, 5e-324, 1e-310, 1e200, 1e306)},
            computes="MAE and RMSE of 20,000 errors up to 999 x scale_mm", reference=EXACT,
            predicts=BLOCKED + "; squares above 1e308 refused", unit="relative",
            expects=lambda scale_mm: "number" if scale_mm <= 1e140 else "either",
        ),
        *family(
            group, "mixed magnitudes", check.mixed,
            {"low_mm": (1e-30, 1e-6), "high_mm": (1e-5, 1.0, 1e30)},
            computes="MAE and RMSE of magnitudes from low_mm to high_mm", reference=EXACT, predicts=BLOCKED,
            unit="relative",
        ),
        *family(
            group, "one large error", check.one_large, {"large_mm": (1.0, 1.7e7, 1e8, 1e12, 1e16)},
            computes="MAE and RMSE of 10^7 errors, all but this one 1 mm", reference=EXACT, predicts=WORST,
            unit="relative",
        ),
        *family(
            group, "sample", check.sample,
            {"stored": ("float32", "float64"), "scale_mm": (1.0, 1e-30, 1e30, 1e-43, 1e-160, 1e-300)},
            computes="object and background MAE and RMSE of 100 x 100 px", reference=EXACT, predicts=BLOCKED,
            unit="relative", expects=lambda stored, scale_mm: "number",
        ),
        *family(
            group, "distribution", check.distribution, {"scale_mm": (1.0, 1e-30, 1e30, 1e-300)},
            computes="median, 95th percentile, largest, bias, shift-free MAE", unit="mm",
            reference="sorted values and exact sums", predicts="gamma_9600 mean |e| + 4 u",
        ),
        *family(
            group, "cancelling errors", check.cancelling, {"large_mm": (1.0, 1e6, 1e12, 1e16)},
            computes="bias of positive and negative errors that nearly cancel", reference="exact sum", unit="mm",
            predicts="gamma of (log2 9600 + 16) x mean |e|: pairwise sums in a block, blocks exactly",
        ),
        *family(
            group, "merging order", check.merged, {"order": ("one by one", "as a tree, backwards")},
            computes="200 states of 1e-30 to 1e30 mm merged", reference="all at once",
            predicts="6 sqrt(6 merges) u", unit="relative",
        ),
        *family(
            group, "not a number", check.not_a_number, {"value": (float("nan"), float("inf"), float("-inf"), 1e300)},
            computes="a score of a prediction with a pixel of this value", reference="there is none",
            predicts="must be refused", unit="mm", expects="refusal",
        ),
        *family(
            group, "perfect and empty", check.flawless, {},
            computes="scores of a perfect prediction and of an empty set", reference="0, and none",
            predicts="exact", unit="mm",
        ),
    ]  # fmt: skip
