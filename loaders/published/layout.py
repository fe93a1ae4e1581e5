"""Names in the published tree (folders, variables, units), shared by import and export."""

from fpp_ml_bench.constants import VIEWS, split_sample_name
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import LayoutError

TRAINING = "training_datasets"
RAW_SCANS = "fpp_synthetic_dataset"
FRINGE, DEPTH = "fringe", "depth"
INFO = "info_depth_params"
INFO_VARIABLES = ("depth_min", "depth_max")

VARIANT_FOLDERS: dict[Normalisation, str] = {
    "raw": "training_data_depth_raw",
    "global": "training_data_depth_global_normalized",
    "individual": "training_data_depth_individual_normalized",
}
"""Folder of each depth representation; depth in mm is taken from the first that is present."""
BACKGROUND_REMOVED_FOLDERS: dict[Normalisation, str] = {
    name: folder.replace("training_data_depth", "training_data_bgremoved_depth")
    for name, folder in VARIANT_FOLDERS.items()
}
VARIABLES: dict[Normalisation, str] = {
    "raw": "depthMap", "global": "depthMapMeters", "individual": "depthMapNormalized",
}  # fmt: skip
WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS = "wrapped_phase.mat", "unwrapped_phase.mat", "z.csv"
WRAPPED_PHASE_VARIABLE, UNWRAPPED_PHASE_VARIABLE = "wph", "uph"
NOT_STORED = (WRAPPED_PHASE, UNWRAPPED_PHASE, HEIGHTS)
"""Files of a raw scan that are computed from its frames; the import ignores them."""

LISTED_PROBLEMS = 50


def frame_file(index: int) -> str:
    """File name of frame ``index`` in a raw scan."""
    return f"A_{index}.png"


def label_of(stem: str) -> tuple[str, str] | None:
    """Object and view in a file name without its suffix, None for any other name."""
    try:
        name, view = split_sample_name(stem)
    except ValueError:
        return None
    return (name, view) if view in VIEWS else None


def layout_error(root: object, problems: list[str]) -> LayoutError:
    """The error that lists the problems of a tree, at most `LISTED_PROBLEMS` of them."""
    shown = problems[:LISTED_PROBLEMS]
    if len(problems) > len(shown):
        shown.append(f"... and {len(problems) - len(shown)} more")
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    return LayoutError("\n  ".join([f"{root}: {count} with the published layout:", *shown]))
