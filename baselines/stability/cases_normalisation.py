"""Normalisation: flat planes, one pixel, full and empty frames, depth_min = 0, ranges from 1e-6 mm to 1e6 mm."""

from fpp_ml_bench.baselines.stability import normalisation_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family

SPANS = (1e-6, 1e-3, 1.0, 200.0, 1e3, 1e6)
NAMES = ("raw", "global", "individual")
PREDICTS = "4 u32 (D - D_min) individually: 3 roundings; 2 u32 D else; 4 u D for the way back"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "normalisation"
    return [
        *family(
            group, "range", check.round_trip,
            {"name": NAMES, "kind": ("part",), "low_mm": (1700.0,), "stored": ("float64", "float32"),
             "span_mm": SPANS},
            computes="depth to float32 representation and back", reference="the depth", predicts=PREDICTS, unit="mm",
        ),
        *family(
            group, "depth_min = 0", check.round_trip,
            {"name": NAMES, "kind": ("full frame",), "low_mm": (0.0,), "stored": ("float64", "float32"),
             "span_mm": (1e-30, 1e-6, 1.0, 1e6)},
            computes="depth to float32 representation and back", reference="the depth", predicts=PREDICTS, unit="mm",
        ),
        *family(
            group, "shape of the object", check.round_trip,
            {"name": NAMES, "low_mm": (1700.0,), "span_mm": (200.0,), "stored": ("float32",),
             "kind": ("flat plane", "one pixel", "full frame", "empty")},
            computes="depth to float32 representation and back", reference="the depth", predicts=PREDICTS, unit="mm",
        ),
        *family(
            group, "individual, forward", check.forward,
            {"kind": ("part",), "low_mm": (1700.0, 1700.1), "stored": ("float64", "float32"), "span_mm": SPANS},
            computes="(D - D_min) / (D_max - D_min) in float32", reference="the quotient in 80-bit arithmetic",
            predicts="4 u32 of the value: difference, range and quotient round once each", unit="1",
        ),
        *family(
            group, "range from a file", check.foreign_range,
            {"low_mm": (1700.1,), "span_mm": (1e-2, 1.0, 200.0, 1e3)},
            computes="individual depth with a range that is not a float32 number",
            reference="the quotient in 80-bit arithmetic", predicts="4 u32 of the value", unit="1",
        ),
        *family(
            group, "subnormal range", check.round_trip,
            {"name": ("individual",), "kind": ("full frame",), "low_mm": (0.0,), "stored": ("float64",),
             "span_mm": (1e-40, 1e-60, 1e-300)},
            computes="depth to float32 representation and back", reference="the depth", predicts=PREDICTS, unit="mm",
        ),
        *family(
            group, "impossible range", check.impossible_range,
            {"low_mm": (1600.0, float("nan"), float("-inf")), "high_mm": (1500.0, float("inf"), float("nan"))},
            computes="depth with an invalid range", reference="there is no such representation",
            predicts="must be refused", unit="1", expects="refusal",
        ),
        *family(
            group, "scored", check.scored,
            {"mode": ("standard", "paper-individual"),
             "kind": ("part", "full frame", "flat plane", "one pixel", "empty")},
            computes="normalised predictions as the evaluator scores them", reference="the affine map, closed form",
            predicts="4 u D; no range to go back through is refused", unit="mm",
            expects=lambda mode, kind: "number" if kind in ("part", "full frame") else "either",
        ),
    ]  # fmt: skip
