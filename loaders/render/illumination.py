"""How bright each pixel is: projector light by cosine and inverse square on a matte surface, weak specular, ambient.

The material is the paper's (Section 2.2: matte, roughness 0.95, specular 0.15, the same on object and background
plane). A surface turned away from the projector gets ambient light only; cast shadows are an option, off as in the
paper.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.render.raycast import Hits, TracedObject
from fpp_ml_bench.loaders.render.scene import Lighting
from fpp_ml_bench.optics import Direction, Rig
from fpp_ml_bench.portable import power
from fpp_ml_bench.skipping import skipping_enabled

NEAREST_M = 1e-3
"""A point nearer to a centre of projection is inside that lens and gets no light: the inverse square has no limit."""


@dataclass(frozen=True)
class PatternLookup:
    """Where each pixel reads a 1-D pattern profile: entry ``index`` uint16 and its next, blended by ``weight``."""

    index: NDArray[np.uint16]
    weight: NDArray[np.float32]

    @classmethod
    def of(cls, coordinate_px: NDArray[np.float64], length: int) -> "PatternLookup":
        """Lookup of projector coordinates (n,) in px; beyond the outer pixel centres the outer pixel is read."""
        inside = np.clip(np.nan_to_num(coordinate_px), 0.0, length - 1.0)
        index = np.minimum(np.floor(inside), length - 2)
        return cls(index.astype(np.uint16), (inside - index).astype(np.float32))


@dataclass(frozen=True)
class LitPixels:
    """Everything that the 52 exposures of a set of pixels share; arrays of length n.

    ``lookup`` per direction, ``gain`` grey levels per unit of pattern light, ``ambient`` grey levels, both float32.
    """

    lookup: dict[Direction, PatternLookup]
    gain: NDArray[np.float32]
    ambient: NDArray[np.float32]
    shadow_rays: int = 0

    def patched(self, where: NDArray[np.int64], patch: "LitPixels") -> "LitPixels":
        """A copy in which the pixels at flat indices ``where`` are those of ``patch``."""

        def replaced(values: NDArray, patches: NDArray) -> NDArray:
            copy = values.copy()
            copy[where] = patches
            return copy

        lookup = {}
        for direction, here in self.lookup.items():
            there = patch.lookup[direction]
            lookup[direction] = PatternLookup(replaced(here.index, there.index), replaced(here.weight, there.weight))
        gain, ambient = replaced(self.gain, patch.gain), replaced(self.ambient, patch.ambient)
        return LitPixels(lookup, gain, ambient, self.shadow_rays + patch.shadow_rays)


def projector_centre_m(rig: Rig) -> NDArray[np.float64]:
    """The projector's centre of projection in camera coordinates, metres (3,)."""
    rotation, (tx, ty, tz) = rig.R, rig.t
    return -(rotation[0] * tx + rotation[1] * ty + rotation[2] * tz)


@np.errstate(divide="ignore", invalid="ignore")  # of points in a lens, which get no light
def light_surface(
    points_m: NDArray[np.float64], normals: NDArray[np.float64], rig: Rig, lighting: Lighting,
    occluder: TracedObject | None = None,
) -> LitPixels:  # fmt: skip
    """Illumination of surface points (n, 3) with unit ``normals`` (n, 3) that face the camera; NaN points stay dark."""
    centre_m = projector_centre_m(rig)
    # Component by component: operations on (n, 3) arrays run three numbers at a time, on (n,) arrays n.
    x, y, z = (np.ascontiguousarray(axis) for axis in points_m.T)
    nx, ny, nz = (np.ascontiguousarray(axis) for axis in normals.T)
    to_x, to_y, to_z = centre_m[0] - x, centre_m[1] - y, centre_m[2] - z
    squared_m = to_x * to_x + to_y * to_y + to_z * to_z
    to_projector, to_camera = 1.0 / np.sqrt(squared_m), 1.0 / np.sqrt(x * x + y * y + z * z)
    cosine = (nx * to_x + ny * to_y + nz * to_z) * to_projector
    half_x = to_x * to_projector - x * to_camera
    half_y = to_y * to_projector - y * to_camera
    half_z = to_z * to_projector - z * to_camera
    along = nx * half_x + ny * half_y + nz * half_z
    along /= np.sqrt(half_x * half_x + half_y * half_y + half_z * half_z)
    # Blinn-Phong with the exponent that a microfacet roughness of this size has (2 / roughness^4 - 2).
    exponent = max(2.0 / lighting.roughness**4 - 2.0, 0.0)
    gloss = power(np.clip(along, 0.0, 1.0), exponent)
    reference_m = rig.working_range_mm[0] / MM_PER_M
    gain = (1.0 - lighting.specular + lighting.specular * gloss) * cosine
    gain *= lighting.white_grey * reference_m**2 / squared_m
    u, v = rig.project(points_m)
    apart = (squared_m > NEAREST_M**2) & (x * x + y * y + z * z > NEAREST_M**2)
    lit = (cosine > 0) & apart & in_pattern(u, v, rig)
    shadow_rays = 0
    if lighting.shadows and occluder is not None:
        candidates = np.flatnonzero(lit)
        lit[candidates] = ~occluder.shadowed(points_m[candidates], centre_m)
        shadow_rays = candidates.size
    seen = np.isfinite(points_m).all(axis=1)
    lookup: dict[Direction, PatternLookup] = {  # vertical fringes read u, horizontal ones v
        "vertical": PatternLookup.of(u, rig.pattern_length("vertical")),
        "horizontal": PatternLookup.of(v, rig.pattern_length("horizontal")),
    }
    gain = np.where(lit, gain, 0.0).astype(np.float32)
    return LitPixels(lookup, gain, np.where(seen, lighting.ambient_grey, 0.0).astype(np.float32), shadow_rays)


def in_pattern(u: NDArray[np.float64], v: NDArray[np.float64], rig: Rig) -> NDArray[np.bool_]:
    """Which projector pixels (n,), (n,) lie on the pattern, outer pixels included whole; NaN does not; bool (n,)."""
    return (u >= -0.5) & (u <= rig.projector.width - 0.5) & (v >= -0.5) & (v <= rig.projector.height - 0.5)


def background_plane(rig: Rig, lighting: Lighting) -> LitPixels:
    """The empty scene: the plane square to the axis at the rig's background distance, for every pixel of the image."""
    return light_surface(*_plane(rig), rig, lighting)


def _plane(rig: Rig) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and normals of the background plane, (n, 3) each."""
    x, y = (rays.ravel() for rays in rig.camera.rays())
    points_m = np.column_stack([x, y, np.ones_like(x)]) * rig.background_m
    return points_m, np.broadcast_to(np.array([0.0, 0.0, -1.0]), points_m.shape)


def lit_object(hits: Hits, rig: Rig, lighting: Lighting, occluder: TracedObject) -> LitPixels:
    """Illumination of the pixels that see the object, in the order of ``hits.pixels``."""
    return light_surface(hit_points_m(hits, rig), hits.normals, rig, lighting, occluder)


def hit_points_m(hits: Hits, rig: Rig) -> NDArray[np.float64]:
    """Surface points of the hits in camera coordinates; float64 (n, 3)."""
    x, y = (rays.ravel()[hits.pixels] for rays in rig.camera.rays())
    return np.column_stack([x, y, np.ones_like(x)]) * hits.depth_m[:, None]


class Backdrop:
    """The empty scene of a rig. Without an object's shadow it is the same for every view."""

    def __init__(self, rig: Rig, lighting: Lighting) -> None:
        self._rig, self._lighting = rig, lighting
        self._empty = background_plane(rig, lighting)

    def behind(self, traced: TracedObject, covered: NDArray[np.int64]) -> LitPixels:
        """Illumination of the plane behind ``traced``, every pixel of the image.

        What lies at ``covered``, the flat pixels that see the object, is of no consequence: there it may differ with
        skipping on and off. ``shadow_rays`` counts the rays that can meet the object, traced or not.
        """
        if not self._lighting.shadows:
            return self._empty if skipping_enabled() else background_plane(self._rig, self._lighting)
        points_m, normals = self._plane
        # Pixels of the plane that are lit, not hidden from the camera, and within the object's bounding box as the
        # projector sees it.
        possible = self._empty.gain > 0
        possible[covered] = False
        possible &= traced.may_shadow(self._directions, projector_centre_m(self._rig))
        candidates = np.flatnonzero(possible)
        if not skipping_enabled():
            plane = light_surface(points_m, normals, self._rig, self._lighting, traced)
            return LitPixels(plane.lookup, plane.gain, plane.ambient, candidates.size)
        gain = self._empty.gain.copy()
        hidden = traced.shadowed(points_m[candidates], projector_centre_m(self._rig))
        gain[candidates[hidden]] = 0.0
        return LitPixels(self._empty.lookup, gain, self._empty.ambient, candidates.size)

    @cached_property
    def _plane(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return _plane(self._rig)

    @cached_property
    def _directions(self) -> NDArray[np.float64]:
        """From the light to each point, float64 (3, n) in metres."""
        return np.ascontiguousarray((self._plane[0] - projector_centre_m(self._rig)).T)
