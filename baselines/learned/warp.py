"""The warp of an image to the carriers that a network learned from, which lets one network measure
on any rig.

A network knows fringes of one period and direction in the image. An affine map of the image puts
one carrier there, or two at once: where carrier k has the phase ``k_rig . p`` at the pixel p, and
the network learned ``k . p'``, the map ``p' = T p`` with ``K T = S K_rig`` brings both together, K
the rows k and S the signs. The phases come back less those of their carriers, as complex numbers,
so that they are interpolated without their wraps.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.baselines.phase.geometry import CalibrationLayer, Carriers, Image, wrapped
from fpp_ml_bench.constants import MM_PER_M, TAU
from fpp_ml_bench.optics.named_rigs import CROSSED, DEFAULT_CROSSED, crossed_rig
from fpp_ml_bench.optics.rig import Rig

NEAR_SHARE = 0.02
"""Largest difference of the map from none at which the image stays as it is: within it a network
has met all periods and angles, since a fringe's period differs by more over the relief of an
object."""
SHARPEST_PX = 0.45
"""Sigma of the blur that a pixel of the shrunk image has anyway, in its pixels: what is added
before it is shrunk makes the whole as wide."""


PLACES = {1: (0,), 2: (1, 2)}
"""Which of the three carriers of a network for any rig are those of a frame with one, or two."""
KNOWN_PX = {1: 18.0, 2: 15.0}
"""Image px a period that a network knows best, of one carrier and of two; the second is that of the
paper's rig."""
PERIOD_RATIO = 0.7, 1.6
"""Limits of the periods in training windows, over `KNOWN_PX`."""


@cache
def known(carriers: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What a network knows best: change (K, 2) in rad per px along x and y of the carriers' phases,
    and their signs (K,), 1 where a phase grows with nearness. One grows downwards; two are those of
    the paper's rig."""
    if carriers == 1:
        return np.array([[0.0, TAU / KNOWN_PX[1]]]), np.ones(1)
    pair = Carriers.of(crossed_rig(), CROSSED[DEFAULT_CROSSED])
    return pair.step_rad, signs_of(pair.gain)


def to_known(
    step_rad: NDArray[np.float64], signs: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The map (2, 2) from pixels of an image, whose carriers have ``step_rad`` (K, 2) and ``signs``
    (K,), to those of the known ones, and the signs (K,) by which the phases are multiplied."""
    steps, known_signs = known(len(signs))
    turned = signs * known_signs
    if len(signs) == 2:
        return np.asarray(np.linalg.solve(steps, turned[:, None] * step_rad), np.float64), turned
    x, y = (float(step) for step in turned[0] * step_rad[0] / steps[0, 1])
    return np.array([[y, -x], [x, y]]), turned


def known_scale(matrix: NDArray[np.float64]) -> float:
    """By how much an image that ``matrix`` would bring to `KNOWN_PX` stays larger or smaller: the
    least change of size that brings it within `PERIOD_RATIO`, some way from its ends."""
    size = float(np.sqrt(abs(np.linalg.det(matrix))))
    least, most = PERIOD_RATIO
    return float(np.clip(1 / size, least * 1.1, most / 1.15))


@dataclass(frozen=True)
class Warp:
    """From pixels of an image to those of the network's. ``matrix`` float64 (2, 2): T. ``step_rad``
    (K, 2): change of each learned phase per px of the network's along x and y. ``signs`` (K,): +-1,
    of the phases."""

    matrix: NDArray[np.float64]
    step_rad: NDArray[np.float64]
    signs: NDArray[np.float64]

    @classmethod
    def of(cls, step_rad: NDArray[np.float64], signs: NDArray[np.float64]) -> "Warp":
        """Of the carriers ``step_rad`` (K, 2) and ``signs`` (K,) to what `known` says, no further
        in size than `known_scale`."""
        matrix, turned = to_known(step_rad, signs)
        matrix = matrix * known_scale(matrix)
        return cls(matrix, turned[:, None] * step_rad @ np.linalg.inv(matrix), turned)

    @property
    def period_px(self) -> float:
        """Of the longer carrier in the network's image."""
        return float((TAU / np.linalg.norm(self.step_rad, axis=1)).max())

    @property
    def needed(self) -> bool:
        """Whether the image is not left as it is."""
        return bool(np.abs(self.matrix - np.eye(2)).max() > NEAR_SHARE)

    def image(self, grey: Image) -> Image:
        """The image float32 (h, w) as the network knows it; beyond its borders it is mirrored."""
        size, move = self.frame(grey.shape)
        grey = smoothed(grey, self.matrix)
        affine = np.column_stack([self.matrix, move])
        return cv2.warpAffine(  # type: ignore[return-value]
            grey, affine, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )

    def back(self, phase_rad: Image, maps: Sequence[Image], shape: tuple[int, ...]) -> list[Image]:
        """Phases (K, h', w') of the network's image at the pixels of an image of ``shape`` (h, w),
        in [-pi, pi], and behind them other ``maps`` (h', w') of it, interpolated."""
        _, (right, down) = self.frame(shape)
        x, y = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
        (a, b), (c, d) = self.matrix
        across, along = a * x + b * y + right, c * x + d * y + down
        places = across.astype(np.float32), along.astype(np.float32)

        def taken(image: NDArray) -> NDArray:
            smooth = image.astype(np.float32)
            return cv2.remap(smooth, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

        own_x, own_y = np.meshgrid(*(np.arange(n) for n in phase_rad.shape[:0:-1]))
        phases = []
        for phase, (along_x, along_y), sign in zip(
            phase_rad, self.step_rad, self.signs, strict=True
        ):
            beside = phase - (along_x * own_x + along_y * own_y)
            carrier = along_x * across + along_y * along
            angle = np.arctan2(taken(np.sin(beside)), taken(np.cos(beside)))
            phases.append(wrapped(sign * (angle + carrier)).astype(np.float32))
        return [np.stack(phases), *map(taken, maps)]

    def frame(self, shape: tuple[int, ...]) -> tuple[tuple[int, int], NDArray[np.float64]]:
        """Width and height of the network's image of one of ``shape`` (h, w), and what is added to
        ``T p`` for all of it to lie within."""
        height, width = shape
        corners = self.matrix @ [[0, width - 1, 0, width - 1], [0, 0, height - 1, height - 1]]
        least = corners.min(axis=1)
        across, down = np.ceil(corners.max(axis=1) - least).astype(int) + 1
        return (int(across), int(down)), -least


def smoothed(grey: Image, matrix: NDArray[np.float64]) -> Image:
    """An image (h, w) before ``matrix`` shrinks it: finer detail than a pixel of the smaller image
    is averaged; as it is where nothing shrinks."""
    least = float(np.linalg.svd(matrix, compute_uv=False).min())
    if least >= 1:
        return grey
    return cv2.GaussianBlur(grey, (0, 0), SHARPEST_PX * np.sqrt(1 / least**2 - 1))  # type: ignore[return-value]


def signs_of(gains: Iterable[NDArray]) -> NDArray[np.float64]:
    """Whether each phase (K,), whose change with nearness is one of ``gains`` (h, w), grows with
    it, 1, or falls, -1."""
    return np.array([1.0 if np.median(gain) > 0 else -1.0 for gain in gains])


def steps_and_signs(
    rig: Rig, layer: CalibrationLayer
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of fringes of one direction: change (1, 2) in rad of the phase per px along x and y at the
    standoff, and its sign (1,) as of `signs_of`."""
    phase = layer.absolute_phase(rig.standoff_m * MM_PER_M)
    return np.array([[np.diff(phase, axis=axis).mean() for axis in (1, 0)]]), signs_of([layer.gain])
