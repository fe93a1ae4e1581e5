"""Crossed fringes that are dim, clipped, painted, or whose second direction is lost; rivals on the truth."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines import crossed_route
from fpp_ml_bench.baselines.stability.cases import Group, Outcome, worst
from fpp_ml_bench.coding import Crossed
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.optics import Rig, crossed_rig

CROSSED = Group(
    "crossed",
    "the plane's depth, closed form",
    "pi / 2 of the joint phase: a rival order is further off, and a pixel that may be one must say so",
)
RIG = replace(crossed_rig(320), background_m=None)
FAMILY: Crossed = RIG.crossed  # type: ignore[assignment]
DEPTH_MM, WHITE, AMBIENT, NOISE = 1780.0, 160.0, 6.0, 0.7
MIDDLE = slice(120, 200), slice(120, 200)
"""Pixels that are judged: no window of theirs leaves the mask."""


def seen(
    family: Crossed,
    white: NDArray | float = WHITE,
    rig: Rig = RIG,
    measured_as: Crossed | None = None,
    bound_rad: float = math.pi / 2,
) -> Outcome:
    """The worst pixel of a plane that ``family`` lights, flagged where the route gives a reason or no depth.
    ``measured_as``: the family that the route takes it for."""
    x, y = rig.camera.rays()
    z = np.full(x.shape, DEPTH_MM / 1000)
    u, v = rig.project(np.stack([x * z, y * z, z], axis=-1))
    pairs = zip(family.weights, family.cycles_per_px, strict=True)
    waves = sum(weight * np.cos(2 * np.pi * (a * u + b * v)) for weight, (a, b) in pairs)
    noise = np.random.default_rng(4).normal(0, NOISE, x.shape)
    grey = np.clip(np.rint(AMBIENT + white * (0.5 + 0.5 * waves) + noise), 0, 255).astype(np.uint8)
    mask = np.zeros(x.shape, bool)
    mask[60:260, 60:260] = True
    route = crossed_route.CrossedRoute(rig, family=measured_as or family)
    measured = route.measure(grey, mask)
    depth_mm, reason = measured.depth_mm[MIDDLE], measured.reason[MIDDLE]
    flagged = (depth_mm == 0) | (reason != crossed_route.CrossedReason.MEASURED)
    bound_mm = float(np.median(route.carriers.mm_per_rad(np.full(x.shape, DEPTH_MM)))) * bound_rad
    return worst(depth_mm - DEPTH_MM, bound_mm, flagged)


@CROSSED.family(
    "dim",
    "mm",
    expects=lambda white: "number" if white >= 40 else "either",
    white=(220.0, 160.0, 80.0, 40.0, 20.0, 10.0, 5.0, 2.0, 0.0),
)
def dim(white: float) -> Outcome:
    """depth of a plane at this grey level of white, noise 0.7"""
    return seen(FAMILY, white)


@CROSSED.family("saturated half-waves", "mm", expects="either", white=(260.0, 300.0, 400.0, 600.0, 2000.0))
def saturated(white: float) -> Outcome:
    """depth of a plane whose crests are clipped at 255, at this grey level of white"""
    return seen(FAMILY, white)


@CROSSED.family(
    "one direction lost",
    "mm",
    expects=lambda weight: "number" if weight >= 0.3 else "either",
    weight=(0.5, 0.3, 0.1, 0.05, 0.02, 1e-9),
)
def lost(weight: float) -> Outcome:
    """depth of a plane whose second carrier has this weight, and not the 0.5 that the route knows of"""
    return seen(replace(FAMILY, weights=(0.5, weight)), measured_as=FAMILY)


@CROSSED.family("a rival on the truth", "mm", expects="either", ratio=(0.5, 1 / 3, 0.25, 0.2))
def rival(ratio: float) -> Outcome:
    """depth of a plane by periods of 12 px whose gains have this ratio, over four and more periods: with 1 / 2 and
    1 / 3 another order fits exactly"""
    turn_deg = math.degrees(math.atan(ratio))
    along_deg = 128.66  # of the paper's epipolar lines
    return seen(Crossed((12.0, 12.0), (along_deg + turn_deg, along_deg - 90 + turn_deg)))


@CROSSED.family("baseline along one axis", "mm", expects="either", refuses=FppBenchError, angle_deg=(0.0, 20.0, 45.0))
def along_one_axis(angle_deg: float) -> Outcome:
    """depth of a plane where the projector is above the camera and the carriers are turned by this angle: at 0 the
    second carrier tells no depth"""
    return seen(Crossed((18.0, 18.0), (angle_deg, angle_deg + 90)), rig=replace(RIG, translation_m=(0.0, -0.16, 0.0)))


@CROSSED.family("stripes in the paint", "mm", expects="either", period_px=(60.0, 23.0, 7.6, 4.0, 2.0))
def painted(period_px: float) -> Outcome:
    """depth of a plane painted with stripes of this period in the image, along the first carrier's, dark ones with 0.3
    of the albedo; against the plane's depth, closed form; bound: pi of the joint phase, since stripes at a carrier's
    period are a carrier themselves, and nothing in the image tells them apart"""
    carriers = crossed_route.Carriers.of(RIG, FAMILY)
    across, down = carriers.step_rad[0] / np.linalg.norm(carriers.step_rad[0])
    y, x = np.indices((RIG.camera.height, RIG.camera.width))
    stripes = 0.65 + 0.35 * np.cos(2 * np.pi * (across * x + down * y) / period_px)
    return seen(FAMILY, WHITE * stripes, bound_rad=math.pi)
