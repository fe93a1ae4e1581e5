"""The scoring protocol's fixed points: version, metric names, limits. PROTOCOL.md says the same in prose.

A change that can move any number in a result raises `PROTOCOL_VERSION`; a change of the file's form raises
`RESULT_SCHEMA_VERSION`. Results of different protocol versions are never ranked together.
"""

from typing import Literal, get_args

PROTOCOL_VERSION = "1.0.0"
SchemaVersion = Literal["1.0.0"]
RESULT_SCHEMA_VERSION: SchemaVersion = "1.0.0"

Target = Literal["depth", "depth_exact"]
Track = Literal["metric", "oracle range"]
TARGETS: tuple[str, ...] = get_args(Target)

EDGE_BAND_PX = 3
"""Object pixels nearer than this to a depth edge form the edge set, the others the interior."""

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
"""Reported beside the headline: the object away from and along depth edges, and what was not measured at all."""

METRICS = HEADLINE + BESIDE

LARGEST_MM = 1e30
"""Magnitudes above this are refused: the numerical contract of the scores ends there (see PROTOCOL.md)."""

METRES_BELOW = 10.0
MILLIMETRES_ABOVE = 1000.0
"""A prediction whose largest value is under METRES_BELOW, for a target above MILLIMETRES_ABOVE, is not in mm."""
