"""The empty scene: the background plane's grey levels in the light of an image, which tell what is
no object.

The plane's phase is known from the rig, the light is not: it is fitted to the pixels that show the
plane. In fringes of one direction these are tiles whose grey levels are ambient light plus a
multiple of the plane's fringe; the lamp's strength found so calibrates the brightness of objects.
In crossed fringes they are pixels where both phases are the plane's; the lamp's brightness, the
contrast, and the response of projector and camera are fitted, and no absolute grey level is needed.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.geometry import (
    CalibrationLayer,
    Carriers,
    Crop,
    Image,
    Mask,
    wrapped,
)
from fpp_ml_bench.baselines.phase.local_fit import FLOOR_NOISE_GREY, Demodulated
from fpp_ml_bench.constants import MAD_TO_SIGMA, MM_PER_M
from fpp_ml_bench.optics.rig import Rig

SAMPLE_STEP_PX = 5
"""Distance in px of the pixels to which light is fitted. Every fifth along both axes is 4% of an
image, which saves time and leaves many more samples than unknowns."""
LEAST_SHARE = 0.02
"""Least share of the image that must show the plane for the image to calibrate itself. With less,
nothing is fitted, and no plane is predicted."""
DARK_PERCENTILE = 1.0
"""Percentile of the grey levels of an image without background that is taken for its ambient light.
The least value itself would be noise."""
DEFAULT_NOISE_GREY = 1.0
"""Least noise, in grey levels, of an image that shows no background to measure it on: the noise
that `MIN_MODULATION` counts with."""
DIFFERENT_SIGMAS = 3.5
"""A pixel this far from the empty scene is not background; noise alone reaches it at isolated
pixels, 1 in 2,000."""
TILE_PX_PER_PERIOD = 1.1
"""Side of the tiles that are searched for the plane, in periods: over one period, to separate
strength and ambient light."""
TILE_NOISE_SIGMAS = 3.0
"""Largest misfit of a tile that may be background, in standard deviations of the image's noise."""
STRENGTH_TOLERANCE = 0.4
"""Relative deviation of the lamp's strength in an image from a strength that the user gives. A
surface in the working range whose fringe is in phase with the plane's is two to four times as
bright, and must not be taken for the plane."""
LEAST_EXPLAINED = 0.5
"""Least share of the variance of the tiles' grey levels that one plane must explain. A dark tile in
which nothing is to be seen misfits no prediction; a plane that is there explains 0.8 and more even
where it is as dim as noise."""
SAME_STRENGTH = 1.35
"""Ratio of strengths within which tiles show the same surface: sheen changes slowly over a
plane."""
SAME_RAD = 0.4
"""Distance, in rad, of a pair of phases from the plane's pair within which a pixel may show the
plane."""
MOVED_RAD = 1.0
"""Farthest distance in rad, along each axis, of the plane's phases from those of the rig: a
calibration that is off, or a wall that stands elsewhere."""
MOVED_CELLS = 10
"""Cells along each axis in which that distance is looked for. Each is 0.2 rad wide, half of
`SAME_RAD`."""
MOVED_SHARE = 0.1
"""Least share of the image that must agree on another place of the plane. Less may be a flat
object."""
CLEAR_SHARE = 0.5
"""Share of the image that has the rig's own phases from which on no other place of the plane is
looked for: at a half, another place can hardly have more."""
MORE = 1.5
"""How many times as many points another place of the plane must have. Above 1, so that the rig's
own place is kept in a close case."""
EXACT_RAD = 0.05
"""Largest distance of the plane's phases from the rig's, in rad, that is left as it is: the plane's
light was computed for these once, and is computed again for others."""
NARROWING_RAD = (0.3, 0.2, 0.2, 0.2)
"""Distances from the corrected phases, in place of `SAME_RAD`, round by round: a flat object may be
near the plane."""
ERODED_PERIODS = 0.4
"""Width, in periods, that is eroded from the pixels that show the plane: a window beside an object
covers the object too."""
PLAIN_SIGMAS = 5.0
"""Spread of the plane's fitted light, over the noise, below which it shows no fringe."""
TEXTURED = 3.0
"""Misfit of the plane over the frame's noise from which on its albedo is taken to change from place
to place."""
ALBEDO_PERIODS = 0.27
"""Sigma, in periods, of the window in which the albedo of a textured plane is measured: it covers
about a period, so that it averages over the fringe."""
ALBEDO_SIDES = 0.5
"""Distance, in periods, at which the albedo of each side of a pixel is taken, for a pixel beside an
edge of the print."""
ALBEDO_SHARE = 0.03
"""Share of the plane's light that counts as noise where its albedo changes: the measured albedo is
not exact."""
SAMPLES = 4000
"""About how many points the plane is fitted to: enough to average the noise out, few enough to
solve in ms."""
OUTLIER_ROUNDS = 4
"""Rounds of a fit that leaves out outliers. Each measures the noise again without the outliers of
the round before; more rounds cost time."""
OUTLIER_SIGMAS = 4.0
"""Misfit, in standard deviations of the noise, from which on a point is left out of the next round:
normal noise reaches it in 1 of 16,000 points."""
RESPONSE_POWERS = (2, 3)
"""Powers of the pattern that are fitted beside the pattern itself: a projector's gamma bends the
pattern before the light falls off."""
EDGE_PX = 3
"""Width in px of the band along the border of the projector's image on the plane in which nothing
is predicted: pixels there are lit in part, and a calibration shifts the border."""
CURVE_POWERS = (1, 2, 3)
"""Powers of the fitted light whose sum is the plane's grey level: a gamma of projector or camera
bends it."""


@dataclass(frozen=True)
class Background:
    """Fit of the empty scene to one image, grey levels; ``strength``: what a white pattern gives
    per 1/m^2 of irradiance, NaN where neither image nor user tells; ``residual`` float32 (H, W):
    image minus prediction; ``share``: of the tiles that show the plane, 0 for none; ``weights``: of
    `EmptyScene`'s terms; ``textured``: the plane's albedo is taken to change from
    place to place."""

    ambient_grey: float
    strength: float
    noise_grey: float
    residual: Image
    share: float
    weights: tuple[float, ...]
    textured: bool = False

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
    """The background plane as a rig and direction show it; computed once, then fitted to every
    image. Its phase is calibrated; ambient light, the lamp's strength and slow changes of both and of
    the contrast across the image are fitted to the pixels that show the plane. ``white_grey`` and
    ``ambient_grey``, if the user gives them, are a photometric calibration: the grey level of a
    white pattern on a surface that faces the projector at the near end of the working range, and of
    a surface in ambient light alone. Without them an image that does not show the plane, or whose
    rig knows none, is not calibrated, and brightness tells no distance. What is modulated is object
    there (`modulated_region`)."""

    def __init__(
        self,
        rig: Rig,
        layer: CalibrationLayer,
        period_px: float,
        white_grey: float | None,
        ambient_grey: float | None,
    ) -> None:
        self.ambient_grey = ambient_grey
        self.strength = (
            np.nan if white_grey is None else white_grey * (rig.working_range_mm[0] / MM_PER_M) ** 2
        )
        self._rays = rig.camera.rays()
        # Without a known background nothing is predicted, and no image shows it.
        depth_m = np.nan if rig.background_m is None else rig.background_m
        self._phase = layer.absolute_phase(depth_m * MM_PER_M)
        lit, self._edge = pattern_on_plane(rig, depth_m)
        self.beyond = self._edge | (lit == 0)
        self._fall_off = lit * plane_irradiance(rig, depth_m)
        self._light = np.nan_to_num(self._fall_off * (0.5 + 0.5 * np.cos(self._phase)))
        self._terms = self._light_terms(self._fall_off, np.cos(self._phase), *self._rays)
        self._tile = min(max(8, round(period_px * TILE_PX_PER_PERIOD)), *self._light.shape)
        self._mean, self._square = self._tiles(self._light), self._tiles(self._light * self._light)

    def fit(self, image: NDArray[np.uint8]) -> Background:
        """Background of ``image`` uint8 (H, W)."""
        grey = image.astype(np.float32)
        plane_tiles = self._background_tiles(grey)
        share = float(plane_tiles.mean())
        if share < LEAST_SHARE:
            dark = (
                float(np.percentile(image, DARK_PERCENTILE))
                if self.ambient_grey is None
                else self.ambient_grey
            )
            strength = float(np.nan_to_num(self.strength))
            residual = grey - np.float32(dark) - np.float32(strength) * self._terms[0]
            noise = max(image_noise_grey(image), DEFAULT_NOISE_GREY)
            return Background(dark, float(self.strength), noise, residual, 0.0, (strength,))
        plane_pixels = plane_tiles.repeat(self._tile, axis=0).repeat(self._tile, axis=1)
        places = np.nonzero(plane_pixels[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX])
        row, column = (SAMPLE_STEP_PX * place for place in places)
        sampled = grey[row, column].astype(np.float64)
        columns = [np.ones_like(sampled)] + [term[row, column] for term in self._terms]
        terms = np.stack(columns, axis=1).astype(np.float64)
        fitted, solution = _least_squares(terms, sampled, rounds=1)
        noise = _noise_of(sampled - fitted)
        ambient_grey, *weights = solution
        residual = grey - np.float32(ambient_grey)
        for weight, term in zip(weights, self._terms, strict=True):
            residual -= np.float32(weight) * term
        residual[self._edge] = 0
        return Background(
            float(ambient_grey), float(weights[0]), noise, residual, share, tuple(weights)
        )

    def predicted(self, background: Background, shift_rad: float, where: Crop) -> Image:
        """Grey levels, float32 (h, w), that the plane has on the pixels ``where`` of a frame whose
        fringe is shifted by ``shift_rad``, in the light that ``background`` was fitted to."""
        rays = (axis[where] for axis in self._rays)
        wave = np.cos(self._phase[where] + shift_rad)
        terms = self._light_terms(self._fall_off[where], wave, *rays)
        plane = np.full(wave.shape, background.ambient_grey, np.float32)
        for weight, term in zip(background.weights, terms, strict=False):
            plane += np.float32(weight) * term
        return plane

    @staticmethod
    def _light_terms(fall_off: NDArray, wave: NDArray, x: NDArray, y: NDArray) -> list[Image]:
        """Terms (h, w) whose weighted sum, with ambient light, is the plane's light where its fringe
        has the cosine ``wave``: first the fringe as projected, then a lamp of uneven brightness, a
        contrast that changes over the image by the lenses' blur, and ambient light that falls off
        with the camera's lens."""
        light, squared = fall_off * (0.5 + 0.5 * wave), x * x + y * y
        terms = [light * term for term in (*_quadratic(x, y), squared * squared)]
        # A contrast that is off everywhere can't be told from ambient light.
        terms += [fall_off * wave * term for term in _quadratic(x, y)[1:]]
        return [np.nan_to_num(term).astype(np.float32) for term in (*terms, squared)]

    def _tiles(self, image: NDArray) -> NDArray[np.float64]:
        """Means over whole tiles."""
        tile = self._tile
        height, width = (length // tile * tile for length in image.shape)
        rows = (
            image[:height, :width]
            .reshape(height, width // tile, tile)
            .sum(axis=2, dtype=np.float64)
        )
        return rows.reshape(height // tile, tile, width // tile).sum(axis=1) / (tile * tile)

    def _background_tiles(self, grey: Image) -> Mask:
        """Tiles whose grey levels are ambient light plus a common multiple of the predicted
        light."""
        mean, square = self._tiles(grey), self._tiles(grey * grey)
        spread = self._square - self._mean**2
        with np.errstate(divide="ignore", invalid="ignore"):
            covariance = self._tiles(grey * self._light) - mean * self._mean
            slope = covariance / spread
            misfit = np.sqrt(np.maximum(square - mean**2 - covariance * slope, 0))
            largest = TILE_NOISE_SIGMAS * max(image_noise_grey(grey), 1.0)
            plane_tiles = (
                (misfit < largest)
                & (spread > 1e-2 * spread.max())
                & (slope * np.sqrt(spread) > largest / 3)
            )
            if np.isfinite(self.strength):
                plane_tiles &= np.abs(slope / self.strength - 1) < STRENGTH_TOLERANCE
        if not plane_tiles.any():
            return plane_tiles
        # The plane is the surface with the most tiles of one strength.
        ascending = np.sort(slope[plane_tiles])
        count = np.searchsorted(ascending, ascending * SAME_STRENGTH, "right") - np.arange(
            ascending.size
        )
        first = int(count.argmax())
        typical = float(np.median(ascending[first : first + count[first]]))
        plane_tiles &= np.abs(slope / typical - 1) < 0.15
        shown = (square - mean**2)[plane_tiles].sum()
        unexplained = (misfit[plane_tiles] ** 2).sum()
        return (
            plane_tiles
            if unexplained < (1 - LEAST_EXPLAINED) * shown
            else np.zeros_like(plane_tiles)
        )


def image_noise_grey(image: NDArray) -> float:
    """Standard deviation of an image's noise in grey levels, by the median over pixels of a mask
    that removes planes and slow fringes (Immerkaer 1996, Fast Noise Variance Estimation)."""
    grey = image.astype(np.float32)
    across = grey[:, :-2] - 2 * grey[:, 1:-1] + grey[:, 2:]
    mask = across[:-2] - 2 * across[1:-1] + across[2:]
    return MAD_TO_SIGMA * float(np.median(np.abs(mask))) / 6.0


def _noise_of(misfit_grey: NDArray) -> float:
    """Standard deviation of noise in grey levels from misfits of which some are none."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(misfit_grey))), FLOOR_NOISE_GREY)


def plane_irradiance(rig: Rig, depth_m: float) -> NDArray[np.float64]:
    """Irradiance of a plane square to the camera's axis at ``depth_m``: cosine over distance
    squared, 1/m^2, (H, W)."""
    x, y = rig.camera.rays()
    centre = -rig.R.T @ rig.t
    # The plane's normal is the camera's axis, however the projector is rotated.
    right, down, ahead = x * depth_m - centre[0], y * depth_m - centre[1], depth_m - centre[2]
    squared = right**2 + down**2 + ahead**2
    return ahead / (squared * np.sqrt(squared))


def pattern_on_plane(rig: Rig, depth_m: float) -> tuple[Image, Mask]:
    """Where the projector lights a plane square to the camera's axis, 1 or 0 float32 (H, W), and the
    band of `EDGE_PX` along the border of that; everywhere and nowhere for no known plane."""
    x, y = rig.camera.rays()
    if not np.isfinite(depth_m):
        return np.ones(x.shape, np.float32), np.zeros(x.shape, bool)
    u, v = rig.seen((x, y), depth_m)
    lit = rig.projector.holds(u, v)
    square = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    plain = lit.astype(np.uint8)
    edge = cv2.dilate(plain, square) != cv2.erode(plain, square, borderValue=1)
    return lit.astype(np.float32), edge


def _quadratic(x: NDArray, y: NDArray) -> tuple[NDArray, ...]:
    return np.ones_like(x), x, y, x * x, x * y, y * y


def _linear(rig: Rig) -> NDArray[np.float32]:
    """1, x and y (3, H, W) of the camera's rays."""
    x, y = rig.camera.rays()
    return np.stack([np.ones_like(x), x, y]).astype(np.float32)


class CrossedEmptyScene:
    """The plane of a rig in the light of a carrier pair; computed once, then fitted to every
    image."""

    def __init__(self, carriers: Carriers, stride: int) -> None:
        self._carriers, self._stride, self._known = (
            carriers,
            stride,
            carriers.rig.background_m is not None,
        )
        self._period_px = carriers.period_px
        self._margin = 2 * max(1, round(ERODED_PERIODS * carriers.period_px / stride)) + 1
        phases = self._phases()
        self._lit, self._edge = pattern_on_plane(carriers.rig, self._depth_m)
        self._grid_rad = wrapped(phases[:, ::stride, ::stride]).astype(np.float32)
        self._grid = _linear(carriers.rig)[
            :, ::stride, ::stride
        ].copy()  # a view would keep the whole image
        self._terms = self._light(phases)

    @property
    def _depth_m(self) -> float:
        """NaN without a known background: nothing is predicted, and no image shows it."""
        return self._carriers.rig.background_m or np.nan

    def _phases(self) -> NDArray:
        """Phases (2, H, W) of the plane in rad, not wrapped."""
        return self._carriers.phases(self._carriers.nearness(self._depth_m * MM_PER_M))

    def _light(self, phases: NDArray) -> list[Image]:
        """Terms (H, W) whose weighted sum is the plane's light at ``phases`` (2, H, W): a lamp of
        uneven brightness, carriers of any contrast, uneven by the lenses' blur, a projector's
        response, which bends the pattern before the light falls off, and ambient light, which falls
        off with the camera's lens."""
        waves = (
            weight * np.cos(phase)
            for weight, phase in zip(self._carriers.family.weights, phases, strict=True)
        )
        first, second = (wave.astype(np.float32) for wave in waves)
        fall_off = plane_irradiance(self._carriers.rig, self._depth_m).astype(np.float32)
        fall_off *= self._lit / np.float32(np.median(fall_off))
        pattern, (one, x, y) = 1 + first + second, _linear(self._carriers.rig)
        lamp, squared = [fall_off * term for term in _quadratic(x, y)], x * x + y * y
        terms = [term * pattern for term in (*lamp, fall_off * squared * squared)]
        terms += [fall_off * pattern**power for power in RESPONSE_POWERS]
        terms += [term * wave for wave in (first, second) for term in lamp]
        return [*terms, one, squared]

    def __call__(self, grey: Image, seen: Demodulated) -> Background:
        """Fit the plane to an image float32 (H, W), demodulated as ``seen``: its ``residual``
        float32 (H, W), ambient light and noise, and the ``share`` of the image that shows it, 0
        where it is not to be seen. The brightness of a crossed frame tells no distance:
        `Background.strength` is NaN."""
        smooth = cv2.blur(grey, (3, 3))[::SAMPLE_STEP_PX, ::SAMPLE_STEP_PX]
        dark = float(np.percentile(smooth, DARK_PERCENTILE))
        noise = max(image_noise_grey(grey), FLOOR_NOISE_GREY)
        plane_points, moved_rad = self._plane(seen, noise)
        share = float(plane_points.mean())
        if share < LEAST_SHARE:
            return Background(
                dark, np.nan, max(noise, DEFAULT_NOISE_GREY), np.zeros_like(grey), 0.0, ()
            )
        row, column = self._stride * _spread(plane_points)
        samples = grey[row, column].astype(np.float64)
        all_terms = self._terms if moved_rad is None else self._light(self._phases() + moved_rad)
        terms = np.stack([term[row, column] for term in all_terms], axis=1).astype(np.float64)
        light, weights = _least_squares(terms, samples)
        # Horner's rule on whole images, in single precision: 1e-5 of a grey level is enough here.
        first = sum(
            (np.float32(w) * term for w, term in zip(weights, all_terms, strict=True)),
            np.float32(0),
        )
        own_noise = max(image_noise_grey(grey), DEFAULT_NOISE_GREY)
        if (
            np.subtract(*np.percentile(light, [95, 5])) < PLAIN_SIGMAS * own_noise
        ):  # no fringe for a gamma to bend
            residual = self._predicted(grey - first, grey - np.float32(dark))
            return Background(
                dark, np.nan, max(_noise_of(samples - light), noise), residual, share, ()
            )
        curve = np.stack([light**power for power in CURVE_POWERS] + [np.ones_like(light)], axis=1)
        scale = np.maximum(np.abs(curve).max(axis=0), 1e-6)
        fitted, bend = _least_squares(curve / scale, samples)
        noise, bend = _noise_of(samples - fitted), (bend / scale).astype(np.float32)
        plane = ((bend[2] * first + bend[1]) * first + bend[0]) * first + bend[3]
        if noise > TEXTURED * own_noise:
            residual = self._of_any_albedo(grey, plane, dark, own_noise)
            residual = self._predicted(residual, grey - np.float32(dark))
            return Background(dark, np.nan, own_noise, residual, share, (), textured=True)
        residual = self._predicted(grey - plane, grey - np.float32(dark))
        return Background(dark, np.nan, noise, residual, share, ())

    @property
    def beyond(self) -> Mask:
        """Pixels (H, W) whose plane is not lit by the projector, or at the border of that."""
        return self._edge | (self._lit == 0)

    def _predicted(self, residual: Image, lit_grey: Image) -> Image:
        """``residual`` (H, W); where the projector does not light the plane ``lit_grey``, the grey
        levels above a dark pixel's, and 0 along the border."""
        residual = np.where(self._lit > 0, residual, lit_grey)
        residual[self._edge] = 0
        return residual

    def _of_any_albedo(self, grey: Image, plane: Image, dark: float, noise_grey: float) -> Image:
        """Misfit of a plane whose albedo changes from place to place, in units of the noise: the
        fringe of ``plane`` is as bright as the frame says around the pixel, or on one of its
        sides."""
        light, seen = plane - np.float32(dark), grey - np.float32(dark)
        sigma_px = ALBEDO_PERIODS * self._period_px
        power = cv2.GaussianBlur(light * light, (0, 0), sigma_px)
        albedo = cv2.GaussianBlur(seen * light, (0, 0), sigma_px) / np.maximum(power, noise_grey**2)
        reach = round(self._period_px * ALBEDO_SIDES)
        around = cv2.copyMakeBorder(albedo, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
        height, width = grey.shape
        least = np.full(grey.shape, np.inf, np.float32)
        for down, right in (
            (0, 0),
            (-1, 0),
            (1, 0),
            (0, -1),
            (0, 1),
            (-1, -1),
            (-1, 1),
            (1, -1),
            (1, 1),
        ):
            y, x = reach * (1 + down), reach * (1 + right)
            misfit = seen - around[y : y + height, x : x + width] * light
            least = np.where(np.abs(misfit) < np.abs(least), misfit, least)
        return least / np.hypot(1, np.float32(ALBEDO_SHARE / noise_grey) * light)

    def _plane(self, seen: Demodulated, noise_grey: float) -> tuple[Mask, Image | None]:
        """Grid points (h', w') whose windows show the plane alone, and by how much its phases are
        beside the rig's, float32 (2, H, W) in rad, None for at most `EXACT_RAD`. Where its fringes
        are nowhere to be seen, the points without any fringe: they are blurred out, or there is no
        wall."""
        modulation = seen.modulation
        lit = ~self.beyond[:: self._stride, :: self._stride]
        fringed, plain = (
            lit & (modulation.min(axis=0) > noise_grey / 4),
            lit & (modulation.max(axis=0) < noise_grey / 2),
        )
        off_rad = wrapped(seen.phase_rad - self._grid_rad)
        moved_rad = np.zeros((2, 1, 1), np.float32)
        points = self._alone(fringed & (np.hypot(*off_rad) < SAME_RAD))
        if self._known and fringed.any() and points.mean() < CLEAR_SHARE:
            # A flat object may have the phases where the wall should be.
            common_rad = _most_common(off_rad[:, fringed])[:, None, None]
            others = self._alone(fringed & (np.hypot(*wrapped(off_rad - common_rad)) < SAME_RAD))
            if others.mean() > max(MOVED_SHARE, MORE * points.mean()):
                points, moved_rad = others, common_rad
        if points.mean() < max(LEAST_SHARE, self._alone(plain & ~fringed & self._known).mean()):
            return self._alone(plain & self._known), None
        for tolerance_rad in NARROWING_RAD:
            row, column = _spread(points)
            terms = self._grid[:, row, column].T.astype(np.float64)
            left_rad = (moved_rad + wrapped(off_rad - moved_rad))[:, row, column]
            slopes = np.linalg.lstsq(terms, left_rad.T, rcond=None)[0].T
            moved_rad = np.tensordot(slopes, self._grid, 1).astype(np.float32)
            if np.abs(moved_rad).max() < EXACT_RAD:
                return points, None
            points = self._alone(
                fringed & (np.hypot(*wrapped(off_rad - moved_rad)) < tolerance_rad)
            )
        return points, np.tensordot(slopes, _linear(self._carriers.rig), 1).astype(np.float32)

    def _alone(self, points: Mask) -> Mask:
        """``points`` (h', w') whose windows show these alone."""
        square = np.ones((self._margin, self._margin), np.uint8)
        return cv2.erode(points.astype(np.uint8), square, borderValue=1) > 0  # type: ignore[call-overload]


def _spread(points: Mask) -> NDArray[np.intp]:
    """Rows and columns (2, N) of about `SAMPLES` of the ``points``, evenly among them."""
    places = np.argwhere(points)
    return places[:: max(1, len(places) // SAMPLES)].T


def _most_common(off_rad: NDArray) -> NDArray[np.float32]:
    """The distance (2,) in rad, up to `MOVED_RAD`, that most of ``off_rad`` (2, N) are near to."""
    edges = np.linspace(-MOVED_RAD, MOVED_RAD, MOVED_CELLS + 1)
    count = np.histogram2d(off_rad[0], off_rad[1], bins=[edges, edges])[0]
    around = cv2.blur(count, (3, 3), borderType=cv2.BORDER_CONSTANT)
    best = np.stack(np.unravel_index(around.argmax(), around.shape))
    return ((edges[best] + edges[best + 1]) / 2).astype(np.float32)


def _least_squares(
    terms: NDArray[np.float64], values: NDArray[np.float64], rounds: int = OUTLIER_ROUNDS
) -> tuple[NDArray, NDArray]:
    """Least squares, in more than one of the ``rounds`` without outliers: the fitted values and the
    solution."""
    keep = np.ones(len(values), bool)
    fitted: NDArray = values
    solution: NDArray = values
    for _ in range(rounds):
        solution = np.linalg.lstsq(terms[keep], values[keep], rcond=None)[0]
        fitted = terms @ solution
        misfit = np.abs(values - fitted)
        keep = misfit < OUTLIER_SIGMAS * _noise_of(misfit[keep])
    return fitted, solution
