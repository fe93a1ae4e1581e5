"""First stop: what frames show before any order is chosen. Background, object mask, phase and
brightness.

A *measurement model* is one carrier or two, in one frame or a few. With three or more shifted
frames the phase is the N-step least squares of `fpp_ml_bench.decoding`, pixel by pixel, so that two
surfaces are never mixed at a depth edge. One frame has more unknowns than grey levels, and a window
of neighbours is fitted (`local_fit`). Two frames have one equation too few, but a projected fringe
goes down to black: its mean is its modulation plus ambient light. With that constraint a window of
a few px (`PAIR_WINDOW_PERIODS`) is enough. Three crossed frames shift one carrier and keep the
other still, which is left in their mean, where the shifted one cancels.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.empty_scene import Background, CrossedEmptyScene, EmptyScene
from fpp_ml_bench.baselines.phase.geometry import (
    LEAST_RANGE_RAD,
    CalibrationLayer,
    Carriers,
    Crop,
    Image,
    Mask,
    Orders,
    Resampling,
    nearest_inside,
    repeated,
    stride_of,
    wrapped,
)
from fpp_ml_bench.baselines.phase.local_fit import (
    CURVED,
    WEAK_LIGHT_PX,
    WEAK_PHASE_PX,
    Demodulator,
    FringeFit,
    GaussianWindow,
    carrier_fit,
    fringe_fit,
    measured_contrast,
    phase_slopes,
    steadied,
)
from fpp_ml_bench.baselines.phase.object_mask import (
    DARKEST_GREY,
    RING_PERIODS,
    UNLIT_PX,
    beyond_border,
    continued,
    crop_around,
    differs,
    enclosed,
    explained,
    first_mask,
    lit_object,
    lit_part,
    modulated_region,
    object_region,
    refined,
    unlit,
)
from fpp_ml_bench.baselines.phase.settings import PIXELWISE, Settings, steps_of
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.phase_shift import phase_weights, wrapped_phase
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M, TAU
from fpp_ml_bench.decoding.decode import grey_levels
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

Frames = NDArray | Sequence[NDArray]
EVERYWHERE = (slice(None), slice(None))
CROSSED_FRAMES = 3
"""Frames of crossed fringes that shift one carrier: three are the fewest that give its phase and
modulation pixel by pixel."""
MARGIN_PERIODS = 0.5
"""Width of the crop around the object, in periods: it covers the windows, and the mask may grow
into it."""
FIRST_WINDOW_PERIODS = 0.35
"""Sigma of the window of the first fit, in periods. All windows were chosen on train and validation
objects."""
SECOND_WINDOW_PERIODS = 0.27
"""Sigma, in periods, of the window of the second fit, which starts from the phase of the first."""
PAIR_WINDOW_PERIODS = 0.06
"""Sigma, in periods, of the window of the last fits to two frames: a few px are enough, since two
frames leave one unknown less."""
SLOPE_PERIODS = 0.13
"""Sigma, in periods, of the Gaussian under which slopes of the phase are averaged."""
SLACK_SHARE = 0.025
"""Of the range, by which it is widened at both ends where orders are chosen, for noise there: a
depth beyond the range is left out, and no other order is taken to be within. 15 mm of the paper's
600, where it was chosen on validation objects."""
FRINGE_NOISE = 0.03
"""Uncertainty of a fringe extrapolated beyond its window, as a share of its brightness."""
CONTRAST_ROUNDS = 3
"""Fits in a row that measure the contrast of the fringes, each from the phase and brightness of the
one before. Each costs the time of a fit."""
FREE_ROUNDS = 2
"""Fits that use this contrast, and start from the carrier again, because a fit keeps the ripple of
the phase that it starts from."""
PAIR_ROUNDS = 2
"""Fits to two frames over the small window. The second starts from the phase of the first, since
the model is linear around its start."""
MOST_SLACK_PERIODS = 0.07
"""Largest slack of the working range, in periods at its middle: 17 mm of the paper's rig, where
`SLACK_SHARE` is less, and 4 mm of a rig whose period is 57 mm deep, where 15 mm would let almost
every pixel have a second order."""
LEAST_CARRIER_CONTRAST = 0.08
"""Least contrast (modulation over mean) of a carrier on the object that a measurement may give: a
fit with less would hardly see the carrier."""
FAINT_SIGMAS = 6.0
"""Modulation of a window, in standard deviations of its noise, below which light shows no fringe: a
shadow that other light reaches."""
CONTRAST_RIM_PERIODS = 0.5
"""Distance from the silhouette, in periods, within which grid points do not measure the contrast:
their windows cover the background too."""


@dataclass(frozen=True)
class Capture:
    """Frames measured around the object: maps (h, w) of the part ``crop`` of images of ``shape``
    (H, W). ``greys``: float32 grey levels of each frame; ``background``: fit of the empty scene;
    ``inside``: object, ``given`` by the user or found; ``beyond``: pixels that the
    projector lights neither on the plane nor on an object, none where that was not looked for (a
    given mask, several frames); ``period_px``: of the fringe in the image,
    the longer one of two; orders are chosen on a grid of every ``stride``-th pixel, for depths of
    ``range_mm``. An image without an object has a crop of one pixel."""

    rig: Rig
    period_px: float
    range_mm: tuple[float, float]
    stride: int
    shape: tuple[int, ...]
    crop: Crop
    greys: tuple[Image, ...]
    background: Background
    inside: Mask
    given: bool
    beyond: Mask

    @property
    def pixelwise(self) -> bool:
        """Whether there are frames enough for every pixel to have a phase of its own."""
        return len(self.greys) >= PIXELWISE

    @property
    def saturated(self) -> Mask:
        """Object pixels that are clipped in any of the frames."""
        return np.any([grey >= GREY_LEVELS for grey in self.greys], axis=0) & self.inside

    def spread(self, values: NDArray) -> NDArray:
        """Maps of the grid (..., h', w') at all pixels, each that of its grid point or of the
        nearest one inside."""
        if self.pixelwise and self.stride == 1:
            return values
        return repeated(
            values[..., *self._nearest], self.stride, (*values.shape[:-2], *self.inside.shape)
        )

    @cached_property
    def _nearest(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return nearest_inside(self.inside[:: self.stride, :: self.stride])


@dataclass(frozen=True)
class Observation(Capture):
    """Fringes of one direction, whose frames are shifted by ``shifts_rad``. ``layer``: calibration
    layer of the crop; ``fit``: phase, not wrapped, and brightness; ``phase_rad`` float32, the fit's
    phase in [-pi, pi]; ``slopes``: change of the residual phase in rad a px along x and y;
    ``mean_grey``: of pixelwise frames; ``uncertainty_rad`` float32: of the phase, without the
    order, None for that of the fit (`depth`); ``other_phase``: another measurement of the phase,
    and its uncertainty, in rad."""

    layer: CalibrationLayer
    shifts_rad: tuple[float, ...]
    fit: FringeFit
    phase_rad: Image
    slopes: tuple[Image, Image]
    mean_grey: Image | None
    uncertainty_rad: Image | None = None
    other_phase: tuple[Image, Image] | None = None

    @cached_property
    def candidates(self) -> Orders:
        """The orders that the working range allows."""
        return self.layer.orders_in_range(self.phase_rad, self.range_mm)


@dataclass(frozen=True)
class CrossedObservation(Capture):
    """Fringes of two directions in ``grey``, the one frame or the mean of three that shift the
    carrier ``moved``. ``phase_rad`` and ``modulation`` float32 (2, h, w): wrapped phases and grey
    levels, of windows, or of the pixel itself for the carrier ``moved``; ``point_phase_rad`` (2,
    h', w'): the phases measured on the grid of orders; ``contrast``: modulation over mean of each
    carrier, in this image; ``sigma_rad`` float32 (2, h, w): standard uncertainty of the phases, of
    networks that measured them."""

    carriers: Carriers
    moved: int | None
    grey: Image
    phase_rad: Image
    point_phase_rad: Image
    modulation: Image
    contrast: tuple[float, float]
    sigma_rad: Image | None = None

    @property
    def light(self) -> Image:
        """Grey levels less ambient light."""
        return self.grey - np.float32(self.background.ambient_grey)


def modulation_noise_grey(shifts_rad: Sequence[float], noise_grey: float) -> float:
    """Noise of the modulation that frames of the noise ``noise_grey`` measure."""
    _, cosine, sine = phase_weights(shifts_rad)
    return noise_grey * float(np.sqrt(max(cosine @ cosine, sine @ sine)))


class MeasurementModel:
    """What a rig photographs, and how phase is measured in it. Images whose fringe period
    ``seen_px`` is too long are resampled: then ``rig`` is that of the resampled images, which an
    observation is of; images and masks have the captured size. ``frames``: their number and what
    they are."""

    def __init__(
        self, rig: Rig, settings: Settings, seen_px: float, frames: tuple[int, str]
    ) -> None:
        near, far = rig.working_range_mm
        self.settings, self.frames, self.slack_mm = settings, frames, SLACK_SHARE * (far - near)
        self.resampling = Resampling.of(rig, seen_px)
        self.rig = self.resampling.rig

    @property
    def range_mm(self) -> tuple[float, float]:
        """The working range with its slack."""
        near, far = self.rig.working_range_mm
        return near - self.slack_mm, far + self.slack_mm

    def images(self, given: Frames) -> list[NDArray]:
        """Grey levels of captured frames, uint8 or float32 (H, W) each, in the size of ``rig``.
        Raises `DecodeError` for another number, dtype or shape."""
        frames = [given] if isinstance(given, np.ndarray) and given.ndim == 2 else list(given)
        count, kind = self.frames
        if len(frames) != count:
            raise DecodeError(f"expected {count} {kind}, got {len(frames)}")
        camera = self.resampling.captured.camera
        images = [grey_levels(frame) for frame in frames]
        for image in images:
            if image.dtype not in (np.uint8, np.float32) or image.shape != (
                camera.height,
                camera.width,
            ):
                raise DecodeError(
                    f"expected frames of uint8 grey levels, shape (H, W) = "
                    f"{(camera.height, camera.width)} of the "
                    f"rig's camera, got {image.dtype} {image.shape}; use rig.scaled(width) for a "
                    f"resized image"
                )
        return [self.resampling.image(image) for image in images]


def tells_depth(rig: Rig, direction: Direction) -> bool:
    """Whether the fringes of a direction change with depth at all: not where the projector stands
    along them."""
    return TAU * rig.periods_in_range(direction) >= LEAST_RANGE_RAD


class OneCarrier(MeasurementModel):
    """Fringes of one direction, ``settings.frames`` of them (`steps_of`). Phases are those of the
    first of them."""

    def __init__(self, rig: Rig, settings: Settings | None = None) -> None:
        settings = settings or Settings()
        rig.check_sampling()
        shifts_rad = rig.shifts_rad(settings.direction)
        self.steps = steps_of(len(shifts_rad), settings.frames)
        self.first_rad = first = shifts_rad[self.steps[0]]
        self.shifts_rad = tuple(shifts_rad[step] - first for step in self.steps)
        frames = len(self.steps), f"fringes, those of steps {self.steps}"
        super().__init__(rig, settings, rig.image_px_per_period(settings.direction), frames)
        rig = self.rig
        self.layer = CalibrationLayer.of(rig, settings.direction).shifted(first)
        (near, far), periods_in_range = (
            rig.working_range_mm,
            rig.periods_in_range(settings.direction),
        )
        if not tells_depth(rig, settings.direction):
            raise PredictionError(
                f"{settings.direction} fringes tell no depth on this rig: over the working range "
                f"{near:g} to {far:g} mm their phase changes by {TAU * periods_in_range:.2g} rad, "
                f"because the projector stands along them; use the other direction, or crossed "
                f"fringes (fpp-bench patterns --design)"
            )
        self.slack_mm = min(self.slack_mm, MOST_SLACK_PERIODS * (far - near) / periods_in_range)
        self.period_px = rig.image_px_per_period(settings.direction)
        self._scene = EmptyScene(
            rig, self.layer, self.period_px, settings.white_grey, settings.ambient_grey
        )
        self._carrier = np.nan_to_num(self.layer.absolute_phase(rig.standoff_m * MM_PER_M)).astype(
            np.float32
        )
        sigmas = [FIRST_WINDOW_PERIODS, SECOND_WINDOW_PERIODS]
        if settings.frames == 2:
            sigmas += [PAIR_WINDOW_PERIODS] * PAIR_ROUNDS
        self.windows = [GaussianWindow(share * self.period_px) for share in sigmas]

    @cached_property
    def captured_layer(self) -> CalibrationLayer:
        """The calibration layer of the captured images."""
        captured = self.resampling.captured
        return CalibrationLayer.of(captured, self.settings.direction).shifted(self.first_rad)

    @property
    def caution(self) -> str:
        """What a user should know before anything is measured, "" where nothing is."""
        rig, direction = self.resampling.captured, self.settings.direction
        periods = rig.periods_in_range(direction)
        calibrated = rig.background_m is not None or self.settings.white_grey is not None
        if periods <= 1 or calibrated:
            return ""
        near, far = rig.working_range_mm
        return (
            f"the working range {near:g} to {far:g} mm holds {periods:.2g} periods of the "
            f"{direction} fringes, and nothing calibrates brightness (the rig has no background_m, "
            f"and no --white-grey is given): where range and continuity leave two orders, a pixel "
            f"stays without a depth. Narrow working_range_mm to one period, or use crossed fringes"
        )

    def observe(self, image: Frames, mask: Mask | None = None) -> Observation:
        """Mask and phase of captured fringes: one, uint8 (H, W), or the frames of ``steps``.
        ``mask`` bool (H, W) replaces the object mask that is found. Raises `DecodeError` for
        another number, dtype or shape."""
        images = self.images(image)
        background = self._scene.fit(images[0])
        if mask is not None:
            region = self.resampling.mask(mask)
        elif background.shown:
            region = object_region(background, self.period_px)
        else:
            first = images[0].astype(np.float32)
            _, modulation = carrier_fit(
                first, np.ones(first.shape, bool), self._carrier, self.windows[0]
            )
            region = modulated_region(first, modulation, background, self.period_px)
        crop = crop_around(region, int(np.ceil(MARGIN_PERIODS * self.period_px)))
        greys = tuple(frame[crop].astype(np.float32) for frame in images)
        background = replace(background, residual=background.residual[crop])
        layer, inside, mean_grey = self.layer.at(crop), region[crop], None
        dark = np.zeros_like(inside)
        if len(greys) > 1 and mask is None:
            planes = [self._scene.predicted(background, shift, crop) for shift in self.shifts_rad]
            misfits = [grey - plane for grey, plane in zip(greys, planes, strict=True)]
            different = differs(misfits, background.noise_grey)
            region = first_mask(different, self.period_px)
            inside = region if background.shown else inside & region
        if len(greys) >= PIXELWISE:
            fitted = wrapped_phase(greys, self.shifts_rad, np.float32)
            phase, modulation, mean_grey = (np.asarray(values, np.float32) for values in fitted)
            if mask is None:
                noise = modulation_noise_grey(self.shifts_rad, background.noise_grey)
                inside = lit_object(
                    different, region, modulation, noise, background.shown, self.period_px
                )
            # The share of a window on the object is what the use of slopes needs.
            fit = FringeFit(phase, modulation, self.windows[1].moment(inside.astype(np.float32)))
        else:
            if mask is None:
                dark = unlit(np.maximum.reduce(greys), background, self.period_px)
            inside, fit = self._local_fits(
                greys, background, crop, inside & ~dark, dark, mask is not None
            )
        phase, slopes = self._phase_and_slopes(layer, inside, fit)
        return Observation(
            rig=self.rig,
            period_px=self.period_px,
            range_mm=self.range_mm,
            stride=stride_of(self.period_px),
            shape=images[0].shape,
            crop=crop,
            greys=greys,
            background=background,
            inside=inside,
            given=mask is not None,
            beyond=dark & self._scene.beyond[crop],
            layer=layer,
            shifts_rad=self.shifts_rad,
            fit=fit,
            phase_rad=phase,
            slopes=slopes,
            mean_grey=mean_grey,
        )

    def with_object(self, seen: Observation, inside: Mask) -> Observation:
        """An observation of one frame with another object ``inside`` (h, w), over which the windows
        are fitted again."""
        _, fit = self._local_fits(
            seen.greys, seen.background, seen.crop, inside, np.zeros_like(inside), True
        )
        phase, slopes = self._phase_and_slopes(seen.layer, inside, fit)
        return replace(seen, inside=inside, fit=fit, phase_rad=phase, slopes=slopes)

    def _phase_and_slopes(
        self, layer: CalibrationLayer, inside: Mask, fit: FringeFit
    ) -> tuple[Image, tuple[Image, Image]]:
        """The wrapped phase of a fit, and the slopes of what is left of it by the calibration."""
        phase = wrapped(fit.phase_rad).astype(np.float32)
        residual = wrapped(phase - layer.infinity_rad).astype(np.float32)
        return phase, phase_slopes(residual, inside, SLOPE_PERIODS * self.period_px)

    def _local_fits(
        self,
        greys: Sequence[Image],
        background: Background,
        crop: Crop,
        inside: Mask,
        dark: Mask,
        given: bool,
    ) -> tuple[Mask, FringeFit]:
        """Object mask and local fits of one or two frames, each window starting from the phase of
        the last; ``inside``: where frames differ from the empty scene and are not ``dark``, or the
        ``given`` mask."""
        period_px, grey = self.period_px, greys[0]
        carrier = self._carrier[crop]
        phase, _ = carrier_fit(grey, inside, carrier, self.windows[0])
        for window in self.windows[1:]:
            fit = fringe_fit(greys, inside, phase, background.ambient_grey, window, self.shifts_rad)
            phase = fit.phase_rad
        if not background.calibrated:
            # Fringes of any contrast on surfaces of any brightness: the contrast is measured, then
            # the fits start again, because a fit keeps the ripple of the phase that it starts from.
            ambient = background.ambient_grey
            for _ in range(CONTRAST_ROUNDS):
                if not given:
                    inside = inside & explained(
                        grey, np.float32(ambient) + fit.light, ambient, period_px
                    )
                contrast = measured_contrast(grey - np.float32(ambient), inside, fit)
                light = ambient, self.windows[0], self.shifts_rad, contrast, CURVED
                fit = fringe_fit(greys, inside, fit.phase_rad, *light)
            phase, _ = carrier_fit(grey, inside, carrier, self.windows[0])
            for _ in range(FREE_ROUNDS):
                fit = fringe_fit(greys, inside, phase, *light)
                phase = fit.phase_rad
        if given:
            return inside, fit
        if len(greys) == 1:
            bright = np.maximum(fit.brightness, 0)
            predicted = (background.ambient_grey + fit.light).astype(np.float32)
            inside = refined(
                inside, background, predicted, grey, FRINGE_NOISE * bright, RING_PERIODS * period_px
            )
        inside = (
            inside
            & ~dark
            & (fit.brightness > (DARKEST_GREY if background.shown else MIN_MODULATION))
        )
        return inside, fit


class TwoCarriers(MeasurementModel):
    """Crossed fringes of a ``family`` (default: the rig's own), one frame; or three frames of the
    rig, of which the carrier ``moved`` is shifted. Raises `PredictionError` where carriers hardly
    change with depth."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings | None = None,
        family: Crossed | None = None,
        moved: int | None = None,
    ) -> None:
        self.family = family or rig.crossed or Crossed.of_pair(rig)
        rig.check_sampling()
        seen_px = max(rig.image_px_of_carrier(cycles) for cycles in self.family.cycles_per_px)
        frames = (1, "crossed frame") if moved is None else (CROSSED_FRAMES, "crossed frames")
        super().__init__(rig, settings or Settings(), seen_px, frames)
        self.moved = moved
        self.carriers = Carriers.of(self.rig, self.family)
        self.period_px = self.carriers.period_px
        self.stride = stride_of(self.period_px)
        self.demodulator = Demodulator(self.carriers, self.stride)
        self._scenes = [CrossedEmptyScene(self.carriers, self.stride)]
        if moved is None:
            return
        shifted = self.family.shifts_deg[:CROSSED_FRAMES]
        self.shifts_rad = [float(np.radians(pair[moved])) for pair in shifted]
        standoff = self.carriers.nearness(self.rig.standoff_m * MM_PER_M)
        self._standoff_rad = self.carriers.phases(standoff)[moved].astype(np.float32)
        near_q, far_q = (
            float(np.median(self.carriers.nearness(end))) for end in self.rig.working_range_mm
        )
        span = float(np.median(np.abs(self.carriers.gain[moved]))) * abs(near_q - far_q)
        if not span >= LEAST_RANGE_RAD:
            raise PredictionError(
                f"crossed --frames {CROSSED_FRAMES}: over the working range the carrier that the "
                f"frames shift changes "
                f"by {span:.2g} rad, too little for a depth; shift the other carrier"
            )
        for pair in shifted[1:]:
            carriers = Carriers.of(self.rig, replace(self.family, shifts_deg=(pair,)))
            self._scenes.append(CrossedEmptyScene(carriers, self.stride))

    @cached_property
    def captured_carriers(self) -> Carriers:
        """The carriers of the captured images."""
        return Carriers.of(self.resampling.captured, self.family)

    def observe(self, image: Frames, mask: Mask | None = None) -> CrossedObservation:
        """Mask and both phases of one crossed frame, uint8 (H, W) or float32 grey levels of the
        same range, or of three. ``mask`` bool (H, W) replaces the object mask that is found. Raises
        `DecodeError` for another number, dtype or shape."""
        greys, moved = [grey.astype(np.float32) for grey in self.images(image)], self.moved
        grey, period_px, stride = greys[0], self.period_px, self.stride
        if moved is not None:
            fitted = wrapped_phase(greys, self.shifts_rad, np.float32)
            own_phase, own_modulation, grey = (np.asarray(values, np.float32) for values in fitted)
            # `Carriers` has the phases of the first frame.
            own_phase = wrapped(own_phase + np.float32(self.shifts_rad[0]))
        seen = self.demodulator(grey)
        pairs = zip(self._scenes, greys, strict=True)
        planes = [
            scene(frame, seen if frame is grey else self.demodulator(frame))
            for scene, frame in pairs
        ]
        background = planes[0]
        if mask is not None:
            region = self.resampling.mask(mask)
        elif not all(plane.shown for plane in planes):
            background = replace(background, share=0.0)
            modulation = (
                repeated(seen.modulation.max(axis=0), stride, grey.shape)
                if moved is None
                else own_modulation
            )
            region = modulated_region(grey, modulation, background, period_px)
        elif moved is None:
            region = object_region(background, period_px)
            region |= enclosed(region, background, period_px)
        else:
            different = differs([plane.residual for plane in planes], background.noise_grey)
            closed = first_mask(different, period_px)
            lit_grey, lit_noise = self._steadied(
                own_phase, own_modulation, background, WEAK_LIGHT_PX
            )[1:]
            region = lit_object(different, closed, lit_grey, lit_noise, background.shown, period_px)
            residual = wrapped(own_phase - self.carriers.infinity_rad[moved])
            region = continued(region, closed, different, residual)
        if mask is None:
            region = beyond_border(region, period_px)
        crop = crop_around(region, int(np.ceil(MARGIN_PERIODS * period_px)), stride)
        background, inside = replace(background, residual=background.residual[crop]), region[crop]
        grid = tuple(slice(part.start // stride, -(-part.stop // stride)) for part in crop)
        beyond = np.zeros_like(inside)
        if mask is None and moved is None:
            faint = seen.modulation[:, *grid].max(axis=0) < FAINT_SIGMAS * self.demodulator.noise(
                background.noise_grey
            )
            dark = unlit(grey[crop], background, period_px, UNLIT_PX)
            inside = lit_part(inside, dark | repeated(faint, stride, inside.shape))
            beyond = dark & self._scenes[0].beyond[crop]
        carriers = self.carriers.at(crop)
        points, mean_grey = (
            inside[::stride, ::stride],
            seen.mean_grey[grid] - background.ambient_grey,
        )
        phases, modulation = self.demodulator.phases_at(seen, carriers), seen.modulation[:, *grid]
        if moved is None:
            whole = repeated(modulation[..., *nearest_inside(points)], stride, (2, *inside.shape))
        else:
            own = own_phase[crop], own_modulation[crop]
            phases[moved], own_grey, _ = self._steadied(
                *own, background, WEAK_PHASE_PX, inside, crop
            )
            modulation[moved] = own_grey[::stride, ::stride]
            whole = repeated(modulation, stride, (2, *inside.shape))
            whole[moved] = own_grey
        return CrossedObservation(
            rig=self.rig,
            period_px=period_px,
            range_mm=self.range_mm,
            stride=stride if moved is None else 1,
            shape=grey.shape,
            crop=crop,
            greys=tuple(frame[crop] for frame in greys),
            background=background,
            inside=inside,
            given=mask is not None,
            beyond=beyond,
            carriers=carriers,
            moved=moved,
            grey=grey[crop],
            phase_rad=phases,
            point_phase_rad=seen.phase_rad[:, *grid] if moved is None else phases,
            modulation=whole,
            contrast=self._contrast(modulation, mean_grey, points),
        )

    def _steadied(
        self,
        phase_rad: Image,
        modulation: Image,
        background: Background,
        sigma_px: float,
        inside: Mask | None = None,
        crop: Crop = EVERYWHERE,
    ) -> tuple[Image, Image, Image]:
        """`steadied` phase and modulation of the shifted carrier."""
        noise_grey = modulation_noise_grey(self.shifts_rad, background.noise_grey)
        whole = np.ones(phase_rad.shape, bool) if inside is None else inside
        return steadied(
            phase_rad, modulation, self._standoff_rad[crop], noise_grey, whole, sigma_px
        )

    def _contrast(self, modulation: Image, mean_grey: Image, points: Mask) -> tuple[float, float]:
        """Modulation over mean of both carriers on the object; as projected where too little of it
        is seen."""
        reach = 2 * max(1, round(CONTRAST_RIM_PERIODS * self.period_px / self.stride)) + 1
        inner = cv2.erode(points.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0  # type: ignore[call-overload]
        inner &= mean_grey > MIN_MODULATION
        if not inner.any():
            return self.carriers.family.weights
        shares = np.median(modulation[:, inner] / mean_grey[inner], axis=1)
        least, most = (
            np.float32(LEAST_CARRIER_CONTRAST),
            np.asarray(self.carriers.family.weights, np.float32),
        )
        first, second = np.clip(shares, least, most).tolist()
        return first, second
