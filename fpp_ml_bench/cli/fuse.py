"""``fpp-bench fuse``: an object's views in one point cloud, and the pixels that other views contradict."""

import argparse
from pathlib import Path

from fpp_ml_bench.cli import SPLITS
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders import storage

SUMMARY = (
    "Put the views of each object into one point cloud by their known placement, and compare them with each other."
)
EXAMPLES = (
    "fpp-bench predict phase data/full --out predictions",
    "fpp-bench fuse predictions --dataset data/full --out fused",
    "fpp-bench fuse predictions --dataset data/full --object power_drill --out fused",
    "fpp-bench fuse depth_exact --dataset data/full --out fused-exact          the cloud of the exact depth",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "predictions",
        metavar="PREDICTIONS",
        help="predictions of a split; or depth or depth_exact, the dataset's own (a folder: ./depth)",
    )
    add("--dataset", type=Path, required=True, metavar="DATASET", help="folder of a generated dataset")
    add("--split", choices=SPLITS, default="test", help="split of PREDICTIONS (default: test)")
    add("--object", metavar="NAME", help="only this object (default: all of the split)")
    add("--cell-mm", type=float, metavar="MM", help="edge of the cells in which points are averaged (default: 2)")
    add(
        "--out",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder for {object}.ply (metres, object coordinates) and fusion.json",
    )


def run(args: argparse.Namespace) -> int:
    """Fuse, write, print what was counted. Raises FppBenchError for unusable predictions or data."""
    from fpp_ml_bench.baselines import views
    from fpp_ml_bench.cli.console import progress_bar, show
    from fpp_ml_bench.tables import Table

    dataset = storage.DatasetFolder(args.dataset)
    cell_mm = views.CELL_MM if args.cell_mm is None else args.cell_mm
    name, objects = views.fuse_split(args.predictions, dataset, args.split, args.object, cell_mm)
    counts = {}
    with progress_bar("fusing", len(views.views_by_object(dataset, args.split, args.object)), "objects") as advance:
        for fused in objects:
            views.write_object(args.out, fused)
            counts[fused.name] = fused.counts
            advance(1)
    views.write_counts(args.out, name, dataset, args.split, cell_mm, counts)
    table = Table(
        "object", numbers=("points in the cloud", "pixels with a depth", "contradicted"), title=printable(name)
    )
    for obj, row in counts.items():
        points, answered, wrong = (int(row[key] or 0) for key in ("cloud_points", "answered_px", "contradicted_px"))
        table.add_row(obj, f"{points:,}", f"{answered:,}", f"{wrong:,} ({_percent(wrong, answered)})")
    show(table)
    answered, wrong = (sum(int(row[key] or 0) for row in counts.values()) for key in ("answered_px", "contradicted_px"))
    print(f"other views contradict {wrong:,} of {answered:,} pixels with a depth ({_percent(wrong, answered)})")
    print(f"{args.out}: {{object}}.ply, {views.FUSION_FILE}")
    return 0


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.1f}%" if whole else "-"
