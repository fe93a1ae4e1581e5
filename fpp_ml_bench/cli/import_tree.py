"""``fpp-bench import``: a published tree, or a scanner's captures, into the dataset format."""

import argparse
import sys
from pathlib import Path
from time import perf_counter

from fpp_ml_bench import calibration, coding, optics
from fpp_ml_bench.cli.calibrate import print_fit
from fpp_ml_bench.cli.console import gigabytes, progress_bar, show
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders import captures, published, storage
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.tables import Table

SUMMARY = (
    "Read a published tree (PNG fringes, .mat depth, raw scans), or the captures of a scanner, into the same dataset\n\
format as a build."
)
EXAMPLES = (
    "fpp-bench import fpp-ml-bench data/published",
    "fpp-bench import fpp-ml-bench data/published --frame-order paper",
    "fpp-bench import my-scans data/mine --rig my-rig.yaml",
    "fpp-bench import my-scans data/mine --fit-rig               find the rig from frames and depth, as calibrate does",
    "fpp-bench import --captures my-captures data/mine --rig my-rig.yaml --splits splits.yaml",
    "",
    "TREE holds training_datasets/ (training_data_depth_raw, or the global or individual variant) and, if there are",
    "raw scans, fpp_synthetic_dataset/. The tree's split is used. If files break the layout, they are all listed and",
    "nothing is imported. Frame orders: paper, vertical-first, by-direction, by-direction-vertical-first, with any of",
    "+white-first, +backward-steps, +least-bit-first; the order is checked on the images.",
    "",
    "With --captures, TREE holds a folder for each object, with a folder of frames for each view, or with the frames",
    "of a single view: as many images as the rig's sequence has, in the order of their names. The rig decodes them",
    "into the ground truth. splits.yaml lists the objects under train, validation and test.",
)
_CAPTURE_OPTIONS = "splits", "bits", "colour", "min_modulation", "max_clipped_steps", "max_disagreement", "anyway"
_MOST_SHOWN = 30


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tree", type=Path, metavar="TREE", help="folder that holds training_datasets/, or captures")
    parser.add_argument("out", type=Path, metavar="OUT", help="new folder, or the folder of an interrupted import")
    parser.add_argument("--workers", type=int, metavar="N", help="processes (default: one per processor)")
    rig = parser.add_mutually_exclusive_group()
    rig.add_argument(
        "--rig", type=Path, metavar="FILE", help="rig that took the images, YAML or JSON (default: the paper's, scaled)"
    )
    rig.add_argument(
        "--fit-rig", action="store_true", help="find projector and pitch from raw scans and depth (fpp-bench calibrate)"
    )
    parser.add_argument(
        "--frame-order",
        default="auto",
        metavar="NAME",
        help="order of the raw scans' files (default: auto, determined from the images)",
    )
    add = parser.add_argument_group("captures without depth").add_argument
    add("--captures", action="store_true", help="TREE holds captures, which --rig decodes into the ground truth")
    add(
        "--splits",
        type=Path,
        metavar="FILE",
        help="YAML lists of objects under train, validation and test (default: all in test)",
    )
    add("--bits", type=int, metavar="N", help="bits of the camera, 8 to 16 (default: found in the images)")
    add(
        "--colour",
        metavar="NAME",
        help="what to take of colour images: luminance, red, green, blue or mean (default: refuse them)",
    )
    add(
        "--min-modulation",
        type=float,
        metavar="GREY",
        help="least modulation of a pixel with depth, grey levels of 255 (default: 5)",
    )
    add(
        "--max-clipped-steps",
        type=int,
        metavar="N",
        help="phase steps that may be saturated at a pixel (default: a ninth of them)",
    )
    add("--anyway", action="store_true", default=None, help="import captures that their examination refuses, too")
    add(
        "--max-disagreement",
        type=float,
        metavar="PX",
        help="largest distance of both directions' coordinates from the epipolar line (default: 1.5)",
    )


def run(args: argparse.Namespace) -> int:
    """Import, and print a summary. Raises FppBenchError for an unusable tree, captures, rig or folder."""
    workers = usable_cores() if args.workers is None else args.workers
    if workers < 1:
        raise BuildError(f"--workers {workers}: expected 1 or more")
    return _run_captures(args, workers) if args.captures else _run_tree(args, workers)


def _run_captures(args: argparse.Namespace, workers: int) -> int:
    if args.rig is None:
        raise BuildError(
            "--captures: the rig that took them is missing; give its file with --rig (fpp-bench calibrate)"
        )
    if args.frame_order != "auto":
        raise BuildError("--frame-order belongs to published trees; captures have the order of their rig's sequence")
    given = {
        "min_modulation": args.min_modulation,
        "max_clipped_steps": args.max_clipped_steps,
        "max_disagreement_px": args.max_disagreement,
    }
    limits = coding.Limits(**{name: value for name, value in given.items() if value is not None})
    splits = None if args.splits is None else captures.read_splits(args.splits)
    plan = captures.plan_captures(
        args.tree, optics.load_rig(args.rig), splits, limits, args.bits, args.colour, bool(args.anyway)
    )
    count, images = len(plan.reader.captures), len(plan.reader.rig.sequence)
    started = perf_counter()
    with progress_bar("importing", count, "images", images) as advance:
        manifest = captures.import_captures(args.out, plan, workers, advance)
    _print_captures(manifest)
    _print_end(args.out, manifest, images, perf_counter() - started, captures.capture_notes(manifest))
    return 0


def _print_captures(manifest: "storage.Manifest") -> None:
    """Print what was decoded of each capture, those with the least first where there are many."""
    rows = [row for part in manifest.samples.values() for row in part]
    shown = rows if len(rows) <= _MOST_SHOWN else sorted(rows, key=lambda row: row["decoded_share"])[:_MOST_SHOWN]
    reasons = [reason.name.lower() for reason in coding.Reason]
    reasons = [name for name in reasons if any(name in row["refused_share"] for row in shown)]
    more = f", the {len(shown)} of {len(rows)} captures with the least decoded" if len(shown) < len(rows) else ""
    titles = "decoded", "modulation", *(name.replace("_", " ") for name in reasons)
    table = Table("", numbers=titles, title=f"pixels decoded, their median modulation, and pixels refused{more}")
    for row in shown:
        refused = (f"{100 * row['refused_share'].get(name, 0.0):.1f}%" for name in reasons)
        table.add_row(row["sample"], f"{100 * row['decoded_share']:.1f}%", f"{row['median_modulation']:.1f}", *refused)
    show(table)


def _print_end(out: Path, manifest: "storage.Manifest", images: int, seconds: float, notes: list[str]) -> None:
    size, count = sum(file.bytes for file in manifest.files), sum(map(len, manifest.samples.values()))
    parts = ", ".join(f"{split} {len(rows)}" for split, rows in manifest.samples.items())
    print(f"{out}: {parts} samples, {count * images:,} images, {gigabytes(size)} in {seconds:.1f} s")
    for note in notes:
        print(f"  {note}")
    print(f"next: fpp-bench info {out}")


def _run_tree(args: argparse.Namespace, workers: int) -> int:
    for name in _CAPTURE_OPTIONS:
        if getattr(args, name) is not None:
            raise BuildError(f"--{name.replace('_', '-')} belongs to captures without depth; give --captures too")
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
    _print_end(args.out, manifest, images, perf_counter() - started, published.import_notes(manifest))
    if rig is None:
        _warn_of_other_rig(args.tree, published.depth_difference_mm(plan.reader))
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
