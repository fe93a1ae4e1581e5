"""Amplitude and phase of both carriers around every few pixels, by one linear filter each.

Around a pixel the frame is fitted, under a Gaussian window, by a quadratic brightness and both carriers:
``I = p(x, y) + sum_k Re(z_k exp(i k_k (x, y)))``. The solution z_k is a fixed combination of grey levels, the same at
every pixel, so that it is computed with Fourier transforms, and only where it is needed: the filter's band is narrow,
and its part of the spectrum, transformed back alone, gives z_k on a grid of every ``stride``-th pixel.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from fpp_ml_bench.baselines.phase.calibration_layer import TAU, Image, wrapped
from fpp_ml_bench.baselines.phase.carriers import Carriers

WINDOW_PERIODS = 0.4  # sigma of the window, in periods of the longer carrier
WINDOW_SIGMAS = 3.0
POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Powers of x and y of the brightness: its change across the window would otherwise count as phase."""


@dataclass(frozen=True)
class Demodulated:
    """On every ``stride``-th pixel: ``amplitude`` complex64 (2, h', w'), modulation and wrapped phase of each carrier,
    and ``mean_grey`` float32 (h', w')."""

    amplitude: NDArray[np.complex64]
    mean_grey: Image
    stride: int

    @property
    def phase_rad(self) -> Image:
        """Wrapped phases float32 (2, h', w')."""
        return np.angle(self.amplitude).astype(np.float32)

    @property
    def modulation(self) -> Image:
        """Grey levels, float32 (2, h', w')."""
        return np.abs(self.amplitude)


class Demodulator:
    """The filters of a pair of carriers, for images of their size; ``stride``: px between two answers."""

    def __init__(self, carriers: Carriers, stride: int) -> None:
        camera = carriers.rig.camera
        self.stride, self.shape = stride, (camera.height, camera.width)
        kernels = window_kernels(carriers.step_rad, WINDOW_PERIODS * carriers.period_px)
        self._reach = kernels[0].shape[0] // 2
        # A length that the stride divides, so that every stride-th sample is a whole number of samples apart.
        self._coarse = [fft.next_fast_len(-(-(length + 2 * self._reach) // stride)) for length in self.shape]
        lengths = [stride * n for n in self._coarse]
        self._filters = []
        for kernel, step in zip(kernels, (*carriers.step_rad, np.zeros(2)), strict=True):
            # Bins of the carrier along rows and columns: the band around them is moved to zero frequency.
            centre = [round(float(rad) * n / TAU) for rad, n in zip(step[::-1], lengths, strict=True)]
            padded = np.zeros(lengths, np.complex128)
            padded[: kernel.shape[0], : kernel.shape[1]] = kernel
            padded = np.roll(padded, (-self._reach, -self._reach), (0, 1))
            bins = np.ix_(*(self._band(c, n, m) for c, n, m in zip(centre, lengths, self._coarse, strict=True)))
            response = np.conj(fft.fft2(np.conj(padded)))[bins] / stride**2
            ramps = [
                np.exp(1j * TAU * c * (np.arange(0, size, stride)) / n)
                for c, n, size in zip(centre, lengths, self.shape, strict=True)
            ]
            self._filters.append((bins, response.astype(np.complex64), np.outer(*ramps).astype(np.complex64)))
        self._lengths = lengths

    @staticmethod
    def _band(centre: int, length: int, coarse: int) -> NDArray[np.intp]:
        return (centre + np.rint(fft.fftfreq(coarse, 1 / coarse)).astype(np.intp)) % length

    def phases_at(self, seen: Demodulated, carriers: Carriers) -> Image:
        """Wrapped phases float32 (2, h, w) of all pixels of ``carriers``, from those on the grid: the carrier itself
        is taken out before interpolating, and what is left changes slowly."""
        rows, columns = carriers.crop
        y, x = (np.arange(part.start, part.stop, dtype=np.float32) for part in (rows, columns))
        grid_y, grid_x = (self.stride * np.arange(n) for n in seen.mean_grey.shape)
        places = np.meshgrid(x / self.stride, y / self.stride)
        phases = []
        for amplitude, (across, down) in zip(seen.amplitude, carriers.step_rad, strict=True):
            slow = amplitude * np.outer(np.exp(-1j * down * grid_y), np.exp(-1j * across * grid_x)).astype(np.complex64)
            real, imaginary = (
                cv2.remap(np.ascontiguousarray(part), *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                for part in (slow.real, slow.imag)
            )
            fast = (down * y)[:, None] + across * x
            phases.append(wrapped(np.arctan2(imaginary, real) + fast))
        return np.stack(phases).astype(np.float32)

    def __call__(self, grey: Image) -> Demodulated:
        """Demodulate an image float32 (H, W); beyond its border it is continued by its mirror image."""
        (height, width), reach = self.shape, self._reach
        after = [n - length - reach for n, length in zip(self._lengths, self.shape, strict=True)]
        padded = np.pad(grey, ((reach, after[0]), (reach, after[1])), mode="symmetric")
        padded = np.roll(padded, (-reach, -reach), (0, 1))
        spectrum = fft.fft2(padded.astype(np.float32))
        rows, columns = -(-height // self.stride), -(-width // self.stride)
        answers = []
        for bins, response, ramp in self._filters:
            answers.append(fft.ifft2(spectrum[bins] * response)[:rows, :columns] * ramp)
        return Demodulated(np.stack(answers[:2]), np.ascontiguousarray(answers[2].real), self.stride)


def window_kernels(step_rad: NDArray[np.float64], sigma_px: float) -> list[NDArray[np.complex128]]:
    """Weights (n, n) of the grey levels around a pixel that give z of both carriers and the mean: the least-squares
    solution of this module's model under a Gaussian window of ``sigma_px``; ``step_rad`` (2, 2) as of `Carriers`."""
    half = int(np.ceil(WINDOW_SIGMAS * sigma_px))
    x, y = np.meshgrid(*[np.arange(-half, half + 1, dtype=np.float64)] * 2)
    window = np.exp(-0.5 * (x * x + y * y) / sigma_px**2).ravel()
    terms = [(x / sigma_px) ** a * (y / sigma_px) ** b for a, b in POWERS]
    for across, down in step_rad:
        terms += [np.cos(across * x + down * y), np.sin(across * x + down * y)]
    design = np.stack([term.ravel() for term in terms], axis=1)
    weighted = window[:, None] * design
    solution = np.linalg.solve(design.T @ weighted, weighted.T).reshape(-1, *x.shape)
    first = len(POWERS)
    # A cos + B sin is the real part of (A - i B) exp(i k x).
    pairs = [solution[n] - 1j * solution[n + 1] for n in (first, first + 2)]
    return [*pairs, solution[0] + 0j]
