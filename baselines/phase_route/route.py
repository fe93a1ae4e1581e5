"""The route itself: fringe -> mask and phase -> candidates -> order -> calibration layer -> depth.

Each stage is a function in a module of its own; this module passes arrays from stage to stage and times the stages.
What depends on the rig alone is computed once.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import confidence, orders
from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer, Candidates, orders_in_range
from fpp_ml_bench.baselines.phase_route.empty_scene import Background, EmptyScene
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit, Window, carrier_fit
from fpp_ml_bench.baselines.phase_route.measurement import Measurement, Reason
from fpp_ml_bench.baselines.phase_route.object_mask import DARKEST_GREY, object_region, refined, unlit
from fpp_ml_bench.baselines.phase_route.observation import Crop, Observation, Stopwatch
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.phase_route.several_frames import (
    PIXELWISE,
    differs,
    first_mask,
    measure_pixels,
    pair_fit,
    pixel_uncertainty_rad,
    steps_of,
)
from fpp_ml_bench.baselines.phase_route.shading import phase_slopes, wrapped
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import Rig

Image = NDArray[np.float32]
Frames = NDArray[np.uint8] | Sequence[NDArray[np.uint8]]

MARGIN_PERIODS = 0.5
"""Of the crop around the object: covers the windows, and the mask may grow into it."""
RING_PERIODS = 0.14
"""Distance from the first mask's silhouette within which a pixel may change between object and background."""
FRINGE_NOISE = 0.03
"""Uncertainty of a fringe extrapolated beyond its window, as a share of its brightness."""
PAIR_ROUNDS = 2
"""Fits to two frames over the small window."""


class PhaseRoute:
    """The route for one rig and one fringe direction; ``chooser`` decides the orders (default: without learning)."""

    def __init__(
        self, rig: Rig, settings: Settings | None = None, chooser: orders.Chooser = orders.by_shading_and_smoothness
    ) -> None:
        self.rig, self.settings, self.chooser = rig, settings or Settings(), chooser
        direction = self.settings.direction
        self.layer = CalibrationLayer.of(rig, direction)
        self.period_px = rig.image_px_per_period(direction)
        rig.check_sampling()
        self._scene = EmptyScene(rig, self.layer, self.period_px, self.settings.white_grey, self.settings.ambient_grey)
        self._carrier = np.nan_to_num(self.layer.absolute_phase(rig.standoff_m * MM_PER_M)).astype(np.float32)
        self._windows = [
            Window(share * self.period_px) for share in (self.settings.first_window, self.settings.second_window)
        ]
        self.steps = steps_of(rig.sequence.steps, self.settings.frames)
        self.shifts_rad = tuple(2 * np.pi * n / rig.sequence.steps for n in self.steps)
        if self.settings.frames == 2:
            self._windows += [Window(self.settings.pair_window * self.period_px)] * PAIR_ROUNDS

    def measure(self, image: Frames, mask: NDArray[np.bool_] | None = None) -> Measurement:
        """Depth and the maps behind it, from one captured fringe, uint8 (H, W), or from the frames of ``steps``.

        ``mask`` bool (H, W) replaces the route's own object mask. Raises `DecodeError` for another dtype or shape.
        """
        observation = self.observe(image, mask)
        choice, margin = self.chooser(observation.question, self.rig, self.settings)
        order, margin = orders.spread_over_pixels(
            observation.question, choice, margin, observation.layer.residual_phase(observation.phase_rad, 0.0)
        )
        return self.conclude(observation, order, margin)

    def observe(self, image: Frames, mask: NDArray[np.bool_] | None = None) -> Observation:
        """Mask, phase and candidate orders of captured fringes; arguments as of `measure`."""
        images = self._checked(image)
        watch = Stopwatch()
        background = self._scene.fit(images[0])
        watch.done("background")
        region = object_region(background, self.period_px) if mask is None else mask
        crop = self._crop(region)
        watch.done("mask")
        greys = [frame[crop].astype(np.float32) for frame in images]
        crop_mask = None if mask is None else mask[crop]
        layer = self.layer.at(crop)
        mean_grey = None
        if len(greys) < PIXELWISE:
            inside, fit = self._local_fits(greys, region[crop], crop_mask, background, crop, watch)
        else:
            inside, fit, mean_grey = measure_pixels(
                greys, self.shifts_rad, crop_mask, self._scene, background, crop, self._windows[1], self.period_px,
                watch,
            )  # fmt: skip
        phase = wrapped(fit.phase_rad).astype(np.float32)
        residual = wrapped(phase - layer.infinity_rad).astype(np.float32)
        slopes = phase_slopes(residual, inside, self.settings.slope_window * self.period_px)
        near, far = self.rig.working_range_mm
        slack = self.settings.slack_mm
        candidates = orders_in_range(layer, phase, (near - slack, far + slack))
        question = orders.question_of(
            phase, fit, slopes, candidates, inside, layer, self.rig, crop, background.strength, self.period_px,
            sharp=mean_grey is not None,
        )  # fmt: skip
        watch.done("candidates")
        if mean_grey is None:
            uncertainty = confidence.phase_uncertainty_rad(greys[0], fit, inside, slopes, background, self._windows[-1])
        else:
            uncertainty = pixel_uncertainty_rad(fit, mean_grey, self.shifts_rad, background)
        clipped = confidence.clipped_share(greys, fit, inside, self._windows[1])
        watch.done("confidence")
        shape = images[0].shape
        return Observation(
            (shape[0], shape[1]), crop, len(greys), background, greys[0], inside, layer, fit, phase, residual, slopes,
            uncertainty, clipped, candidates, question, watch,
        )  # fmt: skip

    def _checked(self, image: Frames) -> list[NDArray[np.uint8]]:
        """The frames, as many as the settings say."""
        images = [image] if isinstance(image, np.ndarray) and image.ndim == 2 else list(image)
        shape = (self.rig.camera.height, self.rig.camera.width)
        if len(images) != len(self.steps):
            raise DecodeError(f"expected {len(self.steps)} fringes, those of steps {self.steps}, got {len(images)}")
        for frame in images:
            if np.asarray(frame).dtype != np.uint8 or np.shape(frame) != shape:
                raise DecodeError(
                    f"expected a fringe of uint8 grey levels, shape (H, W) = {shape} of the rig's camera, got "
                    f"{np.asarray(frame).dtype} {np.shape(frame)}; use rig.scaled(width) for a resized image"
                )
        return images

    def conclude(self, observation: Observation, order: NDArray[np.int32], margin: NDArray[np.floating]) -> Measurement:
        """The measurement that follows from an ``order`` int32 for each pixel of the observation's crop (h, w);
        ``margin`` (h, w): how clearly that order won, 0 for a tie, 1 or more for a clear choice (see `orders.Chooser`).

        Raises `DecodeError` for shapes that are not the crop's."""
        if np.shape(order) != observation.inside.shape or np.shape(margin) != observation.inside.shape:
            raise DecodeError(
                f"expected an order and a margin for each of the {observation.inside.shape} pixels (h, w) around the "
                f"object, got {np.shape(order)} and {np.shape(margin)}"
            )
        observation.watch.done("order")
        depth_mm = np.where(observation.inside, observation.layer.depth_mm(observation.phase_rad, order), 0.0)
        depth_mm[~(np.isfinite(depth_mm) & (depth_mm > 0))] = 0.0
        observation.watch.done("depth")
        error_mm, doubt_mm = confidence.expected_error_mm(observation, margin, depth_mm)
        confidence_map = confidence.confidence_of(error_mm)
        reason = confidence.reasons(
            observation, margin, confidence_map, depth_mm, self.rig, self.settings, self.period_px
        )
        observation.watch.done("confidence")
        return self._full_image(observation, order, confidence_map, error_mm, doubt_mm, depth_mm, reason)

    def _local_fits(
        self, greys: Sequence[Image], region: NDArray[np.bool_], mask: NDArray[np.bool_] | None, background: Background,
        crop: Crop, watch: Stopwatch,
    ) -> tuple[NDArray[np.bool_], FringeFit]:  # fmt: skip
        """Object mask and local fits of one or two frames; ``region``: where the first of them differs."""
        if mask is not None:
            fit = self.fit_phase(greys, mask, self._carrier[crop], background)
            watch.done("phase")
            return mask, fit
        dark = unlit(np.maximum.reduce(greys), background.ambient_grey, background.noise_grey, self.period_px)
        if len(greys) > 1:
            region = first_mask(differs(greys, self.shifts_rad, self._scene, background, crop), self.period_px)
        inside = region & ~dark
        watch.done("mask")
        fit = self.fit_phase(greys, inside, self._carrier[crop], background)
        watch.done("phase")
        if len(greys) == 1:
            inside = self._refine(greys[0], inside, fit, background, crop)
        inside = inside & ~dark & (fit.brightness > DARKEST_GREY)
        watch.done("mask")
        return inside, fit

    def fit_phase(
        self, greys: Sequence[Image], inside: NDArray[np.bool_], carrier: NDArray, background: Background
    ) -> FringeFit:
        """The local fits to one or two frames; arrays (h, w) of one part of the image."""
        first = carrier_fit(greys[0], inside, carrier, self._windows[0])
        return pair_fit(greys, self.shifts_rad, inside, first, background.ambient_grey, self._windows[1:])

    def _crop(self, region: NDArray[np.bool_]) -> Crop:
        rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
        if not rows.size:
            return slice(0, 1), slice(0, 1)
        pad = int(np.ceil(MARGIN_PERIODS * self.period_px))
        height, width = region.shape
        return (
            slice(max(int(rows[0]) - pad, 0), min(int(rows[-1]) + pad + 1, height)),
            slice(max(int(columns[0]) - pad, 0), min(int(columns[-1]) + pad + 1, width)),
        )

    def _refine(
        self, grey: NDArray[np.float32], inside: NDArray[np.bool_], fit: FringeFit, background: Background, crop: Crop
    ) -> NDArray[np.bool_]:
        bright = np.maximum(fit.brightness, 0)
        predicted = background.ambient_grey + bright * (1 + np.cos(fit.phase_rad))
        part = Background(
            background.ambient_grey, background.strength, background.noise_grey, background.residual[crop],
            background.share,
        )  # fmt: skip
        return refined(
            inside, part, predicted.astype(np.float32), grey, FRINGE_NOISE * bright, RING_PERIODS * self.period_px
        )

    def _full_image(
        self, observation: Observation, order: NDArray[np.int32], confidence_map: NDArray, error_mm: NDArray,
        doubt_mm: NDArray, depth_mm: NDArray, reason: NDArray[np.uint8],
    ) -> Measurement:  # fmt: skip
        """Maps of the whole image from those of the crop."""

        def paste(part: NDArray, dtype: type, outside: float) -> NDArray:
            image: NDArray = np.full(observation.shape, outside, dtype=dtype)
            image[observation.crop] = np.where(observation.inside, part, outside)
            return image

        least = self.settings.min_confidence
        masked_mm = depth_mm if least == 0 else depth_mm * (confidence_map >= least)
        reasons = paste(reason, np.uint8, Reason.BACKGROUND)
        counts = np.bincount(reasons.ravel(), minlength=len(Reason))
        allowed = observation.candidates
        measurement = Measurement(
            wrapped_phase=paste(observation.phase_rad, np.float32, np.nan),
            modulation=paste(observation.fit.brightness, np.float32, 0),
            order=paste(order, np.int32, 0),
            candidates=Candidates(paste(allowed.first, np.int32, 0), paste(allowed.count, np.int32, 0)),
            confidence=paste(confidence_map, np.float32, 0),
            expected_error_mm=paste(error_mm, np.float32, 0),
            order_doubt_mm=paste(doubt_mm, np.float32, 0),
            depth_mm=paste(masked_mm, np.float32, 0),
            reason=reasons,
            counts={code.name.lower(): int(counts[code]) for code in Reason},
            background_share=observation.background.share,
            seconds=observation.watch.seconds,
        )
        observation.watch.done("depth")
        return measurement
