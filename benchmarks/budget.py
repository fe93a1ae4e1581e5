"""The uncertainty budget of a decoded depth against a Monte Carlo method through the generator.

    python benchmarks/budget.py --calibrations 500

The paper's rig at 240 px photographs planes in six positions; two pixels of each are the places.
Every draw is a calibration anew, from 18 poses of a board whose points have normal errors,
and frames with noise anew. Per place: what the budget states for the draw (root mean square over the
draws), what the depth was off by, their ratio, and the share of draws whose error is within twice
the stated uncertainty. In the last row nothing is photographed: the calibrations
alone. Then noise and rounding, rounding without noise, and a response that is not straight (three
steps a period), each alone, over all pixels of the planes.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from fpp_ml_bench.baselines.certify.certificate import Seen, before_camera, scenes_of
from fpp_ml_bench.baselines.certify.gauges import gauges
from fpp_ml_bench.calibration.projector_points import Pose, ProjectorPoints
from fpp_ml_bench.calibration.result import Calibration, Lens
from fpp_ml_bench.calibration.solve import calibrate
from fpp_ml_bench.calibration.volume import Places, depth_spread
from fpp_ml_bench.cli.console import show
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.decode import decode_stack
from fpp_ml_bench.decoding.triangulation import ROUNDING_GREY, depth_budget_mm, noise_by_light
from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.loaders.render.boards.poses import board_poses, fitting_board
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.tables import Table

CAMERA_PX, PROJECTOR_PX = 0.023, 0.074
"""Normal errors of the board's points: what `fpp-bench calibrate --virtual DIR --size 240` shows."""
OFF = (-25, 25)
"""Columns from the middle of a plane at which its pixels are taken."""
CAPTURES = 40
"""With noise anew; draws of calibrations go through them in turn."""
GAMMA = 1.1
EDGE_PX = 4
COVERAGE = 2.0
NOISE, ROUNDING, RESPONSE = "noise", "rounding to grey levels", "response and epipolar pattern"
Maps = NDArray[np.float64]


def drawn_calibrations(rig: Rig, count: int) -> Iterator[Calibration]:
    """Each from the same poses, with errors of its own."""
    board = replace(fitting_board(rig), detail_mm=0.0)  # of exact centres
    points_m = board.points_mm() / MM_PER_M
    exact = []
    for pose in board_poses(rig, board):
        points = pose.points_m(points_m)
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        camera = rig.camera
        image = np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], axis=1)
        exact.append((image, np.stack(rig.project(points), axis=1)))
    size = rig.camera.width, rig.camera.height
    of_projector = rig.projector.width, rig.projector.height
    for seed in range(count):
        random = np.random.default_rng(seed)
        poses = []
        for number, (image, shown) in enumerate(exact):
            corners = image + random.normal(0, CAMERA_PX, image.shape)
            own = np.full_like(shown, 0.0)
            coded = shown + random.normal(0, PROJECTOR_PX, shown.shape)
            slopes = np.zeros((len(shown), 2, 2))
            poses.append(Pose(f"{number}", size, corners, ProjectorPoints(coded, own, slopes, {})))
        lenses = Lens("radial-1"), Lens("radial-1")
        yield calibrate(poses, board, size, of_projector, lenses, hold_out=False)


def planes(rig: Rig, noisy: bool, gamma: float = 1.0) -> list[Seen]:
    """The planes of a type test in light without further bounces."""
    settings = scenes_of(rig, "paper")
    light = settings.light.changed("bounces", interreflection=False, ambient_occlusion=False)
    light = light.changed("projector", response=gamma)
    if not noisy:
        light = light.changed("camera", full_well_e=None)
    studio = Studio(replace(settings, light=light))
    frames = range(len(rig.sequence))
    return [before_camera(studio, gauge, frames) for gauge in gauges(rig) if gauge.kind == "plane"]


def measured(
    frames: Sequence[Maps | None], rig: Rig, where: NDArray[np.bool_]
) -> tuple[Maps, dict[str, Maps]]:
    """Depth in mm of the pixels ``where`` (H, W), and its budget by noise alone, (n,) each."""
    decoded = decode_stack(stacked(frames), rig, mask=where, details=True)
    missing = int((decoded.depth_mm[where] == 0).sum())
    if missing:
        raise SystemExit(f"{missing} of {where.sum()} pixels have no depth")
    dark, per_grey = noise_by_light(frames, rig) or (ROUNDING_GREY**2, 0.0)
    modulation = next(iter(decoded.details.values())).modulation
    noise_grey = np.sqrt(dark + per_grey * np.nan_to_num(modulation.astype(np.float64)))
    return decoded.depth_mm[where], depth_budget_mm(decoded, rig, noise_grey, {})


def monte_carlo(rig: Rig, count: int) -> Table:
    """Calibration and noise anew in every draw, at ten places."""
    scenes = planes(rig, noisy=True)
    masks = []
    for scene in scenes:
        rows, columns = np.nonzero(scene.part == 0)
        masks.append(np.zeros(scene.part.shape, dtype=bool))
        masks[-1][int(np.median(rows)), int(np.median(columns)) + np.array(OFF)] = True
    exact = np.concatenate([s.exact_mm[mask] for s, mask in zip(scenes, masks, strict=True)])
    rows, columns = (
        np.concatenate(axis) for axis in zip(*(np.nonzero(mask) for mask in masks), strict=True)
    )
    captures = [[scene.frames(capture) for scene in scenes] for capture in range(CAPTURES)]
    errors, by_noise, by_calibration, silent = np.zeros((4, count, len(exact)))
    true_places = Places.at(rig, columns.astype(float), rows.astype(float), exact[None])
    for draw, calibration in enumerate(drawn_calibrations(rig, count)):
        found = calibration.applied_to(rig)
        results = [
            measured(frames, found, mask)
            for frames, mask in zip(captures[draw % CAPTURES], masks, strict=True)
        ]
        depth = np.concatenate([depth for depth, _ in results])
        places = Places.at(found, columns.astype(float), rows.astype(float), depth[None])
        errors[draw] = depth - exact
        silent[draw] = true_places.found_mm(found)[0] - exact
        by_noise[draw] = np.concatenate([total(budget) for _, budget in results])
        by_calibration[draw] = depth_spread(places, calibration.root).mm[0]
    stated = np.hypot(by_noise, by_calibration)
    inside = np.abs(errors) <= COVERAGE * stated
    columns_shown = ("row, column", "noise", "calibration", "stated", "found", "ratio", "within 2")
    table = Table("depth, mm", numbers=columns_shown, title=f"{count} draws; mm")
    for at, depth_mm in enumerate(exact):
        own = [rms(values[:, at]) for values in (by_noise, by_calibration, stated, errors)]
        table.add_row(
            f"{depth_mm:.0f}",
            f"{rows[at]}, {columns[at]}",
            *(f"{mm:.3f}" for mm in own),
            f"{own[2] / own[3]:.2f}",
            f"{100 * inside[:, at].mean():.1f}%",
        )
    ratio = rms(stated) / rms(errors)
    table.add_row("all", "", "", "", "", "", f"{ratio:.2f}", f"{100 * inside.mean():.1f}%")
    only = rms(by_calibration), rms(silent)
    cells = f"{only[0]:.3f}", "", f"{only[1]:.3f}", f"{only[0] / only[1]:.2f}", ""
    table.add_row("calibration alone", "", "", *cells)
    return table


def alone(rig: Rig) -> Table:
    """Each source alone, over all pixels of the planes."""
    table = Table("source alone", numbers=("stated, mm", "found, mm", "ratio"))

    def add(name: str, stated: Sequence[Maps], found: Sequence[Maps]) -> None:
        both = [rms(np.concatenate([part.ravel() for part in parts])) for parts in (stated, found)]
        table.add_row(name, *(f"{mm:.4f}" for mm in both), f"{both[0] / both[1]:.2f}")

    whole: list[tuple[Seen, NDArray[np.bool_]]] = []
    for scene in planes(rig, noisy=True):
        inner = binary_erosion(scene.part == 0, iterations=EDGE_PX)
        whole.append((scene, inner))
    noisy = [
        (measured(scene.frames(0), rig, inner), scene.exact_mm[inner]) for scene, inner in whole
    ]
    add("noise and rounding", [total(b) for (_, b), _ in noisy], [d - z for (d, _), z in noisy])
    still = planes(rig, noisy=False)
    silent = [
        (measured(scene.frames(0), rig, inner), scene.exact_mm[inner])
        for scene, (_, inner) in zip(still, whole, strict=True)
    ]
    add("rounding", [b[ROUNDING] for (_, b), _ in silent], [d - z for (d, _), z in silent])
    fine = three_steps(paper_rig())  # at 240 px a period is too few pixels to tell the response
    bent, straight = (planes(fine, noisy=False, gamma=power)[0] for power in (GAMMA, 1.0))
    inner = binary_erosion(bent.part == 0, iterations=EDGE_PX)
    frames, plain = (stacked(scene.frames(0)) for scene in (bent, straight))
    off_mm, exact_mm = (
        decode_stack(each, fine, mask=inner, details=True) for each in (frames, plain)
    )
    both = (off_mm.depth_mm > 0) & (exact_mm.depth_mm > 0)
    systematic_rad = examine(frames, fine).systematic_rad
    lines = depth_budget_mm(off_mm, fine, ROUNDING_GREY, systematic_rad)
    difference = off_mm.depth_mm.astype(np.float64) - exact_mm.depth_mm
    add(f"response, gamma {GAMMA:g}, three steps", [lines[RESPONSE]], [difference[both]])
    return table


def stacked(frames: Sequence[NDArray | None]) -> NDArray:
    return np.stack([frame for frame in frames if frame is not None])


def three_steps(rig: Rig) -> Rig:
    """The rig with sinusoids of two pitches and three steps in each direction."""
    content = rig.to_dict()
    del content["pitch_px"]
    content["sequence"] = {
        "vertical": {"scheme": "phase-shift", "pitches_px": [18, 114, 912], "steps": 3},
        "horizontal": {"scheme": "phase-shift", "pitches_px": [18, 114, 1140], "steps": 3},
    }
    return rig_from_dict(content)


def total(budget: Mapping[str, Maps]) -> Maps:
    return np.hypot(budget[NOISE], budget[ROUNDING])


def rms(values: Maps) -> float:
    return float(np.sqrt(np.mean(np.square(values, dtype=np.float64))))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calibrations", type=int, default=500)
    count = parser.parse_args().calibrations
    rig = paper_rig(240)
    show(alone(rig))
    show(monte_carlo(rig, count))
    return 0


if __name__ == "__main__":
    sys.exit(main())
