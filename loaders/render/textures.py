"""Albedo maps: what is printed on an object, grows in it or has stained it, as functions of the
place on its surface.

They are functions of object coordinates, so that a map sticks to its object in every view, and of
the object's name. Prints lie on the two axes that the surface faces least; wood and stains fill
space.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.render.illumination import Material
from fpp_ml_bench.loaders.render.light import SurfaceLight
from fpp_ml_bench.loaders.render.paint import barycentric
from fpp_ml_bench.loaders.render.scene import SolidMesh, uniform

Values = NDArray[np.float64]
KINDS: dict[str, tuple[str, ...]] = {
    "label": (
        "master_chef_can",
        "tomato_soup_can",
        "mustard_bottle",
        "tuna_fish_can",
        "potted_meat_can",
        "bleach_cleanser",
        "spray_bottle",
        "container_bottle",
        "container_tin",
        "paint_container_bottle",
        "paint_container_jar",
        "paint_container_spraycan",
        "paint_container_tube_small",
        "paint_container_tube",
        "paint_container_tube_large",
        "paint_thinner",
        "battery",
        "battery_case",
        "tall_column",
        "sphere_pair",
    ),
    "text": (
        "cracker_box",
        "sugar_box",
        "pudding_box",
        "gelatin_box",
        "open_book",
        "magazine_stack",
        "vial",
        "hinged_leaves",
    ),
    "wood": (
        "wood_block",
        "wooden_boards",
        "hammer",
        "paint_brush",
        "paint_brush_large",
        "cork",
        "pallet_knife",
        "stair_tower",
        "cone_stack",
    ),
    "checks": ("duct_tape", "mug", "marker", "pen", "boxcutter", "saddle", "step_wedge"),
}
"""Objects by what is on them; all others, and users' meshes without colours, have stains."""
_KIND_OF = {name: kind for kind, names in KINDS.items() for name in names}
CHECK_MM, LETTER_MM, STAIN_MM, RING_MM = 24.0, 14.0, 45.0, 9.0
DARKEST = 0.02
"""Least luminance of a mesh's own colours: black paint returns some light."""
_GLYPHS = (
    0x7C12117E00,
    0x7F49493600,
    0x3E41412200,
    0x7F41413E00,
    0x7F49494100,
    0x7F09090100,
    0x3E41497A00,
    0x7F08087F00,
    0x00417F4100,
    0x7F08147300,
    0x7F40404000,
    0x7F06187F00,
    0x3E41413E00,
    0x7F09090600,
    0x7F09197600,
    0x2649493200,
)
"""Letters as five columns of seven points, a byte each, the lowest bit on top."""


def material_of(
    mesh: SolidMesh,
    position_m: Values,
    normal: Values,
    surface: SurfaceLight,
    triangle: NDArray[np.integer] | None = None,
) -> Material:
    """Albedo and gloss of a mesh at surface points (n, 3) with unit normals (n, 3), object
    coordinates, on triangles ``triangle`` (n,) of it. Where a light has textures, a mesh with
    colours of its own has those and no map."""
    albedo = surface.albedo * surface.object_share
    if surface.textures == "none":
        return Material(albedo, surface.gloss)
    gloss = surface.gloss * uniform("gloss", mesh.name)
    if mesh.paint is not None and triangle is not None:
        weights = barycentric(mesh.vertices_m[mesh.faces[triangle]], position_m)
        return Material(albedo * np.maximum(mesh.paint.at(triangle, weights), DARKEST), gloss)
    kind = _KIND_OF.get(mesh.name, "stains") if surface.textures == "by_kind" else surface.textures
    dark = MAPS[kind](position_m * MM_PER_M, normal, mesh.name)
    return Material(albedo * (1.0 - surface.contrast * dark), gloss)


def checks(position_mm: Values, normal: Values, name: str) -> Values:
    """A checkerboard."""
    across, down = _on_paper(position_mm, normal)
    return ((np.floor(across / CHECK_MM) + np.floor(down / CHECK_MM)) % 2).astype(np.float64)


def text(position_mm: Values, normal: Values, name: str) -> Values:
    """Lines of letters in paragraphs."""
    across, down = _on_paper(position_mm, normal)
    point = LETTER_MM / 10  # seven points of a letter and three between lines
    line, column = np.floor(down / LETTER_MM), np.floor(across / (6 * point))
    row, point_column = np.floor(down / point) % 10, np.floor(across / point) % 6
    code = _hash(line, column, np.zeros_like(line), name)
    glyph = np.array(_GLYPHS, dtype=np.int64)[(code & 15).astype(np.int64)]
    byte = glyph >> (32 - 8 * np.minimum(point_column, 4).astype(np.int64)) & 0xFF
    inked = (byte >> np.minimum(row, 7).astype(np.int64) & 1) == 1
    blank = (row >= 7) | (point_column >= 5) | (code % 6 == 5) | (line % 7 == 6)
    return np.where(inked & ~blank, 1.0, 0.0)


def label(position_mm: Values, normal: Values, name: str) -> Values:
    """A printed label: coloured bands, letters on some of them."""
    band = np.floor(position_mm[:, 2] / (3 * LETTER_MM))
    tone = _hash(band, np.zeros_like(band), np.zeros_like(band), name).astype(np.float64) / 2.0**32
    ground = np.where(tone < 0.4, 0.0, tone * 0.7)
    letters = text(position_mm, normal, name)
    return np.where(letters > 0, np.where(ground > 0.35, 0.0, 1.0), ground)


def wood(position_mm: Values, normal: Values, name: str) -> Values:
    """Grain: rings about an axis beside the object, wavy by noise."""
    x, y, z = position_mm.T
    wave = smooth_noise(np.column_stack([x / 30, y / 30, z / 200]), name)
    radius = np.sqrt((x + 60.0) ** 2 + (y - 25.0) ** 2) / RING_MM + 2.0 * wave
    ring = radius - np.floor(radius)
    fibre = smooth_noise(np.column_stack([x / 1.5, y / 1.5, z / 25]), name)
    return np.clip(0.8 * ring * ring + 0.3 * fibre, 0.0, 1.0)


def stains(position_mm: Values, normal: Values, name: str) -> Values:
    """Soft blotches, and a little grain."""
    blotch = (
        smooth_noise(position_mm / STAIN_MM, name)
        + 0.5 * smooth_noise(position_mm / (STAIN_MM / 3), name)
        - 0.25
    )
    share = np.clip((blotch - 0.4) / 0.3, 0.0, 1.0)
    return np.clip(
        0.85 * share * share * (3.0 - 2.0 * share) + 0.15 * smooth_noise(position_mm / 2.0, name),
        0.0,
        1.0,
    )


MAPS: dict[str, Callable[[Values, Values, str], Values]] = {
    "checks": checks,
    "text": text,
    "label": label,
    "wood": wood,
    "stains": stains,
}
"""How dark each map is, from 0 to 1, at places in mm (n, 3) with unit normals (n, 3), by the
object's name; (n,)."""


def _on_paper(position_mm: Values, normal: Values) -> tuple[Values, Values]:
    """Coordinates to the right and down, in mm, as if each surface were printed from the side that
    it faces most."""
    x, y, z = position_mm.T
    facing = np.abs(normal).argmax(axis=1)
    side, top = np.where(facing == 0, y, x), facing == 2
    right = np.where(top, y, np.where(facing == 0, -side, side))
    return right, np.where(top, x, -z)


def _hash(a: Values, b: Values, c: Values, name: str) -> NDArray[np.uint32]:
    """32 mixed bits of whole numbers (n,) each and a name."""
    seed = np.uint32(int(uniform("texture", name) * 2.0**32))
    with np.errstate(over="ignore"):
        h = np.full(a.shape, seed, dtype=np.uint32)
        for value, factor in ((a, 0x9E3779B1), (b, 0x85EBCA77), (c, 0xC2B2AE3D)):
            h ^= value.astype(np.int64).astype(np.uint32) * np.uint32(factor)
            h ^= h >> np.uint32(15)
            h *= np.uint32(0x2C1B3C6D)
            h ^= h >> np.uint32(12)
    return h


def smooth_noise(place: Values, name: str) -> Values:
    """Noise in [0, 1] that changes over a length of 1: a hash of the corners of each unit cell,
    blended smoothly."""
    cell = np.floor(place)
    share = place - cell
    share = share * share * (3.0 - 2.0 * share)
    total = np.zeros(len(place))
    for dx in (0, 1):
        for dy in (0, 1):
            for dz in (0, 1):
                weight = np.ones(len(place))
                for axis, corner in enumerate((dx, dy, dz)):
                    weight = weight * (share[:, axis] if corner else 1.0 - share[:, axis])
                value = (
                    _hash(cell[:, 0] + dx, cell[:, 1] + dy, cell[:, 2] + dz, name).astype(
                        np.float64
                    )
                    / 2.0**32
                )
                total += weight * value
    return total
