"""Triangulation: baselines down to 0.01 mm, ranges to 100 m, parallel rays, infinity, wrong sides, single precision."""

from fpp_ml_bench.baselines.stability import triangulation_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family

BASELINES = (160.0, 50.0, 10.0, 1.0, 0.1, 0.01)
RANGES = (0.3, 1.0, 1.8, 5.0, 20.0, 100.0)
CLOSED = "the closed form on the same float64 inputs in 50 digits"
RUNNING = "u (8 kappa + 5 kappa_top + 4), kappa = sum of magnitudes over |a - x_p a_2|: running error analysis"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "triangulation"
    return [
        *family(
            group, "baseline", check.one_coordinate,
            {"direction": ("vertical", "horizontal"), "range_m": (1.8,), "baseline_mm": BASELINES},
            computes="depth from one coordinate at 1.8 m", reference=CLOSED, predicts=RUNNING, unit="relative",
        ),
        *family(
            group, "range", check.one_coordinate,
            {"direction": ("vertical", "horizontal"), "baseline_mm": (160.0,), "range_m": RANGES},
            computes="depth from one coordinate", reference=CLOSED, predicts=RUNNING, unit="relative",
        ),
        *family(
            group, "short baseline and long range", check.one_coordinate,
            {"direction": ("vertical",), "baseline_mm": (1.0, 0.01), "range_m": (20.0, 100.0)},
            computes="depth from one coordinate", reference=CLOSED, predicts=RUNNING, unit="relative",
        ),
        *family(
            group, "turned projector ahead of the camera", check.one_coordinate,
            {"direction": ("vertical", "horizontal"), "range_m": (0.3, 1.8, 100.0), "baseline_mm": (160.0, 0.01),
             "turned": (1,)},
            computes="depth from one coordinate, general pose", reference=CLOSED, predicts=RUNNING, unit="relative",
        ),
        *family(
            group, "both directions", check.both_coordinates,
            {"noise_px": (0.0, 0.5), "ahead": (0.0, 0.3, 1.0), "baseline_mm": BASELINES[:4]},
            computes="depth by weighted least squares of both coordinates", unit="relative",
            reference="the minimum, by Newton's method in 50 digits",
            predicts="8 x the closed form's bound + start error x (Gauss-Newton contraction + 4 start error)^3",
            expects="either",
        ),
        *family(
            group, "noise law", check.noise_law,
            {"direction": ("vertical", "horizontal"), "baseline_mm": BASELINES},
            computes="rms depth error over sigma_u Z^2 / (f_p b), minus 1; or the share without depth, minus Phi",
            reference="rig.md's law; where noise is over a fifth of the depth, the normal law of inverse depth",
            predicts="4 standard errors of 20,000 draws, and 8 (sigma_Z / Z)^2 of second order", unit="1",
        ),
        *family(
            group, "nearly parallel rays", check.near_parallel,
            {"shift_px": (10.0, 1.0, 1e-3, 1e-6, 1e-9, 1e-11, 1e-12, 0.0, -1e-6, -1.0)},
            computes="depth of a projector plane this many px from parallel", reference=CLOSED,
            predicts=RUNNING + "; masked where it lies behind", unit="relative", expects="either",
        ),
        *family(
            group, "point at infinity", check.point_at_infinity, {},
            computes="depth where ray and projector plane are exactly parallel", reference="there is none",
            predicts="must be masked", unit="mm", expects="refusal",
        ),
        *family(
            group, "far plane through the decoder", check.decoded_far, {"range_m": (0.3, 1.0, 3.2, 20.0, 100.0)},
            computes="decoded depth of a plane outside the working range", reference="the working range",
            predicts="must be masked", unit="mm", expects="refusal",
        ),
        *family(
            group, "behind the projector", check.behind_projector, {"ahead_m": (0.5, 1.0, 3.0)},
            computes="depth of points that lie behind a projector ahead of the camera", reference="there is none",
            predicts="must be masked", unit="mm", expects="refusal",
        ),
        *family(
            group, "projector behind the surface", check.lit_from_behind, {},
            computes="projector light on a surface lit from its far side", reference="none reaches the camera",
            predicts="exactly 0, so the decoder masks it for want of modulation", unit="grey", expects="refusal",
        ),
        *family(
            group, "float32 coordinate", check.single_coordinate_in,
            {"range_m": (0.3, 1.8, 100.0), "baseline_mm": BASELINES},
            computes="depth from a coordinate rounded to float32",
            reference="depth from the float64 coordinate, 50 digits",
            predicts="2^-24 kappa, kappa = u_p / (u_p - u_infinity); not checked where that is over 1/2",
            unit="relative", expects="either",
        ),
        *family(
            group, "float32 calibration layer", check.single_layer,
            {"range_m": (0.3, 1.8, 100.0), "baseline_mm": BASELINES},
            computes="depth by the phase route's calibration layer in float32", reference="the depth put in",
            predicts="2^-24 (sum of phase magnitudes / |psi| + 6)", unit="relative",
        ),
        *family(
            group, "impossible coordinates", check.overflowing,
            {"value": (1e308, -1e308, 1e16, float("inf"), float("nan"))},
            computes="depth from coordinates that no projector has", reference="finite and positive, or masked",
            predicts="must be masked where there is no depth", unit="mm", expects="either",
        ),
        *family(
            group, "no weight", check.no_weight, {},
            computes="depth from two directions without modulation", reference="there is none",
            predicts="must be masked", unit="mm", expects="refusal",
        ),
    ]  # fmt: skip
