"""Draw the rigs of the track `fpp-bench-rigs`, ``loaders/render/track_rigs.json``: rigs that a lab
could own, of all directions of the baseline and all standoffs.

    python benchmarks/draw_rigs.py
    python benchmarks/draw_rigs.py --picture data/rigs docs/pictures/rigs.png     of a built track
    python benchmarks/draw_rigs.py --table crossed.json ...     of what fpp-eval wrote

The rigs are drawn until each class of `CLASSES` has its number, and none of `NEAR_M` more than its
share. Every second one has a calibration error of `GOOD_PX`, the others one drawn up to `POOR_PX`.
Neither a method nor its error was looked at. Another version of the track is another `SEED`.
"""

import json
import math
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.design.rigs import axes_deg, drawn_rig
from fpp_ml_bench.evaluation.result.parts import TrackScores
from fpp_ml_bench.loaders.render.track import RIGS_FILE, TRACK_LIGHTS, track
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.style import figure, figure_png, percent, styled, three_digits
from fpp_ml_bench.tables import Table

SEED = 20261128
CLASSES = {"beside": 6, "above": 6, "oblique": 4}
"""Rigs by where the projector is from the camera."""
NEAR_M, MOST_AT_A_DISTANCE = (0.3, 0.61, 1.23, 2.5), 6
"""Thirds of the standoffs by their logarithm, and how many rigs one may have."""
ALONG_DEG = 10.0
"""Of the baseline to an axis of the image, up to which it is no oblique one."""
GOOD_PX, POOR_PX = 0.1, 1.0


def class_of(rig: Rig) -> str:
    """``beside``, ``above`` or ``oblique``: where the projector is from the camera."""
    across, down, _ = -rig.R.T @ rig.t  # the projector in the camera frame
    turn = math.degrees(math.atan2(abs(down), abs(across)))
    if turn <= ALONG_DEG:
        return "beside"
    return "above" if turn >= 90 - ALONG_DEG else "oblique"


@styled
def picture(folder: Path) -> bytes:
    """Each rig of a built track: its first crossed frame, and camera (dot at 0), projector and the
    volume between the ends of the working range in the plane of the baseline; PNG."""
    rigs = {name: track()[name] for name in track() if name.endswith(f"-{TRACK_LIGHTS[0]}")}
    drawn = figure(11.0, 7.4)
    cells = drawn.subplots(4, 8, width_ratios=[1.25, 1] * 4)
    for (name, settings), (image, plane) in zip(rigs.items(), cells.reshape(-1, 2), strict=True):
        rig, opened = settings.rig, DatasetFolder(folder / name)
        sample = opened.samples("test")[2]
        image.imshow(opened.frame(sample, rig.sequence.crossed_frames[0]), cmap="gray", vmin=0)
        image.set_title(f"{name.rsplit('-', 1)[0]}, {class_of(rig)}", loc="left", fontsize=8)
        image.axis("off")
        place = -rig.R.T @ rig.t
        across = place[:2] / np.hypot(*place[:2])  # of the baseline, in the image
        aim = rig.R[2]
        plane.plot(0, 0, "o", np.hypot(*place[:2]), place[2], "s", markersize=4)
        for start, ahead in (
            ((0.0, 0.0), (0.0, 1.0)),
            ((np.hypot(*place[:2]), place[2]), (aim[:2] @ across, aim[2])),
        ):
            far = 1.3 * rig.standoff_m
            plane.plot(
                *zip(start, np.add(start, far * np.array(ahead)), strict=True), linewidth=0.8
            )
        near, far = (end / MM_PER_M for end in rig.working_range_mm)
        plane.axhspan(near, far, color="0.85")
        plane.set(
            xlim=(-0.4 * rig.standoff_m, 0.75 * rig.standoff_m),
            ylim=(-0.2 * rig.standoff_m, 1.3 * rig.standoff_m),
        )
        plane.set_title(
            f"{rig.standoff_m:.2f} m, {axes_deg(rig):.0f} deg, {settings.light.calibration_px:g} px",
            loc="left",
            fontsize=6.5,
        )
        plane.set_aspect("equal")
        plane.tick_params(labelbottom=False, labelleft=False, length=0)
    return figure_png(drawn, reduced=True)


def tables(files: list[Path]) -> str:
    """Means of the methods whose scores ``fpp-eval --json`` wrote, and their errors by rig;
    Markdown."""
    methods = {
        file.stem: TrackScores.model_validate_json(file.read_text(encoding="utf-8"))
        for file in files
    }
    means, by_rig = [], []
    for light in TRACK_LIGHTS:
        for name, scores in methods.items():
            mean, worst = scores.mean(light), scores.worst(light)
            refused = sum(dataset.endswith(light) for dataset in scores.refused)
            means.append(
                {
                    "light": light,
                    "method": name,
                    "per mille": three_digits(mean.per_mille),
                    "answered": three_digits(mean.answered_per_mille),
                    "projector px": three_digits(mean.projector_px),
                    "x many frames": three_digits(mean.of_decoded),
                    "missed": percent(mean.missing_share),
                    "invented": percent(mean.invented_share),
                    "worst rig": f"{three_digits(scores.datasets[worst].per_mille)} ({worst[4:6]})",
                    "refused": str(refused),
                }
            )
    for dataset in track():
        rows = [scores.datasets.get(dataset) for scores in methods.values()]
        cells = [
            "refused"
            if row is None
            else f"{three_digits(row.per_mille)} / {three_digits(row.answered_per_mille)}"
            for row in rows
        ]
        by_rig.append({"dataset": dataset, **dict(zip(methods, cells, strict=True))})
    parts = (
        Table.of("", rows, words=(0, 1) if rows is means else (0,)) for rows in (means, by_rig)
    )
    return "\n\n".join("\n".join(part.markdown()).strip() for part in parts)


def main() -> int:
    if sys.argv[1:2] == ["--table"]:
        print(tables([Path(name) for name in sys.argv[2:]]))
        return 0
    if sys.argv[1:2] == ["--picture"]:
        folder, file = map(Path, sys.argv[2:])
        file.write_bytes(picture(folder))
        return 0
    random = np.random.default_rng(SEED)
    left, at_a_distance, drawn = Counter(CLASSES), Counter[int](), []
    while left.total():
        rig = drawn_rig(random)
        kind, third = class_of(rig), sum(rig.standoff_m >= end for end in NEAR_M[1:-1])
        if not left[kind] or at_a_distance[third] == MOST_AT_A_DISTANCE:
            continue
        left[kind] -= 1
        at_a_distance[third] += 1
        poor = round(math.exp(random.uniform(math.log(GOOD_PX), math.log(POOR_PX))), 2)
        drawn.append({"calibration_px": poor if len(drawn) % 2 else GOOD_PX, **rig.to_dict()})
        print(f"rig-{len(drawn):02d}: {kind}, {rig.standoff_m} m", file=sys.stderr)
    lines = ",\n".join(json.dumps(rig, separators=(",", ":")) for rig in drawn)
    Path(RIGS_FILE).write_text(f"[{lines}]\n")
    print(f"{RIGS_FILE}: {Path(RIGS_FILE).stat().st_size} bytes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
