"""Object error against frames captured and against seconds: from one shot to the full sequence, with the paper's rows.

    fpp-bench build data/full --preset full
    python benchmarks/frames_curve.py data/full --work frames-work --out docs/pictures/frames_curve.png

Settings: the phase route with 1 to 18 fringes of one direction, without Gray code; the classical method with N fringes
and their Gray code, one direction and both; the whole sequence; the learned route. Scored as ``fpp-eval --target
depth_exact`` does, object pixels left out included, each with its whole depth. Each setting's result is kept in
``--work`` as JSON and not computed again; ``--settings`` asks for some of them. Seconds are those of the processor,
one thread, which other work on the machine does not lengthen much; frames are in memory. The paper's rows are what the
paper reports, one frame a prediction, without seconds.
"""

import argparse
import csv
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import cv2
import numpy as np

from fpp_ml_bench.baselines.methods import Method, method
from fpp_ml_bench.baselines.prediction import captured_frames
from fpp_ml_bench.commands.console import progress_bar
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.evaluation.scores import score_sample
from fpp_ml_bench.leaderboard.paper import PAPER_HEADING, paper_tables
from fpp_ml_bench.loaders.store import DatasetFolder

FEW = (1, 2, 3, 4, 6, 9, 18)
STEPS = (3, 4, 6, 9, 18)
WRONG_MM = 60.0
"""An error that no phase makes, only a wrong order or a missed pixel: under a quarter of the shortest period."""
SETTINGS: dict[str, tuple[str, dict]] = {
    **{f"phase {way} {n}": ("phase", {"direction": way, "frames": n}) for way in ("horizontal", "vertical")
       for n in FEW},
    **{f"classical {way} {n}": ("classical", {"direction": way, "steps": n})
       for way in ("horizontal", "vertical", "both") for n in STEPS},
    **{f"phase-net {way} 1": ("phase-net", {"direction": way}) for way in ("horizontal", "vertical")},
}  # fmt: skip
"""Line and point of each setting: its method, and its options."""
ERROR_TICKS = (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200)
FRAME_TICKS = (1, 2, 3, 4, 6, 9, 13, 18, 25, 32, 50)
MS_TICKS = (20, 30, 50, 100, 200, 300, 500, 1000, 2000)
STYLES = {
    "phase horizontal": ("tab:orange", "o-", "phase route, horizontal"),
    "phase vertical": ("tab:blue", "o-", "phase route, vertical"),
    "classical horizontal": ("tab:orange", "s--", "N + Gray code, horizontal"),
    "classical vertical": ("tab:blue", "s--", "N + Gray code, vertical"),
    "classical both": ("tab:green", "s--", "N + Gray code, both"),
    "phase-net horizontal": ("tab:red", "*", "learned route, horizontal"),
    "phase-net vertical": ("tab:purple", "*", "learned route, vertical"),
}
PAPER_SHOWN = (
    ("normalization", "raw", "UNet, raw mm"), ("normalization", "global", "UNet, global"),
    ("normalization", "individual", "UNet, range given"), ("loss", "hybrid_l1_0.7", "its best loss, range given"),
    ("multi_frame", "vertical", "trained on 18, range given"),
)  # fmt: skip
"""Table, row and label of the paper's rows in the figure."""


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


def measure(opened: DatasetFolder, split: str, setting: str, made: Method) -> Point:
    rows, seconds = [], []
    samples = opened.samples(split)
    with progress_bar(setting, len(samples), "samples") as advance:
        for number, sample in enumerate(samples):
            frames = captured_frames(opened, made, sample)
            if number == 0:
                made.predict(frames)
            started = process_time()
            depth_mm = made.predict(frames)
            seconds.append(process_time() - started)
            target_mm = opened.target_mm(sample, "depth_exact")
            scores = score_sample(depth_mm, target_mm, EDGE_BAND_PX).metrics()
            there = (target_mm > 0) & (depth_mm > 0)
            far = np.count_nonzero(np.abs(depth_mm - target_mm)[there] > WRONG_MM) / np.count_nonzero(target_mm > 0)
            keys = ("object_mae_mm", "object_valid_mae_mm", "object_interior_mae_mm", "object_edge_mae_mm")
            named = [float(scores[key] or 0.0) for key in keys]
            rows.append((*named, 100 * far, 100 * (scores["object_missing_share"] or 0), scores["background_mae_mm"]))
            advance(1)
    table = np.array(rows, dtype=np.float64)
    whole, measured, interior, edge, far, missing, background = map(float, table.mean(axis=0))
    return Point(
        setting, len(made.frames_used), whole, float(np.median(table[:, 0])), measured, interior, edge, far, missing,
        background, float(np.median(seconds)),
    )  # fmt: skip


def point(opened: DatasetFolder, split: str, setting: str, work: Path) -> Point | None:
    """The kept result of a setting, or a new one; None where there is no such method here."""
    name, options = SETTINGS[setting]
    path = work / f"{setting.replace(' ', '-')}.json"
    try:
        made = method(name, opened.rig, **options)
    except (FppBenchError, ImportError) as reason:
        print(f"{setting}: left out ({reason})")
        return None
    key = {
        "dataset": opened.fingerprint, "split": split,
        "settings": {one: str(value) for one, value in made.settings.items()},
    }  # fmt: skip
    if path.is_file():
        kept = json.loads(path.read_text())
        if kept["key"] == key:
            return Point(**kept["point"])
    found = measure(opened, split, setting, made)
    path.write_text(json.dumps({"key": key, "point": asdict(found)}, indent=1) + "\n")
    return found


def draw(points: list[Point], path: Path) -> None:
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, NullFormatter

    fastest, slowest = (1000 * pick(p.seconds for p in points) for pick in (min, max))
    figure = Figure(figsize=(12.5, 5.4), dpi=110, layout="constrained")
    by_frames, by_time = figure.subplots(1, 2, sharey=True)
    for line, (colour, style, label) in STYLES.items():
        some = [p for p in points if p.setting.rsplit(" ", 1)[0] == line]
        if not some:
            continue
        for axes, x in ((by_frames, [p.frames for p in some]), (by_time, [1000 * p.seconds for p in some])):
            axes.plot(x, [p.object_mae_mm for p in some], style, color=colour, label=label, markersize=6)
    for number, (table, row, label) in enumerate(PAPER_SHOWN):
        (found,) = (one for one in paper_tables()[table].rows if one.row == row)
        error = found.errors_mm["object_mae_mm"]
        title = PAPER_HEADING if number == 0 else None
        by_frames.plot(1, error, "D", color="k", fillstyle="none", label=title)
        right = 150 if row == "hybrid_l1_0.7" else 8  # beside its neighbours' labels, which lie close above and below
        text = f"{label}: {error:g}"
        by_frames.annotate(text, (1, error), xytext=(right, -3), textcoords="offset points", fontsize=7)
    by_frames.set_xlabel("frames captured")
    by_time.set_xlabel("milliseconds of one processor thread an image")
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
    columns = ("setting", "frames", "object MAE mm", "median view mm", "measured pixels mm", "interior mm", "edge mm",
               "far off %", "missing %", "background mm", "ms")  # fmt: skip
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
    parser.add_argument("dataset", type=Path, help="dataset folder with all frames and the exact depth")
    parser.add_argument("--split", default="test")
    parser.add_argument("--work", type=Path, default=Path("frames-work"), help="folder that keeps each result")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS), metavar="SETTING")
    parser.add_argument("--out", type=Path, default=Path("frames_curve.png"), help="figure; the CSV lies beside it")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    args.work.mkdir(parents=True, exist_ok=True)
    opened = DatasetFolder(args.dataset)
    found = [point(opened, args.split, setting, args.work) for setting in args.settings]
    points = [one for one in found if one is not None]
    table(points, args.out.with_suffix(".csv"))
    draw(points, args.out)
    print(f"\n{args.out}\n{args.out.with_suffix('.csv')}")


if __name__ == "__main__":
    main()
