"""The route itself: fringe -> mask and phase -> candidates -> order -> calibration layer -> depth.

Each stage is a function of its own module; this one hands arrays from one to the next, and times them. What depends on
the rig alone is made once.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase_route import confidence, orders
from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer, Candidates, orders_in_range
from fpp_ml_bench.baselines.phase_route.empty_scene import Background, EmptyScene
from fpp_ml_bench.baselines.phase_route.local_fit import FringeFit, Window, carrier_fit, fringe_fit
from fpp_ml_bench.baselines.phase_route.measurement import Measurement, Reason
from fpp_ml_bench.baselines.phase_route.object_mask import object_region, refined, unlit
from fpp_ml_bench.baselines.phase_route.observation import Crop, Observation, Stopwatch
from fpp_ml_bench.baselines.phase_route.settings import Settings
from fpp_ml_bench.baselines.phase_route.shading import phase_slopes, wrapped
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decode_blocks import MIN_MODULATION
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.rig import Rig

MARGIN_PERIODS = 0.5
"""Of the crop around the object: no window is needed beyond, the mask may grow into it."""
RING_PERIODS = 0.14
"""How far from the first mask's silhouette a pixel may change sides."""
FRINGE_NOISE = 0.03
"""Uncertainty of a fringe carried on beyond its window, as a share of its brightness."""

DARKEST_GREY = MIN_MODULATION / 4
"""What is object and darker than this has no fringe at all: it lies in shadow or faces away, and gets no depth."""


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

    def measure(self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Measurement:
        """Depth and all that it came from, of one captured fringe, uint8 (H, W).

        ``mask`` bool (H, W) replaces the route's own object mask. Raises `DecodeError` for another dtype or shape.
        """
        seen = self.observe(image, mask)
        choice, margin = self.chooser(seen.question, self.rig, self.settings)
        order, margin = orders.spread_over_pixels(
            seen.question, choice, margin, seen.layer.residual_phase(seen.phase_rad, 0.0)
        )
        return self.conclude(seen, order, margin)

    def observe(self, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None) -> Observation:
        """Mask, phase and candidate orders of one captured fringe, uint8 (H, W); arguments as of `measure`."""
        shape = (self.rig.camera.height, self.rig.camera.width)
        if np.asarray(image).dtype != np.uint8 or np.shape(image) != shape:
            raise DecodeError(
                f"expected a fringe of uint8 grey levels, shape (H, W) = {shape} of the rig's camera, got "
                f"{np.asarray(image).dtype} {np.shape(image)}; use rig.scaled(width) for a resized image"
            )
        watch = Stopwatch()
        background = self._scene.fit(image)
        watch.done("background")
        region = object_region(background, self.period_px) if mask is None else mask
        crop = self._crop(region)
        grey, inside = image[crop].astype(np.float32), region[crop]
        if mask is None:
            dark = unlit(grey, background.ambient_grey, background.noise_grey, self.period_px)
            inside = inside & ~dark
        watch.done("mask")
        layer = self.layer.at(crop)
        fit = self.fit_phase(grey, inside, self._carrier[crop], background)
        watch.done("phase")
        if mask is None:
            inside = self._refine(grey, inside, fit, background, crop)
            inside &= ~dark & (fit.brightness > DARKEST_GREY)
            watch.done("mask")
        phase = wrapped(fit.phase_rad).astype(np.float32)
        residual = wrapped(phase - layer.infinity_rad).astype(np.float32)
        slopes = phase_slopes(residual, inside, self.settings.slope_window * self.period_px)
        near, far = self.rig.working_range_mm
        slack = self.settings.slack_mm
        candidates = orders_in_range(layer, phase, (near - slack, far + slack))
        question = orders.ask(
            phase, fit, slopes, candidates, inside, layer, self.rig, crop, background.strength, self.period_px
        )
        watch.done("candidates")
        window = self._windows[1]
        uncertainty = confidence.phase_uncertainty_rad(grey, fit, inside, slopes, background, window)
        clipped = confidence.clipped_share(grey, fit, inside, window)
        watch.done("confidence")
        return Observation(
            shape, crop, background, grey, inside, layer, fit, phase, residual, slopes, uncertainty, clipped,
            candidates, question, watch,
        )  # fmt: skip

    def conclude(self, seen: Observation, order: NDArray[np.int32], margin: NDArray[np.floating]) -> Measurement:
        """The measurement that an ``order`` int32 for each pixel of the observation's crop (h, w) makes of it;
        ``margin`` (h, w): how clearly that order won, 0 a tie, 1 or more beyond doubt (see `orders.Chooser`).

        Raises `DecodeError` for shapes that are not the crop's."""
        if np.shape(order) != seen.inside.shape or np.shape(margin) != seen.inside.shape:
            raise DecodeError(
                f"expected an order and a margin for each of the {seen.inside.shape} pixels (h, w) around the object, "
                f"got {np.shape(order)} and {np.shape(margin)}"
            )
        seen.watch.done("order")
        depth_mm = np.where(seen.inside, seen.layer.depth_mm(seen.phase_rad, order), 0.0)
        depth_mm[~(np.isfinite(depth_mm) & (depth_mm > 0))] = 0.0
        seen.watch.done("depth")
        error_mm = confidence.expected_error_mm(seen, margin, depth_mm)
        sure = confidence.confidence_of(error_mm)
        reason = confidence.reasons(seen, margin, sure, self.settings, self.period_px)
        seen.watch.done("confidence")
        return self._whole(seen, order, sure, error_mm, depth_mm, reason)

    def fit_phase(
        self, grey: NDArray[np.float32], inside: NDArray[np.bool_], carrier: NDArray, background: Background
    ) -> FringeFit:
        """Both local fits; arrays (h, w) of one part of the image."""
        first = carrier_fit(grey, inside, carrier, self._windows[0])
        return fringe_fit(grey, inside, first, background.ambient_grey, self._windows[1])

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

    def _whole(
        self, seen: Observation, order: NDArray[np.int32], sure: NDArray, error_mm: NDArray, depth_mm: NDArray,
        reason: NDArray[np.uint8],
    ) -> Measurement:  # fmt: skip
        """Maps of the whole image from those of the crop."""

        def paste(part: NDArray, dtype: type, outside: float) -> NDArray:
            whole: NDArray = np.full(seen.shape, outside, dtype=dtype)
            whole[seen.crop] = np.where(seen.inside, part, outside)
            return whole

        kept = depth_mm if self.settings.min_confidence == 0 else depth_mm * (sure >= self.settings.min_confidence)
        reasons = paste(reason, np.uint8, Reason.BACKGROUND)
        counts = np.bincount(reasons.ravel(), minlength=len(Reason))
        allowed = seen.candidates
        measured = Measurement(
            wrapped_phase=paste(seen.phase_rad, np.float32, np.nan),
            modulation=paste(seen.fit.brightness, np.float32, 0),
            order=paste(order, np.int32, 0),
            candidates=Candidates(paste(allowed.first, np.int32, 0), paste(allowed.count, np.int32, 0)),
            confidence=paste(sure, np.float32, 0),
            expected_error_mm=paste(error_mm, np.float32, 0),
            depth_mm=paste(kept, np.float32, 0),
            reason=reasons,
            counts={one.name.lower(): int(counts[one]) for one in Reason},
            background_share=seen.background.share,
            seconds=seen.watch.seconds,
        )
        seen.watch.done("depth")
        return measured
