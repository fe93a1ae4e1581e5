"""Least squares of fringes under a Gaussian window, which never reaches across the object mask.

One direction: ``I = a + b x + c y + C cos(theta) + S sin(theta)`` around each pixel, with theta a
carrier (a plane at the standoff) whose phase the solution corrects by ``atan2(-S, C)``
(`carrier_fit`). Two directions: a quadratic brightness and both carriers, ``I = p(x, y) + sum_k
Re(z_k exp(i k_k (x, y)))``. The solution z_k is a fixed combination of grey levels, the same at
every pixel, so that it is computed with Fourier transforms, and only where it is needed: the
filter's band is narrow, and its part of the spectrum, transformed back alone, gives z_k on a grid
of every ``stride``-th pixel (`Demodulator`).

Then, for any number of directions and frames, ``I - ambient = g raised(phase + d)``, with g a
polynomial and d one change of phase (`tied_fit`). A projected fringe goes down to black, so its
mean and its modulation are the same number g; with that constraint a slope of brightness is not
taken for phase.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from fpp_ml_bench.baselines.phase.geometry import TAU, Carriers, Image, Mask, wrapped
from fpp_ml_bench.constants import MAD_TO_SIGMA

WINDOW_SIGMAS = 3.0
"""Half the width at which a Gaussian window is cut off, in its sigmas: 1% of the peak weight is
left there."""
RIDGE = 1e-6
"""Share of the window's weight that is added to the diagonal, so that fits of a few pixels stay
finite in float32."""
LARGEST_STEP_RAD = 0.7
"""Largest change of the phase in one fit, in rad: beyond it the linear model does not hold."""
WHOLE_WINDOW = 0.9
"""Share of a window that lies on the object, of the pixels on which contrast is measured."""
LEAST_CONTRAST = 0.3
"""Least contrast of the fringes (modulation over mean) that a measurement may give. A fit with less
would hardly see the fringe."""
STEEPEST_RAD_PER_PX = 0.5
"""Largest change of the residual phase a px that counts as slope; the carrier itself changes by
0.28."""
DEMODULATION_PERIODS = 0.4
"""Sigma of the demodulator's window, in periods of the longer carrier. A larger window tells the
carriers' spectra apart better and mixes more surfaces."""
FLOOR_NOISE_GREY = 0.3
"""Least noise in grey levels: rounding to whole grey levels makes 0.29."""
REACH_PX = 2
"""Farthest distance, in px along each axis, of the pairs of pixels that are averaged: 12 pairs in a
square of 5 px. Over a longer distance fewer surfaces are planes."""
SAME_PLANE_SIGMAS = 3.0
"""Difference, in standard deviations of its noise, within which a pair of pixels lies on one plane
with the pixel between them. A larger limit averages across small depth steps."""
WEAK_SIGMAS = 10.0
"""Modulation around a pixel, in sigmas of its noise, below which it is not measured alone."""
WEAK_PHASE_PX = 2.0
"""Sigma, in px, of the average that phase and order are taken from there. With it, at a noise of 2
grey levels, the MAE of five views fell from 72 to 9 mm (`docs/results/crossed.md`)."""
WEAK_LIGHT_PX = 1.25
"""Sigma, in px, of that average for the mask: smaller, so that the silhouette is not blurred as
much."""
SIDES = 8
"""Directions in which neighbours are asked for their plane: every 45 degrees, so that some
neighbour lies on either side of any edge."""
SIDE_PERIODS = (0.25, 0.5, 0.75)
"""Distances in periods at which they are asked. At an edge, the windows of some of these neighbours
cover one surface alone (`docs/results/crossed.md`)."""
SIDE_WINDOW_PX = 2.0
"""Sigma, in px, of the window in which the offers of neighbours are compared with the grey levels:
wide enough to average noise, and narrower than the fit's window."""
SIDE_SLOPE_PX = 3.0
"""Sigma, in px, of the average from which the slopes of offers are taken, since a slope of noisy
maps would be multiplied by the distance of the neighbour."""
SIDE_SHARE = 0.08
"""Share of the brightness that counts as noise when offers are compared: an offered plane is not
exactly the surface."""
SIDE_CAP = 16.0
"""Most that the misfit of one pixel counts in this comparison, in squared sigmas: beyond four
sigmas a pixel shows another surface, and must not decide alone."""
SIDE_COST = 0.5
"""Cost of an offer from a period away, in squared sigmas a pixel; it grows with the distance, so
that a pixel's own fit wins where offers explain it equally well."""


PLANE = ((0, 0), (1, 0), (0, 1))
"""Powers of x and y of the terms of a brightness that changes evenly across a window."""
CURVED = (*PLANE, (2, 0), (1, 1), (0, 2))
"""Powers of x and y of the terms of a quadratic brightness."""


class GaussianWindow:
    """A Gaussian of ``sigma_px`` and its moments up to the fourth, for `cv2.sepFilter2D`."""

    def __init__(self, sigma_px: float) -> None:
        half = int(np.ceil(WINDOW_SIGMAS * sigma_px))
        t = np.arange(-half, half + 1) / sigma_px
        weight = np.exp(-0.5 * t * t)
        weight /= weight.sum()
        self.sigma_px = sigma_px
        self._kernels = [(weight * t**power).astype(np.float64) for power in range(5)]

    def moment(self, image: Image, along_x: int = 0, along_y: int = 0) -> Image:
        """Sum of ``image`` (H, W) under the window times x^along_x y^along_y, in window sigmas; 0
        beyond the image. In the image's precision, single or double."""
        kernels = self._kernels
        return cv2.sepFilter2D(
            image, -1, kernels[along_x], kernels[along_y], borderType=cv2.BORDER_CONSTANT
        )  # type: ignore[return-value]


@dataclass(frozen=True)
class FringeFit:
    """``phase_rad`` float32 (H, W), not wrapped: carrier plus correction; ``brightness`` g, grey
    levels (a white pattern's is twice as much); ``weight``: share of the window that lies on the
    object; ``contrast`` of the fringes, modulation over mean."""

    phase_rad: Image
    brightness: Image
    weight: Image
    contrast: float = 1.0

    @property
    def raised(self) -> Image:
        """Light over brightness of the fringe in the first frame."""
        return 1 + np.float32(self.contrast) * np.cos(self.phase_rad)

    @property
    def light(self) -> Image:
        """Grey levels (H, W) of the fitted fringe, without the ambient light, in the first
        frame."""
        return np.maximum(self.brightness, 0) * self.raised


def solve_symmetric(rows: list[list[Image]], right: list[Image]) -> list[Image]:
    """Solve one small symmetric system a pixel by elimination without pivoting; ``rows``: from the
    diagonal on. Both arguments are overwritten. The windows' normal matrices are positive; `RIDGE`
    keeps them so in float32."""
    size = len(right)
    ridge = RIDGE * rows[0][0] + np.float32(1e-9)
    for row in rows:
        row[0] = row[0] + ridge
    for i in range(size):
        for j in range(i + 1, size):
            factor = rows[i][j - i] / rows[i][0]
            for k in range(j, size):
                rows[j][k - j] = rows[j][k - j] - factor * rows[i][k - i]
            right[j] = right[j] - factor * right[i]
    for i in reversed(range(size)):
        for j in range(i + 1, size):
            right[i] = right[i] - rows[i][j - i] * right[j]
        right[i] = right[i] / rows[i][0]
    return right


def carrier_fit(
    grey: Image, inside: Mask, carrier_rad: NDArray, window: GaussianWindow
) -> tuple[Image, Image]:
    """Phase in rad and modulation in grey levels, float32 (H, W), from the five-term fit of
    ``grey`` around each pixel; use them inside only."""
    weight = inside.astype(np.float32)
    light = grey * weight
    cosine, sine = np.cos(carrier_rad).astype(np.float32), np.sin(carrier_rad).astype(np.float32)
    by_cosine, by_sine = weight * cosine, weight * sine
    m = window.moment
    w00, cc = m(weight), m(by_cosine * cosine)
    rows = [
        [w00, m(weight, 1, 0), m(weight, 0, 1), m(by_cosine), m(by_sine)],
        [m(weight, 2, 0), m(weight, 1, 1), m(by_cosine, 1, 0), m(by_sine, 1, 0)],
        [m(weight, 0, 2), m(by_cosine, 0, 1), m(by_sine, 0, 1)],
        [cc, m(by_cosine * sine)],
        [w00 - cc],
    ]
    answer = solve_symmetric(
        rows, [m(light), m(light, 1, 0), m(light, 0, 1), m(light * cosine), m(light * sine)]
    )
    phase: Image = (carrier_rad + np.arctan2(-answer[4], answer[3])).astype(np.float32)
    return phase, np.hypot(answer[3], answer[4])


def tied_fit(
    views: Iterable[tuple[NDArray, NDArray, NDArray]],
    inside: Mask,
    window: GaussianWindow,
    terms: Sequence[tuple[int, int]],
) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Fit of ``light = g raised + s slope`` around each pixel of one or several ``views``, each
    light (grey levels less ambient light), and light over brightness with its change by the phase,
    (h, w). Brightness g, the polynomial of ``terms`` at the pixel; s, brightness times change of
    phase; share of the window on the object; mean square of the slopes times that share."""
    # The moments of more terms than a plane's are too much alike for the elimination in single
    # precision.
    weight: NDArray = inside.astype(np.float32 if len(terms) <= len(PLANE) else np.float64)
    rr: NDArray
    rr = rs = ss = lr = ls = np.zeros_like(weight)
    for light, raised, slope in views:
        by_raised, by_slope = weight * raised, weight * slope
        rr, rs, ss = rr + by_raised * raised, rs + by_raised * slope, ss + by_slope * slope
        lr, ls = lr + light * by_raised, ls + light * by_slope
    m = window.moment
    power = m(ss)
    powers = {(a + c, b + d) for a, b in terms for c, d in terms}
    moments = {(a, b): m(rr, a, b) for a, b in powers}
    rows = [
        [moments[a + c, b + d] for c, d in terms[i:]] + [m(rs, a, b)]
        for i, (a, b) in enumerate(terms)
    ] + [[power]]
    g, *_, s = solve_symmetric(rows, [m(lr, a, b) for a, b in terms] + [m(ls)])
    return g, s, m(weight), power


def fringe_fit(
    greys: Sequence[Image],
    inside: Mask,
    carrier_rad: Image,
    ambient: float,
    window: GaussianWindow,
    shifts_rad: Sequence[float],
    contrast: float = 1.0,
    terms: Sequence[tuple[int, int]] = PLANE,
) -> FringeFit:
    """`tied_fit` of g (1 + c cos(carrier + shift + d)), c the ``contrast``, around each pixel of
    ``greys``, float32 (H, W) each: one image, or several whose fringes are shifted by
    ``shifts_rad``."""
    real: type = np.float32 if len(terms) <= len(PLANE) else np.float64

    def view(grey: Image, shift: float) -> tuple[NDArray, NDArray, NDArray]:
        angle = carrier_rad.astype(real) + real(shift)
        return (
            grey - real(ambient),
            1 + real(contrast) * np.cos(angle),
            -real(contrast) * np.sin(angle),
        )

    views = (view(grey, shift) for grey, shift in zip(greys, shifts_rad, strict=True))
    g, s, share, _ = tied_fit(views, inside, window, terms)
    step = np.clip(s / np.maximum(g, 1.0), -LARGEST_STEP_RAD, LARGEST_STEP_RAD)
    return FringeFit(
        (carrier_rad + step).astype(np.float32),
        g.astype(np.float32),
        share.astype(np.float32),
        contrast,
    )


def measured_contrast(light: Image, inside: Mask, fit: FringeFit) -> float:
    """Modulation over mean of the fringes of ``light`` (grey levels less the ambient light), over
    the pixels whose window lies on the object: the contrast with which the phase and brightness of
    ``fit`` explain them best."""
    fringe, whole = np.cos(fit.phase_rad), inside & (fit.weight > WHOLE_WINDOW)
    varies = np.clip(light / np.maximum(fit.brightness, 1.0) - 1, -1, 1)
    power = float((fringe**2).sum(where=whole, dtype=np.float64))
    if power == 0:
        return fit.contrast
    return float(
        np.clip((fringe * varies).sum(where=whole, dtype=np.float64) / power, LEAST_CONTRAST, 1.0)
    )


def phase_slopes(residual_rad: Image, inside: Mask, smooth_px: float) -> tuple[Image, Image]:
    """Change of the residual phase a px along x and y, float32 (H, W), averaged under a Gaussian
    inside the mask."""
    size = 2 * int(np.ceil(2.5 * smooth_px)) + 1
    weight = cv2.erode(inside.astype(np.float32), np.ones((3, 3), np.uint8))
    total = np.maximum(
        cv2.GaussianBlur(weight, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT), 1e-3
    )
    slopes: list[Image] = []
    for axis in (1, 0):
        change: NDArray = (
            wrapped(np.roll(residual_rad, -1, axis) - np.roll(residual_rad, 1, axis)) / 2
        )
        change = (
            np.clip(change, -STEEPEST_RAD_PER_PX, STEEPEST_RAD_PER_PX).astype(np.float32) * weight
        )
        smooth = cv2.GaussianBlur(change, (size, size), smooth_px, borderType=cv2.BORDER_CONSTANT)
        slopes.append((smooth / total).astype(np.float32))
    return slopes[0], slopes[1]


def fringes(
    carriers: Carriers, nearness: NDArray, contrast: tuple[float, float]
) -> tuple[Image, Image]:
    """Light over brightness (h, w) of crossed fringes of some ``contrast`` at ``nearness``, and its
    change by the joint phase."""
    raised, slope = np.ones(nearness.shape, np.float32), np.zeros(nearness.shape, np.float32)
    shares = carriers.gain / carriers.joint_gain
    for phase, share, modulation in zip(carriers.phases(nearness), shares, contrast, strict=True):
        raised += np.float32(modulation) * np.cos(phase)
        slope -= np.float32(modulation) * np.sin(phase) * share
    return raised, slope


@dataclass(frozen=True)
class Demodulated:
    """On every ``stride``-th pixel: ``amplitude`` complex64 (2, h', w'), modulation and wrapped
    phase of each carrier, and ``mean_grey`` float32 (h', w')."""

    amplitude: NDArray[np.complex64]
    mean_grey: Image

    @property
    def phase_rad(self) -> Image:
        """Wrapped phases float32 (2, h', w')."""
        return np.angle(self.amplitude).astype(np.float32)

    @property
    def modulation(self) -> Image:
        """Grey levels, float32 (2, h', w')."""
        return np.abs(self.amplitude)


class Demodulator:
    """The filters of a pair of carriers, for images of their size; ``stride``: px between two
    answers."""

    def __init__(self, carriers: Carriers, stride: int) -> None:
        camera = carriers.rig.camera
        self.stride, self.shape = stride, (camera.height, camera.width)
        self._sigma_px = DEMODULATION_PERIODS * carriers.period_px
        kernels = window_kernels(carriers.step_rad, self._sigma_px)
        self._reach = kernels[0].shape[0] // 2
        # A length that the stride divides, so that every stride-th sample is a whole number of
        # samples apart.
        self._coarse = [
            fft.next_fast_len(-(-(length + 2 * self._reach) // stride)) for length in self.shape
        ]
        lengths = [stride * n for n in self._coarse]
        self._filters = []
        for kernel, step in zip(kernels, (*carriers.step_rad, np.zeros(2)), strict=True):
            # Bins of the carrier along rows and columns: the band around them is moved to zero
            # frequency.
            centre = [
                round(float(rad) * n / TAU) for rad, n in zip(step[::-1], lengths, strict=True)
            ]
            padded = np.zeros(lengths, np.complex128)
            padded[: kernel.shape[0], : kernel.shape[1]] = kernel
            padded = np.roll(padded, (-self._reach, -self._reach), (0, 1))
            bins = np.ix_(
                *(
                    self._band(c, n, m)
                    for c, n, m in zip(centre, lengths, self._coarse, strict=True)
                )
            )
            response = np.conj(fft.fft2(np.conj(padded)))[bins] / stride**2
            ramps = [
                np.exp(1j * TAU * c * (np.arange(0, size, stride)) / n)
                for c, n, size in zip(centre, lengths, self.shape, strict=True)
            ]
            self._filters.append(
                (bins, response.astype(np.complex64), np.outer(*ramps).astype(np.complex64))
            )
        self._lengths = lengths

    @staticmethod
    def _band(centre: int, length: int, coarse: int) -> NDArray[np.intp]:
        return (centre + np.rint(fft.fftfreq(coarse, 1 / coarse)).astype(np.intp)) % length

    def noise(self, noise_grey: float) -> float:
        """Noise of a modulation where pixels have ``noise_grey``."""
        return noise_grey / (self._sigma_px * float(np.sqrt(TAU)))

    def phases_at(self, seen: Demodulated, carriers: Carriers) -> Image:
        """Wrapped phases float32 (2, h, w) of all pixels of ``carriers``, from those on the grid:
        the carrier itself is taken out before interpolating, and what is left changes slowly."""
        rows, columns = carriers.crop
        y, x = (np.arange(part.start, part.stop, dtype=np.float32) for part in (rows, columns))
        grid_y, grid_x = (self.stride * np.arange(n) for n in seen.mean_grey.shape)
        places = np.meshgrid(x / self.stride, y / self.stride)
        phases = []
        for amplitude, (across, down) in zip(seen.amplitude, carriers.step_rad, strict=True):
            slow = amplitude * np.outer(
                np.exp(-1j * down * grid_y), np.exp(-1j * across * grid_x)
            ).astype(np.complex64)
            real, imaginary = (
                cv2.remap(
                    np.ascontiguousarray(part),
                    *places,
                    cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE,
                )
                for part in (slow.real, slow.imag)
            )
            fast = (down * y)[:, None] + across * x
            phases.append(wrapped(np.arctan2(imaginary, real) + fast))
        return np.stack(phases).astype(np.float32)

    def __call__(self, grey: Image) -> Demodulated:
        """Demodulate an image float32 (H, W); beyond its border it is continued by its mirror
        image."""
        (height, width), reach = self.shape, self._reach
        after = [n - length - reach for n, length in zip(self._lengths, self.shape, strict=True)]
        padded = np.pad(grey, ((reach, after[0]), (reach, after[1])), mode="symmetric")
        padded = np.roll(padded, (-reach, -reach), (0, 1))
        spectrum = fft.fft2(padded.astype(np.float32))
        rows, columns = -(-height // self.stride), -(-width // self.stride)
        answers = []
        for bins, response, ramp in self._filters:
            answers.append(fft.ifft2(spectrum[bins] * response)[:rows, :columns] * ramp)
        return Demodulated(np.stack(answers[:2]), np.ascontiguousarray(answers[2].real))


def window_kernels(step_rad: NDArray[np.float64], sigma_px: float) -> list[NDArray[np.complex128]]:
    """Weights (n, n) of the grey levels around a pixel that give z of both carriers and the mean:
    the least-squares solution of this module's model under a Gaussian window of ``sigma_px``;
    ``step_rad`` (2, 2) as of `Carriers`."""
    half = int(np.ceil(WINDOW_SIGMAS * sigma_px))
    x, y = np.meshgrid(*[np.arange(-half, half + 1, dtype=np.float64)] * 2)
    window = np.exp(-0.5 * (x * x + y * y) / sigma_px**2).ravel()
    terms = [(x / sigma_px) ** a * (y / sigma_px) ** b for a, b in CURVED]
    for across, down in step_rad:
        terms += [np.cos(across * x + down * y), np.sin(across * x + down * y)]
    design = np.stack([term.ravel() for term in terms], axis=1)
    weighted = window[:, None] * design
    solution = np.linalg.solve(design.T @ weighted, weighted.T).reshape(-1, *x.shape)
    first = len(CURVED)
    # A cos + B sin is the real part of (A - i B) exp(i k x).
    pairs = [solution[n] - 1j * solution[n + 1] for n in (first, first + 2)]
    return [*pairs, solution[0] + 0j]


def steadied(
    phase_rad: Image,
    modulation: Image,
    carrier_rad: Image,
    noise_grey: float,
    inside: Mask,
    sigma_px: float,
) -> tuple[Image, Image, Image]:
    """Phase and modulation (h, w) of shifted frames and the modulation's noise, ``noise_grey`` for
    a pixel alone. Where noise hides its phase, they are those of an average over its neighbours
    ``inside``, from which the carrier, whose phase is ``carrier_rad``, is taken out first."""
    weight = inside.astype(np.float32)
    carrier, own = (np.exp(1j * rad).astype(np.complex64) for rad in (carrier_rad, phase_rad))
    slow = weight * modulation * own / carrier
    maps = (weight, weight * modulation * modulation, slow.real, slow.imag)
    share, power, real, imaginary = (
        cv2.GaussianBlur(np.ascontiguousarray(image), (0, 0), sigma_px) for image in maps
    )
    share = np.maximum(share, np.float32(1e-6))
    weak = inside & (power < (WEAK_SIGMAS * noise_grey) ** 2 * share)
    average = (real + np.complex64(1j) * imaginary) / share
    phase = np.where(weak, np.angle(average * carrier), phase_rad).astype(np.float32)
    # The mean of white noise under a Gaussian of sigma s has 1 / (2 s sqrt(pi)) of its standard
    # deviation.
    noise = np.where(weak, noise_grey / (2 * sigma_px * np.sqrt(np.pi)), noise_grey).astype(
        np.float32
    )
    return phase, np.where(weak, np.abs(average), modulation).astype(np.float32), noise


def phase_noise_grey(psi: Image, modulation: Image, inside: Mask) -> float:
    """Noise of a frame in grey levels, from the second differences of the phase ``psi`` (h, w),
    rad, of three frames along the rows of the object; surfaces are planes to them, except for few
    pixels."""
    middle = inside[:, 2:] & inside[:, :-2] & inside[:, 1:-1]
    if not middle.any():
        return FLOOR_NOISE_GREY
    second = (psi[:, 2:] - 2 * psi[:, 1:-1] + psi[:, :-2])[middle] * modulation[:, 1:-1][middle]
    return max(
        MAD_TO_SIGMA * float(np.median(np.abs(second))) / np.sqrt(6 * 2 / 3), FLOOR_NOISE_GREY
    )


def same_plane_mean(psi: Image, sigma: Image, inside: Mask) -> tuple[Image, Image]:
    """Mean of every pixel's phase ``psi`` (h, w), rad, of standard uncertainty ``sigma``, and of
    the pairs of pixels opposite each other, up to `REACH_PX` away, that differ from it and from a
    plane through it by no more than noise; and the mean's uncertainty. Opposite pixels have the
    mean of their plane at the pixel, so a slope adds nothing."""
    reach, limit = REACH_PX, np.float32(SAME_PLANE_SIGMAS**2)
    height, width = psi.shape
    maps = np.pad(
        np.stack([psi, sigma * sigma, inside]).astype(np.float32),
        ((0, 0), (reach, reach), (reach, reach)),
    )

    def beside(down: int, right: int) -> NDArray[np.float32]:
        return maps[:, reach + down : reach + down + height, reach + right : reach + right + width]

    own = beside(0, 0)[1]
    total, weights = psi / own, 1 / own
    half = [(0, right) for right in range(1, reach + 1)]
    half += [(down, right) for down in range(1, reach + 1) for right in range(-reach, reach + 1)]
    for down, right in half:
        (first, first_variance, first_known), (second, second_variance, second_known) = (
            beside(down, right),
            beside(-down, -right),
        )
        alike = (first_known > 0) & (second_known > 0)
        alike &= (first - psi) ** 2 < limit * (first_variance + own)
        alike &= (second - psi) ** 2 < limit * (second_variance + own)
        variance = first_variance + second_variance
        alike &= (first + second - 2 * psi) ** 2 < limit * (variance + 4 * own)
        # The middle of a pair, each with half of its weight, has a quarter of the sum of both
        # variances.
        weight = np.where(alike, 4 / np.maximum(variance, np.float32(1e-12)), np.float32(0))
        total += weight * (first + second) / 2
        weights += weight
    return (total / weights).astype(np.float32), np.sqrt(1 / weights).astype(np.float32)


def best_sides(
    fit_of: tuple[Image, Image],
    light: Image,
    inside: Mask,
    raised: Callable[[Image], Image],
    noise_grey: float,
    period_px: float,
) -> tuple[Image, Image, NDArray[np.intp]]:
    """The window of a pixel near a depth edge or a crease covers two surfaces, and its fit lies
    between them. The windows of some of its neighbours, up to three quarters of a period away,
    cover one: each offers its plane, and the offer wins that explains the grey levels around the
    pixel best.

    ``fit_of``: what was fitted, a map that depth follows from and the brightness, (h, w);
    ``raised``: light over brightness that follows from such a map; ``light``: grey levels less
    ambient light. Returns both maps, and rows and columns (2, h, w) of the neighbours that they are
    from."""
    if min(inside.shape) < 2:  # no object
        return *fit_of, np.indices(inside.shape)
    weight = inside.astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), SIDE_SLOPE_PX), 1e-6)
    maps = [*fit_of, weight]
    for values in fit_of:
        maps += np.gradient(cv2.GaussianBlur(values * weight, (0, 0), SIDE_SLOPE_PX) / share)
    reach = round(max(SIDE_PERIODS) * period_px)
    padded = np.pad(np.stack(maps).astype(np.float32), ((0, 0), (reach, reach), (reach, reach)))
    turns = TAU * np.arange(SIDES) / SIDES
    offsets = [(0, 0)] + [
        (round(distance * period_px * np.sin(turn)), round(distance * period_px * np.cos(turn)))
        for distance in SIDE_PERIODS
        for turn in turns
    ]
    share = np.maximum(cv2.GaussianBlur(weight, (0, 0), SIDE_WINDOW_PX), 1e-6)
    height, width = inside.shape
    best, away = (
        np.full((3, height, width), np.inf, np.float32),
        np.zeros((2, height, width), np.intp),
    )
    for down, right in offsets:
        there = (
            slice(reach + down, reach + down + height),
            slice(reach + right, reach + right + width),
        )
        values, bright, known, by_y, by_x, bright_y, bright_x = padded[:, *there]
        offered = values - down * by_y - right * by_x
        bright = np.maximum(bright - down * bright_y - right * bright_x, 0)
        cost = (light - bright * raised(offered)) ** 2 / (
            noise_grey**2 + (SIDE_SHARE * bright) ** 2
        )
        cost = np.where(known > 0, np.minimum(cost, SIDE_CAP), SIDE_CAP) * weight
        mean = (
            cv2.GaussianBlur(cost, (0, 0), SIDE_WINDOW_PX) / share
            + SIDE_COST * np.hypot(down, right) / period_px
        )
        won = inside & (known > 0) & (mean < best[0])
        best[:, won] = mean[won], offered[won], bright[won]
        away[0][won], away[1][won] = down, right
    best[1:, ~inside] = np.stack(fit_of)[:, ~inside]
    return best[1], best[2], np.indices(inside.shape) + away
