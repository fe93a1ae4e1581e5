"""Rigs that a lab could own, drawn at random: what a method must measure that is made for any rig.

A drawn rig that breaks a rule of `broken_rule` is drawn again. The rules are those of setting up a
scanner: both devices see the same volume in focus, their axes meet at an angle that tells depth and
still sees into hollows, and the code is sampled finely enough and leaves few rival orders.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.gray_code import bits_needed
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.design.search import Assumptions, search
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.named_rigs import FIRST_SHIFTED_DEG
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig, rotation_matrix
from fpp_ml_bench.optics.sequence import Sequence

LEAST_COVERAGE = 0.95
"""Of the camera's pixels at the standoff that see the pattern, and `LEAST_END_COVERAGE` at both
ends of the range, where the two fields of view come apart."""
LEAST_END_COVERAGE = 0.75
PIXEL_M, F_NUMBER = 3.45e-6, 8.0
"""Pixel and aperture of a common industrial camera, for its depth of field."""
MOST_BLUR_PX = 1.5
"""Diameter of the camera's circle of confusion at the ends of the range, focused at the standoff.
From 2 px on a period of 8 px loses a tenth of its modulation."""
AXES_DEG = 4.0, 28.0
"""Angle between the two lines of sight to the middle of the volume. Below, 1 px of the projector is
as long as the relief that is measured; above, hollows lie in shadow."""
CODE_PX = 0.35, 2.5
"""Projector px that an image px covers: a finer camera wastes pixels, a coarser one does not sample
the code."""
MOST_WRONG_SHARE, MOST_EXPECTED_SHARE = 0.04, 0.0025
"""Wrong orders of single pixels, and expected error by the standoff, of the proposed carriers."""
LINES_PX = 22.0
"""Image px that a period of the fringes of one direction covers, as near as whole projector px
allow: that of the paper's rig."""
PERIOD_PX, TRIED = (6.0, 40.0), 24
"""Image px that a period of crossed fringes may cover, and how many periods between are tried."""
_GRID = 9
_DIGITS = 9
"""Decimals of a drawn number: the last bits of a cosine differ between processors."""
_CAMERAS = (640, 480), (800, 600), (960, 960), (1024, 768), (1280, 1024), (1280, 960)
_PROJECTORS = (912, 1140), (854, 480), (1024, 768), (1280, 720), (1280, 800), (1920, 1080)


def drawn_rig(random: np.random.Generator) -> Rig:
    """A rig whose crossed frames `fpp_ml_bench.design` proposes, and that breaks no rule; its
    sequence holds three crossed frames, 18 steps of both directions with Gray code, black and
    white."""
    while True:
        rig = _layout(random)
        if broken_rule(rig) is None and (coded := _coded(rig)) is not None:
            return coded


def broken_rule(rig: Rig) -> str | None:
    """What a lab would change about ``rig`` before it looks at codes; None for nothing."""
    near_m, far_m = rig.range_m
    for depth_m, least in (
        (rig.standoff_m, LEAST_COVERAGE),
        (near_m, LEAST_END_COVERAGE),
        (far_m, LEAST_END_COVERAGE),
    ):
        if (share := coverage(rig, depth_m)) < least:
            return f"{share:.0%} of the image sees the pattern at {depth_m:g} m"
    focal_px = rig.camera.fx
    aperture_m = focal_px * PIXEL_M / F_NUMBER
    for depth_m in (near_m, far_m):
        blur_px = aperture_m * focal_px * abs(1 / rig.standoff_m - 1 / depth_m)
        if blur_px > MOST_BLUR_PX:
            return f"the camera's blur is {blur_px:.1f} px at {depth_m:g} m"
    angle = axes_deg(rig)
    if not AXES_DEG[0] <= angle <= AXES_DEG[1]:
        return f"the axes meet at {angle:.0f} degrees"
    covered = [math.hypot(*rig.image_frequency(along)) for along in ((1.0, 0.0), (0.0, 1.0))]
    if not all(CODE_PX[0] <= px <= CODE_PX[1] for px in covered):
        return f"an image px covers {min(covered):.2g} to {max(covered):.2g} projector px"
    return None


def coverage(rig: Rig, depth_m: float) -> float:
    """Share of the camera's pixels that see the pattern on a plane square to its axis."""
    u, v = rig.seen(rig.camera.grid(_GRID), depth_m)
    return float(rig.projector.holds(u, v, 0.5).mean())


def axes_deg(rig: Rig) -> float:
    """Angle at the middle of the volume between the lines to camera and projector."""
    point = np.array([0.0, 0.0, rig.standoff_m])
    to_projector = -rig.R.T @ rig.t - point
    cosine = -to_projector[2] / np.sqrt((to_projector**2).sum())
    return math.degrees(math.acos(min(max(float(cosine), -1.0), 1.0)))


def _layout(random: np.random.Generator) -> Rig:
    """Devices and pose, all drawn; with the paper's fringes."""

    def even(low: float, high: float) -> float:
        return float(random.uniform(low, high))

    camera = _device(random, _CAMERAS, (1.2, 2.6), distorted=random.random() < 0.5)
    projector = _device(random, _PROJECTORS, (1.2, 2.2), distorted=random.random() < 0.3)
    standoff_m = round(math.exp(even(math.log(0.3), math.log(2.5))), 3)
    near_mm = round(standoff_m * MM_PER_M * (1 - even(0.1, 0.2)))
    far_mm = round(standoff_m * MM_PER_M * (1 + even(0.1, 0.25)))
    background_m = round(far_mm * even(1.05, 1.5) / MM_PER_M, 3)
    # Beside or above each other, or anything between.
    axis = float(random.choice((0.0, 90.0, 180.0, 270.0)))
    turn = math.radians(axis + (even(-5, 5) if random.random() < 0.7 else even(-45, 45)))
    length = standoff_m * even(0.08, 0.45)
    place = np.array(
        [length * math.cos(turn), length * math.sin(turn), standoff_m * even(-0.08, 0.08)]
    )
    aim = np.array([0.0, 0.0, standoff_m * even(0.9, 1.3)])
    if random.random() < 0.2:  # parallel axes
        aim = place + np.array([0.0, 0.0, 1.0])
    rotation = np.round(_towards(aim - place, math.radians(even(-4, 4))), _DIGITS)
    translation = np.round(-rotation @ place, 6)
    return Rig(
        camera,
        projector,
        tuple(tuple(row) for row in rotation.tolist()),  # type: ignore[arg-type]
        tuple(translation.tolist()),
        working_range_mm=(near_mm, far_mm),
        standoff_m=standoff_m,
        background_m=background_m,
        sequence=Sequence(18, 15, 15),
    )


def _device(
    random: np.random.Generator,
    sizes: tuple[tuple[int, int], ...],
    throw: tuple[float, float],
    distorted: bool,
) -> Pinhole:
    """``throw``: limits of the focal length by the width."""
    width, height = sizes[int(random.integers(len(sizes)))]
    focal = round(width * float(random.uniform(*throw)), 1)
    cx, cy = (round(float(n / 2 + random.normal(0, 0.01 * n)), 1) for n in (width, height))
    k1, k2 = (round(float(random.uniform(-0.12, 0.06)), 3), round(float(random.normal(0, 0.02)), 3))
    lens = (k1, k2, 0.0, 0.0, 0.0) if distorted else (0.0,) * 5
    return Pinhole(width, height, focal, focal, cx, cy, lens)


def _towards(direction: NDArray[np.float64], roll_rad: float) -> NDArray[np.float64]:
    """Rotation float64 (3, 3) of a device that looks along ``direction``, upright but for a roll."""
    ahead = direction / np.sqrt((direction**2).sum())
    across = np.cross([0.0, 1.0, 0.0], ahead)
    across /= np.sqrt((across**2).sum())
    upright = np.stack([across, np.cross(ahead, across), ahead])
    return np.asarray(rotation_matrix((0.0, 0.0, roll_rad)) @ upright)


def _coded(rig: Rig) -> Rig | None:
    """The rig with codes of its own; None where no pair of carriers is good enough."""
    pitches = [
        max(4.0, float(round(LINES_PX * math.hypot(*rig.image_frequency(along)))))
        for along in ((0.0, 1.0), (1.0, 0.0))
    ]
    lengths = rig.projector.height, rig.projector.width
    bits = [bits_needed(length, pitch) for length, pitch in zip(lengths, pitches, strict=True)]
    rig = replace(
        rig,
        pitch_horizontal_px=pitches[0],
        pitch_vertical_px=pitches[1],
        sequence=Sequence(18, *bits),
    )
    covered = math.hypot(*rig.image_frequency((1.0, 0.0)))
    tried = {float(round(px * covered)) for px in np.geomspace(*PERIOD_PX, TRIED)}
    try:
        candidate = search(rig, Assumptions(image_px=PERIOD_PX), tried).proposed
        rig.check_sampling()
    except RigError:
        return None
    most_mm = MOST_EXPECTED_SHARE * rig.standoff_m * MM_PER_M
    if candidate.wrong_share > MOST_WRONG_SHARE or candidate.expected_mm > most_mm:
        return None
    proposed = candidate.crossed
    return rig.with_crossed(
        Crossed(proposed.pitches_px, proposed.angles_deg, shifts_deg=FIRST_SHIFTED_DEG)
    )
