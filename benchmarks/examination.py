"""The examination on captures that are right: none may be refused or warned of, and how long it takes.

    python benchmarks/examination.py [CAPTURES] [--size 240]

Scenes by the renderer: three lights with 3 to 18 steps, and the light `paper` with each disturbance of FPP-C at every
severity. CAPTURES: a folder with the captures of the public repository jakobwilm/slstudio, as for `real_captures.py`;
they are examined as they are, mirrored, and in the opposite order, which has to be named.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from real_captures import rig_of

from fpp_ml_bench import optics
from fpp_ml_bench.baselines import robustness
from fpp_ml_bench.examination import Examination, examine
from fpp_ml_bench.loaders import captures, render

STEPS, OBJECTS = (3, 4, 5, 6, 8, 12, 18), ("mug", "power_drill", "honeycomb", "wire_loop", "large_clamp", "gear")
DISTURBED_STEPS, DISTURBED_OBJECTS = (3, 4, 18), ("mug", "power_drill")
MOVED = ("motion", "calibration-error")
"""Axes that are no light: a scene that moves is a fault."""
Scene = tuple[str, "optics.Rig", NDArray]


def photographed(title: str, size: int, steps: int, light: "render.Light", name: str) -> Scene:
    sequence = {"steps": steps, "bits_horizontal": 7, "bits_vertical": 7}
    rig = optics.rig_from_dict({**optics.paper_rig(size).to_dict(), "sequence": sequence})
    row = render.Studio(render.BuildSettings(rig, (name,), light=light)).photograph(render.solid_mesh(name), "A60")
    return f"{title}, {steps} steps, {name}", rig, np.stack([row.frames[index] for index in range(len(rig.sequence))])


def scenes(size: int) -> Iterator[Scene]:
    for light in ("paper", "workshop", "hard"):
        for steps in STEPS:
            for name in OBJECTS:
                yield photographed(light, size, steps, render.named_light(light), name)
    known = robustness.corruptions()
    for title, axis in known.axes.items():
        for severity in range(1, 6) if title not in MOVED else ():
            for steps in DISTURBED_STEPS:
                for name in DISTURBED_OBJECTS:
                    yield photographed(f"{title} {severity}", size, steps, axis.light(known.clean, severity), name)


def real(folder: Path) -> Iterator[tuple[Scene, bool]]:
    """The public captures, and whether the rig is calibrated."""
    theirs = optics.read_opencv_calibration(folder / "calibration" / "calibration.xml")
    with tempfile.TemporaryDirectory() as scratch:
        for name in ("skull_2x3", "skull_gray"):
            rig = rig_of(theirs, name, Path(scratch))
            frames = captures.read_frames(folder / name, count=len(rig.sequence)).frames
            yield (name, rig, frames), True
            yield (f"{name}, mirrored", rig, np.ascontiguousarray(frames[:, :, ::-1])), True
            yield (f"{name}, in the opposite order", rig, frames[::-1]), True
        rig = rig_of(theirs, "board", Path(scratch))
        for number in range(1, 7):
            frames = captures.read_frames(folder / "calibration" / f"calseq{number}", count=len(rig.sequence)).frames
            for calibrated in (True, False):
                yield (f"calseq{number}, {'decoded' if calibrated else 'for calibration'}", rig, frames), calibrated


def named(found: Examination) -> str:
    return "; ".join(str(finding)[:160] for finding in found.findings if finding.severity != "note") or "nothing"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="?", type=Path, metavar="CAPTURES")
    parser.add_argument("--size", type=int, default=240, metavar="PX")
    args = parser.parse_args()
    count = wrong = 0
    slowest = 0.0
    for title, rig, frames in scenes(args.size):
        started = perf_counter()
        says = named(examine(frames, rig))
        slowest, count = max(slowest, perf_counter() - started), count + 1
        if says != "nothing":
            wrong += 1
            print(f"{title}: {says}", flush=True)
    print(f"{count} scenes of {args.size} px: {wrong} refused or warned of; slowest examination {slowest:.2f} s")
    for (title, rig, frames), calibrated in real(args.captures) if args.captures else ():
        started = perf_counter()
        found = examine(frames, rig, calibrated=calibrated)
        print(f"{title}: {named(found)}; {perf_counter() - started:.2f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
