"""Three crossed frames that shift one carrier and keep the other still: depth from each pixel's own phase.

The shifted carrier's phase is the three-step least squares of `fpp_ml_bench.coding`, pixel by pixel, so that nothing
mixes two surfaces at an edge. In the mean of the frames that carrier cancels, and the other one is left. It is used for
the order alone, in two ways: by its phase in a window, and by the grey level of each single pixel, whose brightness is
known from the first carrier's modulation. A phase of three frames has the noise of the camera. It is averaged over
pairs of pixels on opposite sides, but only pairs that lie on one plane with the pixel within the noise.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.calibration_layer import Image, Mask, wrapped
from fpp_ml_bench.baselines.phase.carriers import LEAST_RANGE_RAD, Carriers
from fpp_ml_bench.baselines.phase.crossed_observation import CrossedMeasurement, CrossedObservation, Settings
from fpp_ml_bench.baselines.phase.crossed_orders import Candidates, candidates, chosen, neighbours, rival
from fpp_ml_bench.baselines.phase.crossed_route import LEAST_TRUST, WELL_LIT, CrossedRoute
from fpp_ml_bench.baselines.phase.empty_scene import EmptySceneFit
from fpp_ml_bench.baselines.phase.labels import LARGE
from fpp_ml_bench.baselines.phase.local_fit import Window
from fpp_ml_bench.baselines.phase.object_mask import FLOOR_NOISE_GREY, Background, modulated_region
from fpp_ml_bench.baselines.phase.observation import Watch
from fpp_ml_bench.baselines.phase.orders import chosen_values, jump_links, links_between, nearest_inside, repeated
from fpp_ml_bench.baselines.phase.refinement import LEAST_GREY, WINDOW_PERIODS, Fit, fringes
from fpp_ml_bench.baselines.phase.several_frames import differs, first_mask, lit_object
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.coding.phase_shift import wrapped_phase
from fpp_ml_bench.constants import GREY_LEVELS, MAD_TO_SIGMA
from fpp_ml_bench.errors import DecodeError, PredictionError
from fpp_ml_bench.optics.rig import Rig

FRAMES = 3
SMOOTHNESS = 33.0
"""Weight of the link between two pixels: a pixel's window shares most of its light with its neighbour's, and one
pixel's light may be that of two surfaces."""
LIGHT_SIGMA, LIGHT_NOISE, MOST_LIGHT = 0.06, 1.2, 6.5
"""Of a pixel's light over its brightness: standard uncertainty of the model, what noise over brightness adds, and the
largest cost."""
INDIRECT_PERIODS, MOST_INDIRECT = 1.0, 0.4
"""Light from other surfaces changes slowly: the window of its median, and its largest share of the brightness."""
MEDIAN_STEP = 0.005
LEAST_BRIGHT = 1.0  # grey levels
EVIDENCE_WEIGHT = 2.0  # one carrier's phase has no error: evidence tells twice as much of the order as in one frame
REACH_PX = 2  # of the pairs that are averaged
SAME_PLANE_SIGMAS = 3.0
NOT_AVERAGED = 0.2
"""Of the noise of a pixel's own phase, what the mean over pixels leaves beside its noise: noise hides how far they are
from a plane."""
NOISE_SIGMAS = 3.0
CONTINUED_PX, CONTINUED_RAD = 3, 0.2
SYSTEMATIC_SHARE = 0.15  # phase error as a share of a misfit of the brightness that noise does not explain


def shifted_carrier(rig: Rig, name: str) -> int:
    """The carrier that the rig's first three crossed frames shift. Raises `PredictionError`, in the words of the method
    ``name``, for a rig without such frames."""
    family = rig.crossed
    shifts = np.zeros((0, 2)) if family is None else np.asarray(family.shifts_deg[:FRAMES], np.float64)
    if len(shifts) == FRAMES:
        different = [len(set(np.mod(column, 360))) for column in shifts.T]
        if sorted(different) == [1, FRAMES]:
            return different.index(FRAMES)
    found = "none" if family is None else f"{len(family)} with shifts_deg {[list(pair) for pair in family.shifts_deg]}"
    raise PredictionError(
        f"{name} --frames {FRAMES}: needs three crossed frames that shift one carrier and keep the other still; this "
        f"rig has {found}. Build with --rig crossed, or give the rig such shifts_deg (docs/own_rig.md)"
    )


class ThreeFrameRoute(CrossedRoute):
    """`CrossedRoute` for three frames of the rig, of which the carrier ``moved`` is shifted. Raises `PredictionError`
    where that carrier hardly changes with depth."""

    def __init__(self, rig: Rig, moved: int, settings: Settings | None = None) -> None:
        super().__init__(rig, settings)
        self.moved, rig = moved, self.rig
        self.shifts_rad = [float(np.radians(pair[moved])) for pair in self.family.shifts_deg[:FRAMES]]
        near_q, far_q = (float(np.median(self.carriers.nearness(end))) for end in rig.working_range_mm)
        span = float(np.median(np.abs(self.carriers.gain[moved]))) * abs(near_q - far_q)
        if not span >= LEAST_RANGE_RAD:
            raise PredictionError(
                f"crossed --frames {FRAMES}: over the working range the carrier that the frames shift changes by "
                f"{span:.2g} rad, too little for a depth; shift the other carrier"
            )
        families = [Crossed(**vars(self.family) | {"shifts_deg": (pair,)}) for pair in self.family.shifts_deg[:FRAMES]]
        others = [EmptySceneFit(Carriers.of(rig, family), self.stride) for family in families[1:]]
        self._scenes = [self._scene, *others]

    def measure_frames(self, images: Sequence[NDArray], mask: Mask | None = None) -> CrossedMeasurement:
        """Depth and the maps behind it from the three frames, uint8 (H, W) each. ``mask`` bool (H, W) replaces the
        route's own object mask. Raises `DecodeError` for another number, dtype or shape."""
        return self.conclude(self.observe_frames(images, mask))

    def observe_frames(self, images: Sequence[NDArray], mask: Mask | None = None) -> CrossedObservation:
        """Mask, phase and order of the three frames; arguments as of `measure_frames`."""
        if len(images) != FRAMES:
            raise DecodeError(f"expected {FRAMES} crossed frames, got {len(images)}")
        greys, watch = [self._checked(image) for image in images], Watch()
        phase, modulation, mean = (
            np.asarray(values, np.float32) for values in wrapped_phase(greys, self.shifts_rad, np.float32)
        )
        phase = wrapped(phase + np.float32(self.shifts_rad[0]))  # `Carriers` has the phases of the first frame
        seen = self.demodulator(mean)
        watch.done("phase")
        planes = [fit(grey, self.demodulator(grey)) for fit, grey in zip(self._scenes, greys, strict=True)]
        background = planes[0]
        watch.done("background")
        period_px = self.carriers.period_px
        if mask is not None:
            region = self.resampling.mask(mask)
        elif all(plane.shown for plane in planes):
            different = differs((plane.residual for plane in planes), background.noise_grey)
            region = lit_object(different, modulation, background, self.shifts_rad, period_px)
            residual = wrapped(phase - self.carriers.infinity_rad[self.moved])
            region = continued(region, first_mask(different, period_px), different, residual)
        else:
            region = modulated_region(mean, modulation, background, period_px)
            background = replace(background, share=0.0)
        crop = self._crop(region)
        watch.done("mask")
        grid = tuple(slice(part.start // self.stride, -(-part.stop // self.stride)) for part in crop)
        carriers, inside = self.carriers.at(crop), region[crop]
        windows = self.demodulator.phases_at(seen, carriers)
        phases, modulations = (maps[[0, 1]] for maps in (windows, seen.modulation[:, *grid]))
        phases[self.moved] = phase[crop]
        modulations[self.moved] = modulation[crop][:: self.stride, :: self.stride]
        points = inside[:: self.stride, :: self.stride]
        contrast = self._contrast(modulations, seen.mean_grey[grid] - background.ambient_grey, points)
        modulations = repeated(modulations, self.stride, (2, *inside.shape))
        modulations[self.moved] = modulation[crop]
        found = candidates(carriers, phases, self.settings.slack_mm, exact=self.moved)
        light = mean[crop] - np.float32(background.ambient_grey)
        by_light = self._light_cost(carriers, found, light, modulations[self.moved], contrast, inside, background)
        index, margin, evidence = self._ordered(
            carriers, found, phases, modulations, inside, background.noise_grey, by_light
        )
        beside = neighbours(found, index)
        watch.done("order")
        nearness = chosen_values(found.nearness, index)
        fit = self._fit(carriers, light, inside, nearness, modulations[self.moved], contrast)
        watch.done("fit")
        clipped = np.any([grey[crop] >= GREY_LEVELS for grey in greys], axis=0) & inside
        return CrossedObservation(
            carriers=carriers,
            shape=mean.shape,
            grey=mean[crop],
            background=replace(background, residual=background.residual[crop]),
            inside=inside,
            fit=fit,
            phase_rad=phases,
            modulation=modulations,
            contrast=contrast,
            margin=margin,
            evidence=evidence,
            rival=rival(found, index),
            candidates=beside,
            clipped_share=clipped.astype(np.float32),
            watch=watch,
        )

    def _light_cost(
        self,
        carriers: Carriers,
        found: Candidates,
        light: Image,
        modulation: Image,
        contrast: tuple[float, float],
        inside: Mask,
        background: Background,
    ) -> Image:
        """Cost of every candidate (K, h, w); a deviation of s standard deviations costs s^2 / 2. The deviation is
        that of the measured cosine of the still carrier from the cosine expected at the candidate's depth. The measured
        one follows from ``light`` (mean of the frames minus ambient light) and the brightness, which ``modulation``
        gives. Light from other surfaces is the local median of what the candidates of least misfit leave."""
        still = 1 - self.moved
        bright = np.maximum(modulation / np.float32(contrast[self.moved]), np.float32(LEAST_BRIGHT))
        expected = np.cos(carriers.infinity_rad[still] + carriers.gain[still] * found.nearness)
        left = light / bright - 1 - np.float32(contrast[still]) * expected
        likely = np.where(found.exists, found.misfit_rad, LARGE).argmin(axis=0)
        indirect = local_median(chosen_values(left, likely), inside, INDIRECT_PERIODS * self.carriers.period_px)
        left -= np.minimum(indirect, np.float32(MOST_INDIRECT))
        sigma = np.hypot(np.float32(LIGHT_SIGMA), np.float32(LIGHT_NOISE * background.noise_grey) / bright)
        cost: Image = np.minimum((left / sigma) ** 2 / 2, np.float32(MOST_LIGHT)).astype(np.float32)
        return cost

    def _ordered(
        self,
        carriers: Carriers,
        found: Candidates,
        phases: Image,
        modulations: Image,
        inside: Mask,
        noise_grey: float,
        by_light: Image,
    ) -> tuple[NDArray[np.int32], Image, Image]:
        """As `orders.chosen`, for every pixel, with the costs ``by_light``; neighbours between which the own phase or
        modulation jumps hardly count for each other."""
        own = modulations[self.moved]
        trust = np.clip(modulations[1 - self.moved] / np.float32(WELL_LIT * noise_grey), LEAST_TRUST, 1)
        residual = wrapped(phases[self.moved] - carriers.infinity_rad[self.moved])
        pairs = zip(links_between(inside), jump_links(residual, own, stride=1), strict=True)
        link_x, link_y = (np.float32(SMOOTHNESS) * link * smooth for link, smooth in pairs)
        index, margin, evidence = chosen(carriers, found, trust, inside, (link_x, link_y), by_light)
        return index, margin / np.float32(SMOOTHNESS), np.float32(EVIDENCE_WEIGHT) * evidence

    def _fit(
        self,
        carriers: Carriers,
        light: Image,
        inside: Mask,
        nearness: Image,
        modulation: Image,
        contrast: tuple[float, float],
    ) -> Fit:
        """What `refinement.refined` gives for one frame, from the ``modulation`` and ``nearness`` that every pixel
        measured itself; ``light``: the mean of the frames less ambient light."""
        gain = carriers.gain[self.moved]
        bright = np.maximum(modulation, np.float32(LEAST_GREY * contrast[self.moved]))
        noise_grey = phase_noise_grey(nearness * gain, bright, inside)
        # Least squares of three equal steps: both amplitudes have 2 / 3 of the variance of a grey level.
        own: Image = (noise_grey * np.sqrt(2 / FRAMES) / bright).astype(np.float32)
        psi, sigma = same_plane_mean(nearness * gain, own, inside)
        sigma = np.hypot(sigma, np.float32(NOT_AVERAGED) * own)
        nearness, brightness = psi / gain, modulation / np.float32(contrast[self.moved])
        still = (0.0, contrast[1]) if self.moved == 0 else (contrast[0], 0.0)
        raised, slope = fringes(carriers, nearness, still)
        misfit = light - brightness * raised
        unexplained = np.maximum(np.abs(misfit) - NOISE_SIGMAS * noise_grey / contrast[self.moved], 0)
        uncertainty = np.hypot(sigma, SYSTEMATIC_SHARE * unexplained / bright) * carriers.joint_gain / np.abs(gain)
        weight = Window(WINDOW_PERIODS * self.carriers.period_px).moment(inside.astype(np.float32))
        maps = (nearness, brightness, misfit, slope, weight, uncertainty)
        return Fit(*(np.asarray(values, np.float32) for values in maps))


def local_median(values: Image, inside: Mask, window_px: float) -> Image:
    """Median of ``values`` (h, w) over the square of ``window_px`` around each pixel, in steps of `MEDIAN_STEP` between
    -127 and 127 of them; beyond ``inside`` they are those of the nearest pixel within."""
    levels = np.clip(np.rint(values / np.float32(MEDIAN_STEP)), -127, 127).astype(np.int16)
    levels = levels[nearest_inside(inside)]
    size = 2 * int(window_px / 2) + 1
    median = cv2.medianBlur((levels + 128).astype(np.uint8), size)
    return (median.astype(np.float32) - 128) * np.float32(MEDIAN_STEP)


def continued(inside: Mask, region: Mask, different: Mask, residual_rad: Image) -> Mask:
    """Object pixels (h, w), and those of ``region`` with `CONTINUED_PX` object pixels beside them that either have the
    same ``residual_rad``, or are themselves ``different`` from the empty scene: where object and plane happen to have
    the same grey levels in all frames, and where light from other surfaces drowns the fringe."""
    beside, alike = np.zeros(inside.shape, np.uint8), np.zeros(inside.shape, np.uint8)
    padded, phases = np.pad(inside, 1), np.pad(residual_rad, 1)
    height, width = inside.shape
    for down, right in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        there = slice(down, down + height), slice(right, right + width)
        beside += padded[there]
        alike += padded[there] & (np.abs(wrapped(phases[there] - residual_rad)) < CONTINUED_RAD)
    return inside | (region & ((alike >= CONTINUED_PX) | (different & (beside >= CONTINUED_PX))))


def phase_noise_grey(psi: Image, modulation: Image, inside: Mask) -> float:
    """Noise of a frame in grey levels, from the second differences of the phase ``psi`` (h, w), rad, of three frames
    along the rows of the object; surfaces are planes to them, except for few pixels."""
    middle = inside[:, 2:] & inside[:, :-2] & inside[:, 1:-1]
    if not middle.any():
        return FLOOR_NOISE_GREY
    second = (psi[:, 2:] - 2 * psi[:, 1:-1] + psi[:, :-2])[middle] * modulation[:, 1:-1][middle]
    return max(MAD_TO_SIGMA * float(np.median(np.abs(second))) / np.sqrt(6 * 2 / FRAMES), FLOOR_NOISE_GREY)


def same_plane_mean(psi: Image, sigma: Image, inside: Mask) -> tuple[Image, Image]:
    """Mean of every pixel's phase ``psi`` (h, w), rad, of standard uncertainty ``sigma``, and of the pairs of pixels
    opposite each other, up to `REACH_PX` away, that differ from it and from a plane through it by no more than noise;
    and the mean's uncertainty. Opposite pixels have the mean of their plane at the pixel, so a slope adds nothing."""
    reach, limit = REACH_PX, np.float32(SAME_PLANE_SIGMAS**2)
    psis, variances = np.pad(psi, reach), np.pad(sigma * sigma, reach)
    known = np.pad(inside, reach)
    height, width = psi.shape
    own = variances[reach:-reach, reach:-reach]
    total, weights = psi / own, 1 / own

    def beside(values: NDArray, down: int, right: int) -> NDArray:
        return values[reach + down : reach + down + height, reach + right : reach + right + width]

    half = [(0, right) for right in range(1, reach + 1)]
    half += [(down, right) for down in range(1, reach + 1) for right in range(-reach, reach + 1)]
    for down, right in half:
        both = [
            tuple(beside(maps, *place) for maps in (psis, variances, known))
            for place in ((down, right), (-down, -right))
        ]
        (first, first_variance, first_known), (second, second_variance, second_known) = both
        alike = first_known & second_known
        alike &= (first - psi) ** 2 < limit * (first_variance + own)
        alike &= (second - psi) ** 2 < limit * (second_variance + own)
        variance = first_variance + second_variance
        alike &= (first + second - 2 * psi) ** 2 < limit * (variance + 4 * own)
        # The middle of a pair, each with half of its weight, has a quarter of the sum of both variances.
        weight = np.where(alike, 4 / np.maximum(variance, np.float32(1e-12)), np.float32(0))
        total += weight * (first + second) / 2
        weights += weight
    return (total / weights).astype(np.float32), np.sqrt(1 / weights).astype(np.float32)
