"""What ``--audit`` makes of wrong calibrations: each drawn anew, each before a validation object.

    python benchmarks/calibration_audit.py crossed --draws 40
    python benchmarks/calibration_audit.py fringe-net --draws 40
    python benchmarks/calibration_audit.py crossed --draws 12 --sizes 4 --light workshop

For every kind and size of change: mean absolute error in mm of answered object pixels without and
with the audit, the share of them within 1.96 stated standard uncertainties, and the share of the frames
that are refused. Size: RMS distance
in projector px that the points of the working range move. ``drawn`` is the mixture that `build`
draws: a turn about three axes and a principal point that is off.
"""

import argparse
import sys
from dataclasses import replace

import numpy as np

from fpp_ml_bench.api import load_method
from fpp_ml_bench.baselines.learned.scenes import photographed
from fpp_ml_bench.constants import OBJECTS, VIEWS, split_of
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.render.scene import BuildSettings, photographing_rig
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.tables import Table

KINDS = ("roll", "zoom", "shift", "drawn")
SIZES_PX = (0.1, 0.3, 1.0, 2.0)


def changed(rig: Rig, kind: str, size_px: float, random: np.random.Generator) -> Rig:
    """The rig that photographs where ``rig`` is its calibration."""
    if kind == "drawn":
        return photographing_rig(rig, size_px, int(random.integers(1 << 30)))
    sign, device = float(random.choice([-1, 1])), rig.projector
    if kind == "shift":
        angle = random.uniform(0, 2 * np.pi)
        across, down = size_px * np.cos(angle), size_px * np.sin(angle)
        return replace(rig, projector=replace(device, cx=device.cx + across, cy=device.cy + down))
    x, y = np.meshgrid(*(np.linspace(0, n - 1, 16) for n in (rig.camera.width, rig.camera.height)))
    x, y = rig.camera.normalised(x.ravel(), y.ravel())
    u, v = rig.project(np.stack([x, y, np.ones_like(x)], axis=-1) * rig.standoff_m)
    part = sign * size_px / float(np.sqrt(np.mean((u - device.cx) ** 2 + (v - device.cy) ** 2)))
    if kind == "zoom":
        fx, fy = device.fx * (1 + part), device.fy * (1 + part)
        return replace(rig, projector=replace(device, fx=fx, fy=fy))
    turn = rotation_matrix((0.0, 0.0, part))
    rows = tuple(tuple(row) for row in (turn @ rig.R).tolist())
    return replace(rig, rotation=rows, translation_m=tuple((turn @ rig.t).tolist()))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("method", choices=("crossed", "fringe-net"))
    parser.add_argument("--draws", type=int, default=40, help="of each kind and size (default: 40)")
    parser.add_argument("--light", default="paper")
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES_PX, metavar="PX")
    args = parser.parse_args()
    rig, random = crossed_rig(), np.random.default_rng(5)
    light = named_light(args.light).changed(calibration_px=0.0)
    objects = [name for name in OBJECTS if split_of(name) == "validation"]
    plain, audited = (
        load_method(args.method, rig),
        load_method(args.method, rig, audit=True, anyway=True),
    )
    table = Table(
        "Change",
        numbers=(
            "Size, px",
            "Without, mm",
            "With, mm",
            "Within 95%",
            "Within 95%, audited",
            "Refused",
        ),
    )
    for kind, size_px in [("none", 0.0), *((kind, px) for kind in KINDS for px in args.sizes)]:
        rows = []
        for number in range(args.draws):
            true = rig if kind == "none" else changed(rig, kind, size_px, random)
            name, view = objects[number % len(objects)], VIEWS[number % len(VIEWS)]
            studio = Studio(BuildSettings(rig=true, objects=(name,), light=light, seed=number))
            images, depth_mm, flags = photographed(studio, name, view, plain.frames_used)
            frames: list = [None] * len(rig.sequence)
            for index, image in zip(plain.frames_used, images, strict=True):
                frames[index] = image
            answers = plain.answer(frames), audited.answer(frames)
            known = (depth_mm > 0) & ((flags & VOID) == 0)
            known &= np.logical_and.reduce([answer.depth > 0 for answer in answers])
            row = []
            for answer in answers:
                error_mm = np.abs(answer.depth - depth_mm)[known]
                row += [error_mm.mean(), (error_mm < 1.96 * answer.sigma_mm[known]).mean()]
            rows.append([*row, "does not fit" in answers[1].report["audit"]["says"]])
        before, within, after, covered, refused = np.mean(rows, axis=0)
        shares = [f"{100 * share:.0f}%" for share in (within, covered, refused)]
        table.add_row(kind, f"{size_px:g}", f"{before:.2f}", f"{after:.2f}", *shares)
        print(f"{kind} {size_px:g}: done", file=sys.stderr)
    print("\n".join(table.markdown()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
