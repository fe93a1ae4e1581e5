"""``fpp-bench fuse``: an object's views in one point cloud, and the pixels that other views contradict."""

from pathlib import Path

from fpp_ml_bench.baselines import views
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import SPLITS, command
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench predict phase data/full --out predictions
fpp-bench fuse predictions data/full --out fused
fpp-bench fuse predictions data/full --object power_drill --out fused
fpp-bench fuse depth_exact data/full --out fused-exact          the cloud of the exact depth
"""
)
def fuse(
    *,
    predictions: str = argument(
        "predictions of a split; or depth or depth_exact, the dataset's own (a folder: ./depth)", "PREDICTIONS"
    ),
    dataset: Path = argument("folder of a generated dataset", "DATASET"),
    split: str = option("test", "split of PREDICTIONS (default: test)", choices=SPLITS),
    only: str | None = option(None, "only this object (default: all of the split)", "NAME", flag="--object"),
    cell_mm: float = option(views.CELL_MM, "edge of the cells in which points are averaged (default: 2)", "MM"),
    out: Path = option(REQUIRED, "folder for {object}.ply (metres, object coordinates) and fusion.json", "DIR"),
) -> None:
    """Put the views of each object into one point cloud by their known placement, and compare them with each other.

    Prints what was counted. Raises FppBenchError for unusable predictions or data."""
    opened = DatasetFolder(dataset)
    name, count, objects = views.fuse_split(predictions, opened, split, out, only, cell_mm)
    counts = {}
    with progress_bar("fusing", count, "objects") as advance:
        for obj, row in objects:
            counts[obj] = row
            advance(1)
    table = Table(
        "object", numbers=("points in the cloud", "pixels with a depth", "contradicted"), title=printable(name)
    )
    for obj, row in counts.items():
        points, answered, wrong = (int(row[key] or 0) for key in ("cloud_points", "answered_px", "contradicted_px"))
        table.add_row(obj, f"{points:,}", f"{answered:,}", f"{wrong:,} ({_percent(wrong, answered)})")
    show(table)
    answered, wrong = (sum(int(row[key] or 0) for row in counts.values()) for key in ("answered_px", "contradicted_px"))
    print(f"other views contradict {wrong:,} of {answered:,} pixels with a depth ({_percent(wrong, answered)})")
    print(f"{out}: {{object}}.ply, {views.FUSION_FILE}")


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f}%" if whole else "-"
