"""``fpp-bench calibrate``: the rig from captures of a board, or from frames with depth."""

import sys
from dataclasses import dataclass, replace
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.calibration.boards import Board, parse_board
from fpp_ml_bench.calibration.from_depth import DepthFit, fit_projector
from fpp_ml_bench.calibration.result import Calibration, Lens, draw_residuals
from fpp_ml_bench.calibration.solve import calibrate as calibrate_rig
from fpp_ml_bench.calibration.volume import Places, Spread, depth_spread, volume_error_mm
from fpp_ml_bench.cli.console import progress_bar, say_findings, show
from fpp_ml_bench.cli.options import AT_LEAST_ONE, WORKING_RANGE, command, value, whole
from fpp_ml_bench.constants import LARGEST_SIDE_PX, MM_PER_M
from fpp_ml_bench.errors import CalibrationError, RigError
from fpp_ml_bench.examination.findings import Examination
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.loaders.captures.decoding import board_poses as read_board_poses
from fpp_ml_bench.loaders.captures.decoding import calibrated_rig, pose_folders
from fpp_ml_bench.loaders.published.importing import plan_import, tree_views
from fpp_ml_bench.loaders.render.boards.captures import photograph_board
from fpp_ml_bench.loaders.render.boards.poses import (
    BOARD_POSES,
    PAPER_BOARD,
    board_poses,
    fitting_board,
)
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.opencv_files import OpenCvCalibration, write_opencv_calibration
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import check_lengths, is_json, load_rig, save_rig
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table

AUTO, AUTO_MODELS = "auto", ("radial-1", "radial-2", "radial-3+tangential")
_MOST_SHOWN = 30


def _size(text: str) -> tuple[int, int]:
    width, height = (int(part) for part in text.split("x"))
    return width, height


def _pitches(text: str) -> tuple[float, float]:
    """Pitches given as VERTICAL,HORIZONTAL or one for both."""
    values = [float(part) for part in text.split(",")]
    if len(values) > 2:
        raise ValueError
    return values[0], values[-1]


PITCHES = value(
    "a pitch of at least 4 px, or VERTICAL,HORIZONTAL",
    _pitches,
    lambda px: all(4 <= pitch < 65536 for pitch in px),
)
PROJECTOR = value("width x height in px such as 912x1140", _size, lambda size: min(size) > 1)
FOCAL = value("a focal length in px", float, lambda px: 0 < px < 1e6)


@dataclass(frozen=True, kw_only=True)
class BoardSettings:
    """What is known of a board, and how it is calibrated from."""

    HEADING = "board"
    board: str | None = option(None, "the board, such as checker:9x13:10", "KIND:CxR:MM")
    sequence: Path | None = option(
        None, "rig file with the projector's size and the sequence", "FILE"
    )
    lens: str = option(
        AUTO,
        "none, radial-1, radial-2, radial-3+tangential, rational, or two of them, "
        "CAMERA,PROJECTOR; auto (default): "
        f"the model of {', '.join(AUTO_MODELS)} with the least error at poses that are left out of "
        f"the fit",
        "MODEL",
    )
    square_pixels: bool = option(False, "fx = fy, of both devices")
    centred: bool = option(False, "the camera's principal point is the image's centre")
    estimate_board: bool = option(False, "estimate the board's points too: no print is perfect")
    baseline: float | None = option(
        None, "distance of camera and projector, where the spacing of the board is not known", "MM"
    )
    working_range: tuple[float, float] | None = option(
        None, "working range in mm (default: the boards', and 10%)", "NEAR,FAR", parse=WORKING_RANGE
    )
    bits: int | None = option(None, "bits of the camera, where files of 16 bits hold fewer", "N")
    colour: str | None = option(None, "of colour images: luminance, mean, red, green, blue", "NAME")
    anyway: bool = option(False, "use poses whose frames the examination refuses, too")
    opencv: Path | None = option(
        None, "also write OpenCV's calibration file (.xml, .yml, .json)", "FILE"
    )


@dataclass(frozen=True, kw_only=True)
class VirtualSettings:
    """How a virtual rig photographs a board."""

    HEADING = "virtual"
    true_rig: Path | None = option(None, "the rig that photographs (default: the paper's)", "FILE")
    size: int | None = option(
        None,
        "width of its images (default: the rig's)",
        "PX",
        parse=whole(64, LARGEST_SIDE_PX, "px"),
    )
    poses: int | None = option(None, "poses of the board (default: 18)", "N", parse=whole(1, 100))


@dataclass(frozen=True, kw_only=True)
class DepthSettings:
    """What is known of frames with depth."""

    HEADING = "depth"
    camera: Path | None = option(
        None, "rig file with the camera and the frames' sequence (default: the paper's)", "FILE"
    )
    projector: tuple[int, int] | None = option(
        None, "projector's size in px (default: that of --camera, 912x1140)", "WxH", parse=PROJECTOR
    )
    pitch: tuple[float, float] | None = option(
        None, "fringe pitch in projector px if known, or VERTICAL,HORIZONTAL", "PX", parse=PITCHES
    )
    focal: float | None = option(None, "projector's focal length in px if known", "PX", parse=FOCAL)
    lens_term: bool = option(False, "fit the projector's first radial lens term too")
    frame_order: str = option(
        "auto", "order of the raw scans' files (default: auto, determined from the images)", "NAME"
    )
    workers: int | None = option(
        None, "threads (default: one per processor)", "N", parse=AT_LEAST_ONE
    )


@dataclass(frozen=True, kw_only=True)
class CalibrateSettings(DepthSettings, VirtualSettings, BoardSettings):
    """Settings of `calibrate`."""

    captures: Path | None = argument(
        "folder with a folder of frames for each board pose", "CAPTURES", None
    )
    from_depth: Path | None = option(
        None, "instead: a published tree with raw scans and depth in mm", "TREE"
    )
    virtual: Path | None = option(
        None,
        "instead: photograph a board with a virtual rig into DIR, and calibrate from the images",
        "DIR",
    )
    out: Path = option(REQUIRED, "rig file to write, .yaml or .json", "RIG")


@command(
    """\
fpp-bench calibrate poses --board checker:9x13:10 --sequence projector.yaml --out rig.yaml
fpp-bench calibrate poses --board circles:5x9:60:18 --sequence projector.yaml --out rig.yaml --estimate-board
fpp-bench calibrate --virtual boards --out found.yaml                   the paper's calibration, by our own light
fpp-bench calibrate --from-depth fpp-ml-bench --out rig.yaml
fpp-bench calibrate --from-depth my-scans --out rig.yaml --camera my-rig.yaml --projector 1280x800

Board: CAPTURES holds a folder for each pose of the board, each with all frames of the sequence, which must code
both directions. The sequence file is a rig file of which projector (width, height) and sequence are read.
Boards: checker:COLUMNSxROWS:SPACING (inner corners, mm), circles:..:SPACING:RADIUS, circles-asymmetric:..,
charuco:..:SPACING:MARKER[:DICTIONARY] (default: DICT_4X4_1000; its markers may lie as before OpenCV 4.6, too).

Depth: TREE is a published tree with raw scans (fpp-bench import --help). Phase and depth give the projector up
to the size of its pixels, and with it the pitch in px. The pitch is given by --pitch or --focal, or taken from
--projector, with square pixels and the principal point in the pattern's middle. Depth residuals compare what the
rig found decodes from the frames with the tree's depth.
"""
)
def calibrate(settings: CalibrateSettings) -> None:
    """Find the rig that took captures: camera, projector and pose, from poses of a board or from
    frames with depth.

    Raises FppBenchError for unusable captures, rigs or files."""
    out = settings.out
    is_json(out)
    if not out.absolute().parent.is_dir():
        raise RigError(f"{out}: the folder {out.parent} does not exist; make it first")
    if (
        sum(
            given is not None
            for given in (settings.captures, settings.from_depth, settings.virtual)
        )
        != 1
    ):
        raise CalibrationError(
            "expected one of CAPTURES of a board, --from-depth TREE, or --virtual DIR"
        )
    if settings.pitch is not None and settings.focal is not None:
        raise CalibrationError(
            "--pitch and --focal: each gives the size of the projector's pixels; give one of them"
        )
    if settings.from_depth is not None:
        _from_depth(settings, settings.from_depth)
    elif settings.virtual is not None:
        _virtual(settings, settings.virtual)
    elif settings.captures is not None:
        if settings.board is None or settings.sequence is None:
            raise CalibrationError(
                "captures of a board need --board KIND:COLUMNSxROWS:SPACING and --sequence FILE"
            )
        _from_board(settings, settings.captures, parse_board(settings.board), settings.sequence)


def _virtual(settings: CalibrateSettings, folder: Path) -> None:
    """Photograph a board, calibrate from the images alone, and compare with the rig that took
    them."""
    true_rig = paper_rig() if settings.true_rig is None else load_rig(settings.true_rig)
    true_rig = true_rig if settings.size is None else true_rig.scaled(settings.size)
    if settings.board is not None:
        board = parse_board(settings.board)
    elif true_rig == paper_rig():
        board = PAPER_BOARD
    else:
        board = fitting_board(true_rig)
    poses = board_poses(true_rig, board, settings.poses or BOARD_POSES)
    with progress_bar("photographing", len(poses) * len(true_rig.sequence), "images") as advance:
        photograph_board(folder, true_rig, board, poses, progress=advance)
    rig = _from_board(settings, folder, board, folder / "rig.yaml", true_rig)
    error = volume_error_mm(rig, true_rig)
    print(
        f"against truth   depth over the working range: {error.rms_mm:.3f} mm RMS, "
        f"{error.worst_mm:.3f} mm at most, "
        f"scale {error.scale:.5f}; baseline {MM_PER_M * true_rig.baseline_m:.2f} mm"
    )


def _from_depth(settings: CalibrateSettings, tree: Path) -> None:
    known_rig = None if settings.camera is None else load_rig(settings.camera)
    reader = plan_import(tree, known_rig, settings.frame_order).rows
    with progress_bar("reading", len(reader.samples), "views") as advance:
        views = tree_views(reader, settings.workers or usable_cores(), advance)
    rig, fit = fit_projector(
        views,
        reader.rig,
        settings.projector,
        pitch_px=settings.pitch,
        focal_px=settings.focal,
        lens=settings.lens_term,
    )
    print_fit(rig, fit)
    save_rig(rig, settings.out)
    print(f"wrote {settings.out}; next: fpp-bench import {tree} --out OUT --rig {settings.out}")


def _from_board(
    settings: CalibrateSettings,
    folder: Path,
    board: "Board",
    sequence: Path,
    like: "Rig | None" = None,
) -> "Rig":
    """Calibrate, print and write; the rig, with standoff, background and (if none is given) range
    of ``like``."""
    lenses = _lenses(settings)
    examined: dict[str, Examination] = {}
    with progress_bar("finding the board", len(pose_folders(folder)), "poses") as advance:
        poses, rig, response = read_board_poses(
            folder,
            board,
            sequence,
            settings.bits,
            settings.colour,
            advance,
            settings.anyway,
            examined.__setitem__,
        )
    for name, examination in examined.items():
        say_findings(
            examination, f"{name}: ", notes=False
        )  # the response is measured over all poses
    lenses = lenses if len(poses) > 3 else lenses[:1]  # models are compared by poses left out
    sizes = (poses[0].size, (rig.projector.width, rig.projector.height))
    options: dict[str, Any] = {
        "estimate_board": settings.estimate_board,
        "baseline_mm": settings.baseline,
    }
    with progress_bar("fitting", len(lenses), "lens models") as advance:
        calibrations = []
        for lens in lenses:
            calibrations.append(calibrate_rig(poses, board, *sizes, lens, **options))
            advance(1)
    if len(calibrations) > 1:
        compared = Table("lens model", numbers=("RMS, px", "left out, px", "BIC"))
        for calibration in calibrations:
            compared.add_row(
                str(calibration.camera.lens),
                f"{calibration.rms_px.both:.4f}",
                f"{calibration.held_out_rms_px:.4f}",
                f"{calibration.bic:.0f}",
            )
        show(compared)
    best = min(calibrations, key=lambda calibration: calibration.held_out_rms_px)
    rig = calibrated_rig(
        best, rig, settings.working_range or (like.working_range_mm if like else None)
    )
    if like is not None:
        rig = replace(rig, standoff_m=like.standoff_m, background_m=like.background_m)
    check_lengths(rig, "the spacing of --board, in mm,")
    print_calibration(best)
    places = Places.over(rig)
    spread = depth_spread(places, best.root)
    print_spread(spread, places)
    if response is not None:
        print(
            f"response        gamma {response.gamma:.3f} +- {response.sigma:.4f} of projector and "
            f"camera together; "
            f"white on the board: {response.white_grey:.0f} of 255 grey levels"
        )
    save_rig(rig, settings.out)
    written = [settings.out, settings.out.with_suffix(".png")]
    write_atomically(written[-1], draw_residuals(best, spread.maps(places)))
    if settings.opencv is not None:
        content = OpenCvCalibration(
            rig.camera, rig.projector, rig.rotation, rig.translation_m, best.rms_px
        )
        write_opencv_calibration(content, settings.opencv)
        written.append(settings.opencv)
    print(
        f"wrote {', '.join(map(str, written))}; next: fpp-bench decode {settings.out} FRAMES --out "
        f"OUT"
    )
    return rig


def _lenses(settings: CalibrateSettings) -> list[tuple["Lens", "Lens"]]:
    """Camera and projector models to try: one pair, or those that `AUTO` compares."""
    pairs = []
    for name in AUTO_MODELS if settings.lens == AUTO else (settings.lens,):
        first, _, second = name.partition(",")
        camera = Lens(first.strip(), settings.square_pixels, settings.centred)
        pairs.append((camera, Lens((second or first).strip(), settings.square_pixels)))
    return pairs


def _four_digits(error_px: float) -> str:
    return "-" if isnan(error_px) else f"{error_px:.4f}"


def print_calibration(calibration: "Calibration") -> None:
    """Print the errors of every pose, and the rig with its standard uncertainties."""
    columns = "camera", "projector", "both", "left out"
    table = Table("", numbers=columns, title="reprojection error (RMS, px; no point rejected)")
    for pose in calibration.poses:
        errors = (*pose.rms_px, pose.held_out_rms_px)
        named = f"{pose.name} (!)" if pose.name in calibration.spoilers else pose.name
        table.add_row(named, *map(_four_digits, errors), end_section=pose is calibration.poses[-1])
    table.add_row("all", *map(_four_digits, (*calibration.rms_px, calibration.held_out_rms_px)))
    show(table)
    for doubt in calibration.doubts:
        print(doubt, file=sys.stderr)
    if isnan(calibration.held_out_rms_px):
        few = (
            f"{len(calibration.poses)} poses: none can be left out to compare lens models or to "
            f"find a bad pose"
        )
        print(
            f"note: {few}; the lens is {calibration.camera.lens}. Capture four or more",
            file=sys.stderr,
        )
    if calibration.spoilers:
        print(
            f"  (!) {', '.join(calibration.spoilers)}: fits the other poses badly; look at it, or "
            f"capture it again"
        )
    alone = ", ".join(
        f"{name} {error:.4f}"
        for name, error in zip(("camera", "projector"), calibration.alone_rms_px, strict=True)
    )
    print(
        f"alone           {alone} px (each device by OpenCV's calibrateCamera, with a perfect "
        f"board)"
    )
    for name, device in (("camera", calibration.camera), ("projector", calibration.projector)):
        values = [
            f"{label} {getattr(device.pinhole, label):.2f} "
            + (f"+- {sigma:.2f}" if sigma else "(fixed)")
            for label, sigma in zip(("fx", "fy", "cx", "cy"), device.sigma, strict=False)
        ]
        terms = ", ".join(f"{term:.5f}" for term in device.pinhole.distortion)
        print(f"{name:<15} {', '.join(values)} px; {device.lens}: {terms}")
    x, y, z = (
        f"{length:.2f} +- {sigma:.2f}"
        for length, sigma in zip(
            calibration.translation_mm, calibration.translation_sigma_mm, strict=True
        )
    )
    print(
        f"translation     {x}, {y}, {z} mm; baseline {calibration.baseline_mm:.2f} mm; scale "
        f"{calibration.scale}"
    )


def print_spread(spread: Spread, places: Places) -> None:
    """Print what the calibration leaves of the depth, over the image at three depths."""
    columns = "image centre", "half of the image below", "95% below"
    title = "standard uncertainty of the depth by this calibration, mm (the scale taken as exact)"
    table = Table("depth, mm", numbers=columns, title=title)
    for depth_mm, sigma_mm in spread.maps(places).items():
        rows, columns_px = (length // 2 for length in sigma_mm.shape)
        levels = np.nanquantile(sigma_mm, (0.5, 0.95), method="lower")
        cells = ("-" if isnan(mm) else f"{mm:.3f}" for mm in (sigma_mm[rows, columns_px], *levels))
        table.add_row(f"{depth_mm:.0f}", *cells)
    show(table)
    print(
        f"                as an error of the projector's coordinate: {spread.median_px:.3f} px; all "
        f"pixels share it, and it halves with half the reprojection error or four times the poses"
    )


def print_fit(rig: "Rig", fit: "DepthFit") -> None:
    """Print a fitted rig and its residuals: of all views together, and of the views with the
    largest RMS."""
    columns = "pixels", "no depth", "median", "sigma", "RMS", "RMS, px"
    shown = sorted(fit.views, key=lambda view: -view.rms_mm if view.pixels else float("-inf"))[
        :_MOST_SHOWN
    ]
    more = (
        f", the worst {len(shown)} of {len(fit.views)} views" if len(shown) < len(fit.views) else ""
    )
    table = Table("", numbers=columns, title=f"depth by the rig minus the depth given, mm{more}")
    for view in (*shown, fit.total):
        lengths = (
            f"{view.median_mm:.4f}",
            f"{view.sigma_mm:.4f}",
            f"{view.rms_mm:.4f}",
            f"{view.rms_px:.3f}",
        )
        cells = lengths if view.pixels else "----"
        table.add_row(
            view.name, str(view.pixels), str(view.missing), *cells, end_section=view is shown[-1]
        )
    projector, (x, y, z) = rig.projector, (MM_PER_M * shift for shift in rig.translation_m)
    measured = " and ".join(
        f"{p:.3f} +- {e:.3f}" for p, e in zip(fit.pitch_px, fit.pitch_error_px, strict=True)
    )
    show(table)
    print(
        f"pitch           {rig.pitch_vertical_px:g} px vertical, {rig.pitch_horizontal_px:g} px "
        f"horizontal fringes"
    )
    print(f"  taken from    {fit.pitch_from}; measured {measured}")
    print(
        f"projector       {projector.width} x {projector.height} px, focal length "
        f"{projector.fx:.2f} and "
        f"{projector.fy:.2f} px, principal point {projector.cx:.2f}, {projector.cy:.2f}"
    )
    if projector.is_distorted:
        print(f"  lens          k1 {projector.distortion[0]:.5f}")
    print(
        f"translation     {x:.2f}, {y:.2f}, {z:.2f} mm; baseline {MM_PER_M * rig.baseline_m:.2f} mm"
    )
