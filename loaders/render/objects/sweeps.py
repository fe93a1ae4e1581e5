"""Skins over a row of rings: tubes along a bent path, and lofts through changing cross-sections.

Lengths in millimetres, results closed :class:`manifold3d.Manifold` solids. Source: own.
"""

from collections.abc import Sequence

import numpy as np
from manifold3d import Manifold, Mesh64

from fpp_ml_bench.loaders.render.objects.solids import Point3, Solid

Level = tuple[float, float, float, float]


def curve(points: Sequence[Sequence[float]] | np.ndarray, per_span: int = 10) -> np.ndarray:
    """Smooth curve (M, D) through control points (N, D): centripetal Catmull-Rom, ``per_span`` pieces each."""
    control = np.asarray(points, dtype=np.float64)
    padded = np.concatenate([2 * control[:1] - control[1:2], control, 2 * control[-1:] - control[-2:-1]])
    knots = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(padded, axis=0), axis=1)))])
    spans = []
    for i in range(1, len(padded) - 2):
        t = np.linspace(knots[i], knots[i + 1], per_span, endpoint=False)[:, None]
        t0, t1, t2, t3 = knots[i - 1 : i + 3]
        p0, p1, p2, p3 = padded[i - 1 : i + 3]
        a1 = ((t1 - t) * p0 + (t - t0) * p1) / (t1 - t0)
        a2 = ((t2 - t) * p1 + (t - t1) * p2) / (t2 - t1)
        a3 = ((t3 - t) * p2 + (t - t2) * p3) / (t3 - t2)
        b1 = ((t2 - t) * a1 + (t - t0) * a2) / (t2 - t0)
        b2 = ((t3 - t) * a2 + (t - t1) * a3) / (t3 - t1)
        spans.append(((t2 - t) * b1 + (t - t1) * b2) / (t2 - t1))
    return np.concatenate([*spans, control[-1:]])


def skin(rings: np.ndarray, closed: bool = False) -> Solid:
    """Solid under rings of points (N, K, 3), each joined to the next; ``closed`` joins the last to the first.

    Ends that are not closed are capped by a fan about the mean of their ring, so end rings should be star-shaped.
    """
    count, sides = rings.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    here = index if closed else index[:-1]
    there = np.roll(index, -1, axis=0) if closed else index[1:]
    a, b = here.ravel(), np.roll(here, -1, axis=1).ravel()
    c, d = np.roll(there, -1, axis=1).ravel(), there.ravel()
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    points = [rings.reshape(-1, 3)]
    if not closed:
        points.append(np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)]))
        first, last = index[0], index[-1]
        centre = np.full(sides, count * sides)
        faces.append(np.stack([np.roll(first, -1), first, centre], axis=1))
        faces.append(np.stack([last, np.roll(last, -1), centre + 1], axis=1))
    vertices, triangles = np.concatenate(points), np.concatenate(faces)
    corners = vertices[triangles]
    if np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        triangles = triangles[:, ::-1]
    return Manifold(Mesh64(vertices, np.ascontiguousarray(triangles, dtype=np.uint64)))


def superellipse(width: float, depth: float, power: float = 2.0, sides: int = 120) -> np.ndarray:
    """Outline (sides, 2) of |2x/width|^power + |2y/depth|^power = 1: an ellipse at 2, towards a rectangle above."""
    angle = 2 * np.pi * np.arange(sides) / sides
    cosine, sine = np.cos(angle), np.sin(angle)
    x = np.sign(cosine) * np.abs(cosine) ** (2 / power)
    y = np.sign(sine) * np.abs(sine) ** (2 / power)
    return np.stack([x * width / 2, y * depth / 2], axis=1)


def loft(levels: Sequence[Level] | np.ndarray, smooth: int = 0, sides: int = 120) -> Solid:
    """Upright solid through superellipses (height, size along y, size along x, power), wide side to the camera.

    ``smooth`` above 0 passes a smooth curve through the levels, with that many pieces between two of them.
    """
    rows = np.asarray(levels, dtype=np.float64)
    if smooth:
        rows = curve(rows, smooth)
    rings = np.empty((len(rows), sides, 3))
    for row, (height, width, depth, power) in enumerate(rows):
        rings[row, :, :2] = superellipse(depth, width, power, sides)
        rings[row, :, 2] = height
    return skin(rings)


def tube(
    path: Sequence[Point3] | np.ndarray,
    radius: float | Sequence[float] | np.ndarray,
    flatten: float = 1.0,
    up: Point3 = (0, 0, 1),
    closed: bool = False,
    sides: int = 32,
) -> Solid:
    """Round (or, with ``flatten`` other than 1, oval) bar along a path (N, 3) with one radius or one for each point.

    ``up`` fixes how an oval section lies: its radius towards ``up`` is ``flatten`` times the one across.
    """
    points = np.asarray(path, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(points))
    if closed:
        tangents = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    else:
        tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(np.broadcast_to(np.asarray(up, dtype=np.float64), points.shape), tangents)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    above = np.cross(tangents, across)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring_across = np.cos(angle)[None, :, None] * across[:, None, :]
    ring_above = flatten * np.sin(angle)[None, :, None] * above[:, None, :]
    return skin(points[:, None, :] + radii[:, None, None] * (ring_across + ring_above), closed)
