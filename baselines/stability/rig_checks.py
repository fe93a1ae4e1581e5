"""Checks of the rig: nearly singular intrinsics, rotations that are not orthonormal, folding lenses, files."""

import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fpp_ml_bench.baselines.stability.case import Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.frames import plane_stack
from fpp_ml_bench.baselines.stability.roundoff import U64, difference, floats, high_precision
from fpp_ml_bench.baselines.stability.triangulation_checks import conditioning, exact_coordinates, rays
from fpp_ml_bench.decoding import Reason, decode_stack, depth_from_coordinate
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics import (
    Pinhole,
    Rig,
    distort,
    fold_radius_squared,
    load_rig,
    paper_rig,
    rig_from_dict,
    rotation_matrix,
    save_rig,
    undistort,
)


def intrinsics(focal_px: float, centre_px: float) -> Outcome:
    """Pixels to rays and back through a matrix that is nearly singular."""
    try:
        camera = Pinhole(960, 960, focal_px, focal_px, centre_px, centre_px)
    except RigError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    u = np.linspace(-0.5, 959.5, 97)
    x, y = camera.rays()
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return Outcome(math.inf, 1.0, note="rays that are not finite")
    back = camera.pixels(*camera.normalised(u, u))[0]
    bound = 3 * U64 * (np.abs(u - centre_px) + abs(centre_px)) + U64 * np.abs(u)
    return worst(back - u, bound, condition=float(np.max((np.abs(u - centre_px) + abs(centre_px)) / 960)))


def _tilted(off: float, kind: str) -> Any:
    turn = rotation_matrix((0.05, -0.09, 0.12))
    if kind == "scaled":  # R R^T - I is (1 + s)^2 - 1
        return (turn * (1 + off / 2)).tolist()
    skew = turn.copy()
    skew[0] += off * turn[1]  # R R^T - I is off between the first two rows
    return skew.tolist()


def off_orthonormal(off: float, kind: str) -> Outcome:
    """Depth through a matrix that is not orthonormal, against depth through the original rotation."""
    base = replace(paper_rig(24), rotation=rotation_matrix((0.05, -0.09, 0.12)).tolist())
    try:
        rig = replace(base, rotation=_tilted(off, kind))
    except RigError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    ray_maps = rays()
    coordinate = exact_coordinates(ray_maps, 1.8, base)[0]
    depth_mm = depth_from_coordinate(ray_maps, coordinate, rig, "vertical")
    relative, condition = conditioning(ray_maps, coordinate, base, 0)
    # Each row of R moves by off at most: the difference a - x_p a_2 by off times the condition number, twice.
    bound = relative + 2 * off * condition
    return worst(depth_mm / 1800.0 - 1, bound / (1 - bound), np.isnan(depth_mm), condition=float(condition.max()))


def rotation_vector(angle_rad: float) -> Outcome:
    """Rodrigues' formula, and whether a rig accepts its result."""
    axis = np.array([0.48, -0.6, 0.64])
    vector = axis * angle_rad
    matrix = rotation_matrix(tuple(vector.tolist()))
    try:
        replace(paper_rig(24), rotation=matrix.tolist())
    except RigError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    mp = high_precision()
    x, y, z = (mp.mpf(float(value)) for value in vector)
    angle = mp.sqrt(x * x + y * y + z * z)
    cross = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first = mp.sin(angle) / angle if angle != 0 else mp.mpf(1)
    second = (1 - mp.cos(angle)) / angle**2 if angle != 0 else mp.mpf(0.5)
    exact = mp.eye(3) + first * cross + second * cross * cross
    errors = difference(matrix.ravel(), [exact[i, j] for i in range(3) for j in range(3)])
    return worst(errors, 8 * U64 * (1 + angle_rad), condition=angle_rad)


def lens_inverse(k1: float, k2: float, k3: float) -> Outcome:
    """The inverse over a wide image: bisection in 50 digits where it exists, masked elsewhere."""
    coefficients = (k1, k2, 0.0, 0.0, k3)
    fold = math.sqrt(fold_radius_squared(coefficients))
    radius = np.linspace(0.0, 1.6, 81)[1:]
    turn = 0.7
    x, y = undistort(radius * math.cos(turn), radius * math.sin(turn), coefficients)
    radii = np.hypot(x, y)
    mp = high_precision()

    def forward(r):  # type: ignore[no-untyped-def]
        r2 = r * r
        return r * (1 + r2 * (mp.mpf(k1) + r2 * (mp.mpf(k2) + r2 * mp.mpf(k3))))

    largest = forward(mp.mpf(fold)) if math.isfinite(fold) else mp.inf
    exact, slopes, exists = [], [], []
    for distorted in radius:
        target = mp.mpf(float(distorted))
        exists.append(bool(target < largest))
        low, high = mp.mpf(0), mp.mpf(fold) if math.isfinite(fold) else mp.mpf(4)
        for _ in range(80 if exists[-1] else 1):
            middle = (low + high) / 2
            low, high = (middle, high) if forward(middle) < target else (low, middle)
        exact.append(low)
        slopes.append(max(float(mp.diff(forward, low)) if exists[-1] else 1.0, 1e-9))
    invertible, slope = np.array(exists), np.array(slopes)
    bound = 32 * U64 / slope
    error = np.where(invertible, radii - floats(exact), np.where(np.isnan(radii), 0.0, np.inf))
    near = np.abs(radius - float(largest)) < 1e-3 if math.isfinite(fold) else np.zeros(len(radius), bool)
    return worst(
        error, bound, np.isnan(radii), float(np.mean(~invertible | near)), condition=float(1 / slope[invertible].min())
    )


def tangential(p1: float) -> Outcome:
    """Strong tangential distortion: the inverse must distort back to the input, on the branch through the axis."""
    coefficients = (-0.2, 0.0, p1, -p1, 0.0)
    grid = np.linspace(-0.8, 0.8, 33)
    xd, yd = (axis.ravel() for axis in np.meshgrid(grid, grid))
    x, y = undistort(xd, yd, coefficients)
    finite = np.isfinite(x)
    residual = np.hypot(*(a - b for a, b in zip(distort(x, y, coefficients), (xd, yd), strict=True)))
    # The right branch is reached by continuation from the axis: 200 small steps.
    px, py = np.zeros_like(xd), np.zeros_like(yd)
    lost = np.zeros(xd.shape, bool)
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
    r2 = px * px + py * py
    right = ~lost & (r2 < fold_radius_squared(coefficients))
    trace = jxx + jyy
    slope = (trace - np.sqrt(np.maximum(trace * trace - 4 * determinant, 0))) / 2  # the Jacobian is symmetric
    off = np.where(right, np.hypot(x - px, y - py), np.inf)  # no solution off that branch
    bound = np.where(right, 32 * U64 / np.maximum(slope, 1e-6), 1.0)
    return worst(np.where(finite, np.maximum(off, residual), 0.0), bound, ~finite, float(np.mean(~right)))


def folding_camera(k1: float) -> Outcome:
    """A decoder whose lens model has no inverse in the image's corners."""
    base = paper_rig(32)
    camera = replace(base.camera, fx=base.camera.fx / 4, fy=base.camera.fy / 4, distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    rig = replace(base, camera=camera)
    frames, _ = plane_stack(replace(base, camera=replace(camera, distortion=(0.0,) * 5)))
    x, y = camera.rays()
    without = np.isnan(x) | np.isnan(y)
    decoded = decode_stack(frames, rig, direction="vertical")
    wrong = without & (decoded.depth_mm != 0)
    wrong |= without & (decoded.reason == Reason.DECODED)
    corner = bool(without[0, 0])
    note = f"{without.mean():.0%} of the pixels have no ray; the corner {'has none' if corner else 'has a ray'}"
    return worst(np.where(wrong, np.inf, 0.0), 0.0, decoded.depth_mm == 0, 1.0, note=note)


def _bad_rig(change: str) -> Rig:
    data = paper_rig(24).to_dict()
    if change == "mirror":
        data["rotation"] = [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    elif change == "zero baseline":
        data["translation_m"] = [0.0, 0.0, 0.0]
    elif change == "NaN in rotation":
        data["rotation"][1][1] = math.nan
    elif change == "infinite focal length":
        data["camera"]["fx"] = math.inf
    elif change == "zero focal length":
        data["projector"]["fy"] = 0.0
    elif change == "zero matrix":
        data["rotation"] = [[0.0] * 3] * 3
    elif change == "rank 2":
        data["rotation"] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
    return rig_from_dict(data)


def bad_file(change: str) -> Outcome:
    return refusal(lambda: _bad_rig(change), RigError)


def file_round_trip(suffix: str) -> Outcome:
    """Numbers that are hard to print must be restored to the last bit."""
    base = paper_rig(24)
    awkward = (0.1 + 0.2, 1e-17, math.nextafter(0.125, 1.0), 5e-324, -1 / 3)
    camera = replace(base.camera, cx=math.pi * 1e2, cy=2 / 3 * 1e2, distortion=awkward)
    rig = replace(
        base, camera=camera, translation_m=(math.nextafter(0.125, 0.0), -0.1 - 1e-17, 1e-300),
        rotation=rotation_matrix((1e-9, 2e-9, -3e-9)).tolist(), pitch_vertical_px=18 + 2**-48,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"rig{suffix}"
        save_rig(rig, path)
        loaded = load_rig(path)
    same = loaded == rig and json.dumps(loaded.to_dict()) == json.dumps(rig.to_dict())
    return Outcome(0.0 if same else math.inf, 0.0)
