"""Losses and networks: zero residual, empty mask, constant input, overflow of half precisions, gradients."""

from fpp_ml_bench.baselines.networks import NETWORKS
from fpp_ml_bench.baselines.stability import losses_checks as losses
from fpp_ml_bench.baselines.stability import networks_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family
from fpp_ml_bench.baselines.training import LOSSES

RICHARDSON = "difference of two extrapolations (the next order) + 64 u |f| sqrt(n) / h of rounding"


def cases() -> list[Case]:
    """The cases of this group."""
    group = "networks"
    return [
        *family(
            group, "zero residual", losses.zero_residual, {"name": LOSSES},
            computes="loss and gradient of a perfect prediction", reference="1e-4 for RMSE, else 0; gradient exactly 0",
            predicts="4 u32: one root of e = 1e-8", unit="1",
        ),
        *family(
            group, "empty mask", losses.empty_mask, {"name": LOSSES},
            computes="loss and gradient without object pixels", reference="exactly rounded sums; 0 where masked",
            predicts="32 u32: torch's pairwise sums", unit="1",
        ),
        *family(
            group, "loss magnitude", losses.loss_magnitude,
            {"name": ("rmse", "hybrid_l1"), "scale": (1e-30, 1e-6, 1.0, 2e3, 1e15, 1e25)},
            computes="float32 loss of errors of this size", reference="exactly rounded sums in float64",
            predicts="2 (log2 n + 16) u32: pairwise sums; beyond 1e19 the square is infinite, and training stops",
            unit="1", expects=lambda name, scale: "either" if scale > 1e19 else "number",
        ),
        *family(
            group, "half-precision loss", losses.loss_half,
            {"name": ("rmse", "hybrid_l1"), "dtype": ("float16", "bfloat16"), "scale": (1.0, 2e3, 3e4, 1e5)},
            computes="loss of half-precision tensors in mm", reference="exactly rounded sums of the same input",
            predicts="2 (log2 n + 16) u32: computed in float32; infinite input gives an infinite loss", unit="1",
            expects=lambda name, dtype, scale: "either" if dtype == "float16" and scale > 3e4 else "number",
        ),
        *family(
            group, "constant input, instance norm", check.constant_input,
            {"dtype": ("float32", "float64"), "value": (0.0, 0.1, 1.0, 255.0, 1e4, 1e8, 1e-30)},
            computes="output and gradient of a map without variance", reference="the bias",
            predicts="d / sqrt(d^2 + eps), d = (log2 n + 16) u |value|, or that factor twice: the mean, centred again",
            unit="1",
        ),
        *family(
            group, "nearly constant input, instance norm", check.nearly_constant,
            {"offset": (0.0, 1.0, 1e2, 1e4, 1e6)},
            computes="normalised map of amplitude 1 on this offset, float32", reference="float64 on the same input",
            predicts="2 (min(g |offset|, 1e-3 + g^2 |offset|) + g |x| + g), g = (log2 n + 16) u32", unit="1",
        ),
        *family(
            group, "instance norm gradient", check.instance_norm_gradient, {},
            computes="closed-form gradient in float64", reference="torch's own instance norm in float64",
            predicts="12 u sum |seed|", unit="1",
        ),
        *family(
            group, "loss gradient", losses.loss_gradient, {"name": LOSSES},
            computes="directional derivative in float64", reference="Richardson's extrapolated differences",
            predicts=RICHARDSON, unit="1",
        ),
        *family(
            group, "calibration layer gradient", check.layer_gradient, {"direction": ("horizontal", "vertical")},
            computes="directional derivative of depth by phase", reference="Richardson's extrapolated differences",
            predicts=RICHARDSON, unit="mm/rad",
        ),
        *family(
            group, "network gradient", check.network_gradient, {"name": NETWORKS},
            computes="directional derivative of the whole network, float64",
            reference="Richardson's extrapolated differences", predicts=RICHARDSON, unit="1",
        ),
        *family(
            group, "network in float32", check.network_single, {"name": NETWORKS},
            computes="output in float32", reference="the same weights in float64",
            predicts="16 x what rounding each weight and pixel once (2^-24) does: condition number x unit round-off",
            unit="1",
        ),
        *family(
            group, "network on a constant image", check.network_constant, {"name": NETWORKS, "value": (0.0, 0.5, 1.0)},
            computes="numbers that are not finite in output and gradients, training mode", reference="none",
            predicts="exact", unit="count",
        ),
        *family(
            group, "network in half precision", check.network_half,
            {"name": NETWORKS, "dtype": ("bfloat16", "float16")},
            computes="depth of the last layer under autocast, 1800 mm", reference="float64 on the same features",
            predicts="10 u32 x 1810 mm: the last layer runs in float32; bfloat16 alone would be 4 mm off", unit="mm",
        ),
        *family(
            group, "phase route", check.phase_output,
            {"name": ("phase", "phase-net"), "image": ("black", "white", "constant", "noise", "checkerboard")},
            computes="depth of an image without an object", unit="mm", expects="either",
            reference="a depth in the working range and its slack of 15 mm, or a reason why it is invalid",
            predicts="exact: no other depth may count as measured",
        ),
        *family(
            group, "training metric", losses.metric_scale, {"scale": (1.0, 1e-30, 1e30, 1e-160, 1e-300)},
            computes="mean RMSE of 50 samples as a torchmetrics metric", reference="exactly rounded sums",
            predicts="gamma of 460 roundings", unit="relative",
        ),
        *family(
            group, "training metric, not a number", losses.metric_refuses,
            {"value": (float("nan"), float("inf"), 1e200)},
            computes="a score of a prediction with a pixel of this value", reference="there is none",
            predicts="must be refused", unit="mm", expects="refusal",
        ),
    ]  # fmt: skip
