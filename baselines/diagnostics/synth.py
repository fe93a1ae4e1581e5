"""Rendered frames of scenes that are not in a dataset, with the dataset's own light and sensor model.

An unchanged scene gives the frames of its dataset, noise included, except for a few pixels in 50,000 that differ by a
grey level (tests/test_counterfactual_scenes.py). The noise of a pixel depends only on the dataset's seed, the object,
view, frame and pixel, so it is the same in a changed scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface
from fpp_ml_bench.loaders.render import (
    BuildSettings,
    Exposure,
    Lighting,
    LitPixels,
    Noise,
    background_plane,
    light_surface,
)
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import Direction, Rig

Projected = Literal["sequence", "no fringe inside", "no fringe outside", "other direction", "other pitch"]
PITCH_FACTOR = 4 / 3
"""Factor of the changed pitch: 18 px become 24."""
Frames = list[NDArray[np.uint8] | None]


@dataclass(frozen=True)
class Scene:
    """Lit pixels in front of the empty scene, and the pattern that is projected on them.

    ``pixels`` uint32 (n,), with ``lit`` in the same order. ``mask`` bool (H, W): the object mask for methods that use
    it. ``stream``: key of the noise. ``projected``: the unchanged sequence, its mean light inside or outside the
    object, the frames of the other direction, or fringes of another pitch.
    """

    pixels: NDArray[np.uint32]
    lit: LitPixels
    mask: NDArray[np.bool_]
    stream: tuple[object, ...]
    projected: Projected = "sequence"


class SceneRenderer:
    """Renders scenes with the light, sensor and empty background of a rig; caches the last background."""

    def __init__(self, rig: Rig, noise_sigma_grey: float = BuildSettings.noise_sigma_grey) -> None:
        self.rig, self.lighting = rig, Lighting()
        self.shape = (rig.camera.height, rig.camera.width)
        self.noise = Noise.of_sigma(noise_sigma_grey)
        self._all_pixels = np.arange(self.shape[0] * self.shape[1], dtype=np.uint32)
        self._background_stream: tuple[object, ...] = ()
        self._backgrounds: dict[tuple[int, int], NDArray[np.uint8]] = {}

    @classmethod
    def of(cls, dataset: DatasetFolder) -> "SceneRenderer":
        """The renderer for ``dataset``; with the benchmark's noise where an imported dataset does not state its own."""
        return cls(dataset.rig, dataset.manifest.settings.get("noise_sigma_grey", BuildSettings.noise_sigma_grey))

    @cached_property
    def exposure(self) -> Exposure:
        return Exposure.of(self.rig, self.noise)

    @cached_property
    def _uniform(self) -> Exposure:
        light = np.broadcast_to(self.exposure.light.mean(axis=1, keepdims=True), self.exposure.light.shape)
        return replace(self.exposure, light=np.ascontiguousarray(light))

    @cached_property
    def _other_pitch(self) -> Exposure:
        pitches = {
            name: PITCH_FACTOR * getattr(self.rig, name) for name in ("pitch_horizontal_px", "pitch_vertical_px")
        }
        return Exposure.of(replace(self.rig, **pitches), self.noise)  # type: ignore[arg-type]

    @cached_property
    def _empty(self) -> LitPixels:
        return background_plane(self.rig, self.lighting)

    def light(self, surface: Surface) -> LitPixels:
        """The light on ``surface``; no cast shadows, as in the paper."""
        return light_surface(surface.points_m(), surface.normals, self.rig, self.lighting)

    def frames(self, scene: Scene, indices: Sequence[int], masked: bool = False) -> Frames:
        """Frames ``indices`` of ``scene``, uint8 (H, W), by frame number; None for all others. With ``masked`` they are
        0 outside ``scene.mask``."""
        inside, outside = {
            "no fringe inside": (self._uniform, self.exposure),
            "no fringe outside": (self.exposure, self._uniform),
            "other pitch": (self._other_pitch, self._other_pitch),
        }.get(scene.projected, (self.exposure, self.exposure))
        projected_indices = [
            self._partner(index) if scene.projected == "other direction" else index for index in indices
        ]
        object_values = inside.expose(projected_indices, scene.lit, scene.pixels, scene.stream)
        frames: Frames = [None] * len(self.rig.sequence)
        for index, projected_index, values in zip(indices, projected_indices, object_values, strict=True):
            image = self._background(scene.stream, projected_index, outside).copy()
            image.ravel()[scene.pixels] = values
            frames[index] = image * scene.mask if masked else image
        return frames

    def _background(self, stream: tuple[object, ...], index: int, exposure: Exposure) -> NDArray[np.uint8]:
        if self._background_stream != stream:
            self._background_stream, self._backgrounds = stream, {}
        key = id(exposure), index  # the three exposures live as long as the renderer
        if key not in self._backgrounds:
            self._backgrounds[key] = exposure.expose([index], self._empty, self._all_pixels, stream)[0].reshape(
                self.shape
            )
        return self._backgrounds[key]

    def _partner(self, index: int) -> int:
        """The frame of the other direction with the same step or bit; black and white frames map to themselves."""
        sequence = self.rig.sequence
        frame = sequence.frames[index]
        if frame.direction is None:
            return index
        other_direction: Direction = "vertical" if frame.direction == "horizontal" else "horizontal"
        frame_indices = (
            sequence.sinusoids(other_direction) if frame.kind == "sinusoid" else sequence.gray(other_direction)
        )
        return frame_indices[min(frame.step, len(frame_indices) - 1)]
