"""The route: frame -> both carriers -> mask -> candidates -> order -> fit of the nearness -> depth and its reasons."""

from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.carriers import Carriers
from fpp_ml_bench.baselines.phase.crossed_observation import (
    CrossedMeasurement,
    CrossedObservation,
    CrossedReason,
    Settings,
)
from fpp_ml_bench.baselines.phase.crossed_orders import Candidates, candidates, chosen, neighbours, rival
from fpp_ml_bench.baselines.phase.demodulation import Demodulated, Demodulator
from fpp_ml_bench.baselines.phase.empty_scene import EmptySceneFit
from fpp_ml_bench.baselines.phase.local_fit import Window
from fpp_ml_bench.baselines.phase.object_mask import Background, Crop, modulated_region, object_region, unlit
from fpp_ml_bench.baselines.phase.observation import Watch
from fpp_ml_bench.baselines.phase.orders import chosen_values, nearest_inside, repeated, stride_of
from fpp_ml_bench.baselines.phase.refinement import WINDOW_PERIODS, refined
from fpp_ml_bench.baselines.phase.resampling import Periods, Resampling
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding.decode import grey_levels
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.rig import Rig

MARGIN_PERIODS = 0.5  # of the crop around the object, which the windows and the mask's rim need
LEAST_CONTRAST = 0.08
CONTRAST_RIM_PERIODS = 0.5  # grid points this near to the silhouette don't measure the contrast
WELL_LIT = 8.0  # modulation over noise from which on a window's phase counts fully
LEAST_TRUST = 0.05
EVIDENCE_SCALE, MARGIN_SCALE, EVEN_ODDS = 1.0, 4.0, 0.8
"""By how much evidence and margin of energy the odds of two orders grow e-fold, and where they are even."""
LEAST_WRONG, MOST_WRONG = 0.01, 0.32
"""Chances of a wrong order between which the rival widens the stated uncertainty. Below, it lies outside of the widest
interval in use (99%). The variance of both orders together would state several mm for a chance of 0.1%, at pixels
whose error is a tenth of that."""
HALF_CONFIDENCE_MM = 5.0  # expected error of a pixel whose confidence is a half
SATURATED_SHARE = 0.02
LOST_SHARE, LOST_CHANCE = 0.25, 0.6
"""Share of a carrier's contrast below which it counts as not seen, and the least probability of a wrong order then."""
TEXTURE_SHARE = 0.35  # rms misfit over brightness of a window that shows no crossed fringe
TEXTURE_RAD = 0.5  # distance of both phases from the depth's at which something else than its fringes was seen
AMBIGUOUS_CHANCE = 0.3  # of a wrong order


class CrossedRoute:
    """The route for one rig and one family of crossed frames (default: the rig's own). Images whose fringe period is
    beyond ``periods`` are resampled: then `rig` and `carriers` are those of the resampled images, which a
    `CrossedObservation` is of; images, masks and the `CrossedMeasurement` have the captured size."""

    def __init__(
        self,
        rig: Rig,
        settings: Settings | None = None,
        family: Crossed | None = None,
        periods: Periods | None = None,
    ) -> None:
        self.settings = settings or Settings()
        self.family = family or rig.crossed or Crossed.of_pair(rig)
        rig.check_sampling()
        seen_px = max(rig.image_px_of_carrier(cycles) for cycles in self.family.cycles_per_px)
        self.resampling = Resampling.to(rig, seen_px, periods or Periods())
        self.rig = rig = self.resampling.rig
        self.carriers = Carriers.of(rig, self.family)
        self.stride = stride_of(self.carriers.period_px)
        self.demodulator = Demodulator(self.carriers, self.stride)
        self._scene = EmptySceneFit(self.carriers, self.stride)

    def measure(self, image: NDArray[np.uint8], mask: Mask | None = None) -> CrossedMeasurement:
        """Depth and the maps behind it from one crossed frame uint8 (H, W), or float32 grey levels of the same range.
        ``mask`` bool (H, W) replaces the route's own object mask. Raises `DecodeError` for another dtype or shape."""
        return self.conclude(self.observe(image, mask))

    def observe(self, image: NDArray, mask: Mask | None = None) -> CrossedObservation:
        """Mask, order and fit of a crossed frame; arguments as of `measure`."""
        grey, watch = self._checked(image), Watch()
        mask = None if mask is None else self.resampling.mask(mask)
        seen = self.demodulator(grey)
        watch.done("phase")
        background = self._scene(grey, seen)
        watch.done("background")
        period_px = self.carriers.period_px
        if mask is not None:
            region = mask
        elif background.shown:
            region = object_region(background, period_px)
        else:
            modulation = repeated(seen.modulation.max(axis=0), self.stride, grey.shape)
            region = modulated_region(grey, modulation, background, period_px)
        crop = self._crop(region)
        watch.done("mask")
        return self._observed(grey, seen, background, region, crop, mask is not None, watch)

    def _observed(
        self, image: Image, seen: Demodulated, plane: Background, region: Mask, crop: Crop, given: bool, watch: Watch
    ) -> CrossedObservation:
        grid = tuple(slice(part.start // self.stride, -(-part.stop // self.stride)) for part in crop)
        carriers, grey = self.carriers.at(crop), image[crop]
        coarse = self.carriers.at(tuple(slice(part.start, part.stop, self.stride) for part in crop))  # type: ignore[arg-type]
        background, inside = replace(plane, residual=plane.residual[crop]), region[crop]
        period_px = self.carriers.period_px
        dark = unlit(grey, background, period_px)
        if not given:
            inside = inside & ~dark
        points = inside[:: self.stride, :: self.stride]
        phases, modulation = seen.phase_rad[:, *grid], seen.modulation[:, *grid]
        contrast = self._contrast(modulation, seen.mean_grey[grid] - background.ambient_grey, points)
        found = candidates(coarse, phases, self.settings.slack_mm)
        trust = np.clip(modulation.min(axis=0) / np.float32(WELL_LIT * background.noise_grey), LEAST_TRUST, 1)
        index, margin, evidence = chosen(coarse, found, trust, points)
        beside = neighbours(found, index)
        watch.done("order")

        def spread(values: NDArray) -> NDArray:
            """Values of the grid at all pixels, each that of its grid point or of the nearest one inside."""
            return repeated(values[..., *nearest], self.stride, (*values.shape[:-2], *grey.shape))

        nearest = nearest_inside(points)
        phase_rad = self.demodulator.phases_at(seen, carriers)
        start = _lifted(carriers, phase_rad, spread(chosen_values(found.nearness, index)))
        light = grey - np.float32(background.ambient_grey)
        fit = refined(carriers, light, inside, start, contrast, background.noise_grey)
        watch.done("fit")
        if not given and not background.shown:
            inside = inside & (fit.brightness > MIN_MODULATION)
        clipped = ((grey >= GREY_LEVELS) & inside).astype(np.float32)
        clipped_share = Window(WINDOW_PERIODS * period_px).moment(clipped) / np.maximum(fit.weight, 1e-3)
        return CrossedObservation(
            carriers=carriers,
            shape=image.shape,
            grey=grey,
            background=background,
            inside=inside,
            fit=fit,
            phase_rad=phase_rad,
            modulation=spread(modulation),
            contrast=contrast,
            margin=spread(margin),
            evidence=spread(evidence),
            rival=spread(rival(found, index)),
            candidates=Candidates(spread(beside.nearness), spread(beside.misfit_rad), spread(beside.exists)),
            clipped_share=clipped_share.astype(np.float32),
            watch=watch,
        )

    def conclude(self, seen: CrossedObservation, wrong_chance: Image | None = None) -> CrossedMeasurement:
        """The measurement that follows from an observation. ``wrong_chance`` (h, w): probability of a wrong order, by
        default from the observation's evidence and margin."""
        carriers, fit, watch, inside = seen.carriers, seen.fit, seen.watch, seen.inside
        depth_mm = carriers.depth_mm(fit.nearness)
        found = inside & self.rig.in_range(depth_mm)  # a fit may leave the range that its order was chosen in
        depth_mm = np.where(found, depth_mm, 0.0)
        if wrong_chance is None:
            odds = seen.evidence / EVIDENCE_SCALE + seen.margin / MARGIN_SCALE - EVEN_ODDS
            wrong_chance = (1 / (1 + np.exp(np.clip(odds, -50, 50)))).astype(np.float32)
        wrong_chance = np.where(_lost(seen), np.maximum(wrong_chance, LOST_CHANCE), wrong_chance)
        mm_per_rad = carriers.mm_per_rad(np.maximum(depth_mm, 1.0))
        apart_rad = np.abs(seen.rival - fit.nearness) * carriers.joint_gain
        sigma_rad = np.hypot(fit.uncertainty_rad, reaching(apart_rad, wrong_chance))
        sigma_mm = np.where(found, mm_per_rad * sigma_rad, 0.0)
        confidence = np.where(found, 1 / (1 + sigma_mm / HALF_CONFIDENCE_MM), 0.0)
        reason = self._reasons(seen, found, wrong_chance, confidence)

        def paste(part: NDArray, dtype: type = np.float32, outside: float = 0) -> NDArray:
            whole: NDArray = np.full(seen.shape, outside, dtype=dtype)
            whole[carriers.crop] = np.where(inside, part, outside)
            return whole

        kept = depth_mm * (confidence >= self.settings.min_confidence)
        reasons = paste(reason, np.uint8, CrossedReason.BACKGROUND)
        counts = np.bincount(reasons.ravel(), minlength=len(CrossedReason))
        watch.done("confidence")
        measured = CrossedMeasurement(
            depth_mm=paste(kept),
            sigma_mm=paste(sigma_mm * (kept > 0)),
            confidence=paste(confidence),
            wrong_chance=paste(wrong_chance),
            brightness_grey=paste(fit.brightness),
            reason=reasons,
            counts={code.name.lower(): int(counts[code]) for code in CrossedReason},
            background_share=seen.background.share,
            seconds=watch.seconds,
        )
        return self._restored(measured) if self.resampling.needed else measured

    @cached_property
    def _captured(self) -> Carriers:
        """The carriers of the captured images."""
        return Carriers.of(self.resampling.captured, self.family)

    def _restored(self, measured: CrossedMeasurement) -> CrossedMeasurement:
        """The measurement in the size of the captured image."""
        joint, known = self.carriers.joint_gain, measured.depth_mm > 0
        nearness = np.where(known, self.carriers.nearness(np.where(known, measured.depth_mm, 1000.0)), 0.0)
        # The joint gain changes slowly over the image: its middle will do as a unit.
        unit = float(np.median(joint))
        on_object, psi, nearest = self.resampling.restored_phase((nearness * unit).astype(np.float64), known)
        depth_mm = self._captured.depth_mm(psi / unit)
        found = on_object & self.resampling.captured.in_range(depth_mm)

        def restored(values: Image) -> Image:
            return np.where(found, nearest(values), 0).astype(np.float32)

        # The nearest depth says nothing of a pixel that has none for a reason of its own.
        own = np.where(known, np.uint8(CrossedReason.BACKGROUND), measured.reason)
        own = cv2.resize(own, found.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        reason = np.select([found, on_object], [nearest(measured.reason), CrossedReason.OUT_OF_RANGE], own)
        counts = np.bincount(reason.ravel(), minlength=len(CrossedReason))
        return replace(
            measured,
            depth_mm=np.where(found, depth_mm, 0).astype(np.float32),
            reason=reason.astype(np.uint8),
            counts={code.name.lower(): int(counts[code]) for code in CrossedReason},
            sigma_mm=restored(measured.sigma_mm),
            confidence=restored(measured.confidence),
            wrong_chance=restored(measured.wrong_chance),
            brightness_grey=restored(measured.brightness_grey),
        )

    def _reasons(
        self, seen: CrossedObservation, found: Mask, wrong_chance: Image, confidence: NDArray
    ) -> NDArray[np.uint8]:
        fit = seen.fit
        bright = np.maximum(fit.brightness, 0.5)
        window = Window(WINDOW_PERIODS * self.carriers.period_px)
        misfit = window.moment((fit.misfit_grey**2 * seen.inside).astype(np.float32)) / np.maximum(fit.weight, 1e-3)
        by_reason = {
            CrossedReason.BACKGROUND: ~seen.inside,
            CrossedReason.LOW_MODULATION: fit.brightness < MIN_MODULATION,
            CrossedReason.SATURATED: seen.clipped_share > SATURATED_SHARE,
            CrossedReason.OUT_OF_RANGE: ~found,
            CrossedReason.ONE_DIRECTION: _lost(seen),
            CrossedReason.TEXTURE: (np.sqrt(misfit) > TEXTURE_SHARE * bright)
            | (seen.candidates.misfit_rad[1] > TEXTURE_RAD),
            CrossedReason.AMBIGUOUS: wrong_chance > AMBIGUOUS_CHANCE,
            CrossedReason.UNSURE: confidence < self.settings.min_confidence,
        }
        codes = [np.uint8(reason) for reason in by_reason]
        return np.select(list(by_reason.values()), codes, np.uint8(CrossedReason.MEASURED))

    def _contrast(self, modulation: Image, mean_grey: Image, points: Mask) -> tuple[float, float]:
        """Modulation over mean of both carriers on the object; as projected where too little of it is seen."""
        reach = 2 * max(1, round(CONTRAST_RIM_PERIODS * self.carriers.period_px / self.stride)) + 1
        inner = cv2.erode(points.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0  # type: ignore[call-overload]
        inner &= mean_grey > MIN_MODULATION
        if not inner.any():
            return self.carriers.weights
        shares = np.median(modulation[:, inner] / mean_grey[inner], axis=1)
        first, second = (
            float(np.clip(share, LEAST_CONTRAST, weight))
            for share, weight in zip(shares, self.carriers.weights, strict=True)
        )
        return first, second

    def _checked(self, image: NDArray) -> Image:
        camera = self.resampling.captured.camera
        shape = camera.height, camera.width
        given = grey_levels(image)
        if given.dtype not in (np.uint8, np.float32) or given.shape != shape:
            raise DecodeError(
                f"expected a crossed frame of uint8 grey levels, shape (H, W) = {shape} of the rig's camera, got "
                f"{given.dtype} {given.shape}; use rig.scaled(width) for a resized image"
            )
        return self.resampling.image(given).astype(np.float32)

    def _crop(self, region: Mask) -> Crop:
        """The part around ``region``, from a grid point on; a single point where there is no object."""
        left, top, width, height = cv2.boundingRect(region.astype(np.uint8))
        if not width:
            return slice(0, 1), slice(0, 1)
        pad = int(np.ceil(MARGIN_PERIODS * self.carriers.period_px))
        starts = [max(edge - pad, 0) // self.stride * self.stride for edge in (top, left)]
        stops = [min(edge + pad, size) for edge, size in zip((top + height, left + width), region.shape, strict=True)]
        return slice(starts[0], stops[0]), slice(starts[1], stops[1])


def _lifted(carriers: Carriers, phase_rad: Image, nearness: NDArray) -> NDArray:
    """Nearness (h, w) of wrapped phases (2, h, w), both in the turns that are nearest to ``nearness``."""
    beside = wrapped(phase_rad - carriers.phases(nearness))
    return nearness + (carriers.gain * beside).sum(axis=0) / carriers.joint_gain**2  # type: ignore[no-any-return]


def reaching(apart_rad: NDArray, wrong_chance: Image) -> NDArray:
    """Standard uncertainty whose interval of the probability 1 - ``wrong_chance`` just reaches a rival ``apart_rad``
    away; 0 for a chance below `LEAST_WRONG`."""
    sigmas = ndtri(1 - np.clip(wrong_chance, LEAST_WRONG, MOST_WRONG) / 2)
    return np.where(wrong_chance < LEAST_WRONG, 0.0, apart_rad / sigmas)


def _lost(seen: CrossedObservation) -> Mask:
    """Pixels (h, w) at which one of the carriers is not to be seen."""
    bright = np.maximum(seen.fit.brightness, 0.5)
    pairs = zip(seen.modulation, seen.carriers.weights, strict=True)
    shares = [modulation / (weight * bright) for modulation, weight in pairs]
    return np.minimum(*shares) < LOST_SHARE * max(seen.contrast) / max(seen.carriers.weights)  # type: ignore[no-any-return]
