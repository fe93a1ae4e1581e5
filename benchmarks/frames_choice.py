"""Fewest frames a scene needs for a stated error, chosen while capturing, against a choice that is given the depth.

    fpp-bench build data/full --preset full
    python benchmarks/frames_choice.py data/full --error-mm 1 3 5 --out docs/pictures/frames_choice.png

For every view: the frames that ``fpp-bench predict phase --error-mm`` uses and the object MAE they reach, and the
oracle: of the same levels the fewest frames whose object MAE against the exact depth (without void pixels, as
``fpp-eval --target depth_exact`` scores) is at most that error. Over
budget: views whose error is larger than stated. ``--calibrate`` prints instead which share of the doubt about the order
turned out to be a real error (`ORDER_SHARE`), over that split.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.phase_route import PIXELWISE, FewestFrames, Measurement, PhaseMethod
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.cli.console import progress_bar
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.loaders.storage import DatasetFolder


@dataclass(frozen=True)
class View:
    """One view and one stated error: frames and object MAE in mm of the choice, and of the oracle."""

    sample: str
    error_mm: float
    frames: int
    mae_mm: float
    expected_mm: float
    oracle_frames: int
    oracle_mae_mm: float


class CachedMethod:
    """A method that measures the same frames only once: all stated errors share the measurements of a view."""

    def __init__(self, method: PhaseMethod) -> None:
        self.method, self.frames_used, self.settings = method, method.frames_used, method.settings
        self._frames: list | None = None
        self._measurement: Measurement | None = None

    def measure(self, frames: list) -> Measurement:
        if self._measurement is None or self._frames is not frames:
            self._frames, self._measurement = frames, self.method.measure(frames)
        return self._measurement


def object_mae_mm(depth_mm: np.ndarray, target_mm: np.ndarray, void: np.ndarray) -> float:
    return float(score_sample(depth_mm, target_mm, EDGE_BAND_PX, void).object.mae_mm or 0.0)


def level_errors(chooser: FewestFrames, frames: list, target_mm: np.ndarray, void: np.ndarray) -> dict[int, float]:
    """Object MAE in mm of every level that can be chosen, by its number of frames."""
    errors_mm = {}
    for count, method in chooser.methods.items():
        errors_mm[count] = object_mae_mm(method.measure(frames).depth_mm, target_mm, void)
        if count >= PIXELWISE:
            classical = ClassicalMethod(chooser.rig, direction=chooser.options.direction, steps=count)
            errors_mm[count + len(chooser.gray)] = object_mae_mm(classical.predict(frames), target_mm, void)
    return dict(sorted(errors_mm.items()))


def measure_views(dataset: DatasetFolder, split: str, direction: str, errors: list[float], every: int) -> list[View]:
    choosers = {error: FewestFrames(dataset.rig, error, direction=direction) for error in errors}
    first = choosers[errors[0]]
    cached = {count: CachedMethod(method) for count, method in first.methods.items()}
    for chooser in choosers.values():
        chooser.methods = cached  # type: ignore[assignment]
    views = []
    samples = dataset.samples(split)[::every]
    with progress_bar(f"{direction}, {split}", len(samples), "samples") as advance:
        for sample in samples:
            frames, target_mm = captured_frames(dataset, first, sample), dataset.target_mm(sample, "depth_exact")
            void = dataset.void(sample, "depth_exact")
            levels = level_errors(first, frames, target_mm, void)
            for error, chooser in choosers.items():
                choice = chooser.choose(frames)
                enough = [count for count, mae in levels.items() if mae <= error]
                oracle = enough[0] if enough else min(levels, key=lambda count: levels[count])
                look = choice.looks[-1]
                mae = object_mae_mm(choice.depth_mm, target_mm, void)
                views.append(View(sample, error, look.frames, mae, look.expected_mm, oracle, levels[oracle]))
            advance(1)
    return views


def calibrate(dataset: DatasetFolder, split: str, every: int) -> None:
    """Print, for each level, expected and real error of order and phase, means over views of both directions."""
    rows: dict[int, list[tuple[float, float, float, float]]] = {}
    for direction in ("horizontal", "vertical"):
        chooser = FewestFrames(dataset.rig, 1.0, direction=direction)
        samples = dataset.samples(split)[::every]
        with progress_bar(f"{direction}, {split}", len(samples), "samples") as advance:
            for sample in samples:
                frames, target_mm = captured_frames(dataset, chooser, sample), dataset.target_mm(sample, "depth_exact")
                scored = object_mask(target_mm) & ~dataset.void(sample, "depth_exact")
                for count, method in chooser.methods.items():
                    measurement = method.measure(frames)
                    measured = scored & (measurement.depth_mm > 0)
                    error = np.abs(measurement.depth_mm - target_mm)[measured].astype(np.float64)
                    far = error > 60
                    doubt = float(measurement.order_doubt_mm[measured].mean())
                    phase = float(measurement.expected_error_mm[measured].mean()) - doubt
                    rows.setdefault(count, []).append((phase, error[~far].mean(), doubt, error[far].sum() / error.size))
                advance(1)
    print("| frames | by phase, expected mm | real mm | by order, doubt mm | real mm | share |")
    print("|---|---|---|---|---|---|")
    for count, errors in rows.items():
        phase, real, doubt, wrong = np.mean(errors, axis=0)
        print(f"| {count} | {phase:.2f} | {real:.2f} | {doubt:.2f} | {wrong:.2f} | {wrong / doubt:.3f} |")


def table(views: list[View]) -> None:
    columns = (
        "stated mm",
        "frames, mean",
        "median",
        "most",
        "object MAE mm",
        "over budget",
        "oracle: frames",
        "MAE mm",
        "as many",
        "more",
        "fewer",
    )
    print(f"\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for error in sorted({v.error_mm for v in views}):
        at_error = [v for v in views if v.error_mm == error]
        frames, oracle = np.array([v.frames for v in at_error]), np.array([v.oracle_frames for v in at_error])
        mae, best = np.array([v.mae_mm for v in at_error]), np.mean([v.oracle_mae_mm for v in at_error])
        over = f"{np.count_nonzero(mae > error)} of {len(at_error)}"
        counts = [int(np.count_nonzero(cases)) for cases in (frames == oracle, frames > oracle, frames < oracle)]
        ours = f"{frames.mean():.1f} | {np.median(frames):g} | {frames.max()} | {mae.mean():.2f} | {over}"
        print(f"| {error:g} | {ours} | {oracle.mean():.1f} | {best:.2f} | {' | '.join(map(str, counts))} |")
    for v in views:
        if v.mae_mm > v.error_mm:
            print(
                f"over {v.error_mm:g} mm: {v.sample}, {v.frames} frames, {v.mae_mm:.2f} mm, expected "
                f"{v.expected_mm:.2f}; oracle {v.oracle_frames} frames, {v.oracle_mae_mm:.2f} mm"
            )


def draw(views: list[View], error_mm: float, path: Path) -> None:
    """Frames and reached error of every view for one stated error."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

    drawn = [v for v in views if v.error_mm == error_mm]
    places = np.arange(len(drawn))
    figure = Figure(figsize=(11, 6.2), dpi=100, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(places, [v.oracle_frames for v in drawn], "_", color="k", markersize=14, label="oracle")
    upper.plot(places, [v.frames for v in drawn], "o", color="tab:blue", label="chosen")
    upper.set_ylabel("frames captured")
    upper.set_yscale("log")
    upper.set_yticks(sorted({v.frames for v in drawn} | {v.oracle_frames for v in drawn}))
    lower.plot(places, [v.expected_mm for v in drawn], "o", color="tab:blue", fillstyle="none", label="expected")
    lower.plot(places, [v.mae_mm for v in drawn], "o", color="tab:blue", label="reached")
    lower.axhline(error_mm, color="tab:red", linewidth=1, label=f"stated: {error_mm:g} mm")
    lower.set_ylabel("object MAE, mm")
    lower.set_yscale("log")
    lower.set_xticks(places, [v.sample for v in drawn], rotation=90, fontsize=7)
    for axes in (upper, lower):
        axes.yaxis.set_major_formatter(ScalarFormatter())
        axes.yaxis.set_minor_formatter(lambda value, place: "")
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=8, loc="upper left", ncols=3)
    upper.set_ylim(0.8, 45)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="dataset folder with all frames and the exact depth")
    parser.add_argument("--split", default="test")
    parser.add_argument("--fringe", default="horizontal", choices=("horizontal", "vertical"))
    parser.add_argument("--error-mm", type=float, nargs="+", default=[1.0, 3.0, 5.0], metavar="MM")
    parser.add_argument("--drawn", type=float, default=3.0, metavar="MM", help="the stated error that the figure shows")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th view")
    parser.add_argument(
        "--calibrate", action="store_true", help="only the share of the doubt about the order that is real"
    )
    parser.add_argument("--out", type=Path, default=Path("frames_choice.png"))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    dataset = DatasetFolder(args.dataset)
    if args.calibrate:
        calibrate(dataset, args.split, args.every)
        return
    views = measure_views(dataset, args.split, args.fringe, args.error_mm, args.every)
    table(views)
    if args.drawn in args.error_mm:
        draw(views, args.drawn, args.out)
        print(f"\n{args.out}")


if __name__ == "__main__":
    main()
