"""``fpp-bench calibrate``: the rig from captures of a board, or from frames with depth."""

import argparse
from dataclasses import replace
from pathlib import Path

from fpp_ml_bench import calibration, optics
from fpp_ml_bench.cli import count
from fpp_ml_bench.cli.console import progress_bar, say_findings, show, working_range
from fpp_ml_bench.constants import LARGEST_SIDE_PX, MM_PER_M
from fpp_ml_bench.errors import CalibrationError, RigError
from fpp_ml_bench.examination import Examination
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders import captures, published, render
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.tables import Table

SUMMARY = (
    "Find the rig that took captures: camera, projector and pose, from poses of a board or from frames with depth."
)
EXAMPLES = (
    "fpp-bench calibrate poses --board checker:9x13:10 --sequence projector.yaml --out rig.yaml",
    "fpp-bench calibrate poses --board circles:5x9:60:18 --sequence projector.yaml --out rig.yaml --estimate-board",
    "fpp-bench calibrate --virtual boards --out found.yaml                   the paper's calibration, by our own light",
    "fpp-bench calibrate --from-depth fpp-ml-bench --out rig.yaml",
    "fpp-bench calibrate --from-depth my-scans --out rig.yaml --camera my-rig.yaml --projector 1280x800",
    "",
    "Board: CAPTURES holds a folder for each pose of the board, each with all frames of the sequence, which must code",
    "both directions. The sequence file is a rig file of which projector (width, height) and sequence are read.",
    "Boards: checker:COLUMNSxROWS:SPACING (inner corners, mm), circles:..:SPACING:RADIUS, circles-asymmetric:..,",
    "charuco:..:SPACING:MARKER.",
    "",
    "Depth: TREE is a published tree with raw scans (fpp-bench import --help). Phase and depth give the projector up",
    "to the size of its pixels, and with it the pitch in px. The pitch is given by --pitch or --focal, or taken from",
    "--projector, with square pixels and the principal point in the pattern's middle. Depth residuals compare what the",
    "rig found decodes from the frames with the tree's depth.",
)
AUTO, AUTO_MODELS = "auto", ("radial-1", "radial-2", "radial-3+tangential")
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
    add = parser.add_argument
    add("captures", nargs="?", type=Path, metavar="CAPTURES", help="folder with a folder of frames for each board pose")
    add("--from-depth", type=Path, metavar="TREE", help="instead: a published tree with raw scans and depth in mm")
    add(
        "--virtual",
        type=Path,
        metavar="DIR",
        help="instead: photograph a board with a virtual rig into DIR, and calibrate from the images",
    )
    add("--out", type=Path, metavar="RIG", required=True, help="rig file to write, .yaml or .json")
    board = parser.add_argument_group("board")
    add = board.add_argument
    add("--board", metavar="KIND:CxR:MM", help="the board, such as checker:9x13:10")
    add("--sequence", type=Path, metavar="FILE", help="rig file with the projector's size and the sequence")
    add(
        "--lens",
        default=AUTO,
        metavar="MODEL",
        help="none, radial-1, radial-2, radial-3+tangential, rational, or two of them, CAMERA,PROJECTOR; auto "
        f"(default): of {', '.join(AUTO_MODELS)} the one that predicts poses left out best",
    )
    add("--square-pixels", action="store_true", help="fx = fy, of both devices")
    add("--centred", action="store_true", help="the camera's principal point is the image's centre")
    add("--estimate-board", action="store_true", help="estimate the board's points too: no print is perfect")
    add("--baseline", type=float, metavar="MM", help="distance of camera and projector, where the spacing is not known")
    add("--range", type=working_range, metavar="NEAR,FAR", help="working range in mm (default: the boards', and 10%%)")
    add("--bits", type=int, metavar="N", help="bits of the camera, where files of 16 bits hold fewer")
    add("--colour", metavar="NAME", help="of colour images: luminance, mean, red, green, blue")
    add("--anyway", action="store_true", help="use poses whose frames the examination refuses, too")
    add("--opencv", type=Path, metavar="FILE", help="also write OpenCV's calibration file (.xml, .yml, .json)")
    virtual = parser.add_argument_group("virtual")
    add = virtual.add_argument
    add("--true-rig", type=Path, metavar="FILE", help="the rig that photographs (default: the paper's)")
    add("--size", type=int, metavar="PX", help="width of its images (default: the rig's)")
    add("--poses", type=count(100), metavar="N", help="poses of the board (default: 18)")
    depth = parser.add_argument_group("depth")
    add = depth.add_argument
    add(
        "--camera",
        type=Path,
        metavar="FILE",
        help="rig file with the camera and the frames' sequence (default: the paper's)",
    )
    add("--projector", type=_size, metavar="WxH", help="projector's size in px (default: that of --camera, 912x1140)")
    known = depth.add_mutually_exclusive_group()
    known.add_argument(
        "--pitch", type=_pitches, metavar="PX", help="fringe pitch in projector px if known, or VERTICAL,HORIZONTAL"
    )
    known.add_argument("--focal", type=_focal, metavar="PX", help="projector's focal length in px if known")
    add("--lens-term", action="store_true", help="fit the projector's first radial lens term too")
    add(
        "--frame-order",
        default="auto",
        metavar="NAME",
        help="order of the raw scans' files (default: auto, determined from the images)",
    )
    add("--workers", type=int, metavar="N", help="threads (default: one per processor)")


def run(args: argparse.Namespace) -> int:
    """Fit, write the rig, and print the residuals. Raises FppBenchError for unusable captures, rigs or files."""
    workers = usable_cores() if args.workers is None else args.workers
    if workers < 1:
        raise CalibrationError(f"--workers {workers}: expected 1 or more")
    if args.out.suffix.lower() not in (".yaml", ".yml", ".json"):
        raise RigError(f"{args.out}: expected a rig file ending in .yaml, .yml or .json")
    if not args.out.absolute().parent.is_dir():
        raise RigError(f"{args.out}: the folder {args.out.parent} does not exist; make it first")
    if sum(given is not None for given in (args.captures, args.from_depth, args.virtual)) != 1:
        raise CalibrationError("expected one of CAPTURES of a board, --from-depth TREE, or --virtual DIR")
    if args.from_depth is not None:
        return _from_depth(args, workers)
    if args.virtual is not None:
        return _virtual(args)
    if args.board is None or args.sequence is None:
        raise CalibrationError("captures of a board need --board KIND:COLUMNSxROWS:SPACING and --sequence FILE")
    _from_board(args, args.captures, calibration.parse_board(args.board), args.sequence)
    return 0


def _virtual(args: argparse.Namespace) -> int:
    """Photograph a board, calibrate from the images alone, and compare with the rig that took them."""
    if args.size is not None and not 64 <= args.size <= LARGEST_SIDE_PX:
        raise CalibrationError(f"--size {args.size}: expected 64 to {LARGEST_SIDE_PX} px")
    true_rig = optics.paper_rig() if args.true_rig is None else optics.load_rig(args.true_rig)
    true_rig = true_rig if args.size is None else true_rig.scaled(args.size)
    if args.board is not None:
        board = calibration.parse_board(args.board)
    elif true_rig == optics.paper_rig():
        board = render.PAPER_BOARD
    else:
        board = render.fitting_board(true_rig)
    poses = render.board_poses(true_rig, board, args.poses or render.BOARD_POSES)
    with progress_bar("photographing", len(poses) * len(true_rig.sequence), "images") as advance:
        render.photograph_board(args.virtual, true_rig, board, poses, progress=advance)
    range_mm = args.range or true_rig.working_range_mm
    found = _from_board(args, args.virtual, board, args.virtual / "rig.yaml", range_mm, true_rig)
    error = calibration.volume_error_mm(found, true_rig)
    print(
        f"against truth   depth over the working range: {error.rms_mm:.3f} mm RMS, {error.worst_mm:.3f} mm at most, "
        f"scale {error.scale:.5f}; baseline {MM_PER_M * true_rig.baseline_m:.2f} mm"
    )
    return 0


def _from_depth(args: argparse.Namespace, workers: int) -> int:
    known_rig = None if args.camera is None else optics.load_rig(args.camera)
    reader = published.plan_import(args.from_depth, known_rig, args.frame_order).reader
    with progress_bar("reading", len(reader.tree.by_name), "views") as advance:
        views = published.tree_views(reader, workers, advance)
    rig, fit = calibration.fit_projector(
        views, reader.rig, args.projector, pitch_px=args.pitch, focal_px=args.focal, lens=args.lens_term
    )
    print_fit(rig, fit)
    optics.save_rig(rig, args.out)
    print(f"wrote {args.out}; next: fpp-bench import {args.from_depth} OUT --rig {args.out}")
    return 0


def _from_board(
    args: argparse.Namespace,
    folder: Path,
    board: "calibration.Board",
    sequence: Path,
    range_mm: tuple[float, float] | None = None,
    like: "optics.Rig | None" = None,
) -> "optics.Rig":
    """Calibrate, print and write; the rig, with standoff and background of ``like``."""
    lenses = _lenses(args)
    examined: dict[str, Examination] = {}
    with progress_bar("finding the board", len(captures.pose_folders(folder)), "poses") as advance:
        poses, rig, response = captures.board_poses(
            folder, board, sequence, args.bits, args.colour, advance, args.anyway, examined.__setitem__
        )
    for name, examination in examined.items():
        say_findings(examination, f"{name}: ", notes=False)  # the response is measured over all poses
    lenses = lenses if len(poses) > 3 else lenses[:1]  # models are compared by poses left out
    sizes = (poses[0].size, (rig.projector.width, rig.projector.height))
    options = {"estimate_board": args.estimate_board, "baseline_mm": args.baseline}
    with progress_bar("fitting", len(lenses), "lens models") as advance:
        found = []
        for lens in lenses:
            found.append(calibration.calibrate(poses, board, *sizes, lens, **options))
            advance(1)
    if len(found) > 1:
        compared = Table("lens model", numbers=("RMS, px", "left out, px", "BIC"))
        for one in found:
            compared.add_row(
                str(one.camera.lens), f"{one.stereo_rms_px:.4f}", f"{one.held_out_rms_px:.4f}", f"{one.bic:.0f}"
            )
        show(compared)
    best = min(found, key=lambda one: one.held_out_rms_px) if len(found) > 1 else found[0]
    rig = captures.calibrated_rig(best, rig, range_mm or args.range)
    if like is not None:
        rig = replace(rig, standoff_m=like.standoff_m, background_m=like.background_m)
    optics.check_lengths(rig, "the spacing of --board, in mm,")
    print_calibration(best)
    if response is not None:
        print(
            f"response        gamma {response.gamma:.3f} +- {response.sigma:.4f} of projector and camera together; "
            f"white on the board: {response.white_grey:.0f} of 255 grey levels"
        )
    optics.save_rig(rig, args.out)
    written = [args.out, args.out.with_suffix(".png")]
    write_atomically(written[-1], calibration.draw_residuals(best))
    if args.opencv is not None:
        errors = (best.camera_rms_px, best.projector_rms_px, best.stereo_rms_px)
        content = optics.OpenCvCalibration(rig.camera, rig.projector, rig.rotation, rig.translation_m, *errors)
        optics.write_opencv_calibration(content, args.opencv)
        written.append(args.opencv)
    print(f"wrote {', '.join(map(str, written))}; next: fpp-bench decode {args.out} FRAMES --out OUT")
    return rig


def _lenses(args: argparse.Namespace) -> list[tuple["calibration.Lens", "calibration.Lens"]]:
    """Camera and projector models to try: one pair, or those that `AUTO` compares."""
    pairs = []
    for name in AUTO_MODELS if args.lens == AUTO else (args.lens,):
        first, _, second = name.partition(",")
        camera = calibration.Lens(first.strip(), args.square_pixels, args.centred)
        pairs.append((camera, calibration.Lens((second or first).strip(), args.square_pixels)))
    return pairs


def print_calibration(found: "calibration.Calibration") -> None:
    """Print the errors of every pose, and the rig with its standard uncertainties."""
    columns = "camera", "projector", "both", "left out"
    table = Table("", numbers=columns, title="reprojection error (RMS, px; no point rejected)")
    for pose in found.poses:
        errors = (pose.camera_rms_px, pose.projector_rms_px, pose.stereo_rms_px, pose.held_out_rms_px)
        named = f"{pose.name} (!)" if pose.name in found.spoilers else pose.name
        table.add_row(named, *(f"{error:.4f}" for error in errors), end_section=pose is found.poses[-1])
    total = (found.camera_rms_px, found.projector_rms_px, found.stereo_rms_px, found.held_out_rms_px)
    table.add_row("all", *(f"{error:.4f}" for error in total))
    show(table)
    if found.spoilers:
        print(f"  (!) {', '.join(found.spoilers)}: fits the other poses badly; look at it, or capture it again")
    alone = ", ".join(
        f"{name} {error:.4f}" for name, error in zip(("camera", "projector"), found.alone_rms_px, strict=True)
    )
    print(f"alone           {alone} px (each device by OpenCV's calibrateCamera, with a perfect board)")
    for name, device in (("camera", found.camera), ("projector", found.projector)):
        values = [
            f"{label} {value:.2f} +- {sigma:.2f}" if sigma else f"{label} {value:.2f} (fixed)"
            for label, value, sigma in zip(
                ("fx", "fy", "cx", "cy"), (device.fx, device.fy, device.cx, device.cy), device.sigma, strict=True
            )
        ]
        terms = ", ".join(f"{term:.5f}" for term in device.distortion)
        print(f"{name:<15} {', '.join(values)} px; {device.lens}: {terms}")
    x, y, z = (
        f"{length:.2f} +- {sigma:.2f}"
        for length, sigma in zip(found.translation_mm, found.translation_sigma_mm, strict=True)
    )
    print(f"translation     {x}, {y}, {z} mm; baseline {found.baseline_mm:.2f} mm; scale {found.scale}")


def print_fit(rig: "optics.Rig", fit: "calibration.DepthFit") -> None:
    """Print a fitted rig and its residuals: of all views together, and of the views with the largest RMS."""
    columns = "pixels", "no depth", "median", "sigma", "RMS", "RMS, px"
    shown = sorted(fit.views, key=lambda view: -view.rms_mm if view.pixels else float("-inf"))[:_MOST_SHOWN]
    more = f", the worst {len(shown)} of {len(fit.views)} views" if len(shown) < len(fit.views) else ""
    table = Table("", numbers=columns, title=f"depth by the rig minus the depth given, mm{more}")
    for view in (*shown, fit.total):
        table.add_row(*_cells(view), end_section=view is shown[-1])
    projector, (x, y, z) = rig.projector, (MM_PER_M * shift for shift in rig.translation_m)
    measured = " and ".join(f"{p:.3f} +- {e:.3f}" for p, e in zip(fit.pitch_px, fit.pitch_error_px, strict=True))
    show(table)
    print(f"pitch           {rig.pitch_vertical_px:g} px vertical, {rig.pitch_horizontal_px:g} px horizontal fringes")
    print(f"  taken from    {fit.pitch_from}; measured {measured}")
    print(
        f"projector       {projector.width} x {projector.height} px, focal length {projector.fx:.2f} and "
        f"{projector.fy:.2f} px, principal point {projector.cx:.2f}, {projector.cy:.2f}"
    )
    if projector.is_distorted:
        print(f"  lens          k1 {projector.distortion[0]:.5f}")
    print(f"translation     {x:.2f}, {y:.2f}, {z:.2f} mm; baseline {MM_PER_M * rig.baseline_m:.2f} mm")


def _cells(view: "calibration.Residual") -> list[str]:
    lengths = (f"{view.median_mm:.4f}", f"{view.sigma_mm:.4f}", f"{view.rms_mm:.4f}", f"{view.rms_px:.3f}")
    return [view.name, str(view.pixels), str(view.missing), *(lengths if view.pixels else "----")]
