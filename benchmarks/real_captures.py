"""The package on real light: calibration, decoding and one frame of public captures (not part of
it).

    python benchmarks/real_captures.py CAPTURES [--out PICTURES]

CAPTURES is a folder with the captures of the public repository jakobwilm/slstudio:
``calibration/calseq1`` to ``calseq6`` (six poses of a checkerboard of 9 x 13 inner corners) with
``calibration/calibration.xml``, ``skull_2x3`` (three steps of 16 periods, three of one) and
``skull_gray`` (white, black, ten Gray bits) with ``pointCloud.mat``.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np
import scipy.io
from numpy.typing import NDArray
from PIL import Image

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.learned.method import FringeNetMethod
from fpp_ml_bench.baselines.phase.geometry import wrapped
from fpp_ml_bench.baselines.phase.method import CrossedMethod, PhaseMethod
from fpp_ml_bench.baselines.robustness.axes import corruptions
from fpp_ml_bench.calibration.boards import Board
from fpp_ml_bench.calibration.result import Lens, draw_residuals
from fpp_ml_bench.calibration.solve import calibrate as calibrate_rig
from fpp_ml_bench.constants import MAD_TO_SIGMA
from fpp_ml_bench.decoding.decode import Decoded, decode_stack
from fpp_ml_bench.decoding.triangulation import coordinate_slope_px_per_mm
from fpp_ml_bench.depth import object_near_edges
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.loaders.captures.decoding import board_poses, calibrated_rig
from fpp_ml_bench.loaders.captures.images import read_frames
from fpp_ml_bench.loaders.render.meshes import load_user_mesh, single_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.opencv_files import (
    OpenCvCalibration,
    read_opencv_calibration,
    write_opencv_calibration,
)
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import load_rig

SPACING_MM = 10.0
"""Not recorded with the captures; with it our point clouds have the size of the authors' to
0.06%."""
VERTICAL = "{scheme: phase-shift, pitches_px: [114, 1824], steps: 3, sign: -1}"
HORIZONTAL = "{scheme: phase-shift, pitches_px: [71.25, 1140], steps: 3, sign: -1}"
BOARD = (
    f"projector: {{width: 1824, height: 1140}}\nsequence: "
    f"{{vertical: {VERTICAL}, horizontal: {HORIZONTAL}, "
)
SEQUENCES = {
    "skull_2x3": f"{{vertical: {VERTICAL}}}",
    "skull_gray": "{order: [white, black, vertical], vertical: {scheme: gray, cell_px: 2, bits: 10}}",
    "board": f"{{order: [vertical, horizontal], vertical: {VERTICAL}, horizontal: {HORIZONTAL}}}",
}
RANGE_MM = (300.0, 500.0)
WORKING_RANGE_MM = (250.0, 700.0)
"""What a user would give who does not know where the object stands; boards and desk are 300 to 600
mm away."""
SKULL_RANGE_MM = (360.0, 430.0)  # the object's own
FAR_MM = 20.0  # an error beyond it is of no use, whatever its cause


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, metavar="CAPTURES")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for pictures")
    args = parser.parse_args()
    needed = [f"calibration/calseq{n}" for n in range(1, 7)]
    needed += [
        "calibration/calibration.xml",
        "skull_2x3",
        "skull_gray",
        "skull_gray/pointCloud.mat",
    ]
    missing = [name for name in needed if not (args.captures / name).exists()]
    if missing:
        print(f"{args.captures}: missing {', '.join(missing)}", file=sys.stderr)
        return 2
    theirs = read_opencv_calibration(args.captures / "calibration" / "calibration.xml")
    with tempfile.TemporaryDirectory() as scratch:
        ours, boards = calibrate(args.captures / "calibration", theirs, Path(scratch), args.out)
        cloud = scipy.io.loadmat(args.captures / "skull_gray" / "pointCloud.mat")["xyz"].astype(
            np.float64
        )
        for name in ("skull_2x3", "skull_gray"):
            for who, found in (("authors", theirs), ("ours", ours)):
                rig = rig_of(found, name, Path(scratch))
                decode(
                    args.captures / name, rig, theirs.camera, cloud, f"{name}, calibration: {who}"
                )
        skull = rig_of(theirs, "skull_2x3", Path(scratch))
        twin(args.captures / "skull_2x3", skull, Path(scratch))
        skull = rig_of(ours, "skull_2x3", Path(scratch))
        phase_of_one_sinusoid(args.captures / "skull_2x3", skull)
        for range_mm in (WORKING_RANGE_MM, SKULL_RANGE_MM):
            one_frame(args.captures / "skull_2x3", skull.with_range(range_mm), Path(scratch))
        for number, (board, corners_px) in enumerate(boards, 1):
            capture = args.captures / "calibration" / f"calseq{number}"
            reference(
                capture,
                rig_of(theirs, "board", Path(scratch)).with_range(WORKING_RANGE_MM),
                "authors",
            )
            phase_of_one_sinusoid(capture, board)
            one_frame(capture, board, Path(scratch), corners_px)
    return 0


def calibrate(
    folder: Path, theirs: "OpenCvCalibration", scratch: Path, out: Path | None
) -> tuple["OpenCvCalibration", list[tuple["Rig", NDArray]]]:
    """Print errors and rigs of several models, and return the one whose held-out error is the
    least, and for each pose the rig that this model finds from the other five, with the pose's
    corners in camera px (n, 2)."""
    poses_folder, sequence = scratch / "poses", scratch / "board.yaml"
    poses_folder.mkdir()
    for number in range(1, 7):
        (poses_folder / f"calseq{number}").symlink_to((folder / f"calseq{number}").resolve())
    sequence.write_text(BOARD + "order: [vertical, horizontal]}\n", encoding="utf-8")
    board = Board("checker", 9, 13, SPACING_MM)
    started = perf_counter()
    poses, stand_in, response = board_poses(poses_folder, board, sequence)
    found_in = perf_counter() - started
    sizes = (
        (theirs.camera.width, theirs.camera.height),
        (theirs.projector.width, theirs.projector.height),
    )
    print(
        f"six poses, {sum(len(pose.corners_px) for pose in poses)} corners, found in "
        f"{found_in:.0f} s"
    )
    if response is not None:
        print(
            f"response: gamma {response.gamma:.3f} +- {response.sigma:.3f}, misfit "
            f"{response.misfit_grey:.2f} grey "
            f"levels, white on the board {response.white_grey:.0f} of 255"
        )
    print(
        "calibration, RMS in px                            camera  alone  projector  alone  stereo "
        " left out"
    )
    errors = theirs.errors_px
    print(f"{'authors':<50}{errors[0]:6.3f}{'':9}{errors[1]:8.3f}{'':7}{errors[2]:8.3f}")
    own = (Lens("radial-1", True, True), Lens("radial-1", True))
    radial, full = (Lens("radial-1"), Lens("radial-1")), (Lens(), Lens())
    results = []
    for title, lens, free in (
        ("their model, perfect board", own, False),
        ("their model, board estimated", own, True),
        ("radial-1, board estimated", radial, True),
        ("radial-3+tangential, board estimated", full, True),
    ):
        found = calibrate_rig(poses, board, *sizes, lens, estimate_board=free)
        alone = found.alone_rms_px
        print(
            f"{title:<50}{found.rms_px.camera:6.3f} {alone[0]:6.3f}  {found.rms_px.projector:8.3f} "
            f"{alone[1]:6.3f}"
            f"{found.rms_px.both:8.3f}{found.held_out_rms_px:10.3f}"
        )
        results.append((found, lens, free))
    best, lens, free = min(results, key=lambda result: result[0].held_out_rms_px)
    rig = calibrated_rig(best, stand_in)
    for name in ("camera", "projector"):
        for who, device in (("authors", getattr(theirs, name)), ("ours", getattr(rig, name))):
            print(
                f"{name:<10} {who:<8} f {device.fx:8.1f} {device.fy:8.1f}  c {device.cx:7.1f} "
                f"{device.cy:7.1f}  "
                f"k1 {device.distortion[0]:+.4f}"
            )
    for who, shift in (("authors", theirs.translation_m), ("ours", best.translation_m)):
        x, y, z = (1000 * length for length in shift)
        print(
            f"translation {who:<8} {x:8.2f} {y:8.2f} {z:8.2f} mm, baseline "
            f"{np.linalg.norm([x, y, z]):.2f} mm"
        )
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        (out / "calibration.png").write_bytes(draw_residuals(best))
    boards = []
    for pose in poses:
        others = [other for other in poses if other is not pose]
        found = calibrate_rig(others, board, *sizes, lens, estimate_board=free, hold_out=False)
        boards.append((calibrated_rig(found, stand_in, WORKING_RANGE_MM), pose.corners_px))
    return OpenCvCalibration(rig.camera, rig.projector, rig.rotation, rig.translation_m), boards


def rig_of(found: "OpenCvCalibration", name: str, scratch: Path) -> "Rig":
    """A rig with a calibration and the sequence of a capture."""
    write_opencv_calibration(found, scratch / "found.yml", unit="m")
    text = (
        f"calibration: {{file: found.yml, unit: m}}\nworking_range_mm: {list(RANGE_MM)}\nsequence: "
        f"{SEQUENCES[name]}\n"
    )
    (scratch / "rig.yaml").write_text(text, encoding="utf-8")
    return load_rig(scratch / "rig.yaml")


def decode(
    folder: Path,
    rig: "Rig",
    camera: "Pinhole",
    cloud: NDArray,
    title: str,
) -> None:
    """Decode a capture and compare with the authors' cloud, which lies on the
    undistorted grid of their ``camera``: in depth, and as points after a rigid motion, since
    another principal point turns the camera's frame."""
    frames = read_frames(folder, count=len(rig.sequence)).frames
    method = ClassicalMethod(rig, threads=2)
    started = perf_counter()
    answer = method.answer(frames)
    seconds = perf_counter() - started
    theirs = cloud[np.isfinite(cloud).all(axis=-1)]
    columns, rows = (np.rint(axis).astype(int) for axis in camera.project(theirs / 1000))
    depth_mm = answer.depth[rows, columns].astype(np.float64)
    both = depth_mm > 0
    difference = depth_mm[both] - theirs[both][:, 2]
    median = float(np.median(difference))
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(difference - median)))
    within = float((np.abs(difference) < 2).mean())
    x, y = (axis[rows, columns][both] for axis in rig.camera.rays())
    apart, scale = after_motion(
        np.stack([x, y, np.ones_like(x)], axis=1) * depth_mm[both, None], theirs[both]
    )
    print(
        f"{title:<34} {both.sum():,} of {len(theirs):,} px: median {median:+.3f} mm, robust sigma "
        f"{sigma:.3f} mm, "
        f"{100 * within:.2f}% within 2 mm; noise {bend_noise_mm(answer.depth):.3f} mm; "
        f"{seconds:.1f} s; after a "
        f"rigid motion: median distance {apart:.3f} mm, their size / ours {scale:.5f}"
    )


def after_motion(points: NDArray[np.float64], target: NDArray[np.float64]) -> tuple[float, float]:
    """Median distance of points (n, 3) from ``target`` after the best rigid motion, without
    outliers, and the ratio of their sizes."""
    kept = np.ones(len(points), dtype=bool)
    for _ in range(8):
        a, b = points[kept].mean(axis=0), target[kept].mean(axis=0)
        left, _, right = np.linalg.svd((points[kept] - a).T @ (target[kept] - b))
        turn = right.T @ np.diag([1.0, 1.0, np.linalg.det(right.T @ left.T)]) @ left.T
        apart = np.linalg.norm((points - a) @ turn.T + b - target, axis=1)
        kept = apart < 3 * MAD_TO_SIGMA * np.median(apart)
    scale = np.sqrt(((target[kept] - b) ** 2).sum() / ((points[kept] - a) ** 2).sum())
    return float(np.median(apart)), float(scale)


def twin(folder: Path, rig: "Rig", scratch: Path) -> None:
    """Render a ball before the same rig by the light `paper`, and compare modulation and noise with
    the real frames."""
    import trimesh

    trimesh.creation.icosphere(subdivisions=5, radius=0.04).export(scratch / "ball.stl")
    virtual = replace(rig, working_range_mm=(350.0, 450.0), standoff_m=0.4, background_m=0.6)
    mesh = single_mesh(scratch / "ball.stl")
    studio = Studio(BuildSettings(virtual, ("ball",), user_meshes=(mesh,)))
    row = studio.photograph(load_user_mesh(mesh), "A0")
    rendered = [row.frames[index] for index in range(len(rig.sequence))]
    real = list(read_frames(folder, count=len(rig.sequence)).frames)
    for title, frames in (("twin, light paper", rendered), ("real frames", real)):
        decoded = decode_stack(
            frames, virtual if title != "real frames" else rig, details=True, threads=2
        )
        found, noise_mm = decoded.depth_mm > 0, bend_noise_mm(decoded.depth_mm)
        modulation = float(np.median(decoded.details["vertical"].modulation[found]))
        print(
            f"{title:<20} {found.sum():,} px: modulation {modulation:.1f} grey levels, noise of "
            f"depth {noise_mm:.3f} mm"
        )


def bend_noise_mm(depth_mm: NDArray[np.float32]) -> float:
    """Noise of a depth map, of which 0 is none: from second differences along the rows, which a
    smooth surface has not. Neighbours are taken for independent: an average over neighbours reads
    lower than its error is."""
    depth = np.where(depth_mm > 0, depth_mm.astype(np.float64), np.nan)
    bends = depth[:, 2:] - 2 * depth[:, 1:-1] + depth[:, :-2]
    bends = bends[np.isfinite(bends) & (np.abs(bends) < 3)]
    return MAD_TO_SIGMA * float(np.median(np.abs(bends - np.median(bends)))) / float(np.sqrt(6))


def reference(folder: Path, rig: "Rig", who: str) -> tuple[NDArray, Decoded]:
    """The frames of a capture and what all of them give; prints how much of the lit pixels that
    is."""
    frames = read_frames(folder, count=len(rig.sequence)).frames
    decoded = decode_stack(frames, rig, threads=2)
    lit = decoded.depth_mm.size - decoded.counts["low_modulation"]
    near, far = rig.working_range_mm
    print(
        f"{folder.name}, {near:g} to {far:g} mm, calibration: {who}: all frames give "
        f"{100 * decoded.counts['decoded'] / lit:.1f}% of {lit:,} lit px a depth"
    )
    return frames, decoded


def one_frame(folder: Path, rig: "Rig", scratch: Path, corners_px: NDArray | None = None) -> None:
    """One frame in the rig's range against the depth that all of them give there: `phase` on the
    first fringe of each direction; where there are both, `crossed` and `fringe-net` on the mean of
    the two, which is a crossed frame; where there is one, also with the mask given. Of all pixels,
    and of those between ``corners_px`` (n, 2) of a board."""
    frames, decoded = reference(folder, rig, "ours")
    known = decoded.depth_mm > 0
    parts = {"all": known}
    if corners_px is not None:
        hull = cv2.convexHull(np.rint(corners_px).astype(np.int32))
        parts["between the corners"] = known & (
            cv2.fillConvexPoly(np.zeros(known.shape, np.uint8), hull, 1) > 0
        )
    methods = [(f"phase, {way}", PhaseMethod(rig, direction=way), way) for way in rig.directions]
    if len(rig.directions) == 2:
        # An order of the vertical fringes is the smaller step in depth.
        methods += [
            ("crossed", CrossedMethod(rig), "vertical"),
            ("fringe-net", FringeNetMethod(rig, fringes="crossed"), "vertical"),
        ]
    else:
        Image.fromarray(known.astype(np.uint8) * 255).save(scratch / "mask.png")
        given = PhaseMethod(rig, mask=scratch / "mask.png", direction=rig.directions[0])
        methods.append((f"phase, {rig.directions[0]}, mask given", given, rig.directions[0]))
    for title, method, way in methods:
        needed = [
            frame if index in method.frames_used else None for index, frame in enumerate(frames)
        ]
        started = perf_counter()
        answer = method.answer(needed)
        seconds = perf_counter() - started
        print(
            f"  {title}: {seconds:.1f} s; without a reference "
            f"{((answer.depth > 0) & ~known).sum():,} px"
        )
        for part, asked in parts.items():
            both = asked & (answer.depth > 0)
            print(
                f"    {part}: answered {100 * both.sum() / asked.sum():.1f}% of {asked.sum():,} px",
                end="",
            )
            if both.any():
                rays = tuple(axis[both] for axis in rig.camera.rays())
                slope = np.abs(coordinate_slope_px_per_mm(rig, decoded.depth_mm[both], way, rays))
                error = np.abs(answer.depth[both].astype(np.float64) - decoded.depth_mm[both])
                wrong, beyond = error * slope > rig.pitch(way) / 2, error > FAR_MM
                confident = beyond & (answer.sigma_mm[both] < corruptions().confident_below * error)
                print(
                    f", median error {np.median(error):.2f} mm, beyond {FAR_MM:g} mm "
                    f"{100 * beyond.mean():.2f}%, wrong "
                    f"orders {100 * wrong.mean():.2f}%, confident errors "
                    f"{100 * confident.mean():.3f}%",
                    end="",
                )
            print(flush=True)


def phase_of_one_sinusoid(folder: Path, rig: "Rig") -> None:
    """The wrapped phase of the first sinusoid of each direction, by the local fit of the phase
    route and by fringe-net, against that of all three steps. The mask is given: where all frames
    have a depth."""
    frames = read_frames(folder, count=len(rig.sequence)).frames
    decoded = decode_stack(frames, rig, details=True, threads=2)
    on_object = decoded.depth_mm > 0
    near = object_near_edges(decoded.depth_mm, [EDGE_BAND_PX])[0]
    for way, details in decoded.details.items():
        frame = frames[rig.sequence.sinusoids(way)[0]]
        methods = {
            "local fit": PhaseMethod(rig, direction=way),
            "fringe-net": FringeNetMethod(rig, fringes=way),
        }
        for title, method in methods.items():
            phase = method.route.measure(frame, on_object).wrapped_phase_rad
            error = np.abs(wrapped(phase - details.phase))
            kept, inner = on_object & np.isfinite(error), on_object & np.isfinite(error) & ~near
            print(
                f"phase of one {way} sinusoid, {folder.name}, {title}: interior "
                f"{error[inner].mean():.3f} rad, "
                f"within {EDGE_BAND_PX} px of depth edges {error[kept & ~inner].mean():.3f}, "
                f"median "
                f"{np.median(error[kept]):.3f}, beyond 0.3 rad "
                f"{100 * (error[kept] > 0.3).mean():.1f}% "
                f"of {kept.sum():,} px"
            )


if __name__ == "__main__":
    raise SystemExit(main())
