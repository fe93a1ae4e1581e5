"""The route itself: fringe -> mask and phase -> candidates -> order -> calibration layer -> depth."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase import confidence, orders, several_frames
from fpp_ml_bench.baselines.phase.calibration_layer import CalibrationLayer, Candidates, Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.continuity import margin_by_range
from fpp_ml_bench.baselines.phase.local_fit import (
    CURVED,
    FringeFit,
    Window,
    carrier_fit,
    fringe_fit,
    measured_contrast,
    phase_slopes,
)
from fpp_ml_bench.baselines.phase.object_mask import (
    DARKEST_GREY,
    RING_PERIODS,
    Background,
    Crop,
    EmptyScene,
    explained,
    modulated_region,
    object_region,
    refined,
    unlit,
)
from fpp_ml_bench.baselines.phase.observation import Capture, Measurement, Observation, Reason, Settings, Watch
from fpp_ml_bench.baselines.phase.resampling import Periods, Resampling
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.decode import grey_levels
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.rig import Rig

Frames = NDArray[np.uint8] | Sequence[NDArray[np.uint8]]

MARGIN_PERIODS = 0.5  # of the crop around the object: covers the windows, and the mask may grow into it
HALF_CONFIDENCE_MM = 5.0  # expected error of a pixel whose confidence is a half
FRINGE_NOISE = 0.03  # uncertainty of a fringe extrapolated beyond its window, as a share of its brightness
CONTRAST_ROUNDS, FREE_ROUNDS = 3, 2  # fits that measure the contrast of the fringes, and that use it
PAIR_ROUNDS = 2  # fits to two frames over the small window
MOST_SLACK_PERIODS = 0.07
"""Largest slack of the working range, in periods at its middle: 17 mm of the paper's rig, whose `Settings.slack_mm` is
15, and 4 mm of a rig whose period is 57 mm deep, where 15 mm would let almost every pixel have a second order."""


class PhaseRoute:
    """The route for one rig and one fringe direction; ``chooser`` decides the orders (default: without learning).
    Images whose fringe period is beyond ``periods`` are resampled: then `rig`, `layer` and `period_px` are those of the
    resampled images, which an `Observation` is of; images, masks and the `Measurement` have the captured size."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings | None = None,
        chooser: orders.Chooser = orders.by_shading_and_smoothness,
        periods: Periods | None = None,
    ) -> None:
        settings, self.chooser = settings or Settings(), chooser
        rig.check_sampling()
        self.resampling = Resampling.of(rig, settings.direction, periods or Periods())
        self.captured_layer = self.layer = CalibrationLayer.of(rig, settings.direction)
        self.rig = rig = self.resampling.rig
        if self.resampling.needed:
            self.layer = CalibrationLayer.of(rig, settings.direction)
        (near, far), periods_in_range = rig.working_range_mm, rig.periods_in_range(settings.direction)
        most_slack_mm = MOST_SLACK_PERIODS * (far - near) / periods_in_range if periods_in_range > 0 else np.inf
        self.settings = settings = replace(settings, slack_mm=min(settings.slack_mm, most_slack_mm))
        self.period_px = rig.image_px_per_period(settings.direction)
        self._scene = EmptyScene(rig, self.layer, self.period_px, settings.white_grey, settings.ambient_grey)
        self._carrier = np.nan_to_num(self.layer.absolute_phase(rig.standoff_m * MM_PER_M)).astype(np.float32)
        self._windows = [Window(share * self.period_px) for share in (settings.first_window, settings.second_window)]
        shifts_rad = rig.shifts_rad(settings.direction)
        self.steps = several_frames.steps_of(len(shifts_rad), settings.frames)
        self.shifts_rad = tuple(shifts_rad[step] for step in self.steps)
        if settings.frames == 2:
            self._windows += [Window(settings.pair_window * self.period_px)] * PAIR_ROUNDS

    def measure(self, image: Frames, mask: Mask | None = None) -> Measurement:
        """Depth and the maps behind it, from one captured fringe, uint8 (H, W), or from the frames of ``steps``.
        ``mask`` bool (H, W) replaces the route's own object mask. Raises `DecodeError` for another dtype or shape."""
        observation = self.observe(image, mask)
        return self.conclude(observation, *self.choose(observation))

    def observe(self, image: Frames, mask: Mask | None = None) -> Observation:
        """Mask, phase and candidate orders of captured fringes; arguments as of `measure`."""
        images = [self.resampling.image(frame) for frame in self._checked(image)]
        watch = Watch()
        background = self._scene.fit(images[0])
        watch.done("background")
        if mask is not None:
            region = self.resampling.mask(mask)
        elif background.shown:
            region = object_region(background, self.period_px)
        else:
            region = self._modulated(images[0].astype(np.float32), background)
        crop = self._crop(region)
        watch.done("mask")
        greys = tuple(frame[crop].astype(np.float32) for frame in images)
        plane, layer = replace(background, residual=background.residual[crop]), self.layer.at(crop)
        capture = Capture(self.rig, self.period_px, images[0].shape, crop, greys, self.shifts_rad, plane, layer, watch)
        if capture.pixelwise:
            given = None if mask is None else region[crop]
            inside, fit, mean_grey = several_frames.pixel_fits(capture, self._scene, given, self._windows[1])
        else:
            inside, fit = self._local_fits(capture, region[crop], given=mask is not None)
        phase = wrapped(fit.phase_rad).astype(np.float32)
        residual = wrapped(phase - capture.layer.infinity_rad).astype(np.float32)
        slopes = phase_slopes(residual, inside, self.settings.slope_window * self.period_px)
        (near, far), slack = self.rig.working_range_mm, self.settings.slack_mm
        candidates = capture.layer.orders_in_range(phase, (near - slack, far + slack))
        watch.done("candidates")
        if capture.pixelwise:
            uncertainty = confidence.pixel_uncertainty_rad(capture, fit, mean_grey)
        else:
            uncertainty = confidence.fit_uncertainty_rad(capture, fit, inside, slopes, self._windows[-1])
        clipped = confidence.clipped_share(capture, fit, inside, self._windows[1])
        watch.done("confidence")
        return Observation(
            **vars(capture),
            inside=inside,
            fit=fit,
            phase_rad=phase,
            slopes=slopes,
            uncertainty_rad=uncertainty,
            clipped_share=clipped,
            candidates=candidates,
        )

    def choose(self, observation: Observation) -> tuple[NDArray[np.int32], Image]:
        """The chooser's order of every pixel of the observation's crop (h, w), and its margin."""
        question = orders.question_of(observation)
        observation.watch.done("candidates")
        choice, margin = self.chooser(question, self.rig, self.settings)
        chosen_rad = orders.chosen_values(question.residual_rad, choice)
        return orders.spread_over_pixels(observation, chosen_rad, margin, question.inside)

    def conclude(
        self,
        observation: Observation,
        order: NDArray[np.int32],
        margin: NDArray[np.floating],
        least_margin: float = -np.inf,
    ) -> Measurement:
        """The measurement that follows from an ``order`` int32 for each pixel of the observation's crop (h, w);
        ``margin`` (h, w): how clearly that order won, 0 for a tie, 1 or more for a clear choice (see `orders.Chooser`).
        A pixel of less than ``least_margin`` has no depth, as always a tie in light that nothing calibrates. Raises
        `DecodeError` for shapes that are not the crop's."""
        inside, watch = observation.inside, observation.watch
        if np.shape(order) != inside.shape or np.shape(margin) != inside.shape:
            raise DecodeError(
                f"expected an order and a margin for each of the {inside.shape} pixels (h, w) around the object, got "
                f"{np.shape(order)} and {np.shape(margin)}"
            )
        if not observation.background.calibrated:  # no evidence about the order, whatever the chooser preferred
            margin = margin_by_range(observation, order)
        watch.done("order")
        depth_mm = np.where(inside, observation.layer.depth_mm(observation.phase_rad, order), 0.0)
        depth_mm[~observation.rig.in_range(depth_mm)] = 0.0
        watch.done("depth")
        error_mm, doubt_mm = confidence.expected_error_mm(observation, margin, depth_mm)
        sureness = (1 / (1 + error_mm / HALF_CONFIDENCE_MM)).astype(np.float32)
        reason = confidence.reasons(observation, margin, sureness, depth_mm, self.settings)
        if not observation.background.calibrated:
            depth_mm[margin == 0] = 0.0  # a guess
        depth_mm[margin < least_margin] = 0.0
        watch.done("confidence")

        def paste(part: NDArray, dtype: type, outside: float) -> NDArray:
            image: NDArray = np.full(observation.shape, outside, dtype=dtype)
            image[observation.crop] = np.where(inside, part, outside)
            return image

        least, allowed = self.settings.min_confidence, observation.candidates
        reasons = paste(reason, np.uint8, Reason.BACKGROUND)
        counts = np.bincount(reasons.ravel(), minlength=len(Reason))
        measurement = Measurement(
            wrapped_phase_rad=paste(observation.phase_rad, np.float32, np.nan),
            modulation_grey=paste(observation.fit.brightness, np.float32, 0),
            order=paste(order, np.int32, 0),
            candidates=Candidates(paste(allowed.first, np.int32, 0), paste(allowed.count, np.int32, 0)),
            confidence=paste(sureness, np.float32, 0),
            expected_error_mm=paste(error_mm, np.float32, 0),
            order_doubt_mm=paste(doubt_mm, np.float32, 0),
            depth_mm=paste(depth_mm if least == 0 else depth_mm * (sureness >= least), np.float32, 0),
            reason=reasons,
            counts={code.name.lower(): int(counts[code]) for code in Reason},
            background_share=observation.background.share,
            seconds=watch.seconds,
        )
        if self.resampling.needed:
            (near, far), slack = self.rig.working_range_mm, self.settings.slack_mm
            layers = self.layer, self.captured_layer
            measurement = self.resampling.restored(measurement, *layers, (near - slack, far + slack))
        watch.done("depth")
        return measurement

    def _checked(self, image: Frames) -> list[NDArray[np.uint8]]:
        """The frames, as many as the settings say."""
        given = [image] if isinstance(image, np.ndarray) and image.ndim == 2 else list(image)
        images = [grey_levels(frame) for frame in given]
        captured = self.resampling.captured.camera
        shape = (captured.height, captured.width)
        if len(images) != len(self.steps):
            raise DecodeError(f"expected {len(self.steps)} fringes, those of steps {self.steps}, got {len(images)}")
        for frame in images:
            if frame.dtype != np.uint8 or frame.shape != shape:
                raise DecodeError(
                    f"expected a fringe of uint8 grey levels, shape (H, W) = {shape} of the rig's camera, got "
                    f"{frame.dtype} {frame.shape}; use rig.scaled(width) for a resized image"
                )
        return images

    def _crop(self, region: Mask) -> Crop:
        left, top, width, height = cv2.boundingRect(region.astype(np.uint8))
        if not width:
            return slice(0, 1), slice(0, 1)
        pad = int(np.ceil(MARGIN_PERIODS * self.period_px))
        rows = slice(max(top - pad, 0), min(top + height + pad, region.shape[0]))
        return rows, slice(max(left - pad, 0), min(left + width + pad, region.shape[1]))

    def _local_fits(self, capture: Capture, region: Mask, given: bool) -> tuple[Mask, FringeFit]:
        """Object mask and local fits of one or two frames, each window starting from the phase of the last; ``region``:
        where the first frame differs, or the ``given`` mask."""
        greys, background, watch, inside = capture.greys, capture.background, capture.watch, region
        if not given:
            dark = unlit(np.maximum.reduce(greys), background, self.period_px)
            if len(greys) > 1:
                misfits = several_frames.plane_misfits(capture, self._scene)
                different = several_frames.differs(misfits, background.noise_grey)
                differs = several_frames.first_mask(different, self.period_px)
                region = differs if background.shown else region & differs
            inside = region & ~dark
            watch.done("mask")
        phase, _ = carrier_fit(greys[0], inside, self._carrier[capture.crop], self._windows[0])
        for window in self._windows[1:]:
            fit = fringe_fit(greys, inside, phase, background.ambient_grey, window, capture.shifts_rad)
            phase = fit.phase_rad
        if not background.calibrated:
            inside, fit = self._free_fits(capture, inside, fit, given)
        watch.done("phase")
        if given:
            return inside, fit
        if len(greys) == 1:
            bright = np.maximum(fit.brightness, 0)
            predicted = (background.ambient_grey + fit.light).astype(np.float32)
            reach_px = RING_PERIODS * self.period_px
            inside = refined(inside, background, predicted, greys[0], FRINGE_NOISE * bright, reach_px)
        inside = inside & ~dark & (fit.brightness > (DARKEST_GREY if background.shown else MIN_MODULATION))
        watch.done("mask")
        return inside, fit

    def _free_fits(self, capture: Capture, inside: Mask, fit: FringeFit, given: bool) -> tuple[Mask, FringeFit]:
        """Object mask and fits to fringes of any contrast on surfaces of any brightness, after a ``fit`` that assumes
        full contrast: its contrast is measured, then the fits start again, because a fit keeps the ripple of the phase
        that it starts from."""
        grey, ambient = capture.greys[0], capture.background.ambient_grey
        for _ in range(CONTRAST_ROUNDS):
            if not given:
                inside = inside & explained(grey, np.float32(ambient) + fit.light, ambient, self.period_px)
            contrast = measured_contrast(grey - np.float32(ambient), inside, fit)
            light = ambient, self._windows[0], capture.shifts_rad, contrast, CURVED
            fit = fringe_fit(capture.greys, inside, fit.phase_rad, *light)
        phase, _ = carrier_fit(grey, inside, self._carrier[capture.crop], self._windows[0])
        for _ in range(FREE_ROUNDS):
            fit = fringe_fit(capture.greys, inside, phase, *light)
            phase = fit.phase_rad
        return inside, fit

    def _modulated(self, grey: Image, background: Background) -> Mask:
        """First mask (H, W) of an image that shows no known background."""
        everywhere = np.ones(grey.shape, bool)
        _, modulation = carrier_fit(grey, everywhere, self._carrier, self._windows[0])
        return modulated_region(grey, modulation, background, self.period_px)
