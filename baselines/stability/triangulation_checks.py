"""What the triangulation cases compute: depth where rays and projector planes are nearly parallel, near and far."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer
from fpp_ml_bench.baselines.stability.case import Outcome, worst
from fpp_ml_bench.baselines.stability.frames import plane_stack
from fpp_ml_bench.baselines.stability.roundoff import U32, U64, difference, high_precision
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import decode_stack
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.illumination import Lighting, light_surface
from fpp_ml_bench.pinhole import Maps
from fpp_ml_bench.rig import Rig, paper_rig
from fpp_ml_bench.rig_io import rotation_matrix
from fpp_ml_bench.triangulation import depth_from_both, depth_from_coordinate, depth_noise_mm

_WEIGHTS = (0.7, 1.3)


def scaled_baseline(baseline_mm: float, ahead: float = 0.0, turned: bool = False) -> Rig:
    """The paper's rig with its baseline shortened, the projector ``ahead`` of the camera by that part of it."""
    rig = paper_rig(24)
    t = np.array([*rig.translation_m[:2], -ahead * rig.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    turn = rotation_matrix((0.05, -0.09, 0.12)) if turned else np.eye(3)
    return replace(rig, rotation=turn.tolist(), translation_m=(float(t[0]), float(t[1]), float(t[2])))


def rays(count: int = 40) -> Maps:
    """Normalised coordinates of camera rays across the paper's field of view, seeded."""
    rng = np.random.default_rng(5)
    return rng.uniform(-0.2, 0.2, count), rng.uniform(-0.2, 0.2, count)


def exact_coordinates(where: Maps, depth_m: float, rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Projector px of points at ``depth_m`` on the rays, from 50 digits rounded once."""
    mp = high_precision()
    u, v = [], []
    for x, y in zip(*where, strict=True):
        ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
        p = [
            mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) * depth_m + mp.mpf(float(rig.t[i]))
            for i in range(3)
        ]
        u.append(float(mp.mpf(rig.projector.fx) * p[0] / p[2] + mp.mpf(rig.projector.cx)))
        v.append(float(mp.mpf(rig.projector.fy) * p[1] / p[2] + mp.mpf(rig.projector.cy)))
    return np.array(u), np.array(v)


def _exact_depth(where: Maps, coordinate: NDArray, rig: Rig, axis: int) -> list:
    """Depth in mm of these very float64 inputs in 50 digits, by the closed form."""
    mp = high_precision()
    device = rig.projector
    found = []
    for x, y, w in zip(*where, coordinate, strict=True):
        ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
        a = [mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) for i in range(3)]
        ideal = (mp.mpf(float(w)) - mp.mpf((device.cx, device.cy)[axis])) / mp.mpf((device.fx, device.fy)[axis])
        bottom = a[axis] - ideal * a[2]
        top = ideal * mp.mpf(float(rig.t[2])) - mp.mpf(float(rig.t[axis]))
        found.append(1000 * top / bottom if bottom != 0 else mp.inf)
    return found


def conditioning(where: Maps, coordinate: NDArray, rig: Rig, axis: int, unit: float = U64) -> tuple[NDArray, NDArray]:
    """Bound of the closed form's relative error, and its condition number: what cancels in a - x_p a_2, over it.

    Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of magnitudes; the difference and the top
    cancel; 4 more for the last quotient and the change to mm.
    """
    x, y = (np.abs(axis_map) for axis_map in where)
    device = rig.projector
    ideal = np.abs((coordinate - (device.cx, device.cy)[axis]) / (device.fx, device.fy)[axis])
    size = [np.abs(rig.R[i, 0]) * x + np.abs(rig.R[i, 1]) * y + np.abs(rig.R[i, 2]) for i in range(3)]
    a = [rig.R[i, 0] * where[0] + rig.R[i, 1] * where[1] + rig.R[i, 2] for i in range(3)]
    signed = (coordinate - (device.cx, device.cy)[axis]) / (device.fx, device.fy)[axis]
    bottom = np.abs(a[axis] - signed * a[2])
    top = np.abs(signed * rig.t[2] - rig.t[axis])
    condition = (size[axis] + ideal * size[2]) / bottom
    above = (ideal * abs(rig.t[2]) + abs(rig.t[axis])) / top
    return unit * (8 * condition + 5 * above + 4), condition


def one_coordinate(baseline_mm: float, range_m: float, direction: Direction, turned: bool = False) -> Outcome:
    rig = scaled_baseline(baseline_mm, 0.3 if turned else 0.0, turned)
    where, axis = rays(), 0 if direction == "vertical" else 1
    coordinate = exact_coordinates(where, range_m, rig)[axis]
    exact = _exact_depth(where, coordinate, rig, axis)
    found = depth_from_coordinate(where, coordinate, rig, direction)
    relative, condition = conditioning(where, coordinate, rig, axis)
    scale = np.array([abs(float(value)) for value in exact])
    return worst(difference(found, exact) / scale, relative, np.isnan(found), condition=float(condition.max()))


def _least_squares(where: Maps, u: NDArray, v: NDArray, rig: Rig) -> tuple[list, NDArray, NDArray]:
    """Depth mm that minimises the weighted misfit, by Newton in 50 digits; contraction of Gauss-Newton; its start's
    relative error."""
    mp = high_precision()
    device, wu, wv = rig.projector, mp.mpf(_WEIGHTS[0]), mp.mpf(_WEIGHTS[1])
    depths, contraction, start = [], [], []
    for x, y, pu, pv in zip(*where, u, v, strict=True):
        ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
        a = [mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) for i in range(3)]
        t = [mp.mpf(float(value)) for value in rig.t]
        pixel, centre, focal = (float(pu), float(pv)), (device.cx, device.cy), (device.fx, device.fy)
        measured = [(mp.mpf(pixel[i]) - mp.mpf(centre[i])) / mp.mpf(focal[i]) for i in range(2)]
        c = [f * (a[i] - measured[i] * a[2]) for i, f in enumerate((device.fx, device.fy))]
        d = [f * (measured[i] * t[2] - t[i]) for i, f in enumerate((device.fx, device.fy))]
        w = (wu * c[0] * d[0] + wv * c[1] * d[1]) / (wu * d[0] ** 2 + wv * d[1] ** 2)
        first = w
        for _ in range(15):
            q = a[2] + t[2] * w
            r = [(c[i] - d[i] * w) / q for i in range(2)]
            g = [(d[i] + r[i] * t[2]) / q for i in range(2)]  # -dr/dw
            h = [2 * t[2] * g[i] / q for i in range(2)]  # d2r/dw2
            slope = wu * r[0] * g[0] + wv * r[1] * g[1]
            square = wu * g[0] ** 2 + wv * g[1] ** 2
            bend = wu * r[0] * h[0] + wv * r[1] * h[1]
            w += slope / (square + bend)
        depths.append(1000 / w)
        contraction.append(abs(float(bend / square)))
        start.append(abs(float((first - w) / w)))
    return depths, np.array(contraction), np.array(start)


def both_coordinates(baseline_mm: float, ahead: float, noise_px: float) -> Outcome:
    rig = scaled_baseline(baseline_mm, ahead, True)
    where = rays(16)
    rng = np.random.default_rng(6)
    u, v = (axis + noise_px * rng.standard_normal(axis.shape) for axis in exact_coordinates(where, 1.8, rig))
    exact, contraction, start = _least_squares(where, u, v, rig)
    found = depth_from_both(where, u, v, rig, *_WEIGHTS).depth_mm
    scale = np.array([abs(float(value)) for value in exact])
    there = np.array([float(value) > 0 for value in exact])
    roundoff = np.zeros(len(u))
    condition = 0.0
    for axis, coordinate in enumerate((u, v)):
        relative, of_axis = conditioning(where, coordinate, rig, axis)
        roundoff, condition = np.maximum(roundoff, relative), max(condition, float(of_axis.max()))
    bound = 8 * roundoff + start * (contraction + 4 * start) ** 3
    error = np.where(there, difference(found, exact) / scale, 0.0)
    return worst(error, bound, np.isnan(found), float(np.mean(~there)), condition=condition)


def noise_law(baseline_mm: float, direction: Direction) -> Outcome:
    """rms of depth under noise, by rig.md's law; where noise is a fifth of the depth, the share that lies nowhere."""
    rig = scaled_baseline(baseline_mm)
    count, depth_m, modulation = 20_000, 1.8, 60.0
    where = np.zeros(count), np.zeros(count)
    axis = 0 if direction == "vertical" else 1
    one = exact_coordinates((where[0][:1], where[1][:1]), depth_m, rig)[axis][0]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = one + sigma_px * np.random.default_rng(8).standard_normal(count)
    found = depth_from_coordinate(where, noisy, rig, direction)
    law = float(depth_noise_mm(rig, depth_m * MM_PER_M, direction, 18, modulation))
    share = law / (depth_m * MM_PER_M)
    if share < 0.2:
        rms = float(np.sqrt(np.mean((found - depth_m * MM_PER_M) ** 2)))
        return Outcome(abs(rms / law - 1), 4 / math.sqrt(2 * count) + 8 * share**2, condition=1 / share)
    # Inverse depth is exactly linear in u: it is negative, and there is no depth, with the probability Phi(-1/share).
    nowhere = 0.5 * math.erfc(1 / share / math.sqrt(2))
    bound = 4 * math.sqrt(nowhere * (1 - nowhere) / count) + 1 / count
    return Outcome(abs(float(np.isnan(found).mean()) - nowhere), bound, condition=1 / share)


def near_parallel(shift_px: float) -> Outcome:
    """A projector plane ``shift_px`` from parallel to the ray: depth f b / shift, up to a point at infinity."""
    rig = paper_rig(24)
    where = rays()
    infinity = rig.projector.fx * where[0] + rig.projector.cx
    coordinate = infinity + shift_px
    exact = _exact_depth(where, coordinate, rig, 0)
    found = depth_from_coordinate(where, coordinate, rig, "vertical")
    relative, condition = conditioning(where, coordinate, rig, 0)
    scale = np.array([abs(float(value)) for value in exact])
    # Where the bound is half of the depth a number is round-off and must be masked, like what lies behind.
    nothing = ~(relative < 0.5) | np.array([not float(value) > 0 for value in exact])
    error = np.where(nothing, np.inf, difference(found, exact) / scale)
    size = (np.abs(coordinate) + rig.projector.cx) / rig.projector.fx + np.abs(where[0])
    may_flag = float(np.mean(nothing | (8 * U64 * size * rig.projector.fx > 0.2 * abs(shift_px))))
    return worst(error, relative, np.isnan(found), may_flag, condition=float(np.max(condition)))


def point_at_infinity() -> Outcome:
    """The coordinate of a point at infinity itself, on rays where it is exact."""
    rig = paper_rig(24)
    where = np.array([0.0, 0.125, -0.25]), np.zeros(3)
    coordinate = rig.projector.fx * where[0] + rig.projector.cx
    found = depth_from_coordinate(where, coordinate, rig, "vertical")
    return worst(np.zeros(3), 0.0, np.isnan(found))


def decoded_far(range_m: float) -> Outcome:
    """The decoder on a plane beyond the working range, up to where its parallax is under a hundredth of a pixel."""
    rig = paper_rig(32)
    frames, exact = plane_stack(rig, range_m)
    u, v = exact["vertical"], exact["horizontal"]
    inside = (u > 3) & (u < rig.projector.width - 4) & (v > 3) & (v < rig.projector.height - 4)
    found = decode_stack(frames, rig, mask=inside)
    return worst(found.depth_mm[inside], 0.0, found.depth_mm[inside] == 0, 1.0)


def behind_projector(ahead_m: float) -> Outcome:
    """Depths between camera and a projector that stands ahead of it: behind the projector, so it can't light them."""
    rig = replace(paper_rig(24), translation_m=(0.125, -0.1, -ahead_m))
    where = rays()
    depth = 0.5 * ahead_m
    points = np.stack([where[0], where[1], np.ones(len(where[0]))], axis=1) * depth + rig.t
    mirrored = rig.projector.fx * points[:, 0] / points[:, 2] + rig.projector.cx
    found = depth_from_coordinate(where, mirrored, rig, "vertical")
    return worst(np.zeros(len(mirrored)), 0.0, np.isnan(found))


def lit_from_behind() -> Outcome:
    """A projector beyond the surface that looks back at it lights its far side: the camera sees no fringes."""
    turn = rotation_matrix((0.0, math.pi, 0.0))
    centre = np.array([-0.125, 0.1, 3.0])
    rig = replace(paper_rig(24), rotation=turn.tolist(), translation_m=tuple((-turn @ centre).tolist()))
    x, y = rays()
    points = np.stack([x, y, np.ones(len(x))], axis=1) * 1.8
    normals = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
    lit = light_surface(points, normals, rig, Lighting())
    return worst(lit.gain, 0.0, lit.gain == 0)


def single_coordinate_in(baseline_mm: float, range_m: float) -> Outcome:
    """A coordinate stored in single precision: relative depth error against condition times 2^-24."""
    rig = scaled_baseline(baseline_mm)
    where = rays()
    coordinate = exact_coordinates(where, range_m, rig)[0]
    found = depth_from_coordinate(where, coordinate.astype(np.float32), rig, "vertical")
    device = rig.projector
    slope = np.abs(coordinate) / device.fx / np.abs((coordinate - device.cx) / device.fx - where[0])
    exact = _exact_depth(where, coordinate, rig, 0)
    scale = np.array([abs(float(value)) for value in exact])
    shift = slope * U32
    bound = np.where(shift < 0.5, shift / (1 - np.minimum(shift, 0.5)), 1.0) * 1.001
    error = np.where(shift < 0.5, difference(found, exact) / scale, 0.0)
    return worst(error, bound, np.isnan(found), float(np.mean(shift >= 0.5)), condition=float(slope.max()))


def single_layer(baseline_mm: float, range_m: float) -> Outcome:
    """The calibration layer in float32: it subtracts small phases, so only the phase's own rounding is amplified."""
    rig = scaled_baseline(baseline_mm)
    where = rays()
    layer = CalibrationLayer.of(rig, "vertical", where)
    total = layer.absolute_phase(np.full(len(where[0]), range_m * MM_PER_M))
    order = np.floor(total / (2 * np.pi) + 0.5)
    phase = (total - 2 * np.pi * order).astype(np.float32)
    narrow = replace(
        layer, infinity_rad=layer.infinity_rad.astype(np.float32), gain=layer.gain.astype(np.float32),
        infinity_order=layer.infinity_order.astype(np.float32), forward=layer.forward.astype(np.float32),
    )  # fmt: skip
    found = narrow.depth_mm(phase, order.astype(np.float32))
    psi = np.abs(layer.gain / (layer.forward * range_m + layer.back_m))
    turns = 2 * np.pi * np.abs(order - layer.infinity_order)
    lost = np.abs(phase) + np.abs(layer.infinity_rad) + np.abs(phase - layer.infinity_rad) + 2 * turns + psi
    condition = lost / psi
    relative = condition * U32 + 6 * U32
    useless = relative >= 0.5
    error = np.where(useless, 0.0, found / (range_m * MM_PER_M) - 1)
    bound = np.where(useless, 1.0, relative / (1 - np.minimum(relative, 0.5)))
    return worst(error, bound, condition=float(condition.max()))


def overflowing(value: float) -> Outcome:
    """Coordinates no projector has: a depth that is none must not come out."""
    rig = paper_rig(24)
    where = rays()
    shape = where[0].shape
    u, v = np.full(shape, value), np.full(shape, value)
    one = depth_from_coordinate(where, u, rig, "vertical")
    other = depth_from_both(where, u, v, rig).depth_mm
    legal = np.isnan(one) | (np.isfinite(one) & (one > 0))
    legal &= np.isnan(other) | (np.isfinite(other) & (other > 0))
    return worst(np.where(legal, 0.0, np.inf), 0.0, np.isnan(one) & np.isnan(other), 1.0)


def no_weight() -> Outcome:
    """Both directions without any modulation: their weights are 0, and so is what they say."""
    rig = paper_rig(24)
    where = rays()
    u, v = exact_coordinates(where, 1.8, rig)
    found = depth_from_both(where, u, v, rig, 0.0, 0.0).depth_mm
    return worst(np.zeros(len(u)), 0.0, np.isnan(found))
