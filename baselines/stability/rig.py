"""Rigs with nearly singular intrinsics, rotations off orthonormal and lenses that fold."""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench import coding, decoding, optics
from fpp_ml_bench.baselines.stability import cases
from fpp_ml_bench.baselines.stability.cases import U64, Group, Outcome, difference, wide, worst
from fpp_ml_bench.baselines.stability.coded_frames import plane_stack
from fpp_ml_bench.baselines.stability.triangulation import (
    PAPER,
    TURN,
    conditioning,
    depth_of,
    exact_coordinates,
)
from fpp_ml_bench.errors import RigError

RIG = Group("rig")


def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    camera, u = optics.Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px), np.linspace(-0.5, 959.5, 97)
    if not np.isfinite(camera.rays()).all():
        return Outcome(math.inf, 1.0, note="rays that are not finite")
    size = np.abs(u - centre_px) + abs(centre_px)
    back = camera.pixels(*camera.normalised(u, u))[0]
    return worst(back - u, 3 * U64 * size + U64 * np.abs(u), condition=float(np.max(size / 960)))


_BACK = "pixel to ray and back; against the pixel; bound: 3 u (|u - c| + |c|) + u |u|; refused from a condition number "
RIG.family(
    "intrinsic matrix",
    "px",
    about=f"{_BACK}of 2^26 on, half of the digits",
    refuses=RigError,
    expects=lambda focal_px, centre_px: "number" if 1e-3 <= focal_px <= 1e8 else "either",
    centre_px=(479.5,),
    focal_px=(2e3, 1.0, 1e-3, 1e-6, 1e-8, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300),
)(intrinsics)
RIG.family(
    "far principal point",
    "px",
    about=f"{_BACK}of 2^26 on",
    refuses=RigError,
    focal_px=(2e3,),
    expects=lambda focal_px, centre_px: "number" if centre_px <= 1e6 else "either",
    centre_px=(1e3, 1e6, 1e12, 1e16),
)(intrinsics)


@RIG.family(
    "rotation off orthonormal",
    "relative",
    refuses=RigError,
    kind=("scaled", "sheared"),
    off=(0.0, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 1e-2),
    expects=lambda kind, off: "number" if off < 1e-6 else "refusal",
)
def off_orthonormal(off: float, kind: str) -> Outcome:
    """depth through this matrix; against depth through the rotation, 1800 mm; bound: 2 |R R^T - I| kappa + round-off;
    over 1e-6 a rig is refused"""
    # R R^T - I is (1 + s)^2 - 1 or off between the first two rows.
    matrix = TURN * (1 + off / 2) if kind == "scaled" else TURN + np.outer([off, 0, 0], TURN[1])
    base, rig = (replace(PAPER, rotation=turn.tolist()) for turn in (TURN, matrix))
    coordinate = exact_coordinates(1.8, base)[0]
    depth_mm = depth_of(coordinate, rig)
    rounding, condition = conditioning(coordinate, base)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition number, twice.
    bound = rounding + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), np.isnan(depth_mm), condition=float(condition.max()))


@RIG.family(
    "rotation vector",
    "1",
    angle_rad=(0.0, 1e-300, 1e-12, 1e-4, 1.0, math.pi, math.tau, 1e3, 1e8, 1e12, 1e15),
    refuses=RigError,
    expects=lambda angle_rad: "number" if angle_rad <= 1e8 else "either",
)
def rotation_vector(angle_rad: float) -> Outcome:
    """rotation matrix by Rodrigues' formula; against the same formula in 50 digits; bound: 8 u (1 + angle): the angle
    carries its own rounding; refused where that is over 1e-6"""
    vector = np.array([0.48, -0.6, 0.64]) * angle_rad
    matrix = optics.rotation_matrix(tuple(vector.tolist()))
    replace(PAPER, rotation=matrix.tolist())  # which may refuse it
    mp = cases.high_precision()
    x, y, z = map(mp.mpf, vector)
    angle = mp.sqrt(x * x + y * y + z * z)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first = mp.sin(angle) / angle if angle != 0 else mp.mpf(1)
    second = (1 - mp.cos(angle)) / angle**2 if angle != 0 else mp.mpf(0.5)
    exact = wide(np.eye(3)) + first * cross + second * (cross @ cross)
    return worst(difference(matrix, exact), 8 * U64 * (1 + angle_rad), condition=angle_rad)


def lens_inverse(k1: float, k2: float, k3: float) -> Outcome:
    """ideal radius of distorted ones up to 1.6; against bisection in 50 digits below the fold; bound: 32 u / slope of
    the model: a residual of some roundings; masked where no point maps there"""
    coefficients = (k1, k2, 0.0, 0.0, k3)
    fold, radius = math.sqrt(optics.fold_radius_squared(coefficients)), np.linspace(0.0, 1.6, 81)[1:]
    radii = np.hypot(*optics.undistort(radius * math.cos(0.7), radius * math.sin(0.7), coefficients))
    a, b, c = wide((k1, k2, k3))

    def forward(r: Any) -> Any:
        return r * (1 + r * r * (a + r * r * (b + r * r * c)))

    top = wide(min(fold, 4.0))
    largest = forward(top) if math.isfinite(fold) else wide(math.inf)
    target, low, high = wide(radius), 0 * wide(radius), top + 0 * wide(radius)
    for _ in range(80):
        middle = (low + high) / 2
        below = forward(middle) < target
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    square = low * low
    slope = np.maximum((1 + square * (3 * a + square * (5 * b + square * 7 * c))).astype(float), 1e-9)
    invertible = target < largest
    error = np.where(invertible, radii - low.astype(float), np.where(np.isnan(radii), 0.0, np.inf))
    near = np.abs(radius - float(largest)) < 1e-3
    may_flag, bound = float(np.mean(~invertible | near)), 32 * U64 / np.where(invertible, slope, 1.0)
    return worst(error, bound, np.isnan(radii), may_flag, condition=float(1 / slope[invertible].min()))


RIG.family("lens inverse, k1", "1", k1=(-0.1, -0.3, -1.0, -5.0, 0.5, 5.0, 100.0), k2=(0.0,), k3=(0.0,))(lens_inverse)
RIG.family("lens inverse, several terms", "1", k1=(-0.8, 0.6), k2=(0.9, -1.5), k3=(-0.3, 2.0))(lens_inverse)


@RIG.family("tangential lens", "1", expects="either", p1=(0.001, 0.01, 0.05, 0.1, 0.3))
def tangential(p1: float) -> Outcome:
    """ideal points of a grid under tangential distortion; against Newton continuation from the axis in 200 steps;
    another branch is no answer; bound: 32 u / least slope of the model there: a residual of some roundings"""
    coefficients = (-0.2, 0.0, p1, -p1, 0.0)
    xd, yd = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.8, 0.8, 33)] * 2))
    x, y = optics.undistort(xd, yd, coefficients)
    residual = np.hypot(*(a - b for a, b in zip(optics.distort(x, y, coefficients), (xd, yd), strict=True)))
    px, py, lost = np.zeros_like(xd), np.zeros_like(yd), np.zeros(xd.shape, bool)
    k1, _, q1, q2, _ = coefficients
    for step in np.linspace(0, 1, 201)[1:]:
        for _ in range(4 if step < 1 else 20):
            r2 = px * px + py * py
            fx = px * (1 + k1 * r2) + 2 * q1 * px * py + q2 * (r2 + 2 * px * px) - step * xd
            fy = py * (1 + k1 * r2) + q1 * (r2 + 2 * py * py) + 2 * q2 * px * py - step * yd
            jxx = 1 + k1 * r2 + 2 * k1 * px * px + 2 * q1 * py + 6 * q2 * px
            jyy = 1 + k1 * r2 + 2 * k1 * py * py + 6 * q1 * py + 2 * q2 * px
            jxy = 2 * k1 * px * py + 2 * q1 * px + 2 * q2 * py
            determinant = jxx * jyy - jxy * jxy
            lost |= ~(determinant > 1e-6)
            px, py = px - (jyy * fx - jxy * fy) / determinant, py - (jxx * fy - jxy * fx) / determinant
    right = ~lost & (px * px + py * py < optics.fold_radius_squared(coefficients))
    trace = jxx + jyy
    slope = (trace - np.sqrt(np.maximum(trace * trace - 4 * determinant, 0))) / 2  # the Jacobian is symmetric
    off = np.where(right, np.hypot(x - px, y - py), np.inf)  # no solution off that branch
    bound = np.where(right, 32 * U64 / np.maximum(slope, 1e-6), 1.0)
    masked = ~np.isfinite(x)
    return worst(np.where(masked, 0.0, np.maximum(off, residual)), bound, masked, float(np.mean(~right)))


@RIG.family("lens without inverse at the corner", "mm", expects="either", k1=(-0.1, -0.5, -2.0, -10.0))
def folding_camera(k1: float) -> Outcome:
    """decoded depth where the lens model has no inverse; against there is none; bound: must be masked"""
    base, none = optics.paper_rig(32), (0.0,) * 4
    camera = replace(base.camera, fx=base.camera.fx / 4, fy=base.camera.fy / 4, distortion=(k1, *none))
    frames, _ = plane_stack(replace(base, camera=replace(camera, distortion=(0.0, *none))))
    x, y = camera.rays()
    without = np.isnan(x) | np.isnan(y)
    decoded = decoding.decode_stack(frames, replace(base, camera=camera), direction="vertical")
    given = without & ((decoded.depth_mm != 0) | (decoded.reason == coding.Reason.DECODED))
    note = f"{without.mean():.0%} of the pixels have no ray; the corner {'has none' if without[0, 0] else 'has a ray'}"
    return worst(np.where(given, np.inf, 0.0), 0.0, decoded.depth_mm == 0, note=note)


_IMPOSSIBLE: dict[str, tuple[tuple[Any, ...], Any]] = {
    "mirror": (("rotation",), [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "zero baseline": (("translation_m",), [0.0, 0.0, 0.0]),
    "NaN in rotation": (("rotation", 1, 1), math.nan),
    "infinite focal length": (("camera", "fx"), math.inf),
    "zero focal length": (("projector", "fy"), 0.0),
    "zero matrix": (("rotation",), [[0.0] * 3] * 3),
    "rank 2": (("rotation",), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
}
"""Where in a rig file a change is made, and the value put there."""


@RIG.family("impossible rig", "1", expects="refusal", refuses=RigError, change=_IMPOSSIBLE)
def impossible_rig(change: str) -> None:
    """a rig from a file; against there is no such rig; bound: must be refused"""
    part: Any = (data := PAPER.to_dict())
    (*way, last), value = _IMPOSSIBLE[change]
    for key in way:
        part = part[key]
    part[last] = value
    optics.rig_from_dict(data)


@RIG.family("file round trip", "bits", suffix=(".yaml", ".json"))
def file_round_trip(suffix: str) -> Outcome:
    """a rig of awkward numbers, written and read; against the rig; bound: exact"""
    awkward = (0.1 + 0.2, 1e-17, math.nextafter(0.125, 1.0), 5e-324, -1 / 3)
    rig = replace(
        PAPER,
        camera=replace(PAPER.camera, cx=math.pi * 1e2, cy=2 / 3 * 1e2, distortion=awkward),
        translation_m=(math.nextafter(0.125, 0.0), -0.1 - 1e-17, 1e-300),
        pitch_vertical_px=18 + 2**-48,
        rotation=optics.rotation_matrix((1e-9, 2e-9, -3e-9)).tolist(),
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig{suffix}"
        optics.save_rig(rig, path)
        loaded = optics.load_rig(path)
    same = loaded == rig and json.dumps(loaded.to_dict()) == json.dumps(rig.to_dict())
    return Outcome(0.0) if same else cases.wrong()
