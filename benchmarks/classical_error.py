"""Classical FPP: error against frames captured and against seconds, and whether it follows sqrt(1/N).

    python benchmarks/classical_error.py DATASET [--split test] [--out docs/pictures/classical_error.png]

For N = 3, 4, 6, 9, 18 steps of vertical, horizontal and both fringe directions (with their Gray code), over a split of
a built dataset, against the exact depth, without void pixels, as ``fpp-eval --target depth_exact`` scores. Interior:
measured object pixels 3 px or more from a depth edge. The table also gives the error with edge pixels and the share of
object pixels that were not measured. Errors are means over samples; seconds are the median per sample on one thread,
frames in memory. Prints a Markdown table and draws the figure.
"""

import argparse
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.loaders.storage import DatasetFolder

STEPS = (3, 4, 6, 9, 18)
COLOURS = {"vertical": "tab:blue", "horizontal": "tab:orange", "both": "tab:green"}


@dataclass(frozen=True)
class Point:
    """One method on one split; errors in mm, means over samples."""

    direction: str
    steps: int
    frames: int
    interior_mae_mm: float
    measured_mae_mm: float
    object_mae_mm: float
    missing_share: float
    background_mae_mm: float
    seconds: float


def measure(dataset: DatasetFolder, split: str, direction: str, steps: int) -> Point:
    method = ClassicalMethod(dataset.rig, direction=direction, steps=steps)
    rows, seconds = [], []
    for number, sample in enumerate(dataset.samples(split)):
        frames = [dataset.frame(sample, i) if i in method.frames_used else None for i in range(len(dataset.sequence))]
        if number == 0:
            method.predict(frames)
        frames = [None if frame is None else frame.copy() for frame in frames]
        started = time.perf_counter()
        depth_mm = method.predict(frames)
        seconds.append(time.perf_counter() - started)
        target_mm = dataset.target_mm(sample, "depth_exact")
        scores = score_sample(depth_mm, target_mm, EDGE_BAND_PX, dataset.void(sample, "depth_exact"))
        rows.append(
            (
                scores.interior_valid.mae_mm,
                scores.valid.mae_mm,
                scores.object.mae_mm,
                scores.missing / scores.object.pixels,
                scores.background.mae_mm,
            )
        )
    mean = np.mean(np.array(rows, dtype=np.float64), axis=0)
    return Point(direction, steps, len(method.frames_used), *map(float, mean), statistics.median(seconds))


def draw(points: list[Point], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

    figure = Figure(figsize=(11, 4.4), dpi=110, layout="constrained")
    by_steps, by_frames, by_time = figure.subplots(1, 3, sharey=True)
    for direction, colour in COLOURS.items():
        line = [point for point in points if point.direction == direction]
        error = [point.interior_mae_mm for point in line]
        law = [error[-1] * (line[-1].steps / point.steps) ** 0.5 for point in line]
        by_steps.plot([p.steps for p in line], error, "o-", color=colour, label=direction)
        by_steps.plot([p.steps for p in line], law, ":", color=colour)
        by_frames.plot([p.frames for p in line], error, "o-", color=colour)
        by_frames.plot([p.frames for p in line], [p.measured_mae_mm for p in line], "s--", color=colour, alpha=0.45)
        by_time.plot([1000 * p.seconds for p in line], error, "o-", color=colour)
        for point in line:
            by_time.annotate(
                f"N={point.steps}",
                (1000 * point.seconds, point.interior_mae_mm),
                fontsize=7,
                xytext=(4, 3),
                textcoords="offset points",
            )
    by_steps.set_xlabel("phase steps N a direction")
    by_frames.set_xlabel("frames captured")
    by_time.set_xlabel("milliseconds a sample (1 thread)")
    by_steps.set_ylabel("object MAE against exact depth (mm)")
    by_steps.set_title("dotted: sqrt(1/N) from N = 18", fontsize=9)
    by_frames.set_title("dashed: edge pixels included", fontsize=9)
    by_steps.legend(title="fringes", fontsize=8)
    for axes in (by_steps, by_frames, by_time):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(True, which="both", alpha=0.25)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(ScalarFormatter())
        axes.tick_params(which="both", labelsize=7)
    figure.savefig(path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--out", type=Path, default=Path("classical_error.png"))
    args = parser.parse_args()
    dataset = DatasetFolder(args.dataset)
    steps = [n for n in STEPS if n <= dataset.sequence.steps]
    points = [measure(dataset, args.split, direction, n) for direction in COLOURS for n in steps]
    height, width = dataset.size
    samples = f"{args.split}, {len(dataset.samples(args.split))} samples of {height}x{width} px"
    print(f"{args.dataset} {dataset.fingerprint[:8]}, {samples}\n")
    columns = (
        "fringes",
        "N",
        "frames",
        "interior MAE mm",
        "x sqrt(N)",
        "with edge pixels",
        "not measured",
        "background MAE mm",
        "ms",
    )
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for p in points:
        errors = f"{p.interior_mae_mm:.3f} | {p.interior_mae_mm * p.steps**0.5:.3f} | {p.measured_mae_mm:.3f}"
        rest = f"{100 * p.missing_share:.4f}% | {p.background_mae_mm:.3f} | {1000 * p.seconds:.0f}"
        print(f"| {p.direction} | {p.steps} | {p.frames} | {errors} | {rest} |")
    draw(points, args.out)
    print(f"\n{args.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
