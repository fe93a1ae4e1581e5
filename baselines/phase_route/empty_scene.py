"""The background plane as the rig predicts it, fitted to the background in an image.

The plane's distance is calibrated, so its phase is known at every pixel, and so is its brightness except for three
things: ambient light, the lamp's strength, and a slow change of its sheen across the image. They are fitted to the
image's own background. Pixels that then differ from the prediction by more than noise are not background. The lamp's
strength also turns an object's brightness into distance and slope (`fpp_ml_bench.baselines.phase_route.shading`): the
paper's plane and objects are of the same material.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.optics import Rig

TILE_PX_PER_PERIOD = 1.1
"""Side of the tiles that are searched for the plane: over one period, to separate strength and ambient light."""
TILE_NOISE_GREY = 3.0
"""Largest misfit of a tile that may be background: three times the benchmark's noise."""
LEAST_SHARE = 0.02
"""Of the image's tiles that must show background for the image to calibrate itself."""
STRENGTH_TOLERANCE = 0.4
"""Relative deviation of the lamp's strength in an image from the calibrated strength. A surface in the working range
whose fringe is in phase with the plane's is two to four times as bright, and must not be taken for the plane."""
SAMPLE_STEP_PX = 5
FLOOR_NOISE_GREY = 0.3
"""Noise of rounding to whole grey levels."""


def fall_off(rig: Rig, depth_m: float) -> NDArray[np.float64]:
    """Irradiance of a plane square to the camera's axis at ``depth_m``: cosine over distance squared, 1/m^2, (H, W)."""
    x, y = rig.camera.rays()
    centre = -rig.R.T @ rig.t
    # The plane's normal is the camera's axis, however the projector is rotated.
    from_lamp = [x * depth_m - centre[0], y * depth_m - centre[1], depth_m - centre[2]]
    squared = from_lamp[0] ** 2 + from_lamp[1] ** 2 + from_lamp[2] ** 2
    return from_lamp[2] / (squared * np.sqrt(squared))


@dataclass(frozen=True)
class Background:
    """Fit of the empty scene to one image, grey levels.

    ``ambient_grey``; ``strength``: grey levels that a white pattern gives per 1/m^2 of irradiance; ``noise_grey``;
    ``residual`` float32 (H, W): image minus prediction; ``share``: of the image's tiles that show the plane, 0 where
    the calibrated constants were used; ``weights``: of the terms 1, x, y, x^2, xy, y^2 of the lamp's light.
    """

    ambient_grey: float
    strength: float
    noise_grey: float
    residual: NDArray[np.float32]
    share: float
    weights: tuple[float, ...] = ()


class EmptyScene:
    """The background plane as a rig and direction show it; computed once, then fitted to every image.

    ``white_grey`` and ``ambient_grey`` are the photometric calibration used where an image shows no background: the
    grey level of a white pattern on a surface that faces the projector at the near end of the working range, and of a
    surface in ambient light alone.
    """

    def __init__(self, rig: Rig, layer: CalibrationLayer, period_px: float, white_grey: float, ambient_grey: float):
        self.noise_grey = 1.0
        self.ambient_grey = ambient_grey
        self.strength = white_grey * (rig.working_range_mm[0] / MM_PER_M) ** 2
        x, y = rig.camera.rays()
        phase = layer.absolute_phase(rig.background_m * MM_PER_M)
        light = np.nan_to_num(fall_off(rig, rig.background_m) * (0.5 + 0.5 * np.cos(phase)))
        self._light = light
        self._rays, self._phase = (x, y), phase
        self._fall_off = fall_off(rig, rig.background_m)
        self._terms = [
            np.nan_to_num(light * term).astype(np.float32) for term in (np.ones_like(x), x, y, x * x, x * y, y * y)
        ]
        height, width = light.shape
        self._tile = min(max(8, round(period_px * TILE_PX_PER_PERIOD)), height, width)
        self._mean, self._square = self._tiles(light), self._tiles(light * light)

    def _tiles(self, image: NDArray) -> NDArray[np.float64]:
        """Means over whole tiles."""
        tile = self._tile
        height, width = (length // tile * tile for length in image.shape)
        rows = image[:height, :width].reshape(height, width // tile, tile).sum(axis=2, dtype=np.float64)
        return rows.reshape(height // tile, tile, width // tile).sum(axis=1) / (tile * tile)

    def fit(self, image: NDArray[np.uint8]) -> Background:
        """Background of ``image`` uint8 (H, W)."""
        grey = image.astype(np.float32)
        plane_tiles = self._background_tiles(grey)
        share = float(plane_tiles.mean())
        if share < LEAST_SHARE:
            residual = grey - self.ambient_grey - self.strength * self._terms[0]
            return Background(self.ambient_grey, self.strength, self.noise_grey, residual, 0.0, (self.strength,))
        tile = self._tile
        plane_pixels = np.zeros(image.shape, dtype=bool)
        rows, columns = (count * tile for count in plane_tiles.shape)
        plane_pixels[:rows, :columns] = plane_tiles.repeat(tile, axis=0).repeat(tile, axis=1)
        sampled = np.zeros_like(plane_pixels)
        sampled[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX] = plane_pixels[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX]
        ones = np.ones(int(sampled.sum()))
        terms = np.stack([ones] + [term[sampled] for term in self._terms], axis=1).astype(np.float64)
        solution = np.linalg.lstsq(terms, grey[sampled].astype(np.float64), rcond=None)[0]
        misfit = grey[sampled] - terms @ solution
        noise = max(1.4826 * float(np.median(np.abs(misfit))), FLOOR_NOISE_GREY)
        residual = grey - np.float32(solution[0])
        for weight, term in zip(solution[1:], self._terms, strict=True):
            residual -= np.float32(weight) * term
        return Background(float(solution[0]), float(solution[1]), noise, residual, share, tuple(solution[1:]))

    def predicted(self, background: Background, shift_rad: float, where: tuple[slice, slice]) -> NDArray[np.float32]:
        """Grey levels, float32 (h, w), that the plane has on the pixels ``where`` of a frame whose fringe is shifted by
        ``shift_rad``, in the light that ``background`` was fitted to."""
        x, y = (axis[where] for axis in self._rays)
        terms = (np.ones_like(x), x, y, x * x, x * y, y * y)
        lamp = sum(weight * term for weight, term in zip(background.weights, terms, strict=False))
        fringe = 0.5 + 0.5 * np.cos(self._phase[where] + shift_rad)
        return np.float32(background.ambient_grey) + np.nan_to_num(lamp * self._fall_off[where] * fringe).astype(
            np.float32
        )

    def _background_tiles(self, grey: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Tiles whose grey levels are ambient light plus a common multiple of the predicted light."""
        mean, square = self._tiles(grey), self._tiles(grey * grey)
        spread = self._square - self._mean**2
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self._tiles(grey * self._light) - mean * self._mean
            slope = covariance / spread
            misfit = np.sqrt(np.maximum(square - mean**2 - covariance * slope, 0))
            plane_tiles = (misfit < TILE_NOISE_GREY) & (spread > 1e-2 * spread.max())
            plane_tiles &= np.abs(slope / self.strength - 1) < STRENGTH_TOLERANCE
        if not plane_tiles.any():
            return plane_tiles
        typical = float(np.median(slope[plane_tiles]))
        return plane_tiles & (np.abs(slope / typical - 1) < 0.15)
