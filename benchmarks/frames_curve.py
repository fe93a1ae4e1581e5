"""Object error against frames captured and against seconds, from one frame to the full sequence.

    fpp-bench build data/full --preset full
    python benchmarks/frames_curve.py data/full --work frames-work --out docs/pictures/frames_curve.png
    python benchmarks/frames_curve.py --from docs/pictures/frames_curve.csv --out docs/pictures/frames_curve.png

Settings: the phase route with 1 to 18 fringes of one direction, without Gray code; the classical method with N fringes
and their Gray code, one direction and both; the phase route with learned order, mask and correction. Scored as
``fpp-eval --target depth_exact`` does: void pixels count in no set, an object pixel without a prediction counts with
its whole depth. Each setting's result is stored in ``--work`` as JSON and is not computed again; ``--settings`` selects
some of them. Seconds are processor time of one thread, which other work on the machine lengthens little; frames are in
memory. ``--from`` draws the figure again from its CSV file and measures nothing.
"""

import argparse
import csv
import json
import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from time import process_time

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np

from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.run import captured_frames
from fpp_ml_bench.cli.console import progress_bar
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX, PROTOCOL_VERSION
from fpp_ml_bench.evaluation.score import score_sample
from fpp_ml_bench.loaders.storage import DatasetFolder

FRAME_COUNTS = (1, 2, 3, 4, 6, 9, 18)
STEPS = (3, 4, 6, 9, 18)
WRONG_MM = 60.0
"""A larger error comes from a wrong order, not from the phase: this is just under a quarter of the shortest period."""
SETTINGS: dict[str, tuple[str, dict]] = {
    **{
        f"phase {direction} {n}": ("phase", {"direction": direction, "frames": n})
        for direction in ("horizontal", "vertical")
        for n in FRAME_COUNTS
    },
    **{
        f"classical {direction} {n}": ("classical", {"direction": direction, "steps": n})
        for direction in ("horizontal", "vertical", "both")
        for n in STEPS
    },
    **{f"phase-net {direction} 1": ("phase-net", {"direction": direction}) for direction in ("horizontal", "vertical")},
}
"""Each setting's method and options; the setting's last word is the point on its line."""
ERROR_TICKS = (0.1, 0.2, 0.5, 1, 2, 5, 10)
FRAME_TICKS = (1, 2, 3, 4, 6, 9, 13, 18, 25, 32, 50)
MS_TICKS = (20, 30, 50, 100, 200, 300, 500, 1000, 2000)
STYLES = {
    "phase horizontal": ("tab:orange", "o-", "phase route, horizontal"),
    "phase vertical": ("tab:blue", "o-", "phase route, vertical"),
    "classical horizontal": ("tab:orange", "s--", "N steps + Gray code, horizontal"),
    "classical vertical": ("tab:blue", "s--", "N steps + Gray code, vertical"),
    "classical both": ("tab:green", "s--", "N steps + Gray code, both"),
    "phase-net horizontal": ("tab:red", "*", "phase-net, horizontal"),
    "phase-net vertical": ("tab:purple", "*", "phase-net, vertical"),
}


@dataclass(frozen=True)
class Point:
    """One setting on one split; errors in mm, means over samples unless said otherwise."""

    setting: str
    frames: int
    object_mae_mm: float
    median_view_mm: float
    measured_mae_mm: float
    interior_mae_mm: float
    edge_mae_mm: float
    far_off_percent: float
    missing_percent: float
    background_mae_mm: float
    seconds: float


def measure(dataset: DatasetFolder, split: str, setting: str, predictor: Method) -> Point:
    rows, seconds = [], []
    samples = dataset.samples(split)
    with progress_bar(setting, len(samples), "samples") as advance:
        for number, sample in enumerate(samples):
            frames = captured_frames(dataset, predictor, sample)
            if number == 0:
                predictor.predict(frames)
            started = process_time()
            depth_mm = predictor.predict(frames)
            seconds.append(process_time() - started)
            target_mm = dataset.target_mm(sample, "depth_exact")
            void = dataset.void(sample, "depth_exact")
            scores = score_sample(depth_mm, target_mm, EDGE_BAND_PX, void).metrics()
            scored = object_mask(target_mm) & ~void
            wrong = scored & (depth_mm > 0) & (np.abs(depth_mm - target_mm) > WRONG_MM)
            far = np.count_nonzero(wrong) / np.count_nonzero(scored)
            keys = ("object_mae_mm", "object_valid_mae_mm", "object_interior_mae_mm", "object_edge_mae_mm")
            errors_mm = [float(scores[key] or 0.0) for key in keys]
            missing = scores["object_missing_share"] or 0
            rows.append((*errors_mm, 100 * far, 100 * missing, scores["background_mae_mm"]))
            advance(1)
    scores_by_sample = np.array(rows, dtype=np.float64)
    whole, valid, interior, edge, far, missing, background = map(float, scores_by_sample.mean(axis=0))
    return Point(
        setting,
        len(predictor.frames_used),
        whole,
        float(np.median(scores_by_sample[:, 0])),
        valid,
        interior,
        edge,
        far,
        missing,
        background,
        float(np.median(seconds)),
    )


def point(dataset: DatasetFolder, split: str, setting: str, work: Path) -> Point | None:
    """The stored result of a setting, or a new measurement; None where the method is not available."""
    name, options = SETTINGS[setting]
    path = work / f"{setting.replace(' ', '-')}.json"
    try:
        predictor = load_method(name, dataset.rig, **options)
    except (FppBenchError, ImportError) as reason:
        print(f"{setting}: left out ({reason})")
        return None
    key = {
        "dataset": dataset.fingerprint,
        "split": split,
        "protocol": PROTOCOL_VERSION,
        "settings": {option: str(value) for option, value in predictor.settings.items()},
    }
    if path.is_file():
        stored = json.loads(path.read_text())
        if stored["key"] == key:
            return Point(**stored["point"])
    measured = measure(dataset, split, setting, predictor)
    path.write_text(json.dumps({"key": key, "point": asdict(measured)}, indent=1) + "\n")
    return measured


def read_points(path: Path) -> list[Point]:
    """The points of a CSV file that `table` wrote."""
    kinds = {field.name: field.type for field in fields(Point)}
    with path.open(newline="", encoding="utf-8") as file:
        return [Point(**{key: kinds[key](text) for key, text in row.items()}) for row in csv.DictReader(file)]


def draw(points: list[Point], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    fastest, slowest = (1000 * extreme(p.seconds for p in points) for extreme in (min, max))
    figure = Figure(figsize=(12.5, 5.4), dpi=110, layout="constrained")
    by_frames, by_time = figure.subplots(1, 2, sharey=True)
    for line, (colour, style, label) in STYLES.items():
        on_line = [p for p in points if p.setting.rsplit(" ", 1)[0] == line]
        if not on_line:
            continue
        for axes, x in ((by_frames, [p.frames for p in on_line]), (by_time, [1000 * p.seconds for p in on_line])):
            axes.plot(x, [p.object_mae_mm for p in on_line], style, color=colour, label=label, markersize=6)
    by_frames.set_xlabel("frames captured")
    by_time.set_xlabel("processor milliseconds per image (one thread)")
    by_frames.set_ylabel("object MAE against exact depth, mm")
    by_frames.legend(fontsize=7, loc="upper right")
    for axes in (by_frames, by_time):
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.grid(True, alpha=0.25)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_minor_formatter(NullFormatter())
            axis.set_major_formatter(FuncFormatter(lambda value, place: f"{value:g}"))
        axes.tick_params(labelsize=8)
        axes.set_yticks(ERROR_TICKS)
    by_frames.set_xticks(FRAME_TICKS)
    by_time.set_xticks([tick for tick in MS_TICKS if 0.6 * fastest <= tick <= 1.5 * slowest])
    figure.savefig(path)


def table(points: list[Point], path: Path) -> None:
    """Print the points as a Markdown table and write them as CSV."""
    columns = (
        "setting",
        "frames",
        "object MAE mm",
        "median view mm",
        "measured pixels mm",
        "interior mm",
        "edge mm",
        "far off %",
        "missing %",
        "background mm",
        "ms",
    )
    print(f"\n| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for p in points:
        numbers = [p.object_mae_mm, p.median_view_mm, p.measured_mae_mm, p.interior_mae_mm, p.edge_mae_mm]
        shares = [p.far_off_percent, p.missing_percent]
        cells = [f"{n:.2f}" for n in numbers] + [f"{n:.3f}" for n in shares]
        print(
            f"| {p.setting} | {p.frames} | {' | '.join(cells)} | {p.background_mae_mm:.2f} | {1000 * p.seconds:.0f} |"
        )
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, asdict(points[0]), lineterminator="\n")
        writer.writeheader()
        for p in points:
            writer.writerow({key: f"{v:.5g}" if isinstance(v, float) else v for key, v in asdict(p).items()})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, nargs="?", help="dataset folder with all frames and the exact depth")
    parser.add_argument("--from", dest="csv", type=Path, metavar="CSV", help="draw this file again, measure nothing")
    parser.add_argument("--split", default="test")
    parser.add_argument("--work", type=Path, default=Path("frames-work"), help="folder that stores each result")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS), metavar="SETTING")
    parser.add_argument("--out", type=Path, default=Path("frames_curve.png"), help="figure; the CSV lies beside it")
    args = parser.parse_args()
    if (args.dataset is None) == (args.csv is None):
        parser.error("give a dataset folder, or --from with a CSV file")
    if args.csv is not None:
        draw(read_points(args.csv), args.out)
        print(args.out)
        return
    cv2.setNumThreads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    dataset = DatasetFolder(args.dataset)
    measured = [point(dataset, args.split, setting, args.work) for setting in args.settings]
    points = [p for p in measured if p is not None]
    table(points, args.out.with_suffix(".csv"))
    draw(points, args.out)
    print(f"\n{args.out}\n{args.out.with_suffix('.csv')}")


if __name__ == "__main__":
    main()
