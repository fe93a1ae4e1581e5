"""Measured and expected errors of crossed fringes over their period: what ``fpp-bench patterns
--design`` assumes.

    python benchmarks/crossed_sweep.py paper --pitches 6,8,10,12,14,18
    python benchmarks/crossed_sweep.py paper --focal 1.4 --baseline 1.5 --pitches 7,8,10,12
    python benchmarks/crossed_sweep.py paper --pair 10,12,30,75

RIG: paper or a rig file; --focal and --baseline multiply the camera's focal length and the
translation. The validation objects are rendered with one crossed frame of every period
(`design.search.square_pair`, or the pairs of --pair) in every light, and measured by `crossed` with
the true mask. For each are printed: mean absolute error of the two phases of a window along the
line of depths; share of the pixels whose error across it is above 0.2 and 0.5 rad; wrong orders
before and after neighbours help; MAE and RMSE of the object; and the error that the design expects.
"""

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.learned.scenes import photographed
from fpp_ml_bench.baselines.phase.candidates import chosen_values, crossed_candidates
from fpp_ml_bench.baselines.phase.geometry import grid_of, wrapped
from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.route import two_carriers
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import OBJECTS, VIEWS, split_of
from fpp_ml_bench.design.rivals import EpipolarLines
from fpp_ml_bench.design.search import Assumptions, describe, square_pair
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.loaders.render.light import load_light
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import FIRST_SHIFTED_DEG, NAMED_RIGS
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.tables import Table

WRONG_RAD = np.pi / 2  # of the joint phase
WRONG_MM = 40.0
FAR = np.float32(1000.0)  # a depth in mm where there is none


def measured(
    rig: Rig, family: Crossed, light: str, views: tuple[str, ...]
) -> list[dict[str, float]]:
    """The figures of every view that the rig can place."""
    objects = tuple(name for name in OBJECTS if split_of(name) == "validation")
    shown = rig.with_crossed(replace(family, shifts_deg=FIRST_SHIFTED_DEG))
    studio = Studio(BuildSettings(rig=shown, objects=objects, light=load_light(light)))
    route, rows = two_carriers(TwoCarriers(shown)), []
    for name in objects:
        for view in views:
            try:
                frames, exact, flags = photographed(
                    studio, name, view, (shown.sequence.crossed_frames[0],)
                )
            except FppBenchError:  # the object does not fit this camera's image
                continue
            inside = exact > 0
            target = inside & ((flags & VOID) == 0)
            fitted = route.choose(route.observe(frames[0], inside))
            seen, depth_mm = fitted.seen, route.depth(fitted).depth_mm
            grid = grid_of(seen.stride)
            points, carriers = target[seen.crop][grid], seen.carriers.at(grid)
            truth = carriers.nearness(np.where(points, exact[seen.crop][grid], FAR))
            error: NDArray = wrapped(seen.point_phase_rad - carriers.phases(truth))
            share = carriers.gain / carriers.joint_gain
            along = (error * share).sum(axis=0)[points]
            across = np.abs(error[0] * share[1] - error[1] * share[0])[points]
            offered = crossed_candidates(seen)
            nearest = np.where(offered.exists, offered.misfit_rad, np.inf).argmin(axis=0)
            alone = chosen_values(offered.nearness, nearest)
            off_mm = np.abs(depth_mm - exact)[target]
            rows.append(
                {
                    "along, rad": np.abs(along).mean(),
                    "across > 0.2": 100 * (across > 0.2).mean(),
                    "> 0.5 rad, %": 100 * (across > 0.5).mean(),
                    "wrong before, %": 100
                    * (np.abs(alone - truth) * carriers.joint_gain > WRONG_RAD)[points].mean(),
                    "after, %": 100 * (off_mm > WRONG_MM).mean(),
                    "MAE, mm": off_mm.mean(),
                    "RMSE, mm": np.sqrt((off_mm**2).mean()),
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rig")
    parser.add_argument("--size", type=int, default=960)
    parser.add_argument("--focal", type=float, default=1.0)
    parser.add_argument("--baseline", type=float, default=1.0)
    parser.add_argument("--pitches", default="8,10,12,14,18")
    parser.add_argument(
        "--pair", action="append", default=[], help="P,Q,A,B: px and degrees, in place of --pitches"
    )
    parser.add_argument("--lights", default="paper,workshop")
    parser.add_argument("--views", default=",".join(VIEWS[::2]))
    given = parser.parse_args()
    rig = NAMED_RIGS[given.rig](given.size) if given.rig in NAMED_RIGS else load_rig(given.rig)
    camera = replace(rig.camera, fx=rig.camera.fx * given.focal, fy=rig.camera.fy * given.focal)
    moved = tuple(given.baseline * part for part in rig.translation_m)
    rig = replace(rig, camera=camera, translation_m=moved)
    lines = EpipolarLines.of(rig)
    pairs = [tuple(map(float, words.split(","))) for words in given.pair]
    families = [Crossed(pair[:2], pair[2:]) for pair in pairs]
    families = families or [square_pair(lines, float(pitch)) for pitch in given.pitches.split(",")]
    rows = []
    for family, expected in zip(families, describe(rig, families, Assumptions()), strict=True):
        for light in given.lights.split(","):
            found = measured(rig, family, light, tuple(given.views.split(",")))
            means = {key: np.mean([row[key] for row in found]) for key in found[0]}
            named = {"periods, px": "{:g} / {:g}".format(*family.pitches_px), "light": light}
            figures = {
                key: f"{value:.3f}" if key.endswith("rad") else f"{value:.2f}"
                for key, value in means.items()
            }
            rows.append({**named, **figures, "expected, mm": f"{expected.expected_mm:.2f}"})
            print(rows[-1], flush=True)
    print("\n".join(Table.of(given.rig, rows, words=(0, 1)).markdown()))


if __name__ == "__main__":
    main()
