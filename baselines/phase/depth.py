"""Last stop: depth, its uncertainty, and the reasons not to trust a pixel.

One carrier: wrapped phase and order give the depth in closed form. Its expected error has three
parts. Phase: noise and misfit of the local fit (rms misfit divided by brightness is a phase error,
and the slope of the calibration layer turns it into mm). Rim: there the fit extrapolates instead of
averaging. Order: its margin gives the probability of a wrong order, whose error in mm is known.

Two carriers: the nearness is fitted to the frame itself, ``I - ambient = g (1 + c_1 cos phase_1(q)
+ c_2 cos phase_2(q))``. Starting from the nearness of the order, g (a quadratic) and one change of
q are solved for around each pixel. Depth jumps inside a window are in the start already. A second
round, or less weight for pixels that the first does not explain, makes it worse. Three crossed
frames: a pixel's own phase has the noise of the camera. It is averaged over pairs of pixels on
opposite sides, but only pairs that lie on one plane with the pixel within the noise.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fpp_ml_bench.baselines.phase.candidates import CrossedCandidates
from fpp_ml_bench.baselines.phase.geometry import TAU, Image, Mask, Orders, wrapped
from fpp_ml_bench.baselines.phase.local_fit import (
    CURVED,
    LARGEST_STEP_RAD,
    FringeFit,
    GaussianWindow,
    best_sides,
    fringes,
    phase_noise_grey,
    same_plane_mean,
    tied_fit,
)
from fpp_ml_bench.baselines.phase.object_mask import disk, gaps
from fpp_ml_bench.baselines.phase.observe import (
    CROSSED_FRAMES,
    Capture,
    CrossedObservation,
    Observation,
    OneCarrier,
    TwoCarriers,
)
from fpp_ml_bench.baselines.phase.order import (
    CrossedOrder,
    FringeOrder,
    crossed_order,
    margin_by_range,
)
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.coding.code import MIN_MODULATION
from fpp_ml_bench.coding.crossed import WINDOW_PERIODS
from fpp_ml_bench.coding.phase_shift import phase_weights
from fpp_ml_bench.constants import MM_PER_M

HALF_CONFIDENCE_PARTS = 120
"""Parts of the working range; an expected error as large as one has a confidence of a half, 5 mm of
the paper's 600. It scales the confidence and leaves the ranking of pixels as it is."""
SATURATED_SHARE = 0.02
"""Share of a pixel's window that may be clipped. Above it the reason is SATURATED; the depth
stays."""
LEAST_MARGIN = 0.1
"""Least margin of an order that is not ambiguous; 1 is the margin of brightness that rules the
rival order out."""
MARGIN_SCALE = 0.04
"""Margin by which the odds of two orders grow e-fold. A larger scale gives clear choices a larger
chance of a wrong order, and so a larger expected error."""
MISFIT_SHARE = 0.3
"""Phase error of a local fit as a share of its relative misfit, on the benchmark's objects."""
UNKNOWN_MISFIT_SHARE = 0.75
"""The same share where no known background shows, so that light and surface may be any: chosen on
an image of a real skull (`docs/results/phase_route.md`)."""
SLOWEST = 0.35
"""Least fringe frequency in the image that a window resolves, as a multiple of that of a plane
square to the axis: below it, a window of a fixed size holds too little of a period."""
FASTEST = 2.2
"""Largest such frequency that a window resolves: above it, the fringe changes too much within the
window for the linear fit of the phase."""
THIN_PERIODS = 0.5
"""Least width of an object, in periods, that is not THIN: a window next to a narrower part covers
both of its sides."""

LEAST_WRONG = 0.01
"""Least chance of a wrong order for which the rival widens the uncertainty; below, it lies outside
of the widest interval in use (99%). The variance of both orders would state several mm for a chance
of 0.1%, at pixels whose error is a tenth of that."""
MOST_WRONG = 0.32
"""Largest chance that is used: at 0.32 the interval that just reaches the rival is one standard
deviation (68%), so the stated uncertainty is at most the distance to the rival."""
LOST_SHARE = 0.25
"""Share of a carrier's contrast below which it counts as not seen. A larger share calls dark or
blurred surfaces ONE_DIRECTION."""
LOST_CHANCE = 0.6
"""Least probability of a wrong order where a carrier is not seen: more than a half, since one
carrier alone does not tell the order."""
TEXTURE_SHARE = 0.35
"""Largest rms misfit over brightness of a window that shows crossed fringes; above it the reason is
TEXTURE."""
TEXTURE_RAD = 0.5
"""Distance of both phases, in rad, from those of the depth, above which something else than its
fringes was seen."""
AMBIGUOUS_CHANCE = 0.3
"""Chance of a wrong order above which a pixel of crossed fringes is AMBIGUOUS. Its depth stays."""
FLOOR_GREY = 0.5
"""Least brightness, in grey levels, that a change is divided by: it keeps the phase correction of
black pixels finite."""
SYSTEMATIC_SHARE = 0.08
"""Share of the power of a misfit beyond noise that acts as a phase error everywhere. Set so that
68% intervals hold 68% of the pixels of validation views."""
RIM_SHARE = 0.6
"""What is added to that share by the part of the window beyond the object. Set in the same way."""
NOT_AVERAGED = 0.2
"""Of the noise of a pixel's own phase, the share that the mean over pixels leaves in addition to
its own noise: noise hides how far the pixels are from a plane."""
NOISE_SIGMAS = 3.0
"""Misfit of the brightness, in standard deviations of its noise, that noise explains: beyond three,
1 in 370 pixels has such noise."""
OWN_SYSTEMATIC_SHARE = 0.15
"""Phase error as a share of a misfit of the brightness that noise does not explain."""


class Reason(IntEnum):
    """Why a pixel should not be trusted; of several reasons the lowest. BACKGROUND: the empty scene
    explains it. LOW_MODULATION: too dark for a fringe, in shadow or turned away. SATURATED: clipped
    grey levels in the window. OUT_OF_RANGE: its depth is not in the working range, and is left out.
    THIN: the object is thinner than half a period there. TOO_STEEP: the fringe is compressed or
    stretched beyond what a window resolves. ONE_DIRECTION: one carrier is not to be seen, so that
    nothing decides the order. TEXTURE: what the window shows is no crossed fringe: stripes near a
    carrier's period, or a depth edge. AMBIGUOUS: the candidate orders can't be told apart. WALL:
    the wall explains it as well, or better; its uncertainty reaches the wall. UNSURE: the expected
    error alone is too large."""

    MEASURED = 0
    BACKGROUND = 1
    LOW_MODULATION = 2
    SATURATED = 3
    OUT_OF_RANGE = 4
    THIN = 5
    TOO_STEEP = 6
    ONE_DIRECTION = 7
    TEXTURE = 8
    AMBIGUOUS = 9
    WALL = 10
    UNSURE = 11


@dataclass(frozen=True)
class Measurement:
    """Maps (H, W) of one image; 0 where there is no object. ``depth_mm`` float32, 0 = background or
    masked; ``sigma_mm`` float32: standard uncertainty, 0 where there is no depth;
    ``order_doubt_mm``: the part of the expected error that comes from the order; ``confidence``
    float32, 0 to 1, by the expected error, 0 beyond the range; ``modulation_grey`` float32: half of
    a white pattern's grey level; ``reason`` uint8, a `Reason`, given whether the pixel was masked
    or not; ``background_share``: of the image that shows the plane."""

    depth_mm: Image
    sigma_mm: Image
    order_doubt_mm: Image
    confidence: Image
    modulation_grey: Image
    reason: NDArray[np.uint8]
    background_share: float

    @property
    def counts(self) -> dict[str, int]:
        """Pixels per reason."""
        counts = np.bincount(self.reason.ravel(), minlength=len(Reason))
        return {code.name.lower(): int(counts[code]) for code in Reason}


@dataclass(frozen=True)
class FringeMeasurement(Measurement):
    """Of one carrier also ``wrapped_phase_rad`` float32 in [-pi, pi], NaN where there is no object;
    ``order`` int32; ``candidates``: the orders that the working range allows; and
    ``expected_error_mm`` float32."""

    wrapped_phase_rad: Image
    order: NDArray[np.int32]
    candidates: Orders
    expected_error_mm: Image

    @classmethod
    def of(
        cls,
        measured: Measurement,
        wrapped_phase_rad: Image,
        order: NDArray[np.int32],
        candidates: Orders,
        expected_error_mm: Image,
    ) -> "FringeMeasurement":
        """What every measurement states, and these."""
        return cls(
            measured.depth_mm,
            measured.sigma_mm,
            measured.order_doubt_mm,
            measured.confidence,
            measured.modulation_grey,
            measured.reason,
            measured.background_share,
            wrapped_phase_rad,
            order,
            candidates,
            expected_error_mm,
        )


@dataclass(frozen=True)
class NearnessFit:
    """Depth of two carriers before it is judged: ``nearness`` float32 (h, w); ``brightness`` g,
    grey levels (a white pattern's is twice as much); ``misfit_grey``: frame minus fit; ``weight``:
    share of the window that lies on the object; ``uncertainty_rad``: standard uncertainty of the
    joint phase from noise and misfit, apart from the order."""

    nearness: NDArray[np.float32]
    brightness: Image
    misfit_grey: Image
    weight: Image
    uncertainty_rad: Image

    @classmethod
    def of(cls, *maps: NDArray) -> "NearnessFit":
        """Of maps of any precision."""
        return cls(*(np.asarray(values, np.float32) for values in maps))


@dataclass(frozen=True)
class Fitted:
    """Crossed fringes with the ``fit`` of the nearness in an ``order``. ``wall`` bool (h, w):
    pixels that count as object although the wall explains them as well, or better."""

    seen: CrossedObservation
    order: CrossedOrder
    fit: NearnessFit
    wall: Mask


def _uncertainty_rad(seen: Observation, window: GaussianWindow) -> Image:
    """Expected absolute error of the phase of each pixel in rad, float32 (h, w), apart from the
    order."""
    fit, background = seen.fit, seen.background
    bright = np.maximum(fit.brightness, 0.5)
    if seen.mean_grey is not None:
        # Noise through the weights of the steps, and the difference of mean and modulation beyond
        # it (a pixel that covers two surfaces, or is clipped). Of modulation a pixel that averages
        # the fringe over its area loses a share that is known, without an error of the phase.
        _, cosine, sine = phase_weights(seen.shifts_rad)
        # Of phi = -atan2(S, C): d phi = -(C dS - S dC) / B^2 = -(cos phi dS + sin phi dC) / B.
        c, s = np.cos(fit.phase_rad), np.sin(fit.phase_rad)
        variance = c * c * (sine @ sine) + s * s * (cosine @ cosine) + 2 * c * s * (sine @ cosine)
        noise = background.noise_grey * np.sqrt(variance * 2 / np.pi)
        mean = seen.mean_grey - background.ambient_grey
        before_pixel = fit.brightness / np.float32(np.sinc(1 / seen.period_px))
        disagreement = np.maximum(mean - before_pixel, fit.brightness - mean)
        allowed = 3 * background.noise_grey * np.sqrt(3 / len(seen.shifts_rad))
        return ((noise + np.maximum(disagreement - allowed, 0) / 2) / bright).astype(np.float32)
    misfit = (seen.greys[0] - background.ambient_grey - bright * fit.raised) * seen.inside
    power = window.moment((misfit * misfit).astype(np.float32)) / np.maximum(fit.weight, 1e-3)
    averaged, systematic = _noise_and_rest(seen, power, window, fit.weight)
    rim = np.clip(1 - fit.weight, 0, 1)
    share = MISFIT_SHARE if background.shown else UNKNOWN_MISFIT_SHARE
    return np.sqrt(averaged + systematic) / bright * (share + rim) + np.hypot(*seen.slopes) * rim  # type: ignore[no-any-return]


def _noise_and_rest(
    seen: Capture, power: NDArray, window: GaussianWindow, weight: NDArray
) -> tuple[NDArray, NDArray]:
    """Of the ``power`` of a misfit: noise that is left of white noise after averaging, and what is
    no noise."""
    # A window of sigma s averages 4 pi s^2 pixels of white noise; what is not noise does not
    # average.
    noise = seen.background.noise_grey**2
    return noise / (2 * np.pi * window.sigma_px**2 * np.maximum(weight, 0.05)), np.maximum(
        power - noise, 0
    )


def _window_fit(seen: CrossedObservation, nearness: NDArray) -> NearnessFit:
    """The fit to one frame under a window, from the turns of both phases that are nearest to
    ``nearness``."""
    carriers, light, window = (
        seen.carriers,
        seen.light,
        GaussianWindow(WINDOW_PERIODS * seen.period_px),
    )
    beside = wrapped(seen.phase_rad - carriers.phases(nearness))
    nearness = nearness + (carriers.gain * beside).sum(axis=0) / carriers.joint_gain**2
    view = light, *fringes(carriers, nearness, seen.contrast)
    brightness, change, share, curvature = tied_fit([view], seen.inside, window, CURVED)
    share = np.maximum(share, 1e-6)
    curvature = np.maximum(curvature / share, 1e-3)
    bright = np.maximum(brightness, FLOOR_GREY)
    nearness = (
        nearness
        + np.clip(change / bright, -LARGEST_STEP_RAD, LARGEST_STEP_RAD) / carriers.joint_gain
    )
    misfit = light - np.maximum(brightness, 0) * fringes(carriers, nearness, seen.contrast)[0]
    averaged, rest = _noise_and_rest(
        seen, window.moment(misfit * misfit * seen.inside) / share, window, share
    )
    acting = SYSTEMATIC_SHARE + RIM_SHARE * (1 - np.minimum(share, 1))
    uncertainty = np.sqrt((averaged + rest * acting) / curvature) / bright
    return NearnessFit.of(nearness, brightness, misfit, share, uncertainty)


def _of_best_sides(seen: CrossedObservation, fit: NearnessFit) -> NearnessFit:
    """The fit of every pixel, or of the neighbour whose surface explains the frame there better
    (`best_sides`)."""

    def raised(nearness: Image) -> Image:
        return fringes(seen.carriers, nearness, seen.contrast)[0]

    noise_grey, fitted = seen.background.noise_grey, (fit.nearness, fit.brightness)
    nearness, brightness, places = best_sides(
        fitted, seen.light, seen.inside, raised, noise_grey, seen.period_px
    )
    misfit = seen.light - brightness * raised(nearness)
    return NearnessFit.of(
        nearness, brightness, misfit, fit.weight[*places], fit.uncertainty_rad[*places]
    )


def _own_fit(seen: CrossedObservation, nearness: Image, moved: int) -> NearnessFit:
    """The same from the phase and modulation that every pixel measured itself in three frames."""
    carriers, modulation, contrast = seen.carriers, seen.modulation[moved], seen.contrast[moved]
    gain, bright = carriers.gain[moved], np.maximum(modulation, np.float32(FLOOR_GREY * contrast))
    noise_grey = phase_noise_grey(nearness * gain, bright, seen.inside)
    # Least squares of three equal steps: both amplitudes have 2 / 3 of the variance of a grey
    # level.
    own: Image = (noise_grey * np.sqrt(2 / CROSSED_FRAMES) / bright).astype(np.float32)
    psi, sigma = same_plane_mean(nearness * gain, own, seen.inside)
    sigma = np.hypot(sigma, np.float32(NOT_AVERAGED) * own)
    nearness, brightness = psi / gain, modulation / np.float32(contrast)
    still = (0.0, seen.contrast[1]) if moved == 0 else (seen.contrast[0], 0.0)
    misfit = seen.light - brightness * fringes(carriers, nearness, still)[0]
    unexplained = np.maximum(np.abs(misfit) - NOISE_SIGMAS * noise_grey / contrast, 0)
    uncertainty = (
        np.hypot(sigma, OWN_SYSTEMATIC_SHARE * unexplained / bright)
        * carriers.joint_gain
        / np.abs(gain)
    )
    weight = GaussianWindow(WINDOW_PERIODS * seen.period_px).moment(seen.inside.astype(np.float32))
    return NearnessFit.of(nearness, brightness, misfit, weight, uncertainty)


def reaching(apart_rad: NDArray, wrong_chance: Image) -> NDArray:
    """Standard uncertainty whose interval of the probability 1 - ``wrong_chance`` just reaches a
    rival ``apart_rad`` away; 0 for a chance below `LEAST_WRONG`."""
    sigmas = ndtri(1 - np.clip(wrong_chance, LEAST_WRONG, MOST_WRONG) / 2)
    return np.where(wrong_chance < LEAST_WRONG, 0.0, apart_rad / sigmas)


def _pasted(seen: Capture, part: NDArray, dtype: type = np.float32, outside: float = 0) -> NDArray:
    """A map (h, w) of the crop as one of the image (H, W), ``outside`` where there is no object."""
    whole: NDArray = np.full(seen.shape, outside, dtype=dtype)
    whole[seen.crop] = np.where(seen.inside, part, outside)
    return whole


def _judged(
    seen: Capture,
    settings: Settings,
    depth_mm: NDArray,
    error_mm: NDArray,
    fit: FringeFit | NearnessFit,
    window: GaussianWindow | None,
    reasons: Mapping[Reason, Mask],
    guessed: Mask | bool = False,
) -> Measurement:
    """What every measurement states of a depth (h, w), 0 beyond the object and the range, whose
    expected size of the error is ``error_mm``: confidence, reason, and what is left of depth and
    error where pixels are masked; no doubt of the order. ``window``: what a pixel was measured in,
    None for itself alone; ``reasons``: those of the model's own; ``guessed``: pixels without a
    depth, since their order is a guess."""
    clipped: NDArray = seen.saturated.astype(np.float32)
    if window is not None:
        clipped = window.moment(clipped) / np.maximum(fit.weight, 1e-3)
    answered, least = depth_mm > 0, settings.min_confidence
    half_mm = 2 * seen.rig.half_range_mm / HALF_CONFIDENCE_PARTS
    confidence = np.where(answered, 1 / (1 + error_mm / half_mm), 0)
    by_reason = {
        Reason.BACKGROUND: ~seen.inside,
        Reason.LOW_MODULATION: fit.brightness < MIN_MODULATION,
        Reason.SATURATED: clipped > SATURATED_SHARE,
        Reason.OUT_OF_RANGE: ~answered,
        **reasons,
        Reason.UNSURE: confidence < least,
    }
    codes = [np.uint8(reason) for reason in by_reason]
    reason = np.select(list(by_reason.values()), codes, np.uint8(Reason.MEASURED))
    kept = answered & ~guessed if least == 0 else answered & ~guessed & (confidence >= least)
    return Measurement(
        depth_mm=_pasted(seen, np.where(kept, depth_mm, 0)),
        sigma_mm=_pasted(seen, np.where(kept, error_mm, 0)),
        order_doubt_mm=np.zeros(seen.shape, np.float32),
        confidence=_pasted(seen, confidence),
        modulation_grey=_pasted(seen, fit.brightness),
        reason=_pasted(seen, reason, np.uint8, Reason.BACKGROUND),
        background_share=seen.background.share,
    )


def _restored(
    model: OneCarrier | TwoCarriers,
    measured: Measurement,
    known: Mask,
    depth_mm: NDArray,
    on_object: Mask,
    nearest: Callable[[NDArray], NDArray],
) -> Measurement:
    """``measured`` in the size of the captured image: its ``depth_mm`` (H, W) follows on the pixels
    ``on_object`` from those that were ``known``. Other maps are taken from the ``nearest``
    pixel."""
    in_range = model.resampling.captured.in_range(depth_mm)
    answered = on_object & in_range & (nearest(measured.depth_mm) > 0)
    # The nearest depth says nothing of a pixel that has none for a reason of its own.
    own = np.where(known, np.uint8(Reason.BACKGROUND), measured.reason)
    own = cv2.resize(own, answered.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    reason = np.where(on_object, nearest(measured.reason), own)
    reason[
        on_object & ~in_range & ((reason == Reason.MEASURED) | (reason > Reason.OUT_OF_RANGE))
    ] = Reason.OUT_OF_RANGE

    def taken(values: NDArray, where: Mask) -> Image:
        return np.where(where, nearest(values), np.float32(0))

    return Measurement(
        depth_mm=np.where(answered, depth_mm, 0).astype(np.float32),
        sigma_mm=taken(measured.sigma_mm, on_object & in_range),
        order_doubt_mm=taken(measured.order_doubt_mm, on_object & in_range),
        confidence=taken(measured.confidence, on_object & in_range),
        modulation_grey=taken(measured.modulation_grey, on_object),
        reason=reason.astype(np.uint8),
        background_share=measured.background_share,
    )


def _restored_fringe(model: OneCarrier, measured: FringeMeasurement) -> FringeMeasurement:
    """In the size of the captured image. The residual phase, order included, is interpolated (it
    has no wraps); depth, wrapped phase and order follow from it at every pixel."""
    inside = np.isfinite(measured.wrapped_phase_rad)
    psi = np.where(
        inside, model.layer.residual_phase(measured.wrapped_phase_rad, measured.order), 0.0
    )
    on_object, phases, nearest = model.resampling.restored(psi, inside)
    layer = model.captured_layer
    absolute = np.where(on_object, phases, np.nan) + layer.infinity_rad + TAU * layer.infinity_order
    order = np.rint(absolute / TAU)
    phase = (absolute - TAU * order).astype(np.float32)
    depth_mm = np.zeros(phases.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_mm[on_object] = layer.at(on_object).depth_of_residual_mm(phases[on_object])
    return FringeMeasurement.of(
        _restored(model, measured, inside, depth_mm, on_object, nearest),
        wrapped_phase_rad=phase,
        order=np.nan_to_num(order).astype(np.int32),
        candidates=layer.orders_in_range(phase, model.range_mm),
        expected_error_mm=np.where(on_object, nearest(measured.expected_error_mm), np.float32(0)),
    )


def _restored_crossed(model: TwoCarriers, measured: Measurement) -> Measurement:
    """In the size of the captured image, where the nearness is interpolated."""
    carriers, known = model.carriers, measured.depth_mm > 0
    nearness = np.where(known, carriers.nearness(np.where(known, measured.depth_mm, 1000.0)), 0.0)
    # The joint gain changes slowly over the image: its middle will do as a unit.
    unit = float(np.median(carriers.joint_gain))
    on_object, psi, nearest = model.resampling.restored((nearness * unit).astype(np.float64), known)
    depth_mm = model.captured_carriers.depth_mm(psi / unit)
    return _restored(model, measured, known, depth_mm, on_object, nearest)


def fringe_depth(model: OneCarrier, chosen: FringeOrder) -> FringeMeasurement:
    """The measurement that follows from an order of every pixel, however it was chosen. A pixel
    whose order is a guess has no depth: a tie in light that nothing calibrates."""
    seen, order, margin = chosen.seen, chosen.order, chosen.margin
    guessed: Mask | bool = False
    if not seen.background.calibrated:  # no evidence about the order, whatever the choice preferred
        margin = margin_by_range(seen, order)
        guessed = margin == 0
    inside, layer = seen.inside, seen.layer
    depth_mm = np.where(inside, layer.depth_mm(seen.phase_rad, order), 0.0)
    depth_mm[~seen.rig.in_range(depth_mm)] = 0.0
    ahead = (
        layer.forward * (np.maximum(depth_mm, seen.rig.working_range_mm[0]) / MM_PER_M)
        + layer.back_m
    )
    mm_per_rad = np.abs(ahead**2 / (layer.gain * layer.forward)) * MM_PER_M
    uncertainty_rad = seen.uncertainty_rad
    if uncertainty_rad is None:
        uncertainty_rad = _uncertainty_rad(seen, model.windows[-1])
    wrong_chance = 1 / (1 + np.exp(np.clip(margin / MARGIN_SCALE, 0, 50)))
    error_mm = (mm_per_rad * (uncertainty_rad + TAU * wrong_chance)).astype(np.float32)
    frequency = _frequency(seen, across=0 if model.settings.direction == "vertical" else 1)
    widest = disk(THIN_PERIODS / 2 * seen.period_px)
    reasons = {
        Reason.THIN: cv2.morphologyEx(inside.astype(np.uint8), cv2.MORPH_OPEN, widest) == 0,
        Reason.TOO_STEEP: (frequency < SLOWEST) | (frequency > FASTEST),
        Reason.AMBIGUOUS: margin < LEAST_MARGIN,
    }
    judged = _judged(
        seen, model.settings, depth_mm, error_mm, seen.fit, model.windows[1], reasons, guessed
    )
    first, count = (
        _pasted(seen, part, np.int32) for part in (seen.candidates.first, seen.candidates.count)
    )
    judged = replace(
        judged,
        sigma_mm=judged.sigma_mm
        * np.float32(np.sqrt(np.pi / 2)),  # of a normal error of that expected size
        order_doubt_mm=_pasted(seen, mm_per_rad * TAU * wrong_chance),
    )
    measured = FringeMeasurement.of(
        judged,
        wrapped_phase_rad=_pasted(seen, seen.phase_rad, np.float32, np.nan),
        order=_pasted(seen, order, np.int32),
        candidates=Orders(first, count),
        expected_error_mm=_pasted(seen, error_mm),
    )
    return _restored_fringe(model, measured) if model.resampling.needed else measured


def _frequency(seen: Observation, across: int) -> Image:
    """Frequency of the fringe in the image, (h, w), as a multiple of that of a plane square to the
    camera's axis, which advances by one period every ``period_px`` along the axis ``across`` of the
    slopes."""
    along = np.abs(TAU / seen.period_px + seen.slopes[across]) * seen.period_px / TAU
    frequency: Image = np.hypot(along, np.abs(seen.slopes[1 - across]) * seen.period_px / TAU)
    return frequency


def crossed_nearness(
    settings: Settings, seen: CrossedObservation, offered: CrossedCandidates
) -> Fitted:
    """The order of every pixel, and the nearness that follows from it and the frame."""
    order = crossed_order(settings, seen, offered)
    if seen.moved is None:
        fit = _window_fit(seen, order.nearness)
        if seen.sigma_rad is None:  # phases of networks have edges of their own
            fit = _of_best_sides(seen, fit)
    else:
        fit = _own_fit(seen, order.nearness, seen.moved)
    wall = np.zeros_like(seen.inside)
    if seen.moved is None and not seen.given:
        dropped, wall = gaps(seen.inside, seen.background, fit.misfit_grey)
        if not seen.background.shown:
            dropped = fit.brightness <= MIN_MODULATION
        seen = replace(seen, inside=seen.inside & ~dropped)
    return Fitted(seen, order, fit, wall)


def crossed_depth(model: TwoCarriers, fitted: Fitted) -> Measurement:
    """The measurement that follows from a fit."""
    seen, order, fit, carriers = fitted.seen, fitted.order, fitted.fit, fitted.seen.carriers
    depth_mm = carriers.depth_mm(fit.nearness)
    # A fit may leave the range that its order was chosen in.
    depth_mm = np.where(seen.inside & seen.rig.in_range(depth_mm), depth_mm, 0.0)
    bright = np.maximum(fit.brightness, 0.5)
    pairs = zip(seen.modulation, carriers.family.weights, strict=True)
    weakest = np.minimum(*(modulation / (weight * bright) for modulation, weight in pairs))
    lost = weakest < LOST_SHARE * max(seen.contrast) / max(carriers.family.weights)
    wrong_chance = np.where(lost, np.maximum(order.wrong_chance, LOST_CHANCE), order.wrong_chance)
    mm_per_rad = carriers.mm_per_rad(np.maximum(depth_mm, 1.0))
    doubt_rad = reaching(np.abs(order.rival - fit.nearness) * carriers.joint_gain, wrong_chance)
    sigma_mm = mm_per_rad * np.hypot(fit.uncertainty_rad, doubt_rad)
    if seen.rig.background_m is not None:
        behind_mm = seen.rig.background_m * MM_PER_M - depth_mm
        sigma_mm = np.where(fitted.wall, np.hypot(sigma_mm, behind_mm), sigma_mm)
    window = GaussianWindow(WINDOW_PERIODS * seen.period_px)
    misfit = window.moment((fit.misfit_grey**2 * seen.inside).astype(np.float32)) / np.maximum(
        fit.weight, 1e-3
    )
    texture = (np.sqrt(misfit) > TEXTURE_SHARE * bright) | (order.misfit_rad > TEXTURE_RAD)
    reasons = {
        Reason.ONE_DIRECTION: lost,
        Reason.TEXTURE: texture,
        Reason.AMBIGUOUS: wrong_chance > AMBIGUOUS_CHANCE,
        Reason.WALL: fitted.wall,
    }
    measured_in = None if seen.moved is not None else window
    judged = _judged(seen, model.settings, depth_mm, sigma_mm, fit, measured_in, reasons)
    measured = replace(judged, order_doubt_mm=_pasted(seen, mm_per_rad * doubt_rad))
    return _restored_crossed(model, measured) if model.resampling.needed else measured
