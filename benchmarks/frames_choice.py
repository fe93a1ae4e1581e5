"""Fewest frames a scene needs for a stated error, chosen while capturing, against the choice that knows the truth.

    fpp-bench build data/full --preset full
    python benchmarks/frames_choice.py data/full --error-mm 1 3 5 --out docs/pictures/frames_choice.png

For every view: the frames that ``fpp-bench predict phase --error-mm`` uses and the object MAE they reach, and the
oracle: of the same levels the fewest frames whose object MAE against the exact depth is at most that error. Over
budget: views where the choice stopped with more error than stated. ``--calibrate`` prints instead what doubt about the
order was worth (`ORDER_SHARE`), over that split.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.phase_route.frame_choice import FewestFrames
from fpp_ml_bench.baselines.phase_route.measurement import Measurement
from fpp_ml_bench.baselines.phase_route.method import PhaseMethod
from fpp_ml_bench.baselines.phase_route.several_frames import PIXELWISE
from fpp_ml_bench.baselines.prediction import captured_frames
from fpp_ml_bench.commands.console import progress_bar
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.loaders.store import DatasetFolder


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


class Remembered:
    """A method whose measurement of the same frames is not computed again: errors share the levels of a view."""

    def __init__(self, method: PhaseMethod) -> None:
        self.method, self.frames_used, self.settings = method, method.frames_used, method.settings
        self._of: list | None = None
        self._found: Measurement | None = None

    def measure(self, frames: list) -> Measurement:
        if self._found is None or self._of is not frames:
            self._of, self._found = frames, self.method.measure(frames)
        return self._found


def object_mae_mm(depth_mm: np.ndarray, target_mm: np.ndarray) -> float:
    return float(score_sample(depth_mm, target_mm, EDGE_BAND_PX).object.mae_mm or 0.0)


def ladder(made: FewestFrames, frames: list, target_mm: np.ndarray) -> dict[int, float]:
    """Object MAE in mm of every level that can be chosen, by its number of frames."""
    reached = {}
    for count, one in made.methods.items():
        reached[count] = object_mae_mm(one.measure(frames).depth_mm, target_mm)
        if count >= PIXELWISE:
            classical = ClassicalMethod(made.rig, made.options.direction, count)
            reached[count + len(made.gray)] = object_mae_mm(classical.predict(frames), target_mm)
    return dict(sorted(reached.items()))


def views(opened: DatasetFolder, split: str, direction: str, errors: list[float], every: int) -> list[View]:
    makers = {error: FewestFrames(opened.rig, error, direction=direction) for error in errors}
    shared = {count: Remembered(one) for count, one in makers[errors[0]].methods.items()}
    for made in makers.values():
        made.methods = shared  # type: ignore[assignment]
    found = []
    samples = opened.samples(split)[::every]
    with progress_bar(f"{direction}, {split}", len(samples), "samples") as advance:
        for sample in samples:
            some = next(iter(makers.values()))
            frames, target_mm = captured_frames(opened, some, sample), opened.target_mm(sample, "depth_exact")
            reached = ladder(some, frames, target_mm)
            for error, made in makers.items():
                chosen = made.choose(frames)
                enough = [count for count, mae in reached.items() if mae <= error]
                oracle = enough[0] if enough else min(reached, key=lambda count: reached[count])
                look = chosen.looks[-1]
                mae = object_mae_mm(chosen.depth_mm, target_mm)
                found.append(View(sample, error, look.frames, mae, look.expected_mm, oracle, reached[oracle]))
            advance(1)
    return found


def calibrate(opened: DatasetFolder, split: str, every: int) -> None:
    """Print, for each level, expected and real error of order and phase, means over views of both directions."""
    rows: dict[int, list[tuple[float, float, float, float]]] = {}
    for direction in ("horizontal", "vertical"):
        made = FewestFrames(opened.rig, 1.0, direction=direction)
        samples = opened.samples(split)[::every]
        with progress_bar(f"{direction}, {split}", len(samples), "samples") as advance:
            for sample in samples:
                frames, target_mm = captured_frames(opened, made, sample), opened.target_mm(sample, "depth_exact")
                for count, one in made.methods.items():
                    found = one.measure(frames)
                    there = (found.depth_mm > 0) & (target_mm > 0)
                    error = np.abs(found.depth_mm - target_mm)[there].astype(np.float64)
                    far = error > 60
                    doubt = float(found.order_doubt_mm[there].mean())
                    phase = float(found.expected_error_mm[there].mean()) - doubt
                    rows.setdefault(count, []).append((phase, error[~far].mean(), doubt, error[far].sum() / error.size))
                advance(1)
    print("| frames | by phase, expected mm | real mm | by order, doubt mm | real mm | share |")
    print("|---|---|---|---|---|---|")
    for count, some in rows.items():
        phase, real, doubt, wrong = np.mean(some, axis=0)
        print(f"| {count} | {phase:.2f} | {real:.2f} | {doubt:.2f} | {wrong:.2f} | {wrong / doubt:.3f} |")


def table(found: list[View]) -> None:
    columns = ("stated mm", "frames, mean", "median", "most", "object MAE mm", "over budget", "oracle: frames",
               "MAE mm", "as many", "more", "fewer")  # fmt: skip
    print(f"\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    for error in sorted({one.error_mm for one in found}):
        some = [one for one in found if one.error_mm == error]
        frames, oracle = np.array([v.frames for v in some]), np.array([v.oracle_frames for v in some])
        mae, best = np.array([v.mae_mm for v in some]), np.mean([v.oracle_mae_mm for v in some])
        over = f"{np.count_nonzero(mae > error)} of {len(some)}"
        counts = [int(np.count_nonzero(one)) for one in (frames == oracle, frames > oracle, frames < oracle)]
        ours = f"{frames.mean():.1f} | {np.median(frames):g} | {frames.max()} | {mae.mean():.2f} | {over}"
        print(f"| {error:g} | {ours} | {oracle.mean():.1f} | {best:.2f} | {' | '.join(map(str, counts))} |")
    for v in found:
        if v.mae_mm > v.error_mm:
            print(f"over {v.error_mm:g} mm: {v.sample}, {v.frames} frames, {v.mae_mm:.2f} mm, expected "
                  f"{v.expected_mm:.2f}; oracle {v.oracle_frames} frames, {v.oracle_mae_mm:.2f} mm")  # fmt: skip


def draw(found: list[View], error_mm: float, path: Path) -> None:
    """Frames and reached error of every view for one stated error."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import ScalarFormatter

    some = [one for one in found if one.error_mm == error_mm]
    places = np.arange(len(some))
    figure = Figure(figsize=(11, 6.2), dpi=100, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(places, [v.oracle_frames for v in some], "_", color="k", markersize=14, label="fewest, truth known")
    upper.plot(places, [v.frames for v in some], "o", color="tab:blue", label="chosen, nothing known")
    upper.set_ylabel("frames captured")
    upper.set_yscale("log")
    upper.set_yticks(sorted({v.frames for v in some} | {v.oracle_frames for v in some}))
    lower.plot(places, [v.expected_mm for v in some], "o", color="tab:blue", fillstyle="none", label="expected")
    lower.plot(places, [v.mae_mm for v in some], "o", color="tab:blue", label="reached")
    lower.axhline(error_mm, color="tab:red", linewidth=1, label=f"stated: {error_mm:g} mm")
    lower.set_ylabel("object MAE, mm")
    lower.set_yscale("log")
    lower.set_xticks(places, [v.sample for v in some], rotation=90, fontsize=7)
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
    parser.add_argument("--drawn", type=float, default=3.0, metavar="MM", help="the one in the figure")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every N-th view")
    parser.add_argument("--calibrate", action="store_true", help="only the worth of doubt about the order")
    parser.add_argument("--out", type=Path, default=Path("frames_choice.png"))
    args = parser.parse_args()
    cv2.setNumThreads(1)
    opened = DatasetFolder(args.dataset)
    if args.calibrate:
        calibrate(opened, args.split, args.every)
        return
    found = views(opened, args.split, args.fringe, args.error_mm, args.every)
    table(found)
    if args.drawn in args.error_mm:
        draw(found, args.drawn, args.out)
        print(f"\n{args.out}")


if __name__ == "__main__":
    main()
