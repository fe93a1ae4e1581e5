"""How much light of the projector reaches surface points, and how bright each appears before the
camera's optics.

Inverse square, cosine, the projector's falloff and its field; points turned away, outside the
pattern or, on request, in shadow get none. Brightness is in grey levels of the 8-bit image at
exposure 1.

A surface returns light by a matte part, and a microfacet lobe beside it: ``f = (1 - gloss) albedo /
pi + gloss D G / (4 cos_l cos_v)`` with the GGX distribution D and Smith's G (Walter et al. 2007,
Microfacet Models for Refraction, equations 33 and 34), alpha the square of the roughness: a blend
of a diffuse surface and a rough mirror, as Mitsuba's ``blendbsdf`` of ``diffuse`` and
``roughconductor`` is.
"""

from dataclasses import dataclass, replace
from math import pi

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders.render.light import Light
from fpp_ml_bench.loaders.render.projector import PatternLight, PatternPlace
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.optics.rig import Rig

NEAREST_M = 1e-3
"""A point nearer to a centre of projection is inside that lens and gets no light: the inverse
square has no limit."""

Values = NDArray[np.float64]
Axes = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""x, y and z (n,) each: operations on (n, 3) arrays run three numbers at a time, on (n,) arrays
n."""


@dataclass(frozen=True)
class Material:
    """Albedo and weight of the glossy lobe, one number or float64 (n,)."""

    albedo: NDArray[np.float64] | float
    gloss: NDArray[np.float64] | float


@dataclass(frozen=True)
class Shine:
    """The projector's light at n points: ``irradiance`` float64 (n,) of a white pattern, 1 on a
    surface that faces the projector at the near end of the range; the unit direction ``toward`` it;
    the ``place`` in the pattern; and how many ``shadow_rays`` were cast."""

    irradiance: NDArray[np.float64]
    toward: Axes
    place: PatternPlace
    shadow_rays: int


@dataclass(frozen=True)
class LitPixels:
    """Everything that the exposures of n points share.

    ``gain`` float32 (n,): grey levels of a white pattern's direct light. ``ambient`` float32 (n,):
    grey levels of all other lamps. ``bounced`` float32 (F, n): grey levels of further bounces in
    each frame, None for none.
    """

    place: PatternPlace
    gain: NDArray[np.float32]
    ambient: NDArray[np.float32]
    bounced: NDArray[np.float32] | None = None
    shadow_rays: int = 0

    def brighter(self, factor: NDArray[np.float32] | np.float32) -> "LitPixels":
        """A copy with ``factor``, a number or (n,), times the light."""
        bounced = None if self.bounced is None else self.bounced * factor
        return replace(
            self, gain=self.gain * factor, ambient=self.ambient * factor, bounced=bounced
        )


def projector_centre_m(rig: Rig) -> NDArray[np.float64]:
    """The projector's centre of projection in camera coordinates, metres (3,)."""
    rotation, (tx, ty, tz) = rig.R, rig.t
    return -(rotation[0] * tx + rotation[1] * ty + rotation[2] * tz)


@np.errstate(divide="ignore", invalid="ignore")  # of points in a lens, which get no light
def shine(
    points_m: NDArray[np.float64],
    normals: NDArray[np.float64],
    rig: Rig,
    light: Light,
    pattern: PatternLight,
    occluder: TracedObject | None = None,
) -> Shine:
    """The projector's light at surface points (n, 3) with unit ``normals`` (n, 3), in camera
    coordinates; none at NaN points. ``occluder`` casts shadows where the light has them."""
    centre_m = projector_centre_m(rig)
    x, y, z = (np.ascontiguousarray(axis) for axis in points_m.T)
    nx, ny, nz = (np.ascontiguousarray(axis) for axis in normals.T)
    to_x, to_y, to_z = centre_m[0] - x, centre_m[1] - y, centre_m[2] - z
    squared_m = to_x * to_x + to_y * to_y + to_z * to_z
    inverse = 1.0 / np.sqrt(squared_m)
    to_x, to_y, to_z = to_x * inverse, to_y * inverse, to_z * inverse
    cosine = nx * to_x + ny * to_y + nz * to_z
    reference_m = rig.working_range_mm[0] / MM_PER_M
    irradiance = cosine * (reference_m**2 / squared_m)
    depth_m = rig.R[2, 0] * x + rig.R[2, 1] * y + rig.R[2, 2] * z + rig.t[2]
    falloff = light.projector.falloff
    if falloff:
        axial = depth_m * inverse
        for _ in range(abs(falloff)):
            irradiance = irradiance * axial if falloff > 0 else irradiance / axial
    u, v = rig.project(points_m)
    lit = (
        (cosine > 0)
        & (squared_m > NEAREST_M**2)
        & (x * x + y * y + z * z > NEAREST_M**2)
        & rig.projector.holds(u, v)
    )
    shadow_rays = 0
    if light.bounces.shadows and occluder is not None:
        candidates = np.flatnonzero(lit)
        lit[candidates] = ~occluder.shadowed(points_m[candidates], centre_m)
        shadow_rays = candidates.size
    place = pattern.place(u, v, depth_m, rig, light.projector)
    return Shine(np.where(lit, irradiance, 0.0), (to_x, to_y, to_z), place, shadow_rays)


@np.errstate(divide="ignore", invalid="ignore")
def light_surface(
    points_m: NDArray[np.float64],
    normals: NDArray[np.float64],
    rig: Rig,
    light: Light,
    pattern: PatternLight,
    material: Material | None = None,
    occluder: TracedObject | None = None,
) -> LitPixels:
    """Direct and ambient light of surface points (n, 3) with unit ``normals`` (n, 3) that face the
    camera."""
    surface = light.surface
    material = material or Material(surface.wall_albedo, 0.0)
    arriving = shine(points_m, normals, rig, light, pattern, occluder)
    x, y, z = (np.ascontiguousarray(axis) for axis in points_m.T)
    nx, ny, nz = (np.ascontiguousarray(axis) for axis in normals.T)
    to_x, to_y, to_z = arriving.toward
    inverse = -1.0 / np.sqrt(x * x + y * y + z * z)
    view_x, view_y, view_z = x * inverse, y * inverse, z * inverse
    half_x, half_y, half_z = to_x + view_x, to_y + view_y, to_z + view_z
    along = (nx * half_x + ny * half_y + nz * half_z) / np.sqrt(
        half_x * half_x + half_y * half_y + half_z * half_z
    )
    returned = reflectance(
        nx * to_x + ny * to_y + nz * to_z,
        nx * view_x + ny * view_y + nz * view_z,
        along,
        material.albedo,
        material.gloss,
        surface.roughness,
    )
    gain = np.where(
        arriving.irradiance > 0, arriving.irradiance * returned * grey_of_white(light), 0.0
    )
    ambient = np.where(
        np.isfinite(x + y + z), light.ambient_grey / surface.albedo * material.albedo, 0.0
    )
    return LitPixels(
        arriving.place,
        gain.astype(np.float32),
        ambient.astype(np.float32),
        None,
        arriving.shadow_rays,
    )


def grey_of_white(light: Light) -> float:
    """Grey level of a matte surface of albedo 1 that gets irradiance 1: the reference exposure is
    set on the matte part of the material."""
    return light.camera.reference_grey / ((1.0 - light.surface.gloss) * light.surface.albedo)


def reflectance(
    cos_light: Values,
    cos_view: Values,
    cos_half: Values,
    albedo: Values | float,
    gloss: Values | float,
    roughness: float,
) -> Values:
    """pi f for unit cosines (n,) between the normal and light, view and the direction half-way;
    float64 (n,).

    Times the irradiance it is what a matte surface of that albedo would send: 1 for a white one.
    """
    matte = (1.0 - gloss) * albedo
    if not np.any(gloss):
        return matte + np.zeros_like(cos_light)
    squared = roughness**4
    ground = np.clip(cos_half, 0.0, 1.0) ** 2 * (squared - 1.0) + 1.0
    facets = squared / (pi * ground * ground)
    light, view = np.clip(cos_light, 1e-6, 1.0), np.clip(cos_view, 1e-6, 1.0)
    return matte + gloss * pi * facets * _unhidden(light, squared) * _unhidden(view, squared) / (
        4.0 * light * view
    )


def _unhidden(cosine: Values, squared: float) -> Values:
    """Smith's share of facets that are seen from an angle."""
    tangent = (1.0 - cosine * cosine) / (cosine * cosine)
    return 2.0 / (1.0 + np.sqrt(1.0 + squared * tangent))
