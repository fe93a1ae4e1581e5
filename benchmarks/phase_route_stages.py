"""What each stage of the phase route adds to error and time, and the pictures of docs/phase_route.md.

    python benchmarks/phase_route_stages.py DATASET --split test [--fringe vertical] [--pictures docs/pictures]

Needs a generated dataset (depth_exact) at the size in question, with the frame of the chosen fringe stored:
``fpp-bench build DATASET --preset full --frames sinusoidal``. One thread.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np
from phase_pictures import draw_panels

from fpp_ml_bench.baselines.phase_route import TAU, Measurement, PhaseMethod
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.loaders.storage import DatasetFolder

SHOWN = ("container_bottle_A60", "large_clamp_A120", "wooden_boards_A0")
VARIANTS: dict[str, dict] = {
    "range + shading": {},
    "range + shading + standoff": {"prior": "standoff"},
    "range + standoff, no shading": {"prior": "standoff", "shading": False},
    "range alone": {"shading": False},
}


def compare(measurement: Measurement, route, target: np.ndarray, exact: np.ndarray) -> dict[str, float]:
    """Scores of one sample, by stage; mm, rad and percent of object pixels."""
    inside = object_mask(target)
    measured = inside & (measurement.depth_mm > 0)
    layer = route.layer.at(measured)
    wrapped, order = measurement.wrapped_phase_rad[measured].astype(np.float64), measurement.order[measured]
    residual = layer.residual_phase(wrapped, order)
    true_residual = layer.absolute_phase(exact[measured]) - layer.infinity_rad - TAU * layer.infinity_order
    phase_error = residual - true_residual
    wrong = np.rint(phase_error / TAU)
    floor = np.abs(layer.depth_of_residual_mm(residual - TAU * wrong) - target[measured])
    error = np.abs(measurement.depth_mm - target)
    return {
        "object MAE mm": error[inside].mean(),
        "object median mm": np.median(error[inside]),
        "phase error rad": np.abs(phase_error - TAU * wrong).mean(),
        "wrong order %": 100 * np.count_nonzero(wrong) / inside.sum(),
        "right-order MAE mm": error[measured][wrong == 0].mean(),
        "floor (order given) mm": floor.mean(),
        "missed object %": 100 * np.count_nonzero(inside & ~measured) / inside.sum(),
        "background MAE mm": measurement.depth_mm[~inside].mean(),
        "seconds": sum(measurement.seconds.values()),
    }


def fourier_floor(image: np.ndarray, route, target: np.ndarray, exact: np.ndarray, masked: bool) -> float:
    """MAE with the order given of Gabor filtering (one Gaussian in frequency at the carrier), for comparison, mm."""
    inside = object_mask(target)
    carrier = route.layer.absolute_phase(route.rig.standoff_m * 1000)
    light = image - image[inside].mean()
    weight = inside.astype(float) if masked else np.ones(inside.shape)
    sigma = 0.5 * route.period_px
    size = 2 * int(3 * sigma) + 1
    parts = [cv2.GaussianBlur(light * weight * f, (size, size), sigma) for f in (np.cos(carrier), np.sin(carrier))]
    phase = carrier + np.arctan2(-parts[1], parts[0])
    layer = route.layer.at(inside)
    true_residual = layer.absolute_phase(exact[inside]) - layer.infinity_rad - TAU * layer.infinity_order
    phase_error = phase[inside] - layer.infinity_rad - true_residual
    phase_error -= TAU * np.rint(phase_error / TAU)
    return float(np.abs(layer.depth_of_residual_mm(true_residual + phase_error) - target[inside]).mean())


def sparsification(samples: list[tuple[np.ndarray, np.ndarray]], shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """MAE of the most confident ``shares`` of all pixels, and of the same shares sorted by the true error."""
    error = np.concatenate([e for e, _ in samples])
    confidence = np.concatenate([c for _, c in samples])
    curves = []
    for key in (-confidence, error):
        running = np.cumsum(error[np.argsort(key, kind="stable")]) / np.arange(1, error.size + 1)
        curves.append(running[np.maximum((shares * error.size).astype(int) - 1, 0)])
    return curves[0], curves[1]


def run(dataset: DatasetFolder, split: str, options: dict) -> tuple[list[dict], list[tuple], dict[str, float]]:
    method = PhaseMethod(dataset.rig, **options)
    (frame,) = method.frames_used
    rows, sparse, stages = [], [], {}
    samples = dataset.samples(split)
    method.route.measure(np.array(dataset.frame(samples[0], frame)))  # compiles
    for sample in samples:
        measurement = method.route.measure(np.array(dataset.frame(sample, frame)))
        target, exact = dataset.depth_mm(sample), np.maximum(dataset.depth_mm(sample, "depth_exact"), 1.0)
        rows.append(compare(measurement, method.route, target, exact))
        inside = object_mask(target) & (measurement.depth_mm > 0)
        sparse.append((np.abs(measurement.depth_mm - target)[inside][::7], measurement.confidence[inside][::7]))
        for stage, seconds in measurement.seconds.items():
            stages.setdefault(stage, []).append(seconds)
    return rows, sparse, {stage: float(np.median(seconds)) for stage, seconds in stages.items()}


def pictures(dataset: DatasetFolder, options: dict, folder: Path, sparse: list[tuple]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    method = PhaseMethod(dataset.rig, **options)
    (frame,) = method.frames_used
    for sample in SHOWN:
        image, target = np.array(dataset.frame(sample, frame)), dataset.depth_mm(sample)
        measurement = method.route.measure(image)
        shown = object_mask(target) | (measurement.depth_mm > 0)
        rows, columns = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
        box = (slice(max(rows[0] - 8, 0), rows[-1] + 8), slice(max(columns[0] - 8, 0), columns[-1] + 8))
        blank = np.where(measurement.depth_mm > 0, 1.0, np.nan)[box]
        limits = np.percentile(target[object_mask(target)], [1, 99])
        panels = (
            ("fringe, grey levels", image[box], {"cmap": "gray"}),
            ("wrapped phase, rad", measurement.wrapped_phase_rad[box], {"cmap": "twilight"}),
            ("order", measurement.order[box] * blank, {"cmap": "viridis"}),
            ("depth, mm", measurement.depth_mm[box] * blank, {"vmin": limits[0], "vmax": limits[1]}),
            (
                "error, mm",
                np.where(shown, measurement.depth_mm - target, np.nan)[box],
                {"cmap": "RdBu", "vmin": -20, "vmax": 20},
            ),
            ("confidence", measurement.confidence[box] * blank, {"vmin": 0, "vmax": 1}),
        )
        draw_panels(panels, f"{sample}, one {method.options.direction} fringe", folder / f"phase_{sample}.png")
    shares = np.linspace(0.02, 1, 99)
    by_confidence, best = sparsification(sparse, shares)
    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    axis.plot(100 * shares, by_confidence, label="sorted by confidence")
    axis.plot(100 * shares, best, "--", label="sorted by true error")
    axis.set(xlabel="object pixels kept, %", ylabel="MAE of the pixels kept, mm", ylim=(0, None), xlim=(0, 100))
    axis.legend()
    axis.grid(alpha=0.3)
    figure.savefig(folder / "phase_sparsification.png", dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--fringe", default="horizontal", choices=("horizontal", "vertical"))
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="also write the pictures there")
    parser.add_argument("--variants", action="store_true", help="also without shading, and with the standoff prior")
    parser.add_argument("--fourier", action="store_true", help="also the floor of Gabor filtering")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    dataset = DatasetFolder(args.dataset)
    for title, options in VARIANTS.items() if args.variants else list(VARIANTS.items())[:1]:
        options = {"direction": args.fringe, **options}
        rows, sparse, stages = run(dataset, args.split, options)
        print(f"\n{args.dataset.name}, {args.split}, {args.fringe} fringe, order by {title}: {len(rows)} samples")
        print("| stage | mean | median |\n|---|---|---|")
        for key in rows[0]:
            values = [row[key] for row in rows]
            print(f"| {key} | {np.mean(values):.3f} | {np.median(values):.3f} |")
        print("seconds by stage, median:", ", ".join(f"{stage} {seconds:.3f}" for stage, seconds in stages.items()))
        if title == "range + shading":
            shares = np.array([0.5, 0.75, 0.9, 1.0])
            by_confidence, best = sparsification(sparse, shares)
            print("MAE mm of the most confident 50, 75, 90, 100%:", np.round(by_confidence, 2))
            print("the same, sorted by true error:", np.round(best, 2))
            if args.pictures:
                pictures(dataset, options, args.pictures, sparse)
    if args.fourier:
        route = PhaseMethod(dataset.rig, direction=args.fringe).route
        (frame,) = PhaseMethod(dataset.rig, direction=args.fringe).frames_used
        for masked in (False, True):
            values = []
            for sample in dataset.samples(args.split):
                image = np.array(dataset.frame(sample, frame), dtype=float)
                exact = np.maximum(dataset.depth_mm(sample, "depth_exact"), 1.0)
                values.append(fourier_floor(image, route, dataset.depth_mm(sample), exact, masked))
            window = "inside the true mask" if masked else "across edges"
            print(f"Gabor filter {window}, order given: {np.mean(values):.2f} mm (median {np.median(values):.2f})")


if __name__ == "__main__":
    main()
