"""The object mask: pixels whose grey level the empty scene does not explain; where none is known, modulated pixels.

Twice a period the object's fringe is as bright as the plane's would be, so a single pixel there can't be assigned to
either. Inside the object, morphological closing by a quarter of a period fills these stripes. At the silhouette, a
pixel is assigned to the better of two predictions of its grey level: that of the empty scene, and that of the object's
fringe, extrapolated from the local fit beside it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import CalibrationLayer, Image, Mask
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.optics.rig import Rig

Crop = tuple[slice, slice]

TILE_PX_PER_PERIOD = 1.1
"""Side of the tiles that are searched for the plane: over one period, to separate strength and ambient light."""
TILE_NOISE_SIGMAS = 3.0  # largest misfit of a tile that may be background, in standard deviations of the image's noise
LEAST_SHARE = 0.02  # of the image's tiles that must show background for the image to calibrate itself
STRENGTH_TOLERANCE = 0.4
"""Relative deviation of the lamp's strength in an image from a strength that the user gives. A surface in the working
range whose fringe is in phase with the plane's is two to four times as bright, and must not be taken for the plane."""
LEAST_EXPLAINED = 0.5
"""Least share of the variance of the tiles' grey levels that one plane must explain. A dark tile in which nothing is to
be seen misfits no prediction; a plane that is there explains 0.8 and more even where it is as dim as noise."""
SAME_STRENGTH = 1.35  # ratio of strengths within which tiles show the same surface: sheen changes slowly over a plane
DARK_PERCENTILE = 1.0  # of the grey levels of an image without background that is taken for its ambient light
SAMPLE_STEP_PX = 5
FLOOR_NOISE_GREY = 0.3  # noise of rounding to whole grey levels
DEFAULT_NOISE_GREY = 1.0  # noise of an image that shows no background to measure it on
DIFFERENT_SIGMAS = 3.5
"""A pixel this far from the empty scene is not background; noise alone reaches it at isolated pixels, 1 in 2,000."""
CLOSING_PERIODS = 0.27
RING_PERIODS = 0.14
"""Distance from the first mask's silhouette within which a pixel may change between object and background."""
LARGEST_MISFIT = 0.35  # of a fringe that is there, squared, as a share of its own square
OBJECT_BONUS = 4.0  # added to the plane's squared misfit, in sigmas: a pixel that both predictions explain is object
UNLIT_PERIODS = 0.8
UNLIT_SIGMAS = 4.0  # brightest grey level, above ambient light, of what counts as unlit
DARKEST_GREY = MIN_MODULATION / 4
"""An object pixel with less modulation has no fringe: it lies in shadow or faces away, and gets no depth."""
LEAST_AREA_PERIODS = 0.1  # smallest object, and largest hole that is closed, in squares of one period


@dataclass(frozen=True)
class Background:
    """Fit of the empty scene to one image, grey levels; ``strength``: what a white pattern gives per 1/m^2 of
    irradiance, NaN where neither image nor user tells; ``residual`` float32 (H, W): image minus prediction; ``share``:
    of the tiles that show the plane, 0 for none; ``weights``: of the lamp's terms 1, x, y, x^2, xy, y^2."""

    ambient_grey: float
    strength: float
    noise_grey: float
    residual: Image
    share: float
    weights: tuple[float, ...]

    @property
    def calibrated(self) -> bool:
        """Whether brightness can tell distances: the lamp's strength is known."""
        return bool(np.isfinite(self.strength))

    @property
    def shown(self) -> bool:
        """Whether the image shows the background plane, so that what differs from it is object."""
        return self.share > 0

    @property
    def different(self) -> Mask:
        """Pixels (H, W) whose own grey level the empty scene does not explain."""
        return np.abs(self.residual) > DIFFERENT_SIGMAS * self.noise_grey


class EmptyScene:
    """The background plane as a rig and direction show it; computed once, then fitted to every image. Its phase is
    calibrated; ambient light, the lamp's strength and a slow change of its sheen across the image are fitted to the
    pixels that show the plane. ``white_grey`` and ``ambient_grey``, if the user gives them, are a photometric
    calibration: the grey level of a white pattern on a surface that faces the projector at the near end of the working
    range, and of a surface in ambient light alone. Without them an image that does not show the plane, or
    whose rig knows none, is not calibrated, and brightness tells no distance. What is modulated is object there
    (`modulated_region`)."""

    def __init__(
        self,
        rig: Rig,
        layer: CalibrationLayer,
        period_px: float,
        white_grey: float | None,
        ambient_grey: float | None,
    ) -> None:
        self.ambient_grey = ambient_grey
        self.strength = np.nan if white_grey is None else white_grey * (rig.working_range_mm[0] / MM_PER_M) ** 2
        self._rays = rig.camera.rays()
        # Without a known background nothing is predicted, and no image shows it.
        depth_m = np.nan if rig.background_m is None else rig.background_m
        self._phase = layer.absolute_phase(depth_m * MM_PER_M)
        self._fall_off = plane_irradiance(rig, depth_m)
        self._light = np.nan_to_num(self._fall_off * (0.5 + 0.5 * np.cos(self._phase)))
        self._terms = [np.nan_to_num(self._light * term).astype(np.float32) for term in _quadratic(*self._rays)]
        self._tile = min(max(8, round(period_px * TILE_PX_PER_PERIOD)), *self._light.shape)
        self._mean, self._square = self._tiles(self._light), self._tiles(self._light * self._light)

    def fit(self, image: NDArray[np.uint8]) -> Background:
        """Background of ``image`` uint8 (H, W)."""
        grey = image.astype(np.float32)
        plane_tiles = self._background_tiles(grey)
        share = float(plane_tiles.mean())
        if share < LEAST_SHARE:
            dark = float(np.percentile(image, DARK_PERCENTILE)) if self.ambient_grey is None else self.ambient_grey
            strength = float(np.nan_to_num(self.strength))
            residual = grey - np.float32(dark) - np.float32(strength) * self._terms[0]
            noise = max(image_noise_grey(image), DEFAULT_NOISE_GREY)
            return Background(dark, float(self.strength), noise, residual, 0.0, (strength,))
        plane_pixels = plane_tiles.repeat(self._tile, axis=0).repeat(self._tile, axis=1)
        places = np.nonzero(plane_pixels[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX])
        row, column = (SAMPLE_STEP_PX * place for place in places)
        sampled = grey[row, column].astype(np.float64)
        terms = np.stack([np.ones_like(sampled)] + [term[row, column] for term in self._terms], axis=1)
        solution = np.linalg.lstsq(terms, sampled, rcond=None)[0]
        misfit = sampled - terms @ solution
        noise = max(MAD_TO_SIGMA * float(np.median(np.abs(misfit))), FLOOR_NOISE_GREY)
        ambient_grey, *weights = solution
        residual = grey - np.float32(ambient_grey)
        for weight, term in zip(weights, self._terms, strict=True):
            residual -= np.float32(weight) * term
        return Background(float(ambient_grey), float(weights[0]), noise, residual, share, tuple(weights))

    def predicted(self, background: Background, shift_rad: float, where: Crop) -> Image:
        """Grey levels, float32 (h, w), that the plane has on the pixels ``where`` of a frame whose fringe is shifted by
        ``shift_rad``, in the light that ``background`` was fitted to."""
        terms = _quadratic(*(axis[where] for axis in self._rays))
        lamp = sum(weight * term for weight, term in zip(background.weights, terms, strict=False))
        fringe = 0.5 + 0.5 * np.cos(self._phase[where] + shift_rad)
        plane = np.nan_to_num(lamp * self._fall_off[where] * fringe).astype(np.float32)
        return np.float32(background.ambient_grey) + plane

    def _tiles(self, image: NDArray) -> NDArray[np.float64]:
        """Means over whole tiles."""
        tile = self._tile
        height, width = (length // tile * tile for length in image.shape)
        rows = image[:height, :width].reshape(height, width // tile, tile).sum(axis=2, dtype=np.float64)
        return rows.reshape(height // tile, tile, width // tile).sum(axis=1) / (tile * tile)

    def _background_tiles(self, grey: Image) -> Mask:
        """Tiles whose grey levels are ambient light plus a common multiple of the predicted light."""
        mean, square = self._tiles(grey), self._tiles(grey * grey)
        spread = self._square - self._mean**2
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self._tiles(grey * self._light) - mean * self._mean
            slope = covariance / spread
            misfit = np.sqrt(np.maximum(square - mean**2 - covariance * slope, 0))
            largest = TILE_NOISE_SIGMAS * max(image_noise_grey(grey), 1.0)
            plane_tiles = (misfit < largest) & (spread > 1e-2 * spread.max()) & (slope * np.sqrt(spread) > largest / 3)
            if np.isfinite(self.strength):
                plane_tiles &= np.abs(slope / self.strength - 1) < STRENGTH_TOLERANCE
        if not plane_tiles.any():
            return plane_tiles
        # The plane is the surface with the most tiles of one strength.
        ascending = np.sort(slope[plane_tiles])
        count = np.searchsorted(ascending, ascending * SAME_STRENGTH, "right") - np.arange(ascending.size)
        first = int(count.argmax())
        typical = float(np.median(ascending[first : first + count[first]]))
        plane_tiles &= np.abs(slope / typical - 1) < 0.15
        shown = (square - mean**2)[plane_tiles].sum()
        unexplained = (misfit[plane_tiles] ** 2).sum()
        return plane_tiles if unexplained < (1 - LEAST_EXPLAINED) * shown else np.zeros_like(plane_tiles)


def image_noise_grey(image: NDArray) -> float:
    """Standard deviation of an image's noise in grey levels, by the median over pixels of a mask that removes planes
    and slow fringes (Immerkaer 1996, Fast Noise Variance Estimation)."""
    grey = image.astype(np.float32)
    across = grey[:, :-2] - 2 * grey[:, 1:-1] + grey[:, 2:]
    mask = across[:-2] - 2 * across[1:-1] + across[2:]
    return MAD_TO_SIGMA * float(np.median(np.abs(mask))) / 6.0


def plane_irradiance(rig: Rig, depth_m: float) -> NDArray[np.float64]:
    """Irradiance of a plane square to the camera's axis at ``depth_m``: cosine over distance squared, 1/m^2, (H, W)."""
    x, y = rig.camera.rays()
    centre = -rig.R.T @ rig.t
    # The plane's normal is the camera's axis, however the projector is rotated.
    right, down, ahead = x * depth_m - centre[0], y * depth_m - centre[1], depth_m - centre[2]
    squared = right**2 + down**2 + ahead**2
    return ahead / (squared * np.sqrt(squared))


def _quadratic(x: NDArray, y: NDArray) -> tuple[NDArray, ...]:
    return np.ones_like(x), x, y, x * x, x * y, y * y


def disk(radius_px: float) -> NDArray[np.uint8]:
    """Disk as a structuring element of odd size."""
    half = max(1, round(radius_px))
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    return (x * x + y * y <= (half + 0.5) ** 2).astype(np.uint8)


def closed(mask: Mask, radius_px: float, least_px: float) -> Mask:
    """``mask`` closed by a disk, then without objects and without holes of fewer than ``least_px`` pixels."""
    region = without_small(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, disk(radius_px)) > 0, least_px)
    return region | ~without_small(~region, least_px)


def without_small(mask: Mask, least_px: float) -> Mask:
    """``mask`` (H, W) without its 8-connected components of fewer than ``least_px`` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    keep = stats[:, cv2.CC_STAT_AREA] >= least_px
    keep[0] = False
    return keep[labels] if count > 1 else mask


def object_region(background: Background, period_px: float) -> Mask:
    """First mask (H, W): pixels that differ, closed over the stripes where object and plane are equally bright."""
    return closed(background.different, CLOSING_PERIODS * period_px, LEAST_AREA_PERIODS * period_px**2)


def modulated_region(grey: Image, modulation: Image, background: Background, period_px: float) -> Mask:
    """First mask (H, W) of an image that shows no known background: pixels with a fringe, by ``modulation`` in grey
    levels (`local_fit.carrier_fit`), whose stripes are also as bright as such a fringe: the window of ``modulation``
    reaches a third of a period beyond the silhouette, closing the stripes does not."""
    bright = stripes_filled(grey, period_px) > background.ambient_grey + 2 * MIN_MODULATION
    region = (modulation > MIN_MODULATION) & bright
    return closed(region, 1, LEAST_AREA_PERIODS * period_px**2)


def stripes_filled(grey: Image, period_px: float) -> Image:
    """The envelope of bright stripes: ``grey`` (H, W) closed over most of a period."""
    size = 2 * round(UNLIT_PERIODS * period_px / 2) + 1
    square = np.ones((size, size), np.uint8)
    return cv2.morphologyEx(grey, cv2.MORPH_CLOSE, square, borderType=cv2.BORDER_REPLICATE)  # type: ignore[return-value]


def unlit(grey: Image, background: Background, period_px: float) -> Mask:
    """Pixels (H, W) in ambient light alone over most of a period: closing fills the dark stripes of a fringe first."""
    return stripes_filled(grey, period_px) < background.ambient_grey + UNLIT_SIGMAS * background.noise_grey


def explained(grey: Image, predicted: Image, ambient_grey: float, period_px: float) -> Mask:
    """Pixels (H, W) around which the ``predicted`` grey levels of the object's fringe are seen: not a dark hollow in it
    into which only the fit's window reaches."""
    sigma_px = RING_PERIODS * period_px
    light = predicted - np.float32(ambient_grey)
    misfit, power = (cv2.GaussianBlur(v * v, (0, 0), sigma_px) for v in (grey - predicted, light))
    return misfit < LARGEST_MISFIT * power  # type: ignore[no-any-return]


def refined(
    region: Mask, background: Background, predicted: Image, grey: Image, fringe_noise: NDArray, reach_px: float
) -> Mask:
    """Mask (H, W) by the better of the two predictions within ``reach_px`` of the silhouette; ``predicted`` grey levels
    of the object's fringe, NaN where nothing near predicts it; ``fringe_noise``: its noise, beside the image's."""
    noise = background.noise_grey
    as_plane = (background.residual / noise) ** 2
    with np.errstate(invalid="ignore"):
        as_object = (grey - predicted) ** 2 / (noise**2 + fringe_noise**2)
        nearer = as_object < as_plane + OBJECT_BONUS
    ring = cv2.dilate(region.astype(np.uint8), disk(reach_px)) > 0
    # Pixels that differ stay. The others at the rim are object where the object's fringe explains them better.
    clear = background.different & region
    inner = cv2.erode(region.astype(np.uint8), disk(reach_px)) > 0
    votes = without_small(clear | inner | (ring & nearer), 4)
    smooth = cv2.medianBlur(votes.astype(np.uint8), 3) > 0
    return (smooth | clear) & ring
