"""Solids the 50 objects are made of: turned, boxed, extruded, swept, lofted and joined, all in
millimetres.

Everything here is a :class:`manifold3d.Manifold`, closed by construction, so that unions and cuts
stay watertight. Two drawing frames are used. *Upright* solids (bottles, cans) stand on z = 0 with z
up and their front towards -x, where the camera stands at the first view. *Drawn* solids (scissors,
lettering) are laid out in the xy plane as the viewer sees them, z towards the viewer, and
:func:`facing` stands them up. Source: own.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, Mesh64, OpType
from numpy.typing import ArrayLike

Solid: TypeAlias = Manifold
Section: TypeAlias = CrossSection
Point2 = tuple[float, float]
Point3 = tuple[float, float, float]
Points: TypeAlias = Sequence[Sequence[float]] | np.ndarray
Level = tuple[float, float, float, float]
"""Height, size along y, size along x, and power of a superellipse."""

DRAWINGS: dict[str, Callable[[], Solid]] = {}
"""What makes each object, by its name, as it stands in the scene, in mm."""
GRID_MM = 2.0**-14
"""Solids are put on this grid before they are joined or cut, so that booleans decide alike on every
processor."""
SEGMENTS = 120
"""Round a turned part: chord error 0.05 mm at a radius of 150 mm, a fifteenth of a pixel at 1.8
m."""
SMALL_SEGMENTS = 48  # round parts of less than 20 mm radius
TINY_SEGMENTS = 24  # round parts of less than 4 mm radius


def segments_for(radius: float) -> int:
    """Segments round a circle of ``radius`` mm."""
    return SEGMENTS if radius > 20 else SMALL_SEGMENTS if radius > 4 else TINY_SEGMENTS


def on_grid(solid: Solid, grid_mm: float = GRID_MM) -> Solid:
    """The solid with its vertices on a grid. The last bits of sines and cosines, which differ
    between processors, are gone then."""
    return solid.warp_batch(lambda vertices: np.rint(vertices / grid_mm) * grid_mm)


def union(*solids: Solid) -> Solid:
    """All solids joined into one."""
    return Manifold.batch_boolean([on_grid(solid) for solid in solids], OpType.Add)


def cut(body: Solid, *tools: Solid) -> Solid:
    """The body less every tool."""
    return Manifold.batch_boolean([on_grid(solid) for solid in (body, *tools)], OpType.Subtract)


def place(solid: Solid, at: Point3 = (0, 0, 0), turn: Point3 = (0, 0, 0)) -> Solid:
    """The solid turned by degrees about x, then y, then z, and then moved by ``at`` mm."""
    return solid.rotate(turn).translate(at)


def facing(solid: Solid) -> Solid:
    """A drawn solid (x right, y up, z to the viewer) stood up before the camera of the first
    view."""
    return solid.rotate((90, 0, -90))


def laid(solid: Solid) -> Solid:
    """An upright solid laid into the drawing frame, its front towards the viewer: the inverse of
    :func:`facing`."""
    return solid.rotate((0, 0, 90)).rotate((-90, 0, 0))


def upright(
    enlarged: float, *turns: Point3, stood: Callable[[Solid], Solid] = lambda solid: solid
) -> Callable[[Callable[[], Solid]], Callable[[], Solid]]:
    """Make an object of a function that draws an upright solid at its real size: it stands in the
    scene turned by degrees about x, then y, then z, by one of ``turns`` after the other, and
    ``enlarged``."""

    def add(draw: Callable[[], Solid]) -> Callable[[], Solid]:
        DRAWINGS[draw.__name__] = lambda: reduce(Solid.rotate, turns, stood(draw())).scale(
            (enlarged,) * 3
        )
        return draw

    return add


drawn = partial(upright, stood=facing)
"""The same of a function that draws a solid as the viewer sees it (`facing`)."""


def embossed(body: Solid, section: Section, relief: float) -> Solid:
    """A drawn section pressed out of the front of an upright body by about ``relief`` mm, following
    its surface."""
    low_x, low_y, _, high_x, high_y, _ = body.bounding_box()
    grown = body.scale((1 + 2 * relief / (high_x - low_x), 1 + 2 * relief / (high_y - low_y), 1))
    return on_grid(grown) ^ on_grid(facing(section.extrude(-2 * low_x)))


def polygon(points: Points, soften: float = 0.0) -> Section:
    """Filled outline (N, 2) in mm, in either sense of turning; its corners rounded to radius
    ``soften``."""
    outline = CrossSection([np.asarray(points, dtype=np.float64)])
    if outline.area() <= 0:
        outline = CrossSection([np.asarray(points, dtype=np.float64)[::-1]])
    return softened(outline, soften)


def softened(section: Section, radius: float) -> Section:
    """The section with convex and concave corners rounded to ``radius`` mm (opened, then
    closed)."""
    if radius <= 0:
        return section
    arcs = segments_for(radius)
    opened = section.offset(-radius, JoinType.Round, 2.0, arcs)
    closed = opened.offset(2 * radius, JoinType.Round, 2.0, arcs)
    return closed.offset(-radius, JoinType.Round, 2.0, arcs).simplify(0.01)


def stroke(points: Points, width: float) -> Section:
    """A polyline drawn with a round pen of ``width`` mm."""
    dots = [
        CrossSection.circle(width / 2, SMALL_SEGMENTS).translate((float(x), float(y)))
        for x, y in points
    ]
    pieces = [(a + b).hull() for a, b in pairwise(dots)]
    return CrossSection.batch_boolean(pieces, OpType.Add)


def rectangle(width: float, height: float, soften: float = 0.0, at: Point2 = (0, 0)) -> Section:
    """Rectangle centred at ``at``, its corners rounded."""
    return softened(CrossSection.square((width, height), True), soften).translate(at)


def disc(radius: float, at: Point2 = (0, 0)) -> Section:
    """Circle about ``at``."""
    return CrossSection.circle(radius, segments_for(radius)).translate(at)


def plate(section: Section, thickness: float, bevel: float = 0.0) -> Solid:
    """The section as a plate between z = -thickness/2 and +thickness/2; ``bevel`` mm chamfers it if
    it is convex."""
    if bevel <= 0:
        return section.extrude(thickness).translate((0, 0, -thickness / 2))
    core = section.extrude(thickness - 2 * bevel).translate((0, 0, -thickness / 2 + bevel))
    inset = section.offset(-bevel, JoinType.Round, 2.0, SMALL_SEGMENTS)
    skin = inset.extrude(thickness).translate((0, 0, -thickness / 2))
    return (core + skin).hull()


def _turned_section(profile: Points, soften: float) -> Section:
    side = np.asarray(profile, dtype=np.float64)
    return polygon([*side, *(side[::-1] * (-1.0, 1.0))], soften)


def lathe(profile: Points, soften: float = 0.0, segments: int = SEGMENTS) -> Solid:
    """Solid of revolution about z of (radius, height) points from bottom to top, corners rounded by
    ``soften``."""
    return Manifold.revolve(_turned_section(profile, soften), segments)


def vessel(profile: Points, wall: float, soften: float = 0.0) -> Solid:
    """A lathe that is hollow and open at its top, with walls and floor of ``wall`` mm."""
    outer = _turned_section(profile, soften)
    top = float(np.max(np.asarray(profile)[:, 1]))
    inner = outer.offset(-wall, JoinType.Round, 2.0, SMALL_SEGMENTS)
    mouth = float(np.asarray(profile)[-1, 0]) - wall
    opening = CrossSection.square((2 * mouth, 3 * wall + 2 * soften), True).translate(
        (0, top - wall / 2)
    )
    inner = CrossSection.batch_boolean([inner, opening], OpType.Add)
    return Manifold.revolve((outer - inner).simplify(0.01), SEGMENTS)


def ring(radius: float, bead: float, z: float = 0.0) -> Solid:
    """Torus about z at height ``z``; ``bead`` is the radius of its tube."""
    section = CrossSection.circle(bead, 24 if bead > 3 else 12).translate((radius, z))
    return Manifold.revolve(section, segments_for(radius))


def ball(radius: float, at: Point3 = (0, 0, 0)) -> Solid:
    """Sphere about ``at``."""
    return Manifold.sphere(radius, min(segments_for(radius), SMALL_SEGMENTS)).translate(at)


def rod(
    start: Point3,
    end: Point3,
    radius: float,
    end_radius: float | None = None,
    rounded: bool = False,
) -> Solid:
    """Round bar between two points, tapered to ``end_radius``, with flat or rounded ends."""
    axis = np.subtract(end, start)
    length = float(np.linalg.norm(axis))
    last = radius if end_radius is None else end_radius
    if rounded:
        return (ball(radius, start) + ball(last, end)).hull()
    polar = float(np.degrees(np.arctan2(np.hypot(axis[0], axis[1]), axis[2])))
    azimuth = float(np.degrees(np.arctan2(axis[1], axis[0])))
    return place(
        Manifold.cylinder(length, radius, last, segments_for(max(radius, last))),
        start,
        (0, polar, azimuth),
    )


def post(
    low: float, high: float, radius: float, end_radius: float | None = None, at: Point2 = (0, 0)
) -> Solid:
    """A `rod` along z, from height ``low`` to ``high``."""
    return rod((*at, low), (*at, high), radius, end_radius)


def block(
    width: float, depth: float, height: float, soften: float = 0.0, at: Point3 = (0, 0, 0)
) -> Solid:
    """Box of size x, y, z centred at ``at``, edges and corners rounded to ``soften``."""
    if soften <= 0:
        return Manifold.cube((width, depth, height), True).translate(at)
    corner = Manifold.sphere(soften, 24)
    x, y, z = width / 2 - soften, depth / 2 - soften, height / 2 - soften
    corners = [
        corner.translate((i * x, j * y, k * z)) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)
    ]
    return Manifold.batch_hull(corners).translate(at)


def curve(points: Points, per_span: int = 10) -> np.ndarray:
    """Smooth curve (M, D) through control points (N, D): centripetal Catmull-Rom, ``per_span``
    pieces each."""
    control = np.asarray(points, dtype=np.float64)
    padded = np.concatenate(
        [2 * control[:1] - control[1:2], control, 2 * control[-1:] - control[-2:-1]]
    )
    knots = np.concatenate(
        [[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(padded, axis=0), axis=1)))]
    )
    t = np.linspace(knots[1:-2], knots[2:-1], per_span, endpoint=False, axis=1)[..., None]
    count = len(control) - 1

    def between(
        first: np.ndarray, second: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray:
        return ((high - t) * first + (t - low) * second) / (high - low)

    t0, t1, t2, t3 = (knots[k : k + count, None, None] for k in range(4))
    p0, p1, p2, p3 = (padded[k : k + count, None] for k in range(4))
    middle = between(p1, p2, t1, t2)
    before = between(between(p0, p1, t0, t1), middle, t0, t2)
    behind = between(middle, between(p2, p3, t2, t3), t1, t3)
    return np.concatenate(
        [between(before, behind, t1, t2).reshape(-1, control.shape[1]), control[-1:]]
    )


def symmetric(half: Points) -> np.ndarray:
    """Outline through ``half`` (N, 2), which starts or ends on x = 0, and its mirror image: a
    `curve` through each."""
    mirrored = np.asarray(half, dtype=np.float64)[::-1] * (-1.0, 1.0)
    return np.concatenate([curve(half), curve(mirrored)[1:]])


def cushioned(section: Section, thickness: float, inset: float, middle: float) -> Solid:
    """The section as a plate that is ``middle`` mm thick where it is ``inset`` mm from its edge."""
    return union(plate(section, thickness), plate(section.offset(-inset), middle))


def skin(rings: np.ndarray, closed: bool = False) -> Solid:
    """Solid under rings of points (N, K, 3), each joined to the next; ``closed`` joins the last to
    the first. Ends that are not closed are capped by a fan about the mean of their ring, so end
    rings should be star-shaped."""
    count, sides = rings.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    here = index if closed else index[:-1]
    there = np.roll(index, -1, axis=0) if closed else index[1:]
    a, b = here.ravel(), np.roll(here, -1, axis=1).ravel()
    c, d = np.roll(there, -1, axis=1).ravel(), there.ravel()
    faces = [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    points = [rings.reshape(-1, 3)]
    if not closed:
        points.append(np.stack([rings[0].mean(axis=0), rings[-1].mean(axis=0)]))
        first, last = index[0], index[-1]
        centre = np.full(sides, count * sides)
        faces.append(np.column_stack([np.roll(first, -1), first, centre]))
        faces.append(np.column_stack([last, np.roll(last, -1), centre + 1]))
    vertices, triangles = np.concatenate(points), np.concatenate(faces)
    corners = vertices[triangles]
    if np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() < 0:
        triangles = triangles[:, ::-1]
    return Manifold(Mesh64(vertices, np.ascontiguousarray(triangles, dtype=np.uint64)))


def angles(count: int) -> np.ndarray:
    """``count`` equal steps round a circle from 0, in radians."""
    return 2 * np.pi * np.arange(count) / count


def around(count: int) -> list[Point2]:
    """Unit vectors at ``count`` equal steps round the axis."""
    return list(zip(np.cos(angles(count)).tolist(), np.sin(angles(count)).tolist(), strict=True))


def superellipse(width: float, depth: float, power: float = 2.0, sides: int = 120) -> np.ndarray:
    """Outline (sides, 2) of |2x/width|^power + |2y/depth|^power = 1: an ellipse at 2, towards a
    rectangle above."""
    cosine, sine = np.cos(angles(sides)), np.sin(angles(sides))
    x = np.sign(cosine) * np.abs(cosine) ** (2 / power)
    y = np.sign(sine) * np.abs(sine) ** (2 / power)
    return np.column_stack([x * width / 2, y * depth / 2])


def loft(levels: Points, smooth: int = 0, sides: int = 120) -> Solid:
    """Upright solid through superellipses (`Level`), wide side to the camera. ``smooth`` above 0
    passes a smooth curve through the levels, with that many pieces between two of them."""
    rows = np.asarray(levels, dtype=np.float64)
    if smooth:
        rows = curve(rows, smooth)
    rings = np.empty((len(rows), sides, 3))
    for row, (height, width, depth, power) in enumerate(rows):
        rings[row, :, :2] = superellipse(depth, width, power, sides)
        rings[row, :, 2] = height
    return skin(rings)


def tube(
    path: Points,
    radius: ArrayLike,
    flatten: float = 1.0,
    up: Point3 = (0, 0, 1),
    closed: bool = False,
    sides: int = 32,
) -> Solid:
    """Round (or, with ``flatten`` other than 1, oval) bar along a path (N, 3), of one ``radius`` or
    of one at each point (N,). ``up`` fixes how an oval section lies: its radius towards ``up`` is
    ``flatten`` times the one across."""
    points = np.asarray(path, dtype=np.float64)
    if closed:
        tangents = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    else:
        tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(np.broadcast_to(np.asarray(up, dtype=np.float64), points.shape), tangents)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    above = np.cross(tangents, across)
    angle = angles(sides)[None, :, None]
    ring_across = np.cos(angle) * across[:, None, :]
    ring_above = flatten * np.sin(angle) * above[:, None, :]
    reach = np.asarray(radius, dtype=np.float64).reshape(-1, 1, 1)
    return skin(points[:, None, :] + reach * (ring_across + ring_above), closed)


_GLYPHS = {
    "A": "EHHVHHH",
    "B": "UHHUHHU",
    "C": "FGGGGGF",
    "D": "UHHHHHU",
    "E": "VGGUGGV",
    "F": "VGGUGGG",
    "G": "FGGJHHF",
    "H": "HHHVHHH",
    "I": "E44444E",
    "J": "72222IC",
    "K": "HIKOKIH",
    "L": "GGGGGGV",
    "M": "HRLLHHH",
    "N": "HPLLJHH",
    "O": "EHHHHHE",
    "P": "UHHUGGG",
    "R": "UHHUKIH",
    "S": "FGGE11U",
    "T": "V444444",
    "U": "HHHHHHE",
    "V": "HHHHAA4",
    "Y": "HHA4444",
    "Z": "V1248GV",
    "+": "044V440",
    "-": "000V000",
    " ": "0000000",
}
"""Letters of 5 x 7 cells: a base-32 digit is a row, its bits are the cells, the left one first."""
_ROWS, _ADVANCE = 7, 6


def text_section(text: str, width: float, at: Point2 = (0, 0)) -> Section:
    """The text as a flat section, ``width`` mm wide, centred at ``at``; cells overlap a little
    where they meet."""
    runs = []
    for place, letter in enumerate(text):
        for row, digit in enumerate(_GLYPHS[letter]):
            for column, cell in enumerate(f"{int(digit, 32):05b}"):
                if cell == "1":
                    corner = (place * _ADVANCE + column - 0.05, _ROWS - 1 - row - 0.05)
                    runs.append(CrossSection.square((1.1, 1.1)).translate(corner))
    section = CrossSection.batch_boolean(runs, OpType.Add)
    cells_wide = len(text) * _ADVANCE - 1
    scale = width / cells_wide
    return section.translate((-cells_wide / 2, -_ROWS / 2)).scale((scale, scale)).translate(at)


def text_plate(text: str, width: float, relief: float) -> Solid:
    """Drawn text rising ``relief`` mm above z = 0 and reaching as deep below it, to be joined to a
    face."""
    return text_section(text, width).extrude(2 * relief).translate((0, 0, -relief))


def wrapped(
    section: Section, radius: float, height: float, relief: float, turn: float = 0.0
) -> Solid:
    """A flat section bent round an upright cylinder, centred at ``height`` on its front, ``relief``
    mm proud of it."""
    sunk = 2.0 * relief + 0.5
    flat = (
        section.extrude(sunk + relief)
        .translate((0, 0, -sunk))
        .refine_to_length(max(radius / 12, 1.5))
    )

    def bend(points: np.ndarray) -> np.ndarray:
        angle = points[:, 0] / radius
        reach = radius + points[:, 2]
        return np.column_stack(
            [-reach * np.cos(angle), -reach * np.sin(angle), points[:, 1] + height]
        )

    return flat.warp_batch(bend).rotate((0, 0, turn))


def lettered(radius: float, relief: float, *lines: tuple[str, float, float]) -> list[Solid]:
    """Text lines (words, width, height) bent round an upright cylinder like `wrapped`."""
    return [
        wrapped(text_section(words, width), radius, height, relief)
        for words, width, height in lines
    ]
