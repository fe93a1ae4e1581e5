"""``fpp-bench calibrate``: the rig from captures."""

import argparse
from pathlib import Path

from rich.table import Column, Table

from fpp_ml_bench import calibration, optics
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import CalibrationError, RigError
from fpp_ml_bench.loaders import published
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Find the rig that took captures: projector, pose and fringe pitch, from frames and their depth."
EXAMPLES = (
    "fpp-bench calibrate --from-depth fpp-ml-bench --out rig.yaml",
    "fpp-bench calibrate --from-depth my-scans --out rig.yaml --camera my-rig.yaml --projector 1280x800",
    "fpp-bench calibrate --from-depth my-scans --out rig.yaml --pitch 18,18",
    "fpp-bench import my-scans data/mine --rig rig.yaml",
    "",
    "TREE is a published tree with raw scans (fpp-bench import --help). Phase and depth give the projector up to the",
    "size of its pixels, and with it the pitch in px. The pitch is given by --pitch or --focal, or taken from",
    "--projector, with square pixels and the principal point in the pattern's middle. Depth residuals compare what the",
    "rig found decodes from the frames with the tree's depth.",
)
_MOST_SHOWN = 30


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 1 and int(height) > 1):
        raise argparse.ArgumentTypeError(f"expected width x height in px such as 912x1140, got {text!r}")
    return int(width), int(height)


def _pitches(text: str) -> tuple[float, float]:
    """Pitches given as VERTICAL,HORIZONTAL or one for both."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(4 <= value < 65536 for value in values):
        raise argparse.ArgumentTypeError(f"expected a pitch of at least 4 px, or VERTICAL,HORIZONTAL, got {text!r}")
    return values[0], values[-1]


def _focal(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"expected a focal length in px, got {text!r}")
    return value


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--from-depth", type=Path, metavar="TREE", required=True,
                        help="published tree: raw scans and depth in mm")  # fmt: skip
    parser.add_argument("--out", type=Path, metavar="RIG", required=True, help="rig file to write, .yaml or .json")
    parser.add_argument("--camera", type=Path, metavar="FILE",
                        help="rig file with the camera and the frames' sequence (default: the paper's)")  # fmt: skip
    parser.add_argument("--projector", type=_size, metavar="WxH",
                        help="projector's size in px (default: that of --camera, 912x1140)")  # fmt: skip
    known = parser.add_mutually_exclusive_group()
    known.add_argument("--pitch", type=_pitches, metavar="PX",
                       help="fringe pitch in projector px if known, or VERTICAL,HORIZONTAL")  # fmt: skip
    known.add_argument("--focal", type=_focal, metavar="PX", help="projector's focal length in px if known")
    parser.add_argument("--lens", action="store_true", help="fit the projector's first radial lens term too")
    parser.add_argument("--frame-order", default="auto", metavar="NAME",
                        help="order of the raw scans' files (default: auto, determined from the images)")  # fmt: skip
    parser.add_argument("--workers", type=int, metavar="N", help="threads (default: one per processor)")


def run(args: argparse.Namespace) -> int:
    """Fit, write the rig, and print the residuals. Raises FppBenchError for an unusable tree, rig or file."""
    workers = usable_cores() if args.workers is None else args.workers
    if workers < 1:
        raise CalibrationError(f"--workers {workers}: expected 1 or more")
    if args.out.suffix.lower() not in (".yaml", ".yml", ".json"):
        raise RigError(f"{args.out}: expected a rig file ending in .yaml, .yml or .json")
    if not args.out.absolute().parent.is_dir():
        raise RigError(f"{args.out}: the folder {args.out.parent} does not exist; make it first")
    known_rig = None if args.camera is None else optics.load_rig(args.camera)
    reader = published.plan_import(args.from_depth, known_rig, args.frame_order).reader
    with progress_bar("reading", len(reader.tree.by_name), "views") as advance:
        views = published.tree_views(reader, workers, advance)
    rig, fit = calibration.fit_projector(
        views, reader.rig, args.projector, pitch_px=args.pitch, focal_px=args.focal, lens=args.lens
    )
    print_fit(rig, fit)
    optics.save_rig(rig, args.out)
    print(f"wrote {args.out}; next: fpp-bench import {args.from_depth} OUT --rig {args.out}")
    return 0


def print_fit(rig: "optics.Rig", fit: "calibration.DepthFit") -> None:
    """Print a fitted rig and its residuals: of all views together, and of the views with the largest RMS."""
    columns = [Column(name, justify="right") for name in ("pixels", "no depth", "median", "sigma", "RMS", "RMS, px")]
    shown = sorted(fit.views, key=lambda view: -view.rms_mm if view.pixels else float("-inf"))[:_MOST_SHOWN]
    more = f", the worst {len(shown)} of {len(fit.views)} views" if len(shown) < len(fit.views) else ""
    table = Table("", *columns, title=f"depth by the rig minus the depth given, mm{more}", title_justify="left")
    for view in (*shown, fit.total):
        table.add_row(*_cells(view), end_section=view is shown[-1])
    projector, (x, y, z) = rig.projector, (MM_PER_M * shift for shift in rig.translation_m)
    measured = " and ".join(f"{p:.3f} +- {e:.3f}" for p, e in zip(fit.pitch_px, fit.pitch_error_px, strict=True))
    show(table)
    print(f"pitch           {rig.pitch_vertical_px:g} px vertical, {rig.pitch_horizontal_px:g} px horizontal fringes")
    print(f"  taken from    {fit.pitch_from}; measured {measured}")
    print(f"projector       {projector.width} x {projector.height} px, focal length {projector.fx:.2f} and "
          f"{projector.fy:.2f} px, principal point {projector.cx:.2f}, {projector.cy:.2f}")  # fmt: skip
    if projector.is_distorted:
        print(f"  lens          k1 {projector.distortion[0]:.5f}")
    print(f"translation     {x:.2f}, {y:.2f}, {z:.2f} mm; baseline {MM_PER_M * rig.baseline_m:.2f} mm")


def _cells(view: "calibration.Residual") -> list[str]:
    lengths = (f"{view.median_mm:.4f}", f"{view.sigma_mm:.4f}", f"{view.rms_mm:.4f}", f"{view.rms_px:.3f}")
    return [view.name, str(view.pixels), str(view.missing), *(lengths if view.pixels else "----")]
