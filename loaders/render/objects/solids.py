"""Solids the 50 objects are made of: turned, boxed, extruded and joined, all in millimetres.

Everything here is a :class:`manifold3d.Manifold`, closed by construction, so that unions and cuts stay watertight.
Two drawing frames are used. *Upright* solids (bottles, cans) stand on z = 0 with z up and their front towards -x,
where the camera stands at the first view. *Drawn* solids (scissors, lettering) are laid out in the xy plane as the
viewer sees them, z towards the viewer, and :func:`facing` stands them up. Source: own.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from manifold3d import CrossSection, JoinType, Manifold, OpType

Solid: TypeAlias = Manifold
Section: TypeAlias = CrossSection
Point2 = tuple[float, float]
Point3 = tuple[float, float, float]

GRID_MM = 2.0**-14
"""Solids are put on this grid before they are joined or cut, so that booleans decide alike on every processor."""
SEGMENTS = 120  # round a turned part: chord error 0.05 mm at a radius of 150 mm, a fifteenth of a pixel at 1.8 m
SMALL_SEGMENTS = 48  # round parts of less than 20 mm radius
TINY_SEGMENTS = 24  # round parts of less than 4 mm radius


def segments_for(radius: float) -> int:
    """Segments round a circle of ``radius`` mm."""
    return SEGMENTS if radius > 20 else SMALL_SEGMENTS if radius > 4 else TINY_SEGMENTS


def on_grid(solid: Solid, grid_mm: float = GRID_MM) -> Solid:
    """The solid with its vertices on a grid. The last bits of sines and cosines, which differ between processors, are
    gone then."""
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
    """A drawn solid (x right, y up, z to the viewer) stood up before the camera of the first view."""
    return solid.rotate((90, 0, -90))


def laid(solid: Solid) -> Solid:
    """An upright solid laid into the drawing frame, its front towards the viewer: the inverse of :func:`facing`."""
    return solid.rotate((0, 0, 90)).rotate((-90, 0, 0))


def embossed(body: Solid, section: Section, relief: float) -> Solid:
    """A drawn section pressed out of the front of an upright body by about ``relief`` mm, following its surface."""
    low_x, low_y, _, high_x, high_y, _ = body.bounding_box()
    grown = body.scale((1 + 2 * relief / (high_x - low_x), 1 + 2 * relief / (high_y - low_y), 1))
    return on_grid(grown) ^ on_grid(facing(section.extrude(-2 * low_x)))


def polygon(points: Sequence[Point2] | np.ndarray, soften: float = 0.0) -> Section:
    """Filled outline (N, 2) in mm, in either sense of turning; its corners rounded to radius ``soften``."""
    outline = CrossSection([np.asarray(points, dtype=np.float64)])
    if outline.area() <= 0:
        outline = CrossSection([np.asarray(points, dtype=np.float64)[::-1]])
    return softened(outline, soften)


def softened(section: Section, radius: float) -> Section:
    """The section with convex and concave corners rounded to ``radius`` mm (opened, then closed)."""
    if radius <= 0:
        return section
    arcs = segments_for(radius)
    opened = section.offset(-radius, JoinType.Round, 2.0, arcs)
    closed = opened.offset(2 * radius, JoinType.Round, 2.0, arcs)
    return closed.offset(-radius, JoinType.Round, 2.0, arcs).simplify(0.01)


def stroke(points: Sequence[Point2] | np.ndarray, width: float) -> Section:
    """A polyline drawn with a round pen of ``width`` mm."""
    dots = [CrossSection.circle(width / 2, SMALL_SEGMENTS).translate((float(x), float(y))) for x, y in points]
    pieces = [(a + b).hull() for a, b in pairwise(dots)]
    return CrossSection.batch_boolean(pieces, OpType.Add)


def rectangle(width: float, height: float, soften: float = 0.0, at: Point2 = (0, 0)) -> Section:
    """Rectangle centred at ``at``, its corners rounded."""
    return softened(CrossSection.square((width, height), True), soften).translate(at)


def disc(radius: float, at: Point2 = (0, 0)) -> Section:
    """Circle about ``at``."""
    return CrossSection.circle(radius, segments_for(radius)).translate(at)


def plate(section: Section, thickness: float, bevel: float = 0.0) -> Solid:
    """The section as a plate between z = -thickness/2 and +thickness/2; ``bevel`` mm chamfers it if it is convex."""
    if bevel <= 0:
        return section.extrude(thickness).translate((0, 0, -thickness / 2))
    core = section.extrude(thickness - 2 * bevel).translate((0, 0, -thickness / 2 + bevel))
    inset = section.offset(-bevel, JoinType.Round, 2.0, SMALL_SEGMENTS)
    skin = inset.extrude(thickness).translate((0, 0, -thickness / 2))
    return (core + skin).hull()


def _turned_section(profile: Sequence[Point2] | np.ndarray, soften: float) -> Section:
    side = np.asarray(profile, dtype=np.float64)
    mirrored = side[::-1] * (-1.0, 1.0)
    return polygon(np.concatenate([side, mirrored]), soften)


def lathe(profile: Sequence[Point2] | np.ndarray, soften: float = 0.0, segments: int = SEGMENTS) -> Solid:
    """Solid of revolution about z of (radius, height) points from bottom to top, corners rounded by ``soften``."""
    return Manifold.revolve(_turned_section(profile, soften), segments)


def vessel(profile: Sequence[Point2] | np.ndarray, wall: float, soften: float = 0.0) -> Solid:
    """A lathe that is hollow and open at its top, with walls and floor of ``wall`` mm."""
    outer = _turned_section(profile, soften)
    top = float(np.max(np.asarray(profile)[:, 1]))
    inner = outer.offset(-wall, JoinType.Round, 2.0, SMALL_SEGMENTS)
    mouth = float(np.asarray(profile)[-1, 0]) - wall
    opening = CrossSection.square((2 * mouth, 3 * wall + 2 * soften), True).translate((0, top - wall / 2))
    inner = CrossSection.batch_boolean([inner, opening], OpType.Add)
    return Manifold.revolve((outer - inner).simplify(0.01), SEGMENTS)


def ring(radius: float, bead: float, z: float = 0.0) -> Solid:
    """Torus about z at height ``z``; ``bead`` is the radius of its tube."""
    section = CrossSection.circle(bead, 24 if bead > 3 else 12).translate((radius, z))
    return Manifold.revolve(section, segments_for(radius))


def ball(radius: float, at: Point3 = (0, 0, 0)) -> Solid:
    """Sphere about ``at``."""
    return Manifold.sphere(radius, min(segments_for(radius), SMALL_SEGMENTS)).translate(at)


def rod(start: Point3, end: Point3, radius: float, end_radius: float | None = None, rounded: bool = False) -> Solid:
    """Round bar between two points, tapered to ``end_radius``, with flat or rounded ends."""
    axis = np.subtract(end, start)
    length = float(np.linalg.norm(axis))
    last = radius if end_radius is None else end_radius
    if rounded:
        return (ball(radius, start) + ball(last, end)).hull()
    polar = float(np.degrees(np.arctan2(np.hypot(axis[0], axis[1]), axis[2])))
    azimuth = float(np.degrees(np.arctan2(axis[1], axis[0])))
    return place(Manifold.cylinder(length, radius, last, segments_for(max(radius, last))), start, (0, polar, azimuth))


def block(width: float, depth: float, height: float, soften: float = 0.0, at: Point3 = (0, 0, 0)) -> Solid:
    """Box of size x, y, z centred at ``at``, edges and corners rounded to ``soften``."""
    if soften <= 0:
        return Manifold.cube((width, depth, height), True).translate(at)
    corner = Manifold.sphere(soften, 24)
    x, y, z = width / 2 - soften, depth / 2 - soften, height / 2 - soften
    corners = [corner.translate((i * x, j * y, k * z)) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
    return Manifold.batch_hull(corners).translate(at)


_GLYPHS = {
    "A": "01110 10001 10001 11111 10001 10001 10001",
    "B": "11110 10001 10001 11110 10001 10001 11110",
    "C": "01111 10000 10000 10000 10000 10000 01111",
    "D": "11110 10001 10001 10001 10001 10001 11110",
    "E": "11111 10000 10000 11110 10000 10000 11111",
    "F": "11111 10000 10000 11110 10000 10000 10000",
    "G": "01111 10000 10000 10011 10001 10001 01111",
    "H": "10001 10001 10001 11111 10001 10001 10001",
    "I": "01110 00100 00100 00100 00100 00100 01110",
    "J": "00111 00010 00010 00010 00010 10010 01100",
    "K": "10001 10010 10100 11000 10100 10010 10001",
    "L": "10000 10000 10000 10000 10000 10000 11111",
    "M": "10001 11011 10101 10101 10001 10001 10001",
    "N": "10001 11001 10101 10101 10011 10001 10001",
    "O": "01110 10001 10001 10001 10001 10001 01110",
    "P": "11110 10001 10001 11110 10000 10000 10000",
    "R": "11110 10001 10001 11110 10100 10010 10001",
    "S": "01111 10000 10000 01110 00001 00001 11110",
    "T": "11111 00100 00100 00100 00100 00100 00100",
    "U": "10001 10001 10001 10001 10001 10001 01110",
    "V": "10001 10001 10001 10001 01010 01010 00100",
    "Y": "10001 10001 01010 00100 00100 00100 00100",
    "Z": "11111 00001 00010 00100 01000 10000 11111",
    "+": "00000 00100 00100 11111 00100 00100 00000",
    "-": "00000 00000 00000 11111 00000 00000 00000",
    " ": "00000 00000 00000 00000 00000 00000 00000",
}
_ROWS, _ADVANCE = 7, 6


def text_section(text: str, width: float) -> Section:
    """The text as a flat section, ``width`` mm wide, centred at the origin; cells overlap a little where they meet."""
    runs = []
    for place, letter in enumerate(text):
        for row, cells in enumerate(_GLYPHS[letter].split()):
            for column, cell in enumerate(cells):
                if cell == "1":
                    corner = (place * _ADVANCE + column - 0.05, _ROWS - 1 - row - 0.05)
                    runs.append(CrossSection.square((1.1, 1.1)).translate(corner))
    section = CrossSection.batch_boolean(runs, OpType.Add)
    cells_wide = len(text) * _ADVANCE - 1
    scale = width / cells_wide
    return section.translate((-cells_wide / 2, -_ROWS / 2)).scale((scale, scale))


def text_plate(text: str, width: float, relief: float) -> Solid:
    """Drawn text rising ``relief`` mm above z = 0 and reaching as deep below it, to be joined to a face."""
    return text_section(text, width).extrude(2 * relief).translate((0, 0, -relief))


def wrapped(section: Section, radius: float, height: float, relief: float, turn: float = 0.0) -> Solid:
    """A flat section bent round an upright cylinder, centred at ``height`` on its front, ``relief`` mm proud of it."""
    sunk = 2.0 * relief + 0.5
    flat = section.extrude(sunk + relief).translate((0, 0, -sunk)).refine_to_length(max(radius / 12, 1.5))

    def bend(points: np.ndarray) -> np.ndarray:
        angle = points[:, 0] / radius
        reach = radius + points[:, 2]
        return np.stack([-reach * np.cos(angle), -reach * np.sin(angle), points[:, 1] + height], axis=1)

    return flat.warp_batch(bend).rotate((0, 0, turn))
