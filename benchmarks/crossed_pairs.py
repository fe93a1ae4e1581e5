"""Pairs of carriers from end to end: validation objects rendered with each, measured by the crossed route.

    python benchmarks/crossed_pairs.py [--pair P,Q,A,B ...] [--light NAME]

P, Q: periods in projector px; A, B: angles in degrees. What `fpp-bench design` expects of a pair is for one pixel on
its own; here neighbours help, and windows cover edges. Void pixels are left out.
"""

import argparse

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.crossed_route import CrossedRoute
from fpp_ml_bench.coding import Crossed
from fpp_ml_bench.constants import MM_PER_M, OBJECTS, VIEWS, split_of
from fpp_ml_bench.loaders import render
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics import paper_rig

PAIRS = (
    "18,18,0,90",
    "18,14,0,90",
    "18,18,144.6,54.6",
    "14,14,142.7,52.7",
    "16,18,25,105",
    "18,27,25,160",
    "10,12,30,75",
)
WRONG_MM = 75.0  # an error that only another order explains


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pair", action="append", metavar="P,Q,A,B")
    parser.add_argument("--light", default="paper")
    args = parser.parse_args()
    objects = [name for name in OBJECTS if split_of(name) == "validation"]
    print("| px | degrees | object MAE, mm | median | right order | wrong orders | missed | background MAE |")
    print("|---|---|---|---|---|---|---|---|")
    for text in args.pair or PAIRS:
        first, second, angle, other = map(float, text.split(","))
        family = Crossed((first, second), (angle, other))
        rig = paper_rig().with_crossed(family)
        route = CrossedRoute(rig)
        light = render.load_light(args.light)
        studio = render.Studio(render.BuildSettings(rig, tuple(objects), light=light))
        rows = []
        for name in objects:
            mesh = render.solid_mesh(name)
            for view in VIEWS[::2]:
                scene = studio.trace(mesh, view)
                studio.expose(scene, rig.sequence.crossed_frames[:1])
                depth_mm = np.zeros((rig.camera.height, rig.camera.width))
                depth_mm.ravel()[scene.hits.pixels] = scene.hits.depth_m * MM_PER_M
                frame = studio.frame(rig.sequence.crossed_frames[0])
                void = (studio.flags(scene)[0] & VOID) != 0
                rows.append(scores(route.measure(frame).depth_mm, depth_mm, void))
        mae, median, right, wrong, missed, background = np.mean(rows, axis=0)
        print(
            f"| {first:g} / {second:g} | {angle:g} / {other:g} | {mae:.2f} | {median:.2f} | {right:.2f} | "
            f"{100 * wrong:.2f}% | {100 * missed:.3f}% | {background:.2f} |",
            flush=True,
        )
    return 0


def scores(found_mm: NDArray, depth_mm: NDArray, void: NDArray) -> tuple[float, ...]:
    """MAE and median of the object, MAE of its right orders, shares of wrong orders and of missed pixels, and MAE of
    the background."""
    on_object, background = (depth_mm > 0) & ~void, (depth_mm == 0) & ~void
    error, answered = np.abs(found_mm - depth_mm)[on_object], found_mm[on_object] > 0
    wrong = answered & (error > WRONG_MM)
    return (
        float(error.mean()),
        float(np.median(error)),
        float(error[answered & ~wrong].mean()),
        float(wrong.mean()),
        float((~answered).mean()),
        float(found_mm[background].mean()),
    )


if __name__ == "__main__":
    raise SystemExit(main())
