"""Checks of the triangulation: depth where rays and projector planes are nearly parallel, near and far."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import CalibrationLayer
from fpp_ml_bench.baselines.stability.case import Outcome, worst
from fpp_ml_bench.baselines.stability.frames import plane_stack
from fpp_ml_bench.baselines.stability.roundoff import U32, U64, difference, high_precision
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding import decode_stack, depth_from_both, depth_from_coordinate, depth_noise_mm
from fpp_ml_bench.loaders.render import Lighting, light_surface
from fpp_ml_bench.optics import Direction, Maps, Rig, paper_rig, rotation_matrix

_WEIGHTS = (0.7, 1.3)


def scaled_baseline(baseline_mm: float, ahead: float = 0.0, turned: bool = False) -> Rig:
    """The paper's rig with a shorter baseline and the projector ``ahead`` of the camera by that share of it."""
    rig = paper_rig(24)
    t = np.array([*rig.translation_m[:2], -ahead * rig.baseline_m])
    t *= baseline_mm / MM_PER_M / np.linalg.norm(t)
    turn = rotation_matrix((0.05, -0.09, 0.12)) if turned else np.eye(3)
    return replace(rig, rotation=turn.tolist(), translation_m=(float(t[0]), float(t[1]), float(t[2])))


def rays(count: int = 40) -> Maps:
    """Normalised coordinates of camera rays across the paper's field of view, seeded."""
    rng = np.random.default_rng(5)
    return rng.uniform(-0.2, 0.2, count), rng.uniform(-0.2, 0.2, count)


def exact_coordinates(ray_maps: Maps, depth_m: float, rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Projector px of points at ``depth_m`` on the rays, in 50 digits, rounded once."""
    mp = high_precision()
    u, v = [], []
    for x, y in zip(*ray_maps, strict=True):
        ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
        p = [
            mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) * depth_m + mp.mpf(float(rig.t[i]))
            for i in range(3)
        ]
        u.append(float(mp.mpf(rig.projector.fx) * p[0] / p[2] + mp.mpf(rig.projector.cx)))
        v.append(float(mp.mpf(rig.projector.fy) * p[1] / p[2] + mp.mpf(rig.projector.cy)))
    return np.array(u), np.array(v)


def _exact_depth(ray_maps: Maps, coordinate: NDArray, rig: Rig, axis: int) -> list:
    """Depth in mm of these float64 inputs in 50 digits, by the closed form."""
    mp = high_precision()
    device = rig.projector
    depths = []
    for x, y, w in zip(*ray_maps, coordinate, strict=True):
        ray = (mp.mpf(float(x)), mp.mpf(float(y)), mp.mpf(1))
        a = [mp.fsum(mp.mpf(float(rig.R[i, j])) * ray[j] for j in range(3)) for i in range(3)]
        ideal = (mp.mpf(float(w)) - mp.mpf((device.cx, device.cy)[axis])) / mp.mpf((device.fx, device.fy)[axis])
        bottom = a[axis] - ideal * a[2]
        top = ideal * mp.mpf(float(rig.t[2])) - mp.mpf(float(rig.t[axis]))
        depths.append(1000 * top / bottom if bottom != 0 else mp.inf)
    return depths


def conditioning(
    ray_maps: Maps, coordinate: NDArray, rig: Rig, axis: int, unit: float = U64
) -> tuple[NDArray, NDArray]:
    """Bound of the closed form's relative error, and its condition number: sum of magnitudes over |a - x_p a_2|.

    Running error analysis: x_p has 2 roundings; a, a_2 have 3 each of sums of magnitudes; the difference and the top
    cancel; 4 more for the last quotient and the change to mm.
    """
    x, y = (np.abs(axis_map) for axis_map in ray_maps)
    device = rig.projector
    ideal = np.abs((coordinate - (device.cx, device.cy)[axis]) / (device.fx, device.fy)[axis])
    size = [np.abs(rig.R[i, 0]) * x + np.abs(rig.R[i, 1]) * y + np.abs(rig.R[i, 2]) for i in range(3)]
    a = [rig.R[i, 0] * ray_maps[0] + rig.R[i, 1] * ray_maps[1] + rig.R[i, 2] for i in range(3)]
    signed = (coordinate - (device.cx, device.cy)[axis]) / (device.fx, device.fy)[axis]
    bottom = np.abs(a[axis] - signed * a[2])
    top = np.abs(signed * rig.t[2] - rig.t[axis])
    condition = (size[axis] + ideal * size[2]) / bottom
    above = (ideal * abs(rig.t[2]) + abs(rig.t[axis])) / top
    return unit * (8 * condition + 5 * above + 4), condition


def one_coordinate(baseline_mm: float, range_m: float, direction: Direction, turned: bool = False) -> Outcome:
    rig = scaled_baseline(baseline_mm, 0.3 if turned else 0.0, turned)
    ray_maps, axis = rays(), 0 if direction == "vertical" else 1
    coordinate = exact_coordinates(ray_maps, range_m, rig)[axis]
    exact = _exact_depth(ray_maps, coordinate, rig, axis)
    depth_mm = depth_from_coordinate(ray_maps, coordinate, rig, direction)
    relative, condition = conditioning(ray_maps, coordinate, rig, axis)
    scale = np.array([abs(float(value)) for value in exact])
    return worst(difference(depth_mm, exact) / scale, relative, np.isnan(depth_mm), condition=float(condition.max()))


def _least_squares(ray_maps: Maps, u: NDArray, v: NDArray, rig: Rig) -> tuple[list, NDArray, NDArray]:
    """Depth mm that minimises the weighted misfit, by Newton in 50 digits; contraction of Gauss-Newton; its start's
    relative error."""
    mp = high_precision()
    device, wu, wv = rig.projector, mp.mpf(_WEIGHTS[0]), mp.mpf(_WEIGHTS[1])
    depths, contraction, start = [], [], []
    for x, y, pu, pv in zip(*ray_maps, u, v, strict=True):
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
    ray_maps = rays(16)
    rng = np.random.default_rng(6)
    u, v = (axis + noise_px * rng.standard_normal(axis.shape) for axis in exact_coordinates(ray_maps, 1.8, rig))
    exact, contraction, start = _least_squares(ray_maps, u, v, rig)
    depth_mm = depth_from_both(ray_maps, u, v, rig, *_WEIGHTS).depth_mm
    scale = np.array([abs(float(value)) for value in exact])
    in_front = np.array([float(value) > 0 for value in exact])
    roundoff = np.zeros(len(u))
    condition = 0.0
    for axis, coordinate in enumerate((u, v)):
        relative, of_axis = conditioning(ray_maps, coordinate, rig, axis)
        roundoff, condition = np.maximum(roundoff, relative), max(condition, float(of_axis.max()))
    bound = 8 * roundoff + start * (contraction + 4 * start) ** 3
    error = np.where(in_front, difference(depth_mm, exact) / scale, 0.0)
    return worst(error, bound, np.isnan(depth_mm), float(np.mean(~in_front)), condition=condition)


def noise_law(baseline_mm: float, direction: Direction) -> Outcome:
    """rms of depth under noise against rig.md's law; where noise is a fifth of the depth, the share without a depth."""
    rig = scaled_baseline(baseline_mm)
    count, depth_m, modulation = 20_000, 1.8, 60.0
    ray_maps = np.zeros(count), np.zeros(count)
    axis = 0 if direction == "vertical" else 1
    coordinate = exact_coordinates((ray_maps[0][:1], ray_maps[1][:1]), depth_m, rig)[axis][0]
    sigma_px = rig.pitch(direction) * math.sqrt(2 / 18) / modulation / (2 * math.pi)
    noisy = coordinate + sigma_px * np.random.default_rng(8).standard_normal(count)
    depths_mm = depth_from_coordinate(ray_maps, noisy, rig, direction)
    law = float(depth_noise_mm(rig, depth_m * MM_PER_M, direction, 18, modulation))
    share = law / (depth_m * MM_PER_M)
    if share < 0.2:
        rms = float(np.sqrt(np.mean((depths_mm - depth_m * MM_PER_M) ** 2)))
        return Outcome(abs(rms / law - 1), 4 / math.sqrt(2 * count) + 8 * share**2, condition=1 / share)
    # Inverse depth is exactly linear in u: it is negative, and there is no depth, with the probability Phi(-1/share).
    nowhere = 0.5 * math.erfc(1 / share / math.sqrt(2))
    bound = 4 * math.sqrt(nowhere * (1 - nowhere) / count) + 1 / count
    return Outcome(abs(float(np.isnan(depths_mm).mean()) - nowhere), bound, condition=1 / share)


def near_parallel(shift_px: float) -> Outcome:
    """A projector plane ``shift_px`` from parallel to the ray: depth f b / shift, up to a point at infinity."""
    rig = paper_rig(24)
    ray_maps = rays()
    infinity = rig.projector.fx * ray_maps[0] + rig.projector.cx
    coordinate = infinity + shift_px
    exact = _exact_depth(ray_maps, coordinate, rig, 0)
    depth_mm = depth_from_coordinate(ray_maps, coordinate, rig, "vertical")
    relative, condition = conditioning(ray_maps, coordinate, rig, 0)
    scale = np.array([abs(float(value)) for value in exact])
    # Where the bound exceeds half of the depth, the number is round-off and must be masked, as behind the camera.
    nothing = ~(relative < 0.5) | np.array([not float(value) > 0 for value in exact])
    error = np.where(nothing, np.inf, difference(depth_mm, exact) / scale)
    size = (np.abs(coordinate) + rig.projector.cx) / rig.projector.fx + np.abs(ray_maps[0])
    may_flag = float(np.mean(nothing | (8 * U64 * size * rig.projector.fx > 0.2 * abs(shift_px))))
    return worst(error, relative, np.isnan(depth_mm), may_flag, condition=float(np.max(condition)))


def point_at_infinity() -> Outcome:
    """The coordinate of a point at infinity itself, on rays where it is exact."""
    rig = paper_rig(24)
    ray_maps = np.array([0.0, 0.125, -0.25]), np.zeros(3)
    coordinate = rig.projector.fx * ray_maps[0] + rig.projector.cx
    depth_mm = depth_from_coordinate(ray_maps, coordinate, rig, "vertical")
    return worst(np.zeros(3), 0.0, np.isnan(depth_mm))


def decoded_far(range_m: float) -> Outcome:
    """The decoder on a plane beyond the working range, up to where its parallax is under a hundredth of a pixel."""
    rig = paper_rig(32)
    frames, exact = plane_stack(rig, range_m)
    u, v = exact["vertical"], exact["horizontal"]
    inside = (u > 3) & (u < rig.projector.width - 4) & (v > 3) & (v < rig.projector.height - 4)
    decoded = decode_stack(frames, rig, mask=inside)
    return worst(decoded.depth_mm[inside], 0.0, decoded.depth_mm[inside] == 0, 1.0)


def behind_projector(ahead_m: float) -> Outcome:
    """Depths between the camera and a projector ahead of it: behind the projector, which can't light them."""
    rig = replace(paper_rig(24), translation_m=(0.125, -0.1, -ahead_m))
    ray_maps = rays()
    depth = 0.5 * ahead_m
    points = np.stack([ray_maps[0], ray_maps[1], np.ones(len(ray_maps[0]))], axis=1) * depth + rig.t
    mirrored = rig.projector.fx * points[:, 0] / points[:, 2] + rig.projector.cx
    depth_mm = depth_from_coordinate(ray_maps, mirrored, rig, "vertical")
    return worst(np.zeros(len(mirrored)), 0.0, np.isnan(depth_mm))


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
    ray_maps = rays()
    coordinate = exact_coordinates(ray_maps, range_m, rig)[0]
    depth_mm = depth_from_coordinate(ray_maps, coordinate.astype(np.float32), rig, "vertical")
    device = rig.projector
    slope = np.abs(coordinate) / device.fx / np.abs((coordinate - device.cx) / device.fx - ray_maps[0])
    exact = _exact_depth(ray_maps, coordinate, rig, 0)
    scale = np.array([abs(float(value)) for value in exact])
    shift = slope * U32
    bound = np.where(shift < 0.5, shift / (1 - np.minimum(shift, 0.5)), 1.0) * 1.001
    error = np.where(shift < 0.5, difference(depth_mm, exact) / scale, 0.0)
    return worst(error, bound, np.isnan(depth_mm), float(np.mean(shift >= 0.5)), condition=float(slope.max()))


def single_layer(baseline_mm: float, range_m: float) -> Outcome:
    """The calibration layer in float32: it subtracts small phases, so only the phase's own rounding is amplified."""
    rig = scaled_baseline(baseline_mm)
    ray_maps = rays()
    layer = CalibrationLayer.of(rig, "vertical", ray_maps)
    total = layer.absolute_phase(np.full(len(ray_maps[0]), range_m * MM_PER_M))
    order = np.floor(total / (2 * np.pi) + 0.5)
    phase = (total - 2 * np.pi * order).astype(np.float32)
    narrow = replace(
        layer, infinity_rad=layer.infinity_rad.astype(np.float32), gain=layer.gain.astype(np.float32),
        infinity_order=layer.infinity_order.astype(np.float32), forward=layer.forward.astype(np.float32),
    )  # fmt: skip
    depth_mm = narrow.depth_mm(phase, order.astype(np.float32))
    psi = np.abs(layer.gain / (layer.forward * range_m + layer.back_m))
    turns = 2 * np.pi * np.abs(order - layer.infinity_order)
    lost = np.abs(phase) + np.abs(layer.infinity_rad) + np.abs(phase - layer.infinity_rad) + 2 * turns + psi
    condition = lost / psi
    relative = condition * U32 + 6 * U32
    useless = relative >= 0.5
    error = np.where(useless, 0.0, depth_mm / (range_m * MM_PER_M) - 1)
    bound = np.where(useless, 1.0, relative / (1 - np.minimum(relative, 0.5)))
    return worst(error, bound, condition=float(condition.max()))


def overflowing(value: float) -> Outcome:
    """Coordinates that no projector has: the result must be masked or a finite positive depth."""
    rig = paper_rig(24)
    ray_maps = rays()
    shape = ray_maps[0].shape
    u, v = np.full(shape, value), np.full(shape, value)
    from_one = depth_from_coordinate(ray_maps, u, rig, "vertical")
    from_both = depth_from_both(ray_maps, u, v, rig).depth_mm
    legal = np.isnan(from_one) | (np.isfinite(from_one) & (from_one > 0))
    legal &= np.isnan(from_both) | (np.isfinite(from_both) & (from_both > 0))
    return worst(np.where(legal, 0.0, np.inf), 0.0, np.isnan(from_one) & np.isnan(from_both), 1.0)


def no_weight() -> Outcome:
    """Both directions without modulation: their weights are 0, so there is no depth."""
    rig = paper_rig(24)
    ray_maps = rays()
    u, v = exact_coordinates(ray_maps, 1.8, rig)
    depth_mm = depth_from_both(ray_maps, u, v, rig, 0.0, 0.0).depth_mm
    return worst(np.zeros(len(u)), 0.0, np.isnan(depth_mm))
