"""The plane behind the objects: lit once for all views; a shadow is looked for only where the object can cast one."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.loaders.illumination import (
    Lighting,
    LitPixels,
    background_plane,
    hit_points_m,
    light_surface,
    projector_centre_m,
)  # fmt: skip
from fpp_ml_bench.loaders.raycast import Hits, TracedObject
from fpp_ml_bench.rig import Rig
from fpp_ml_bench.skipping import skipping_enabled


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
        points_m = self._points_m
        candidates = self._may_be_shadowed(traced, covered)
        if not skipping_enabled():
            plane = light_surface(points_m, self._plane.normals, self._rig, self._lighting, traced)
            return LitPixels(plane.lookup, plane.gain, plane.ambient, candidates.size)
        gain = self._empty.gain.copy()
        hidden = traced.shadowed(points_m[candidates], projector_centre_m(self._rig))
        gain[candidates[hidden]] = 0.0
        return LitPixels(self._empty.lookup, gain, self._empty.ambient, candidates.size)

    def _may_be_shadowed(self, traced: TracedObject, covered: NDArray[np.int64]) -> NDArray[np.int64]:
        """Flat pixels of the plane that are lit, not hidden from the camera, and seen by the projector within the
        object's bounding box."""
        possible = self._empty.gain > 0
        possible[covered] = False
        possible &= traced.may_shadow(self._directions, projector_centre_m(self._rig))
        return np.flatnonzero(possible)

    @cached_property
    def _plane(self) -> Hits:
        pixels = np.arange(self._empty.gain.size, dtype=np.int64)
        normals = np.broadcast_to(np.array([0.0, 0.0, -1.0]), (pixels.size, 3))
        return Hits(pixels, np.full(pixels.size, self._rig.background_m), normals)

    @cached_property
    def _points_m(self) -> NDArray[np.float64]:
        return hit_points_m(self._plane, self._rig)

    @cached_property
    def _directions(self) -> NDArray[np.float64]:
        """From the light to each point, float64 (3, n) in metres."""
        return np.ascontiguousarray((self._points_m - projector_centre_m(self._rig)).T)
