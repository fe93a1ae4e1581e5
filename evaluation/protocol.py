"""Constants of the scoring protocol: version, metric names, limits. PROTOCOL.md explains them. A change that can move
any number in a result raises `PROTOCOL_VERSION`; a change of the file format raises `RESULT_SCHEMA_VERSION`. Results of
different protocol versions are never ranked together."""

from typing import Literal, get_args

PROTOCOL_VERSION = "3.0.0"
"""Since 3.0.0, object and void against ``depth_exact`` follow from scene and light alone; the rules against ``depth``
are those of 2.0.0."""
SchemaVersion = Literal["3.0.0"]
RESULT_SCHEMA_VERSION: SchemaVersion = "3.0.0"
"""What is written, and the only version that is read. Since 3.0.0 ``dataset.content`` says what was scored against."""

Target = Literal["depth", "depth_exact"]
Track = Literal[
    "metric",
    "oracle mask",
    "oracle order",
    "oracle range",
    "oracle mask + order",
    "oracle range + mask",
    "oracle range + order",
    "oracle range + mask + order",
]
"""What a method was given of the ground truth of the scored samples; see PROTOCOL.md."""
Mode = Literal["standard", "paper", "paper-individual"]
"""By which rules; see PROTOCOL.md. ``paper-individual`` stands in results of protocol 1 only: ``paper`` for normalised
depth."""
FramesClass = Literal["one frame", "few frames, no code", "full sequence"]
"""What a method captures: at most one frame; several but no Gray code; frames with Gray code."""
Units = Literal["mm", "m", "normalised"]
TARGETS: tuple[str, ...] = get_args(Target)
MODES: tuple[Mode, ...] = ("standard", "paper")
FRAMES_CLASSES: tuple[FramesClass, ...] = get_args(FramesClass)


def scored_columns(target: str, mode: str, flags: bool) -> tuple[str, ...]:
    """Columns of a dataset whose content identifies what was scored against: the depth, and by the rules that know void
    pixels the flags that tell them (``flags``: whether the dataset has any)."""
    return (target, "flags") if mode == "standard" and flags else (target,)


EDGE_BAND_PX = 3
"""Object pixels nearer than this to a depth edge form the edge set, the others the interior."""
WIDE_BAND_PX = 8
"""The same split at a fixed width, reported in every result whatever ``--edge-band`` is: results stay comparable."""

PIXEL_SETS = ("overall", "object", "background")
HEADLINE = tuple(f"{pixels}_{error}_mm" for pixels in PIXEL_SETS for error in ("mae", "rmse"))
"""The paper's six numbers (Section 5.3.2): MAE and RMSE over the full grid, the object and the background, in mm."""

BESIDE = (
    "object_interior_mae_mm",
    "object_interior_rmse_mm",
    "object_edge_mae_mm",
    "object_edge_rmse_mm",
    "object_valid_mae_mm",
    "object_interior_valid_mae_mm",
    "object_edge_share",
    "object_missing_share",
    "object_interior_missing_share",
)
"""Reported beside the headline: the object away from and along depth edges, and the pixels that were not measured."""

WITHIN_MM = (1, 2, 5, 10)
WITHIN = tuple(f"object_within_{limit}mm_share" for limit in WITHIN_MM)
SIGNED = ("object_bias_mm", "object_valid_bias_mm")
"""The only scores that may be negative: the others are magnitudes or shares."""
DISTRIBUTION = (
    "object_median_mm",
    "object_p95_mm",
    "object_max_mm",
    *WITHIN,
    *SIGNED,
    "object_shift_free_mae_mm",
)
"""How the error is distributed over the object: order statistics, tolerances, bias, and the error without an offset
(the MAE once the median error has been subtracted)."""
WIDE_BAND = ("object_wide_band_mae_mm", "object_wide_interior_mae_mm", "object_wide_band_share")

RANGE_SHARE = "object_mae_range_share"
"""Object MAE over the depth range of the sample's scored object pixels, the only share that may exceed 1."""
SINCE_2 = ("void_share", "unlit_mae_mm", "unlit_rmse_mm", "unlit_valid_mae_mm", "unlit_missing_share", RANGE_SHARE)
"""The share of the image that counts in no set, scores of its unlit pixels, against ``depth_exact``
only, and `RANGE_SHARE`. Left out of a result where no sample has them."""

METRICS = HEADLINE + BESIDE + DISTRIBUTION + WIDE_BAND + SINCE_2
HIGHER_IS_BETTER = WITHIN
HELPED_BY_MISSING = (
    "object_valid_mae_mm",
    "object_interior_valid_mae_mm",
    "unlit_valid_mae_mm",
    *SIGNED,
    "object_shift_free_mae_mm",
)
"""Scores that a method can improve by answering fewer pixels; nothing is ranked or sorted by them."""

COVERED = (68, 95, 99)
NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Coverages of the intervals whose hits are counted; those of `COVERED`, in per cent, are scores of their own."""
LEFT_OUT = tuple(step / 20 for step in range(20))
"""Shares of the least sure object pixels that the sparsification curve leaves out."""
SURE_LEFT_OUT = 0.05
NLL_LEAST_SIGMA_MM, NLL_LARGEST_RATIO = 0.01, 10.0
"""The negative log-likelihood takes no sigma below the first, and no |error| / sigma above the second."""
UNCERTAINTY = (
    *(f"coverage_{percent}" for percent in COVERED),
    "sigma_mean_mm",
    "sigma_median_mm",
    "nll",
    "ause_mae_mm",
    "ause_rmse_mm",
    "sure_mae_mm",
    "sure_rmse_mm",
    "unstated_share",
)
"""Scores of a stated uncertainty (``{sample}.sigma.npy``), a block of their own in a result."""

LARGEST_MM = 1e30
"""Magnitudes above this are refused: the numerical contract of the scores ends there (see PROTOCOL.md)."""

METRES_BELOW, UNITS_APART = 10.0, 30.0
"""A prediction whose largest value is under METRES_BELOW, and UNITS_APART times smaller than the depths that there are,
is not in mm: it is nearer to a thousandth of them. One in m whose median is as many times larger is in mm."""
METRES_AT_MOST = 100.0
"""Where no rig and no target are known, larger values than this are hardly metres."""
NORMALISED_AT_MOST = 1.2
"""A normalised prediction whose median over the object is above this can't be a share of the sample's range."""

BOOTSTRAP_RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_250
CONFIDENCE = 0.95
MOST_OBJECTS, MOST_SAMPLES = 1_000, 10_000
"""Limits of a result: its intervals are computed again when it is read, from 10,000 resamples of all objects."""
