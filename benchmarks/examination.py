"""The examination on captures that are right: none may be refused or warned of, and how long it
takes.

    python benchmarks/examination.py [CAPTURES] [--size 240] [--keep FOLDER]

Scenes by the renderer: three lights with 3 to 18 steps, and the light `paper` with each disturbance
of FPP-C at every severity. CAPTURES: a folder with the captures of the public repository
jakobwilm/slstudio, as for `real_captures.py`; they are examined as they are, mirrored, and in the
opposite order, which has to be named. ``--keep``: where rendered frames are kept for the next run.
"""

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from real_captures import rig_of

from fpp_ml_bench.baselines.robustness.axes import corruptions
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.examination.examine import examine
from fpp_ml_bench.examination.findings import Examination
from fpp_ml_bench.loaders.captures.images import read_frames
from fpp_ml_bench.loaders.render.light import Light, named_light
from fpp_ml_bench.loaders.render.meshes import solid_mesh
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.opencv_files import read_opencv_calibration
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict

STEPS, OBJECTS = (
    (3, 4, 5, 6, 8, 12, 18),
    ("mug", "power_drill", "honeycomb", "wire_loop", "large_clamp", "gear"),
)
DISTURBED_STEPS, DISTURBED_OBJECTS = (3, 4, 18), ("mug", "power_drill")
FAULTS = ("motion", "calibration-error")
"""Axes that are no light: a scene that moves and a calibration that is wrong are faults."""
Scene = tuple[str, Rig, NDArray]


def photographed(
    title: str, size: int, steps: int, light: Light, name: str, kept: Path | None
) -> Scene:
    sequence = {"steps": steps, "bits_horizontal": 7, "bits_vertical": 7}
    rig = rig_from_dict({**paper_rig(size).to_dict(), "sequence": sequence})
    what = f"{title}, {steps} steps, {name}"
    file = None if kept is None else kept / f"{what.replace(' ', '_')}_{size}.npy"
    if file is not None and file.exists():
        return what, rig, np.load(file)
    row = Studio(BuildSettings(rig, (name,), light=light)).photograph(solid_mesh(name), "A60")
    frames = np.stack([row.frames[index] for index in range(len(rig.sequence))])
    if file is not None:
        np.save(file, frames)
    return what, rig, frames


def scenes(size: int, kept: Path | None) -> Iterator[Scene]:
    for light in ("paper", "workshop", "hard"):
        for steps in STEPS:
            for name in OBJECTS:
                yield photographed(light, size, steps, named_light(light), name, kept)
    known = corruptions()
    for title, axis in known.axes.items():
        for severity in range(1, 6) if title not in FAULTS else ():
            for steps in DISTURBED_STEPS:
                for name in DISTURBED_OBJECTS:
                    light = axis.light(known.clean, severity)
                    with suppress(BuildError):  # an object too dark to be decoded at all
                        yield photographed(f"{title} {severity}", size, steps, light, name, kept)


def real(folder: Path) -> Iterator[tuple[Scene, bool]]:
    """The public captures, and whether the rig is calibrated."""
    theirs = read_opencv_calibration(folder / "calibration" / "calibration.xml")
    with tempfile.TemporaryDirectory() as scratch:
        for name in ("skull_2x3", "skull_gray"):
            rig = rig_of(theirs, name, Path(scratch))
            frames = read_frames(folder / name, count=len(rig.sequence)).frames
            yield (name, rig, frames), True
            yield (f"{name}, mirrored", rig, np.ascontiguousarray(frames[:, :, ::-1])), True
            yield (f"{name}, in the opposite order", rig, frames[::-1]), True
        rig = rig_of(theirs, "board", Path(scratch))
        for number in range(1, 7):
            frames = read_frames(
                folder / "calibration" / f"calseq{number}", count=len(rig.sequence)
            ).frames
            for calibrated in (True, False):
                yield (
                    (
                        f"calseq{number}, {'decoded' if calibrated else 'for calibration'}",
                        rig,
                        frames,
                    ),
                    calibrated,
                )


def named(found: Examination) -> str:
    return (
        "; ".join(str(finding)[:160] for finding in found.findings if finding.severity != "note")
        or "nothing"
    )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", nargs="?", type=Path, metavar="CAPTURES")
    parser.add_argument("--size", type=int, default=240, metavar="PX")
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    args = parser.parse_args()
    if args.keep is not None:
        args.keep.mkdir(parents=True, exist_ok=True)
    count = wrong = 0
    slowest = 0.0
    for title, rig, frames in scenes(args.size, args.keep):
        started = perf_counter()
        says = named(examine(frames, rig))
        slowest, count = max(slowest, perf_counter() - started), count + 1
        if says != "nothing":
            wrong += 1
            print(f"{title}: {says}", flush=True)
    print(
        f"{count} scenes of {args.size} px: {wrong} refused or warned of; slowest examination "
        f"{slowest:.2f} s"
    )
    for (title, rig, frames), calibrated in real(args.captures) if args.captures else ():
        started = perf_counter()
        found = examine(frames, rig, calibrated=calibrated)
        print(f"{title}: {named(found)}; {perf_counter() - started:.2f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
