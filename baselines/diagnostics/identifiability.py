"""What a frame can tell at all: the paper's Proposition 1 (a single fringe does not determine depth)
as a measured bound.

For each object pixel, the depths in the working range that give the same local observation as its
true depth. *One carrier*: the same wrapped phase, so every order in the range; where all surfaces are
matte and the albedo is known to a share (`KNOWN_ALBEDO`), only those whose brightness, by distance
and slope, differs by no more. *Two carriers*: the same pair of phases within an error (`SAME_RAD`).
A pixel with one such depth is identified. Where a method chose another depth that fits as well, the error is lawful: no
method that looks at a pixel and its neighbourhood alone can avoid it. Any other wrong order was
avoidable.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.probe import (
    Figure,
    Finding,
    Probe,
    ProbeSettings,
    Progress,
    table_of,
)
from fpp_ml_bench.baselines.phase.candidates import irradiance
from fpp_ml_bench.baselines.phase.geometry import (
    TAU,
    CalibrationLayer,
    Carriers,
    Crop,
    main_carrier,
    wrapped,
)
from fpp_ml_bench.baselines.phase.local_fit import phase_slopes
from fpp_ml_bench.depth import object_box
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.style import Picture, gallery

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.subjects import Subject

SAMPLES, QUICK_SAMPLES = 10, 3
SAME_RAD = {"inside surfaces": 0.1, "at edges": 0.4}
"""Distance of two pairs of phases that one frame does not tell apart, in rad: twice the error of a
local fit inside surfaces, and its error near depth edges (docs/results/fringe_net.md)."""
KNOWN_ALBEDO = {"brightness to 30%": 0.3, "brightness to 3%": 0.03}
"""Relative difference of brightness that does not tell two depths apart: papers and paints of a
scene that looks even, and noise alone, 1.8 of 60 grey levels."""
SLOPE_SHARE = 0.13
"""Of the period: sigma of the Gaussian under which the slope of the surface is averaged."""
SHOWN = 5
"""Depths from which on the picture has one colour."""
Depths = NDArray[np.float64]


@dataclass(frozen=True)
class Alike:
    """Of the pixels ``crop`` of an image: ``depth_mm`` float64 (K, h, w) of K candidates, the first
    the true one, NaN where there is none; by what is known, which candidates give the same
    observation: ``fits`` bool (K, h, w) each, the least knowledge first."""

    crop: Crop
    depth_mm: Depths
    fits: Mapping[str, NDArray[np.bool_]]


def alike(rig: Rig, fringes: str, depth_mm: NDArray[np.float32]) -> Alike:
    """The depths that can't be told from the true ``depth_mm`` (H, W), 0 outside the object, by one
    frame of ``fringes``: horizontal, vertical or crossed."""
    box = object_box(depth_mm > 0)
    if box is None:
        raise DiagnosisError("expected a sample with an object")
    true_mm = np.where(depth_mm[box] > 0, depth_mm[box].astype(np.float64), np.nan)
    if fringes == "crossed" and rig.crossed is not None:
        carriers = Carriers.of(rig, rig.crossed).at(box)
        return _of_two(carriers, box, true_mm, rig.working_range_mm)
    return _of_one(rig, fringes, box, true_mm)


def _of_one(rig: Rig, fringes: str, box: Crop, true_mm: Depths) -> Alike:
    """Orders of one carrier, and what a matte surface at each would receive."""
    direction: Any = fringes
    layer = CalibrationLayer.of(rig, direction).at(box)
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = layer.residual_of_depth(true_mm)
        ends = [
            layer.residual_of_depth(np.full(true_mm.shape, end)) for end in rig.working_range_mm
        ]
        most = int(np.ceil(float(np.nanmax(np.abs(ends[1] - ends[0]))) / TAU))
        turns = sorted(range(-most, most + 1), key=abs)
        phases = np.stack([residual + TAU * turn for turn in turns])
        depths = np.stack([layer.depth_of_residual_mm(phase) for phase in phases])
        inside = np.isfinite(true_mm)
        smooth_px = SLOPE_SHARE * rig.image_px_per_period(direction)
        known = np.where(inside, residual, 0).astype(np.float32)
        slopes = phase_slopes(known, inside, smooth_px)
        light = np.stack([irradiance(layer, phase, slopes, rig, box) for phase in phases])
        apart = np.abs(np.log(light / light[0]))
    near, far = rig.working_range_mm
    by_phase = (depths >= near) & (depths <= far)
    by_phase[0] = inside
    apart[0] = 0  # the true one, also where its light is not known
    fits = {
        f"phase and {words}": by_phase & (apart <= np.log1p(share))
        for words, share in KNOWN_ALBEDO.items()
    }
    return Alike(box, np.where(by_phase, depths, np.nan), {"phase": by_phase, **fits})


def _of_two(carriers: Carriers, box: Crop, true_mm: Depths, range_mm: tuple[float, float]) -> Alike:
    """Where the pair of phases comes near to itself again, by the carrier with the larger gain."""
    gain = carriers.gain.astype(np.float64)
    main = main_carrier(gain)
    q = carriers.nearness(true_mm)
    far_q, near_q = (carriers.nearness(end) for end in reversed(range_mm))
    most = int(np.ceil(float(np.nanmax(np.abs(gain[main] * (near_q - far_q)))) / TAU))
    joint = np.hypot(*gain)
    depths, misfits = [], []
    for turn in sorted(range(-most, most + 1), key=abs):
        moved = q + TAU * turn / gain[main]
        beside = wrapped(gain[1 - main] * (q - moved))
        nearest_q = moved + gain[1 - main] * beside / joint**2
        depths.append(carriers.depth_mm(nearest_q))
        misfits.append(np.abs(beside * gain[main]) / joint)
    stack = np.stack(depths)
    with np.errstate(invalid="ignore"):
        in_range = (stack >= range_mm[0]) & (stack <= range_mm[1])
        misfit_rad = np.stack(misfits)
        fits = {
            f"phases to {rad:g} rad, {words}": in_range & (misfit_rad <= rad)
            for words, rad in reversed(SAME_RAD.items())
        }
    stack[0], in_range[0] = true_mm, True
    for each in fits.values():
        each[0] = np.isfinite(true_mm)
    return Alike(box, np.where(in_range, stack, np.nan), fits)


def shares(found: Alike, answer_mm: NDArray[np.float32] | None) -> dict[str, float]:
    """Of the object's pixels, the shares with one depth by what is known; and of an answer (H, W),
    whose order is wrong, lawful and avoidable: it is of the candidate that is nearest to it."""
    inside = next(iter(found.fits.values()))[0]
    pixels = int(inside.sum())
    facts: dict[str, float] = {}
    for kind, fits in found.fits.items():
        facts[f"one depth, {kind}"] = float((fits.sum(axis=0) == 1)[inside].sum() / pixels)
    if answer_mm is None:
        return facts
    answer = answer_mm[found.crop].astype(np.float64)
    apart = np.abs(np.where(answer > 0, answer, np.nan) - found.depth_mm)
    chosen = np.where(np.isnan(apart), np.inf, apart).argmin(axis=0)
    wrong = inside & (answer > 0) & (chosen > 0)
    facts["wrong order"] = float(wrong.sum() / pixels)
    for kind, fits in found.fits.items():
        lawful = wrong & np.take_along_axis(fits, chosen[None], axis=0)[0]
        facts[f"avoidable, {kind}"] = float((wrong & ~lawful).sum() / pixels)
    return facts


class Identifiability(Probe):
    """The bound for each frame that the rig can project, and the subject's errors beside its own."""

    name = "identifiability"
    title = "What a frame can tell"
    question = "How many depths give the same local observation, and which errors were avoidable?"

    def run(
        self,
        subject: "Subject",
        dataset: DatasetFolder,
        settings: ProbeSettings,
        progress: Progress,
    ) -> Finding:
        rig = dataset.rig
        codes = [*rig.fringe_directions, *(["crossed"] if rig.crossed else [])]
        samples = settings.choose(dataset.samples("test"), SAMPLES, QUICK_SAMPLES)
        own = self._own(subject, dataset)
        found: dict[str, list[dict[str, float]]] = {code: [] for code in codes}
        maps: dict[str, Picture] = {}
        for number, sample in enumerate(samples):
            progress(number, len(samples), sample)
            target = "depth_exact" if dataset.has_exact else "depth"
            depth_mm = dataset.depth_mm(sample, target)
            answer = subject.predict(subject.captured(dataset, sample)) if own else None
            for code in codes:
                bound = alike(rig, code, depth_mm)
                found[code].append(shares(bound, answer if code == own else None))
                if number == 0:
                    for kind, fits in bound.fits.items():
                        depths = np.where(fits[0], fits.sum(axis=0, dtype=np.float64), np.nan)
                        picture = Picture(depths, "viridis", 1.0, float(SHOWN))
                        maps[f"{code},\n{kind}"] = picture
            dataset.release(sample)
        rows = {
            code: {key: float(np.mean([row[key] for row in each])) for key in each[0]}
            for code, each in found.items()
        }
        columns = {key: key for row in rows.values() for key in row}
        table = table_of("Shares of the object's pixels", "One frame of", rows, columns)
        figure = Figure(
            f"Depths that give the same observation, {samples[0]}: from 1, dark, to {SHOWN} and more",
            "Number of depths of each object pixel that one frame does not tell apart",
            gallery({"depths": [*maps.values()]}, [*maps], 1.9),
        )
        values = {
            "same_rad": SAME_RAD,
            "known_albedo": KNOWN_ALBEDO,
            "samples": samples,
            "shares": rows,
        }
        return Finding(_summary(subject, own, rows), values, table, figure)

    @staticmethod
    def _own(subject: "Subject", dataset: DatasetFolder) -> str | None:
        """The fringes of the one frame that the subject reads; None of a subject of more frames or
        without depths in mm."""
        if subject.units != "mm" or len(subject.frames_used) != 1:
            return None
        frame = dataset.sequence.frames[subject.frames_used[0]]
        return "crossed" if frame.kind == "crossed" else frame.direction


def _summary(subject: "Subject", own: str | None, rows: dict[str, dict[str, float]]) -> str:
    told = [
        f"{code} {' to '.join(f'{100 * share:.1f}%' for key, share in row.items() if 'one' in key)}"
        for code, row in rows.items()
    ]
    said = f"Object pixels with one depth, from the least to the most knowledge: {', '.join(told)}."
    if own is None:
        return (
            f"{said} {subject.name} is not a method of one frame in mm: its errors are not parted."
        )
    row = rows[own]
    avoidable = [f"{100 * share:.2f}%" for key, share in row.items() if "avoidable" in key]
    return (
        f"{said} {subject.name} has a wrong order at {100 * row['wrong order']:.2f}% of them, "
        f"avoidable at {' to '.join(avoidable)}."
    )
