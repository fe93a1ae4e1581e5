"""Photographs of scenes that no dataset holds, by the dataset's own light and sensor.

An unchanged scene comes out as the frames of its dataset, noise included, but for a few pixels in 50,000 and those by
one grey level (tests/test_counterfactual_scenes.py): the noise of a pixel depends on the dataset's seed, object, view,
frame and pixel alone, and stays the same in a changed scene.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics.synth_surface import Surface
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.loaders.camera import Exposure
from fpp_ml_bench.loaders.illumination import Lighting, LitPixels, background_plane, light_surface
from fpp_ml_bench.loaders.sensor import Noise
from fpp_ml_bench.loaders.settings import BuildSettings
from fpp_ml_bench.loaders.store import DatasetFolder
from fpp_ml_bench.rig import Rig

Projected = Literal["sequence", "no fringe inside", "no fringe outside", "other direction", "other pitch"]
PITCH_FACTOR = 4 / 3
"""Of the pattern with another pitch: the usual 18 px become 24."""
Frames = list[NDArray[np.uint8] | None]


@dataclass(frozen=True)
class Scene:
    """Lit pixels in front of the empty scene, and what is projected on them.

    ``pixels`` uint32 (n,) and their ``lit`` in that order; ``mask`` bool (H, W): what a method that is told the object
    is told; ``stream`` names the noise. ``projected``: the sequence as it is, its mean light inside or outside the
    object, the frames of the other direction in place of each, or fringes of another pitch.
    """

    pixels: NDArray[np.uint32]
    lit: LitPixels
    mask: NDArray[np.bool_]
    stream: tuple[object, ...]
    projected: Projected = "sequence"


class Darkroom:
    """Light, sensor and empty background of one rig; keeps the background of the last noise stream."""

    def __init__(self, rig: Rig, noise_sigma_grey: float = BuildSettings.noise_sigma_grey) -> None:
        self.rig, self.lighting = rig, Lighting()
        self.shape = (rig.camera.height, rig.camera.width)
        self.noise = Noise.of_sigma(noise_sigma_grey)
        self._all = np.arange(self.shape[0] * self.shape[1], dtype=np.uint32)
        self._kept: tuple[tuple[object, ...], dict[tuple[str, int], NDArray[np.uint8]]] = ((), {})

    @classmethod
    def of(cls, dataset: DatasetFolder) -> "Darkroom":
        """That of ``dataset``; an imported one, which does not say its noise, gets the benchmark's."""
        return cls(dataset.rig, dataset.manifest.settings.get("noise_sigma_grey", BuildSettings.noise_sigma_grey))

    @cached_property
    def exposure(self) -> Exposure:
        return Exposure.of(self.rig, self.noise)

    @cached_property
    def _flat(self) -> Exposure:
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
        """Frames ``indices`` of ``scene`` by their number, uint8 (H, W), None for every other; ``masked``: 0 outside
        ``scene.mask``."""
        inside, outside = {
            "no fringe inside": (self._flat, self.exposure),
            "no fringe outside": (self.exposure, self._flat),
            "other pitch": (self._other_pitch, self._other_pitch),
        }.get(scene.projected, (self.exposure, self.exposure))
        shown = [self._partner(index) if scene.projected == "other direction" else index for index in indices]
        object_values = inside.expose(shown, scene.lit, scene.pixels, scene.stream)
        found: Frames = [None] * len(self.rig.sequence)
        for index, real, values in zip(indices, shown, object_values, strict=True):
            image = self._background(scene.stream, real, outside).copy()
            image.ravel()[scene.pixels] = values
            found[index] = image * scene.mask if masked else image
        return found

    def _background(self, stream: tuple[object, ...], index: int, exposure: Exposure) -> NDArray[np.uint8]:
        if self._kept[0] != stream:
            self._kept = (stream, {})
        kept, name = (
            self._kept[1],
            next(n for n in ("exposure", "_flat", "_other_pitch") if getattr(self, n) is exposure),
        )
        if (name, index) not in kept:
            kept[name, index] = exposure.expose([index], self._empty, self._all, stream)[0].reshape(self.shape)
        return kept[name, index]

    def _partner(self, index: int) -> int:
        """The frame of the other direction with the same step or bit; black and white are their own."""
        sequence = self.rig.sequence
        frame = sequence.frames[index]
        if frame.direction is None:
            return index
        other: Direction = "vertical" if frame.direction == "horizontal" else "horizontal"
        run = sequence.sinusoids(other) if frame.kind == "sinusoid" else sequence.gray(other)
        return run[min(frame.step, len(run) - 1)]
