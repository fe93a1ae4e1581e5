"""The paper's two theorems (Section 4.2), checked numerically (docs/phase_and_order.md).

    python benchmarks/theory.py data/small224
    python benchmarks/theory.py data/small224 --picture twins.png

*A single fringe does not determine depth*: surfaces a whole period apart on every ray give the same
frame of that direction, noise included, if at each pixel the brighter one gets a lower albedo (in
direct light from a projector in focus at both: its blur would be a hint). *An error of one period
costs Z^2*, and along the camera's axis Z^2 kappa / (1 -+ Z kappa), one sign for each side, with
kappa = P / (f_p b).
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.scenes import SceneRenderer, constant, moved, original
from fpp_ml_bench.baselines.phase.geometry import CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M, TAU
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction
from fpp_ml_bench.style import DEPTH_COLOURS, Picture, gallery
from fpp_ml_bench.tables import Table

DISTANCES_M = (0.3, 1.0, 1.8, 3.0, 5.0, 10.0)
"""Distances of the object in m at which theory is compared with the rig: from much nearer to much
farther than the paper's 1.8 m."""
SMALL_PERIODS = 1 / 64
"""An error so small, in periods, that the linear model holds over all distances."""
ERRORS_PERIODS = {"1/64 period": SMALL_PERIODS, "a period, away": 1.0, "a period, toward": -1.0}
STARTS_PERIODS = (0.0, -1.0, -0.5)
"""Position of the first of two scenes that are a period apart, in periods from the object's own
position."""
_STEP = 1e-4
"""Relative step of the distance in a difference quotient: far above rounding, far below what
changes the slope."""


@dataclass(frozen=True)
class Twins:
    """Two scenes that a frame can't tell apart: ``depths_mm`` float64 (2, H, W), 0 outside the
    object; ``frames`` and ``other_frames``, of the other direction, uint8 (2, H, W), by their
    numbers ``frame`` and ``other_frame``."""

    sample: str
    direction: Direction
    frame: int
    other_frame: int
    depths_mm: NDArray[np.float64]
    frames: NDArray[np.uint8]
    other_frames: NDArray[np.uint8]
    paint: NDArray[np.float64]

    def describe(self) -> str:
        """A sentence with how far the scenes are apart and how many pixels tell them apart."""
        inside = self.depths_mm[0] > 0
        apart_mm = np.abs(np.subtract(*self.depths_mm))[inside].mean()
        told, told_across = (np.not_equal(*pair).sum() for pair in (self.frames, self.other_frames))
        return (
            f"{self.sample} and a surface {apart_mm:.0f} mm from it on average give the same "
            f"{self.direction} fringe: {told} of {inside.size} pixels differ, and {told_across} "
            f"in the frame of the other direction ({inside.sum()} show the object)"
        )


def twins_of(
    dataset: DatasetFolder, renderer: SceneRenderer, direction: Direction = "horizontal"
) -> Twins:
    """The first test object that fits into the working range twice, a whole period apart: at its
    own position and a period away, or half a period to either side. Raises `DiagnosisError` where
    there is none."""
    rig = renderer.rig
    near_m, far_m = rig.range_m
    in_focus = SceneRenderer(rig, renderer.lamp.changed("projector", defocus_px=0.0))
    sinusoids = rig.sequence.sinusoids
    frame, across = (
        sinusoids(direction)[0],
        sinusoids("vertical" if direction == "horizontal" else "horizontal")[0],
    )
    for sample in dataset.samples("test"):
        first = original(dataset, renderer, sample)
        for start in STARTS_PERIODS if first.mask.any() else ():
            pair = [
                moved(first.surface, rig, direction, constant, TAU * turns)
                for turns in (start, start + 1)
            ]
            if not all(
                near_m <= surface.depth_m.min() and surface.depth_m.max() <= far_m
                for surface in pair
            ):
                continue
            lights = [in_focus.light(surface) for surface in pair]
            # Albedo can only be lowered, so at each pixel it is lowered on the brighter surface.
            least, most = (
                of(*(light.gain.astype(np.float64) for light in lights))
                for of in (np.minimum, np.maximum)
            )
            paint = np.divide(least, most, out=np.ones_like(most), where=most > 0)
            scenes = [
                replace(first, surface=surface, lit=replace(light, gain=least.astype(np.float32)))
                for surface, light in zip(pair, lights, strict=True)
            ]
            depths_mm = np.stack([scene.depth_mm for scene in scenes])
            frames, other_frames = (
                np.stack([np.asarray(in_focus.frames(scene, [index])[index]) for scene in scenes])
                for index in (frame, across)
            )
            return Twins(sample, direction, frame, across, depths_mm, frames, other_frames, paint)
    raise DiagnosisError(
        f"{dataset.path}: no test object fits twice, a period of {direction} fringes apart, within "
        f"{near_m:g} to {far_m:g} m; use a rig with a finer pitch or a wider range"
    )


def _axis(rig: Rig, direction: Direction) -> CalibrationLayer:
    """The layer on the camera's axis alone."""
    return CalibrationLayer.of(rig, direction, (np.zeros(1), np.zeros(1)))


def kappa_per_m(rig: Rig, direction: Direction) -> float:
    """P / (f_p b) on the camera's axis in 1 / m: a period relative to the disparity, per metre of
    distance."""
    layer = _axis(rig, direction)
    return float(TAU / abs(layer.gain[0]) * layer.forward[0])


def depth_error_mm(
    rig: Rig, direction: Direction, distance_m: float, periods: float
) -> float | None:
    """|depth of the wrong phase - depth| on the camera's axis, in mm; None where no point ahead has the wrong phase."""
    layer, true_mm = _axis(rig, direction), distance_m * MM_PER_M
    residual = layer.residual_of_depth(np.array([true_mm]))
    # A depth error away from the camera reduces the magnitude of the residual phase.
    with np.errstate(divide="ignore"):
        (depth_mm,) = layer.depth_of_residual_mm(residual - np.sign(residual) * TAU * periods)
    return float(abs(depth_mm - true_mm)) if 0 < depth_mm < np.inf else None


def exponent(rig: Rig, direction: Direction, distance_m: float, periods: float) -> float | None:
    """d log `depth_error_mm` / d log distance; None where there is no depth."""
    low, high = (
        depth_error_mm(rig, direction, distance_m * factor, periods)
        for factor in (1 - _STEP, 1 + _STEP)
    )
    return float(np.log(high / low) / np.log((1 + _STEP) / (1 - _STEP))) if low and high else None


def picture(twins: Twins) -> bytes:
    """Both scenes' frames and depths as a PNG file."""
    inside = twins.depths_mm[0] > 0
    low, high = twins.depths_mm[:, inside].min(), twins.depths_mm[:, inside].max()
    pairs = {f"{twins.direction} fringe": twins.frames, "other direction": twins.other_frames}
    rows = {
        f"{name},\n{np.not_equal(*pair).sum()} pixels differ": [Picture(frame) for frame in pair]
        for name, pair in pairs.items()
    }
    rows[f"depth,\n{low:.0f} to {high:.0f} mm"] = [
        Picture(np.where(inside, depth, np.nan), DEPTH_COLOURS, low, high)
        for depth in twins.depths_mm
    ]
    return gallery(rows, ("scene A", "scene B"), 2.2)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--picture", type=Path, help="draw both scenes into this PNG file")
    args = parser.parse_args()
    dataset = DatasetFolder(args.dataset)
    twins = twins_of(dataset, SceneRenderer.of(dataset))
    print(twins.describe())
    print(f"kappa: {kappa_per_m(dataset.rig, twins.direction):.4f} per metre")
    table = Table("Phase error", numbers=("Distance, m", "Depth error, mm", "Local exponent"))
    for name, periods in ERRORS_PERIODS.items():
        for distance_m in DISTANCES_M:
            asked = dataset.rig, twins.direction, distance_m, periods
            numbers = depth_error_mm(*asked), exponent(*asked)
            cells = ["-" if one is None else f"{one:.4g}" for one in numbers]
            table.add_row(name, f"{distance_m:g}", *cells)
    print("\n".join(table.markdown()))
    if args.picture:
        args.picture.write_bytes(picture(twins))
    return 0


if __name__ == "__main__":
    sys.exit(main())
