"""What each learned part of phase-net is worth, and the order taken from the depth of a UNet instead.

    python benchmarks/phase_network_levers.py DATASET [--split test] [--fringe vertical] [--per-object] [--hybrid]
        [--brief] [--weights FILE] [--pictures docs/pictures]

Needs a generated dataset at 960 px with the fringe's first frame: ``fpp-bench build data/full --preset full``. Times
are processor seconds on one thread.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from time import process_time

import cv2
import numpy as np
import torch
from phase_pictures import draw_panels
from phase_route_stages import SHOWN

from fpp_ml_bench.baselines.networks import load
from fpp_ml_bench.baselines.phase_network import AnsweredObservation, Levers, NetworkRoute, PhaseNetMethod
from fpp_ml_bench.baselines.phase_route import TAU, Measurement
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder

NOTHING = Levers(order=False, mask=False, phase=False)
NOTHING_LEARNED = "nothing learned"
FULL = "order + mask + correction (phase-net)"
VARIANTS: dict[str, Levers] = {
    NOTHING_LEARNED: NOTHING,
    "order": Levers(mask=False, phase=False),
    "order + mask": Levers(phase=False),
    "order + correction": Levers(mask=False),
    "mask + correction": Levers(order=False),
    FULL: Levers(),
    "the same, each pixel's likeliest order (no graph)": Levers(graph=0.0),
    "the same, graph of weight 1": Levers(graph=1.0),
    "the same, graph of weight 10": Levers(graph=10.0),
    "the same, correction within pi / 4": Levers(bound_rad=np.pi / 4),
    "the same, correction within pi / 8": Levers(bound_rad=np.pi / 8),
}
BLIND = "weights for any albedo"
HYBRID = "order from a UNet's depth (unet-global-rmse, 224 px), nothing else learned"
COLUMNS = ("mean", "median view", "wrong order %", "right-order", "missed %", "background", "CPU seconds")


def compare(measurement: Measurement, route: NetworkRoute, target: np.ndarray) -> dict[str, float]:
    """Scores of one sample in mm and percent of object pixels; a wrong order is off by more than half a period."""
    inside = object_mask(target)
    measured = inside & (measurement.depth_mm > 0)
    layer = route.geometry.layer.at(measured)
    true_phase = layer.absolute_phase(target[measured])
    phase_error = measurement.wrapped_phase_rad[measured] + TAU * measurement.order[measured] - true_phase
    wrong = np.abs(phase_error) > np.pi
    error = np.abs(measurement.depth_mm - target)
    return {
        "mean": error[inside].mean(),
        "wrong order %": 100 * wrong.sum() / inside.sum(),
        "right-order": error[measured][~wrong].mean(),
        "missed %": 100 * (inside & ~measured).sum() / inside.sum(),
        "background": measurement.depth_mm[~inside].mean(),
    }


def measure_with_order_of(depth_mm: np.ndarray, answered: AnsweredObservation, route: NetworkRoute) -> Measurement:
    """The phase route's depth with the candidate order nearest to the order of ``depth_mm``."""
    seen = answered.observation
    depth_order = np.rint((seen.layer.absolute_phase(np.maximum(depth_mm[seen.crop], 1.0)) - seen.phase_rad) / TAU)
    first, count = seen.candidates.first, seen.candidates.count
    order = np.clip(depth_order, first, first + np.maximum(count, 1) - 1).astype(np.int32)
    return route.geometry.route.conclude(seen, order, np.zeros_like(answered.margin))


def unet(size: tuple[int, int]) -> Callable[[np.ndarray], np.ndarray]:
    """The shipped UNet at the image size it was trained at, its depth map resized to ``size`` (H, W)."""
    model = load("unet-global-rmse", "cpu")
    height, width = model.config.image_size

    def predict(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return cv2.resize(model.predict(small), size[::-1], interpolation=cv2.INTER_LINEAR)

    return predict


def table(rows: dict[str, list[dict[str, float]]]) -> None:
    print("| learned | " + " | ".join(COLUMNS) + " |\n|---|" + "---|" * len(COLUMNS))
    for title, samples in rows.items():
        means = {key: np.mean([scores[key] for scores in samples]) for key in samples[0]}
        means["median view"] = np.median([scores["mean"] for scores in samples])
        print(f"| {title} | " + " | ".join(f"{means[key]:.2f}" if key in means else "" for key in COLUMNS) + " |")


def by_object(rows: list[dict[str, float]], names: list[str]) -> None:
    objects = list(dict.fromkeys(name.rsplit("_A", 1)[0] for name in names))
    print("| object | " + " | ".join(key for key in COLUMNS if key in rows[0]) + " |")
    print("|---|" + "---|" * sum(key in rows[0] for key in COLUMNS))
    for item in objects:
        views = [row for row, name in zip(rows, names, strict=True) if name.rsplit("_A", 1)[0] == item]
        means = [f"{np.mean([row[key] for row in views]):.2f}" for key in COLUMNS if key in views[0]]
        print(f"| {item} | {' | '.join(means)} |")


def pictures(dataset: DatasetFolder, method: PhaseNetMethod, folder: Path) -> None:
    """Fringe, wrapped phase, order, depth, error and correction of the views that docs/phase_route.md shows."""
    import matplotlib

    matplotlib.use("Agg")

    for sample in SHOWN:
        image, target = np.array(dataset.frame(sample, method.frames_used[0])), dataset.depth_mm(sample)
        observation = method.route.observe(image)
        measurement = method.route.conclude(observation)
        shown = object_mask(target) | (measurement.depth_mm > 0)
        rows, columns = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
        box = (slice(max(rows[0] - 8, 0), rows[-1] + 8), slice(max(columns[0] - 8, 0), columns[-1] + 8))
        blank = np.where(measurement.depth_mm > 0, 1.0, np.nan)[box]
        limits = np.percentile(target[object_mask(target)], [1, 99])
        correction = np.zeros(image.shape)
        if observation.answers is not None:
            correction[observation.observation.crop] = observation.answers.correction_rad
        error = {"cmap": "RdBu", "vmin": -20, "vmax": 20}
        panels = (
            ("fringe, grey levels", image[box], {"cmap": "gray"}),
            ("wrapped phase, rad", measurement.wrapped_phase_rad[box], {"cmap": "twilight"}),
            ("order", measurement.order[box] * blank, {"cmap": "viridis"}),
            ("depth, mm", measurement.depth_mm[box] * blank, {"vmin": limits[0], "vmax": limits[1]}),
            ("error, mm", np.where(shown, measurement.depth_mm - target, np.nan)[box], error),
            ("correction, rad", correction[box] * blank, {"cmap": "PuOr", "vmin": -0.6, "vmax": 0.6}),
        )
        draw_panels(
            panels, f"{sample}, phase-net, one {method.options.direction} fringe", folder / f"phase_net_{sample}.png"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--fringe", default="horizontal", choices=("horizontal", "vertical"))
    parser.add_argument("--weights", metavar="NAME|FILE", help="default: those for one albedo, as shipped")
    parser.add_argument("--per-object", action="store_true")
    parser.add_argument("--brief", action="store_true", help="only phase-net and the same with nothing learned")
    parser.add_argument("--hybrid", action="store_true", help="also the order from the depth of a UNet")
    parser.add_argument("--blind", action="store_true", help="also the weights for any albedo")
    parser.add_argument("--every", type=int, default=1, help="only every n-th sample")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="also write the pictures there")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    dataset = DatasetFolder(args.dataset)
    method = PhaseNetMethod(dataset.rig, direction=args.fringe, weights=args.weights)
    blind = PhaseNetMethod(dataset.rig, args.fringe, albedo="any") if args.blind else None
    predict_depth = unet(dataset.size) if args.hybrid else None
    variants = {title: VARIANTS[title] for title in ((NOTHING_LEARNED, FULL) if args.brief else VARIANTS)}
    rows: dict[str, list[dict[str, float]]] = {}
    names = dataset.samples(args.split)[:: args.every]
    for number, name in enumerate(names):
        image, target = np.array(dataset.frame(name, method.frames_used[0])), dataset.depth_mm(name)
        if number == 0:
            method.route.measure(image)
        started = process_time()
        observation = method.route.observe(image)
        shared = process_time() - started
        started = process_time()
        method.route.geometry.route.observe(image)
        network = shared - (process_time() - started)
        for title, levers in variants.items():
            started = process_time()
            measurement = method.route.conclude(observation, levers)
            seconds = shared + process_time() - started
            if levers == NOTHING:
                seconds -= network
            rows.setdefault(title, []).append(compare(measurement, method.route, target) | {"CPU seconds": seconds})
        if blind is not None:
            rows.setdefault(BLIND, []).append(compare(blind.route.measure(image), method.route, target))
        if predict_depth is not None:
            hybrid = measure_with_order_of(predict_depth(image), observation, method.route)
            rows.setdefault(HYBRID, []).append(compare(hybrid, method.route, target))
    print(
        f"\n{args.dataset.name}, {args.split}, {args.fringe} fringe: {len(names)} samples, object and background in mm"
    )
    table(rows)
    if args.per_object:
        for title in (NOTHING_LEARNED, FULL):
            print(f"\n{title}")
            by_object(rows[title], names)
    if args.pictures:
        pictures(dataset, method, args.pictures)


if __name__ == "__main__":
    main()
