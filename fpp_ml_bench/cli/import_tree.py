"""``fpp-bench import``: a published tree into the dataset format."""

import argparse
import sys
from pathlib import Path
from time import perf_counter

from fpp_ml_bench import calibration, optics
from fpp_ml_bench.cli.calibrate import print_fit
from fpp_ml_bench.cli.console import gigabytes, progress_bar
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders import published
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Read a published tree (PNG fringes, .mat depth, raw scans) into the same dataset format as a build."
EXAMPLES = (
    "fpp-bench import fpp-ml-bench data/published",
    "fpp-bench import fpp-ml-bench data/published --frame-order paper",
    "fpp-bench import my-scans data/mine --rig my-rig.yaml",
    "fpp-bench import my-scans data/mine --fit-rig               find the rig from frames and depth, as calibrate does",
    "",
    "TREE holds training_datasets/ (training_data_depth_raw, or the global or individual variant) and, if there are",
    "raw scans, fpp_synthetic_dataset/. The tree's split is used. If files break the layout, they are all listed and",
    "nothing is imported. Frame orders: paper, vertical-first, by-direction, by-direction-vertical-first, with any of",
    "+white-first, +backward-steps, +least-bit-first; the order is checked on the images.",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tree", type=Path, metavar="TREE", help="folder that holds training_datasets/")
    parser.add_argument("out", type=Path, metavar="OUT", help="new folder, or the folder of an interrupted import")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per processor)")
    rig = parser.add_mutually_exclusive_group()
    rig.add_argument("--rig", type=Path, metavar="FILE",
                     help="rig that took the images, YAML or JSON (default: the paper's, scaled)")  # fmt: skip
    rig.add_argument("--fit-rig", action="store_true",
                     help="find projector and pitch from raw scans and depth (fpp-bench calibrate)")  # fmt: skip
    parser.add_argument("--frame-order", default="auto", metavar="NAME",
                        help="order of the raw scans' files (default: auto, determined from the images)")  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Import, and print a summary. Raises FppBenchError for an unusable tree, rig or folder."""
    workers = usable_cores() if args.workers is None else args.workers
    if workers < 1:
        raise BuildError(f"--workers {workers}: expected 1 or more")
    rig = None if args.rig is None else optics.load_rig(args.rig)
    plan = published.plan_import(args.tree, rig, args.frame_order)
    if args.fit_rig:
        with progress_bar("reading", len(plan.reader.tree.by_name), "views") as advance:
            views = published.tree_views(plan.reader, workers, advance)
        rig, fit = calibration.fit_projector(views, plan.reader.rig)
        print_fit(rig, fit)
        plan = published.plan_import(args.tree, rig, args.frame_order)
    sample_count = len(plan.reader.tree.by_name)
    images = len(plan.assembly.manifest.stored_frames)
    started = perf_counter()
    with progress_bar("importing", sample_count, "images", images) as advance:
        manifest = published.import_tree(args.out, plan, workers, advance)
    seconds = perf_counter() - started
    size = sum(file.bytes for file in manifest.files)
    parts = ", ".join(f"{split} {len(rows)}" for split, rows in manifest.samples.items())
    print(f"{args.out}: {parts} samples, {sample_count * images:,} images, {gigabytes(size)} in {seconds:.1f} s")
    for note in published.import_notes(manifest):
        print(f"  {note}")
    if rig is None:
        _warn_of_other_rig(args.tree, published.depth_difference_mm(plan.reader))
    print(f"next: fpp-bench info {args.out}")
    return 0


def _warn_of_other_rig(tree: Path, difference_mm: float | None) -> None:
    """Say so where the assumed rig decodes other depths than the tree has."""
    if difference_mm is None or difference_mm <= published.AGREEING_MM:
        return
    off = f"{difference_mm:.1f} mm off in the median" if difference_mm < float("inf") else "none at most pixels"
    print(
        f"warning: the paper's rig did not take these raw scans: the depth it decodes from the first is {off}. Find "
        f"their rig by fpp-bench calibrate --from-depth {tree} --out rig.yaml and import with --rig rig.yaml, or "
        "import with --fit-rig",
        file=sys.stderr,
    )
