"""The light of a scene: what the projector, its further bounces and other lamps give to the object
and the plane."""

from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.loaders.render.bounces import PlaneLight, at_points, between_surfels, mix_frames
from fpp_ml_bench.loaders.render.illumination import (
    LitPixels,
    Material,
    grey_of_white,
    light_surface,
    projector_centre_m,
    shine,
)
from fpp_ml_bench.loaders.render.light import Light
from fpp_ml_bench.loaders.render.projector import PatternLight
from fpp_ml_bench.loaders.render.raycast import TracedObject
from fpp_ml_bench.loaders.render.scene import SolidMesh, along_rays, turned, unturned
from fpp_ml_bench.loaders.render.surfels import Surfels
from fpp_ml_bench.loaders.render.textures import material_of
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.skipping import skipping_enabled

_SURFELS: WeakKeyDictionary[SolidMesh, Surfels] = WeakKeyDictionary()
"""Surfels live as long as their mesh, for its other views and lights."""


class Lighting:
    """A light in a rig's empty scene, the background plane, ready for objects."""

    def __init__(self, rig: Rig, light: Light, pattern: PatternLight) -> None:
        self.rig, self.light, self.pattern = rig, light, pattern
        x, y = (rays.ravel() for rays in rig.camera.rays())
        self._points_m = along_rays(x, y, rig.background)
        self._normals = np.broadcast_to(np.array([0.0, 0.0, -1.0]), self._points_m.shape)
        self._empty = self._plane()
        self.modes, self.mix = pattern.modes(rig.sequence)
        self.returned = (
            PlaneLight.of(rig, light, self.modes) if light.bounces.interreflection else None
        )

    def _plane(self, occluder: TracedObject | None = None) -> LitPixels:
        return light_surface(
            self._points_m, self._normals, self.rig, self.light, self.pattern, occluder=occluder
        )

    def behind(self, traced: TracedObject, covered: NDArray[np.int64]) -> LitPixels:
        """Light of the plane behind ``traced``, every pixel of the image; without shadows the same
        for every view.

        What lies at ``covered``, the flat pixels that see the object, is of no consequence: there
        it may differ with skipping on and off. ``shadow_rays`` counts the rays that can meet the
        object, traced or not.
        """
        if not self.light.bounces.shadows:
            return self._empty if skipping_enabled() else self._plane()
        # Pixels of the plane that are lit, not hidden from the camera, and within the object's
        # bounding box as the projector sees it.
        centre_m = projector_centre_m(self.rig)
        possible = self._empty.gain > 0
        possible[covered] = False
        possible &= traced.may_shadow(np.ascontiguousarray((self._points_m - centre_m).T), centre_m)
        candidates = np.flatnonzero(possible)
        if not skipping_enabled():
            return replace(self._plane(traced), shadow_rays=candidates.size)
        gain = self._empty.gain.copy()
        gain[candidates[traced.shadowed(self._points_m[candidates], centre_m)]] = 0.0
        return replace(self._empty, gain=gain, shadow_rays=candidates.size)


@dataclass(frozen=True)
class ObjectLight:
    """The light upon ``mesh``, turned by ``degrees`` and moved by ``offset_m`` (3,) to be
    ``traced``."""

    lighting: Lighting
    mesh: SolidMesh
    traced: TracedObject
    degrees: float
    offset_m: NDArray[np.float64]

    @cached_property
    def surfels(self) -> Surfels | None:
        """The surfels of the mesh where the light has bounces or ambient occlusion."""
        bounces = self.lighting.light.bounces
        if not (bounces.interreflection or bounces.ambient_occlusion):
            return None
        if self.mesh not in _SURFELS:
            _SURFELS[self.mesh] = Surfels.of(self.mesh)
        return _SURFELS[self.mesh]

    def at(
        self,
        points_m: NDArray[np.float64],
        normals: NDArray[np.float64],
        triangle: NDArray[np.int32],
    ) -> LitPixels:
        """Light of points (n, 3) with unit normals (n, 3), camera coordinates, on triangles
        ``triangle`` (n,), rows of the mesh's faces; where it is -1 on the background plane."""
        rig, light, pattern = self.lighting.rig, self.lighting.light, self.lighting.pattern
        own = np.flatnonzero(triangle >= 0)
        position, facing = (
            unturned(points_m[own] - self.offset_m, self.degrees),
            unturned(normals[own], self.degrees),
        )
        material = material_of(self.mesh, position, facing, light.surface, triangle[own])
        if len(own) < len(points_m):
            albedo = np.full(len(points_m), light.surface.wall_albedo)
            gloss = np.zeros(len(points_m))
            albedo[own], gloss[own] = material.albedo, material.gloss
            material = Material(albedo, gloss)
        lit = light_surface(points_m, normals, rig, light, pattern, material, self.traced)
        if self.surfels is None:
            return lit
        values = [self.surfels.open_share[:, None]] + (
            [] if self.bounced is None else [self.bounced]
        )
        arriving = at_points(self.surfels.grid, np.concatenate(values, axis=1), position, facing)
        ambient, bounced = lit.ambient, None
        if light.bounces.ambient_occlusion:
            ambient = ambient.copy()
            ambient[own] *= arriving[0]
        if self.bounced is not None:
            bounced = np.zeros((len(pattern.table), len(points_m)), dtype=np.float32)
            matte = (1.0 - material.gloss) * material.albedo * grey_of_white(light)
            factor = np.broadcast_to(np.asarray(matte, dtype=np.float32), len(points_m))[own]
            mix_frames(arriving[1:], self.lighting.mix, factor, own, bounced)
        return replace(lit, ambient=ambient, bounced=bounced)

    @cached_property
    def bounced(self) -> NDArray[np.float64] | None:
        """Irradiance of the surfels by further bounces in every mode of the patterns, of light that
        the plane sends back too; float64 (K, J)."""
        surfels, plane = self.surfels, self.lighting.returned
        if surfels is None or plane is None:
            return None
        rig, light, pattern = self.lighting.rig, self.lighting.light, self.lighting.modes
        points = surfels.points
        placed = turned(points.position_m, self.degrees) + self.offset_m
        arriving = shine(
            placed, turned(points.normal, self.degrees), rig, light, pattern, self.traced
        )
        direct = pattern.read(arriving.place, arriving.irradiance)
        material = material_of(
            self.mesh, points.position_m, points.normal, light.surface, points.triangle
        )
        albedo = points.mean(np.broadcast_to((1.0 - material.gloss) * material.albedo, len(placed)))
        outside = plane.upon(surfels, self.degrees, self.offset_m)
        return between_surfels(surfels, points.mean(direct.T), outside, albedo)
