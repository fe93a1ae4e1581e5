"""Gauges of a simulated type test: spheres, ball bars, planes, steps with a slanted edge and wedges,
in positions over a rig's measuring volume, and what a camera sees of them.

A sphere is traced as a mesh whose hits are moved onto the sphere itself, so that nothing sags: the
depth of every pixel is that of the closed form. All other surfaces are flat, and exact as they are.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.raycast import Hits, PixelRays, TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh
from fpp_ml_bench.optics.rig import Rig, rotation_matrix

Vector = NDArray[np.float64]
Kind = Literal["sphere", "ball bar", "plane", "step", "wedge"]
DIAMETER = 0.12
"""Of a sphere, over the diagonal of the volume: VDI/VDE 2634 part 2 is said to ask for 0.1 to
0.2."""
SPACING = 0.32
"""Of the spheres of a ball bar, over the diagonal: at least 0.3."""
LENGTH = 0.52
"""Diagonal of a plane, over that of the volume: at least 0.5."""
STEP, WEDGE_DEG = 0.02, 150.0
"""Height of a step over the diagonal of the volume, and the angle between the faces of a wedge."""
EDGE_DEG = 5.0
"""Angle of the step's edge to the image's columns: the edge response is sampled more finely than
the pixels are."""
SPHERES, BARS, PLANES, OTHERS = 10, 7, 6, 3
"""Positions of each kind: as many as the guideline is said to ask for; steps and wedges are not of
it."""
MARGIN_PX = 8.0
"""Between a gauge and the border of the image."""
PLACED = 40
"""Times that a gauge is moved toward the middle of the volume until camera and projector see all of
it, by a twentieth of the way each."""


@dataclass(frozen=True)
class Surface:
    """What is fitted to the points of a part: a sphere with a ``radius_m``, or with None a plane
    through ``point_m`` (3,); for a sphere its centre. ``normal`` (3,) of a plane, toward the
    camera."""

    point_m: Vector
    radius_m: float | None = None
    normal: Vector | None = None


@dataclass(frozen=True, eq=False)
class Gauge:
    """A gauge in place: ``mesh`` in camera coordinates, its ``surfaces``, and ``part`` int8 (F,),
    of which of them each triangle is, -1 for none."""

    kind: Kind
    position: int
    mesh: SolidMesh
    surfaces: tuple[Surface, ...]
    part: NDArray[np.int8]

    @property
    def name(self) -> str:
        return f"{self.kind} {self.position + 1}"


class TracedGauge(TracedObject):
    """A gauge ready for rays."""

    def __init__(self, gauge: Gauge) -> None:
        super().__init__(gauge.mesh, gauge.mesh.vertices_m)
        self._gauge = gauge

    def primary(self, rays: PixelRays, wanted: NDArray[np.bool_] | None = None) -> Hits:
        """As of `TracedObject`, on the surfaces themselves."""
        hits = super().primary(rays, wanted)
        depth_m, normals = hits.depth_m.copy(), hits.normals.copy()
        part, shape = self._gauge.part[hits.triangle], rays.x.shape
        row, column = np.divmod(hits.pixels, shape[1])
        for number, surface in enumerate(self._gauge.surfaces):
            if surface.radius_m is None:
                continue
            on = np.flatnonzero(part == number)
            ray = np.stack(
                [rays.x[row[on], column[on]], rays.y[row[on], column[on]], np.ones(len(on))]
            )
            along = surface.point_m @ ray / (ray * ray).sum(axis=0)
            beside = ray * along - surface.point_m[:, None]
            # The mesh lies within the sphere, so that every ray which meets it meets the sphere.
            half = surface.radius_m**2 - (beside * beside).sum(axis=0)
            depth_m[on] = along - np.sqrt(np.maximum(half, 0) / (ray * ray).sum(axis=0))
            normals[on] = ((ray * depth_m[on]).T - surface.point_m) / surface.radius_m
        return Hits(hits.pixels, depth_m, normals, hits.triangle)


@dataclass(frozen=True)
class Volume:
    """The measuring volume of a rig, in metres: the working range before the whole image. ``slopes``
    (4,): tangents of the left, right, upper and lower border."""

    rig: Rig
    near_m: float
    far_m: float
    slopes: Vector

    @classmethod
    def of(cls, rig: Rig) -> "Volume":
        camera = rig.camera
        left, right = (
            (x - camera.cx) / camera.fx for x in (MARGIN_PX, camera.width - 1 - MARGIN_PX)
        )
        top, bottom = (
            (y - camera.cy) / camera.fy for y in (MARGIN_PX, camera.height - 1 - MARGIN_PX)
        )
        near_m, far_m = rig.range_m
        return cls(rig, near_m, far_m, np.array([left, right, top, bottom]))

    @property
    def diagonal_m(self) -> float:
        """Of the largest box in it whose near face fills the image."""
        left, right, top, bottom = self.slopes * self.near_m
        return float(np.linalg.norm([right - left, bottom - top, self.far_m - self.near_m]))

    @property
    def middle_m(self) -> Vector:
        """On the middle ray, half-way between the ends of the range."""
        left, right, top, bottom = self.slopes
        z = (self.near_m + self.far_m) / 2
        return np.array([(left + right) / 2 * z, (top + bottom) / 2 * z, z])

    def holds(self, points_m: Vector) -> bool:
        """Whether camera and projector see all of ``points_m`` (n, 3) within the range."""
        x, y, z = points_m.T
        left, right, top, bottom = self.slopes
        return bool(
            ((z >= self.near_m) & (z <= self.far_m)).all()
            and ((x >= left * z) & (x <= right * z) & (y >= top * z) & (y <= bottom * z)).all()
            and self.rig.projector.holds(*self.rig.project(points_m), 0.5).all()
        )

    def placed(self, points_m: Vector, corner: Vector) -> Vector:
        """Where a gauge with ``points_m`` (n, 3) around its own middle goes: as far toward a
        ``corner`` (3,) of the volume, its coordinates -1 to 1, as all of it is held. Raises
        `BuildError` where it fits nowhere on the way."""
        middle = self.middle_m
        z = middle[2] + corner[2] * (self.far_m - self.near_m) / 2
        left, right, top, bottom = self.slopes
        x = z * ((left + right) / 2 + corner[0] * (right - left) / 2)
        y = z * ((top + bottom) / 2 + corner[1] * (bottom - top) / 2)
        way = np.array([x, y, z]) - middle
        for share in np.linspace(1, 0, PLACED + 1):
            if self.holds(points_m + middle + share * way):
                return np.asarray(middle + share * way)
        raise BuildError(
            f"a gauge of {MM_PER_M * np.ptp(points_m, axis=0).max():.0f} mm fits nowhere in the "
            f"measuring volume of {self.near_m * MM_PER_M:g} to {self.far_m * MM_PER_M:g} mm; give a "
            f"rig whose projector covers its camera's image over the working range"
        )


CORNERS = np.array(
    [
        [0, 0, 0],
        [-0.9, -0.9, -0.8],
        [0.9, 0.9, -0.8],
        [0.9, -0.9, 0.8],
        [-0.9, 0.9, 0.8],
        [0, 0, -0.9],
        [0, 0, 0.9],
        [0.9, 0, 0.2],
        [-0.9, 0, -0.2],
        [0, 0.9, 0.1],
    ]
)
"""Where spheres and planes stand, from the first on."""
DIRECTIONS = np.array(
    [[1, 0, 0], [0, 1, 0], [1, 1, 0], [1, -1, 0], [1, 0, 1], [0, 1, -1], [1, 1, 1]], np.float64
)
"""Of the ball bars."""
TILTS_DEG = np.array([[0, 0, 0], [20, 0, 0], [0, 20, 0], [-20, 0, 0], [0, -20, 0], [14, 14, 0]])
"""Of the planes, about x and y."""


def gauges(rig: Rig) -> Iterator[Gauge]:
    """All gauges in their positions, in metres in the rig's camera coordinates."""
    volume = Volume.of(rig)
    size = volume.diagonal_m
    ball = trimesh.creation.icosphere(subdivisions=5, radius=DIAMETER * size / 2)
    for number, corner in enumerate(CORNERS[:SPHERES]):
        yield _spheres("sphere", number, [volume.placed(ball.vertices, corner)], ball)
    for number, direction in enumerate(DIRECTIONS[:BARS]):
        half = SPACING * size / 2 * direction / np.linalg.norm(direction)
        both = np.concatenate([ball.vertices - half, ball.vertices + half])
        middle = volume.placed(both, CORNERS[0])
        yield _spheres("ball bar", number, [middle - half, middle + half], ball)
    side = LENGTH * size / np.sqrt(2)
    for number, tilt in enumerate(TILTS_DEG[:PLANES]):
        yield _flat("plane", number, volume, CORNERS[number], tilt, [_box(side, side, 0.0, 0.0)])
    height = STEP * size
    for number in range(OTHERS):
        yield _flat("step", number, volume, CORNERS[number], TILTS_DEG[0], _step(side / 2, height))
    for number in range(OTHERS):
        yield _flat("wedge", number, volume, CORNERS[number], TILTS_DEG[0], _wedge(side / 2))


def _spheres(kind: Kind, number: int, centres_m: list[Vector], ball: trimesh.Trimesh) -> Gauge:
    count, radius_m = len(ball.vertices), float(np.linalg.norm(ball.vertices, axis=1).max())
    vertices = np.concatenate([ball.vertices + centre for centre in centres_m])
    faces = np.concatenate([ball.faces + count * at for at in range(len(centres_m))])
    part = np.repeat(np.arange(len(centres_m)), len(ball.faces)).astype(np.int8)
    surfaces = tuple(Surface(centre, radius_m) for centre in centres_m)
    return Gauge(kind, number, _mesh(kind, number, vertices, faces), surfaces, part)


Prism = tuple[Vector, float]
"""A prism: its front face (n, 3), corners in order and facing -z, and its depth behind it in m."""


def _box(width_m: float, height_m: float, x_m: float, z_m: float) -> Prism:
    """A plate whose front face is ``z_m`` before the gauge's middle."""
    across, down = width_m / 2, height_m / 2
    face = [(-across, -down), (across, -down), (across, down), (-across, down)]
    return np.array([(x + x_m, y, z_m) for x, y in face]), width_m / 20


def _step(side_m: float, height_m: float) -> list[Prism]:
    """Two plates beside each other, the right one nearer by ``height_m``, with a slanted edge."""
    half, slant = side_m / 2, side_m / 2 * np.tan(np.deg2rad(EDGE_DEG))
    far = np.array([(-half, -half, 0), (-slant, -half, 0), (slant, half, 0), (-half, half, 0.0)])
    near = np.array([(-slant, -half, 0), (half, -half, 0), (half, half, 0), (slant, half, 0.0)])
    return [(far, side_m / 10), (near - [0, 0, height_m], side_m / 10 + height_m)]


def _wedge(side_m: float) -> list[Prism]:
    """Two faces that meet in a ridge toward the camera."""
    half = side_m / 2
    back = half / np.tan(np.deg2rad(WEDGE_DEG / 2))
    left = np.array([(-half, -half, back), (0, -half, 0), (0, half, 0), (-half, half, back)])
    right = np.array([(0, -half, 0), (half, -half, back), (half, half, back), (0, half, 0)])
    return [(left, side_m / 10), (right, side_m / 10)]


def _flat(
    kind: Kind, number: int, volume: Volume, corner: Vector, tilt_deg: Vector, prisms: list[Prism]
) -> Gauge:
    turn = rotation_matrix(tuple(np.deg2rad(tilt_deg)))
    vertices, faces, part = [], [], []
    for at, (face, depth_m) in enumerate(prisms):
        front = face @ turn.T
        vertices.append(np.concatenate([front, front + np.array([0, 0, depth_m])]))
        sides = [(k, (k + 1) % 4, 4 + (k + 1) % 4, 4 + k) for k in range(4)]
        quads = [(0, 1, 2, 3), (7, 6, 5, 4), *((a, d, c, b) for a, b, c, d in sides)]
        faces += [(8 * at + a, 8 * at + b, 8 * at + c) for a, b, c, _ in quads]
        faces += [(8 * at + a, 8 * at + c, 8 * at + d) for a, _, c, d in quads]
        part += [at if quad == 0 else -1 for _ in range(2) for quad in range(len(quads))]
    points = np.concatenate(vertices)
    moved = points + volume.placed(points - points.mean(axis=0), corner) - points.mean(axis=0)
    surfaces = []
    for at in range(len(prisms)):
        a, b, c = moved[8 * at : 8 * at + 3]
        normal = np.cross(b - a, c - a)
        normal = normal / np.linalg.norm(normal)
        surfaces.append(Surface(a, None, -normal if normal @ a > 0 else normal))
    mesh = _mesh(kind, number, moved, np.array(faces))
    return Gauge(kind, number, mesh, tuple(surfaces), np.array(part, np.int8))


def _mesh(kind: Kind, number: int, vertices_m: Vector, faces: NDArray[np.integer]) -> SolidMesh:
    return SolidMesh(
        f"{kind.replace(' ', '_')}-{number + 1}",
        np.ascontiguousarray(vertices_m, np.float64),
        np.ascontiguousarray(faces, np.int32),
    )
