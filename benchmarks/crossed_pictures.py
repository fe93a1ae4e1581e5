"""Draw views of a dataset with crossed fringes from frame to error: phases, mask, order, depth, and what is wrong.

    python benchmarks/crossed_pictures.py data/crossed --out docs/pictures

Depth, order and mask are those of `crossed`; its error stands beside those of `crossed-net` and of three frames.
"""

import argparse
import functools
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from phase_pictures import Panel, draw_panels

from fpp_ml_bench.baselines import load_method
from fpp_ml_bench.baselines.crossed_route import CrossedMethod, CrossedObservation
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.phase_route import TAU, wrapped
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.storage import DatasetFolder

SHOWN = ("magazine_stack_A60", "power_drill_A60")
OTHERS = (("crossed-net", {}), ("crossed", {"frames": 3}))
LARGEST_ERROR_MM = 10.0


def order_of(seen: CrossedObservation) -> np.ndarray:
    """Order of the faster carrier at the fitted nearness, float64 (h, w), from 0 for the furthest on; NaN where there
    is no object."""
    carriers = seen.carriers
    faster = int(np.median(np.abs(carriers.gain[1])) > np.median(np.abs(carriers.gain[0])))
    turns = seen.fit.nearness * carriers.gain[faster] - wrapped((seen.phase_rad - carriers.infinity_rad)[faster])
    order = np.where(seen.inside, np.rint(turns / TAU), np.nan)
    return order - np.nanmin(order)


def cut_colours(name: str, count: int) -> Any:
    """The first ``count`` colours of one of matplotlib's lists."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    return ListedColormap([colormaps[name](number) for number in range(count)])


def panels_of(dataset: DatasetFolder, sample: str, method: CrossedMethod, others: list[Method]) -> list[Panel]:
    """The panels of a view, cut to its object."""
    frames = [None] * len(dataset.sequence)
    for index in {index for used in (method, *others) for index in used.frames_used}:
        frames[index] = dataset.frame(sample, index)
    seen = method.observe(frames)
    if method.route.resampling.needed:
        raise PredictionError(f"{dataset.path}: its fringes are resampled; draw a dataset of 960 px")
    crop = seen.carriers.crop
    exact, void = dataset.target_mm(sample, "depth_exact")[crop], dataset.void(sample, "depth_exact")[crop]
    on_object = object_mask(exact)
    answers = [one.predict(frames)[crop] for one in (method, *others)]
    depth_mm, *_ = answers
    found = object_mask(depth_mm)
    verdict = np.select([void, on_object & found, found, on_object], [np.nan, 1, 2, 3], 0)
    near_mm, far_mm = np.percentile(exact[on_object], [0.5, 99.5])
    ranged = {"cmap": "viridis", "vmin": near_mm - 20, "vmax": far_mm + 20}
    signed = {"cmap": "coolwarm", "vmin": -LARGEST_ERROR_MM, "vmax": LARGEST_ERROR_MM}
    four = functools.partial(cut_colours, count=4)
    cyclic = {"cmap": "twilight", "vmin": -np.pi, "vmax": np.pi}
    first, second = seen.phase_rad
    errors = [np.where(on_object & ~void & (answer > 0), answer - exact, np.nan) for answer in answers]
    names = ["crossed", *("three frames" if len(one.frames_used) > 1 else one.name for one in others)]
    return [
        ("crossed frame", seen.grey, {"cmap": "gray", "vmin": 0, "vmax": 255}),
        ("first carrier, rad", first, cyclic),
        ("second carrier, rad", second, cyclic),
        ("mask: 1 object, 2 added, 3 missed", verdict, {"cmap": four("Set1"), "vmin": -0.5, "vmax": 3.5}),
        ("order", order_of(seen), {"cmap": four("Set2"), "vmin": -0.5, "vmax": 3.5}),
        ("depth, mm", np.where(found, depth_mm, np.nan), ranged),
        ("exact depth, mm", np.where(on_object, exact, np.nan), ranged),
        *((f"error of {name}, mm", error, signed) for name, error in zip(names, errors, strict=True)),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n", 1)[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="dataset with crossed fringes")
    parser.add_argument("--samples", nargs="+", default=SHOWN, metavar="SAMPLE", help="views to draw")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the pictures")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    dataset = DatasetFolder(args.dataset)
    method = load_method("crossed", dataset.rig)
    others = [load_method(name, dataset.rig, **options) for name, options in OTHERS]
    args.out.mkdir(parents=True, exist_ok=True)
    for sample in args.samples:
        panels = panels_of(dataset, sample, method, others)
        draw_panels(panels, f"{sample}, from frame to error", args.out / f"crossed_{sample}.png", columns=5)


if __name__ == "__main__":
    main()
