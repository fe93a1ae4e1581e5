"""The benchmark's constants, in one place: objects and their split, views, working range, units.

Sources: paper Section 3 (50 objects, 6 views by 60 degrees, 80/10/10 split by object, range 1.5-2.1
m) and the public list of its objects. The paper does not list the split; it is defined here, with
the four objects of the paper's test figures in test.
"""

import math
import re

SCHEMA_VERSION = "3.0.0"

TAU = 2 * math.pi
GOLDEN = 0.6180339887498949
"""Inverse of the golden ratio. Multiples of it, without their whole part, fill the interval from 0
to 1 evenly."""
PLASTIC = 0.7548776662466927
"""Inverse of the plastic number: multiples of it do so too, and with those of its square they fill
the plane evenly (the sequence R2, Roberts 2018)."""
MM_PER_M = 1000.0
GREY_LEVELS = 255
LARGEST_SIDE_PX = 8192
"""Of an image that is rendered, and of a depth map whose dataset is not known."""

WORKING_RANGE_MM = (1500.0, 2100.0)
STANDOFF_M = 1.8
BACKGROUND_M = 3.2

SPLITS = ("train", "validation", "test")
TRAIN = SPLITS[0]
"""The split that methods may learn from."""
PUBLISHED_SPLIT_FOLDERS = {"train": "train", "validation": "val", "test": "test"}

VIEW_DEGREES = (0, 60, 120, 180, 240, 300)
VIEWS = tuple(f"A{degrees}" for degrees in VIEW_DEGREES)
CONFIGS = (
    "single_shot",
    "crossed",
    "first_frames",
    "horizontal",
    "vertical",
    "sinusoidal",
    "all",
)
"""Configurations of a dataset: which frames of a sample are read (paper Section 5.4). Ours are
``crossed``, of sets with such frames, and ``first_frames``: these and the first of each direction,
what any method of one frame reads."""

OBJECTS = (
    "master_chef_can",
    "cracker_box",
    "sugar_box",
    "tomato_soup_can",
    "mustard_bottle",
    "tuna_fish_can",
    "pudding_box",
    "gelatin_box",
    "potted_meat_can",
    "banana",
    "pitcher",
    "bleach_cleanser",
    "bowl",
    "mug",
    "power_drill",
    "wood_block",
    "scissors",
    "marker",
    "large_clamp",
    # YCB above, warehouse below
    "eyeglasses",
    "open_book",
    "spray_bottle",
    "cleaning_bucket",
    "container_bottle",
    "container_tin",
    "vial",
    "lighting_candles",
    "magazine_stack",
    "wooden_boards",
    "paint_container_bottle",
    "paint_container_jar",
    "paint_container_spraycan",
    "paint_container_tube_small",
    "paint_container_tube",
    "paint_container_tube_large",
    "paint_brush",
    "paint_brush_large",
    "pallet_knife",
    "pallet_knife_large",
    "spraygun",
    "paint_thinner",
    "battery",
    "battery_case",
    "chalk_stick",
    "pen",
    "cork",
    "clamp",
    "boxcutter",
    "hammer",
    "duct_tape",
)

VALIDATION_OBJECTS = (
    "mustard_bottle",
    "mug",
    "paint_brush_large",
    "paint_container_jar",
    "spraygun",
)
TEST_OBJECTS = ("power_drill", "magazine_stack", "container_bottle", "wooden_boards", "large_clamp")

UNSEEN = (
    "blob",
    "concave_dish",
    "cone_stack",
    "gear",
    "hinged_leaves",
    "hollow_cube",
    "honeycomb",
    "perforated_plate",
    "saddle",
    "sphere_pair",
    "spiral_shell",
    "stair_tower",
    "step_wedge",
    "tall_column",
    "thin_fin",
    "torus_knot",
    "turbine_blade",
    "v_groove",
    "wave_plate",
    "wire_loop",
)
"""Objects of a second test set, of kinds that are not among `OBJECTS`. It is for measuring, never
for choosing."""

# The mini preset: six objects from all splits, among them the extremes of the test figures (a
# concave union of parts and the deepest object).
MINI_OBJECTS = ("bowl", "cracker_box", "banana", "mug", "power_drill", "wooden_boards")
MINI_SIZE = 480
FULL_SIZE = 960
PRESETS: dict[str, tuple[tuple[str, ...], int]] = {
    "mini": (MINI_OBJECTS, MINI_SIZE),
    "full": (OBJECTS, FULL_SIZE),
    "unseen": (UNSEEN, FULL_SIZE),
    "test": (tuple(name for name in OBJECTS if name in TEST_OBJECTS), FULL_SIZE),
}
"""Objects and image width of each."""


def split_of(name: str) -> str:
    """Split of a benchmark or unseen object: ``train``, ``validation`` or ``test``."""
    if name in TEST_OBJECTS or name in UNSEEN:
        return "test"
    return "validation" if name in VALIDATION_OBJECTS else "train"


OBJECT_NAME, VIEW_NAME = re.compile(r"\w[\w-]{0,99}"), re.compile(r"[^\W_]([^\W_]|-){0,99}")
SAMPLE_NAME = re.compile(f"{OBJECT_NAME.pattern}_{VIEW_NAME.pattern}")
"""Names that a dataset may have; they become names of files."""
REPOSITORY_NAME = re.compile(
    r"(?!.*(--|\.\.|\.git$))\w[\w.-]{0,95}/\w[\w.-]{0,95}(?<![.-])", re.ASCII
)
"""OWNER/NAME of a repository of the Hugging Face Hub."""


def sample_name(name: str, view: str) -> str:
    """``{object}_{view}``, the stem of every file of a sample (published layout)."""
    return f"{name}_{view}"


def split_sample_name(sample: str) -> tuple[str, str]:
    """Object and view of a sample name, split at the LAST underscore, because object names contain
    underscores."""
    name, _, view = sample.rpartition("_")
    if not name or not view:
        raise ValueError(f"expected a sample name like 'power_drill_A60', got {sample!r}")
    return name, view


MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
