"""Constants of the scoring protocol: version, names, limits. PROTOCOL.md explains them. A change
that can move any number in a result raises `PROTOCOL_VERSION`; a change of the file format raises
`RESULT_SCHEMA_VERSION`. Results of different protocol versions are never ranked together."""

from typing import Literal, get_args

PROTOCOL_VERSION = "4.0.0"
"""Since 4.0.0 there are two-sided scores, and unanswered and invented pixels count in what is left
of the least sure; all other scores are those of 3.0.0."""
SchemaVersion = Literal["4.0.0"]
RESULT_SCHEMA_VERSION: SchemaVersion = "4.0.0"
"""What is written, and the only version that is read. Since 3.0.0 ``dataset.content`` says what was
scored against."""

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
Mode = Literal["standard", "paper"]
"""By which rules; see PROTOCOL.md."""
FramesClass = Literal["one frame", "few frames, no code", "full sequence"]
"""What a method captures: at most one frame; several but no Gray code; frames with Gray code."""
Units = Literal["mm", "m", "normalised"]
TARGETS: tuple[str, ...] = get_args(Target)
MODES: tuple[Mode, ...] = get_args(Mode)
FRAMES_CLASSES: tuple[FramesClass, ...] = get_args(FramesClass)


def scored_columns(target: str, mode: str, flags: bool) -> tuple[str, ...]:
    """Columns of a dataset whose content identifies what was scored against: the depth, and by the
    rules that know void pixels the flags that tell them (``flags``: whether the dataset has
    any)."""
    return (target, "flags") if mode == "standard" and flags else (target,)


EDGE_BAND_PX = 3
"""Object pixels nearer than this to a depth edge form the edge set, the others the interior."""
WIDE_BAND_PX = 8
"""The same split at a fixed width, reported in every result whatever ``--edge-band`` is: results
stay comparable."""

PIXEL_SETS = ("overall", "object", "background")
WITHIN_MM = (1, 2, 5, 10)

COVERED = (68, 95, 99)
NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.68, 0.7, 0.8, 0.9, 0.95, 0.99)
"""Coverages of the intervals whose hits are counted; those of `COVERED`, in per cent, are scores of
their own."""
LEFT_OUT = tuple(step / 20 for step in range(20))
"""Shares of the least sure object pixels that the sparsification curve leaves out."""
SURE_LEFT_OUT = 0.05
NLL_LEAST_SIGMA_MM, NLL_LARGEST_RATIO = 0.01, 10.0
"""The negative log-likelihood takes no sigma below the first, and no |error| / sigma above the
second."""
LARGEST_MM = 1e30
"""Magnitudes above this are refused: the numerical contract of the scores ends there (see
PROTOCOL.md)."""

METRES_BELOW, UNITS_APART = 10.0, 30.0
"""A prediction whose largest value is under METRES_BELOW, and UNITS_APART times smaller than the
depths that there are, is not in mm: it is nearer to a thousandth of them. One in m whose median is
as many times larger is in mm."""
METRES_AT_MOST = 100.0
"""Where no rig and no target are known, larger values than this are hardly metres."""
NORMALISED_AT_MOST = 1.2
"""A normalised prediction whose median over the object is above this can't be a share of the
sample's range."""

BOOTSTRAP_RESAMPLES = 10_000
BOOTSTRAP_SEED = 20_250
CONFIDENCE = 0.95
MOST_OBJECTS, MOST_SAMPLES = 1_000, 10_000
"""Limits of a result: its intervals are computed again when it is read, from 10,000 resamples of
all objects."""
