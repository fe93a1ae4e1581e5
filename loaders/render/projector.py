"""The projector: from 8-bit patterns to linear light at a distance, blurred by its pixels, its lens
and its focus.

Light is a fraction of the brightest pixel's. A pattern varies along one coordinate, so blur acts
along it alone. Its variances add: of the transfer function in focus, of the camera pixel's
footprint, and of the defocus, whose sigma grows with the distance from the focus in dioptres, as a
thin lens's blur circle does. A Gaussian of variance q px^2 takes exp(-2 pi^2 q / P^2) of the
modulation of a sinusoid of period P, and makes the edges of Gray code soft.

Crossed fringes vary along both coordinates, but their light depends on two phases alone, so that
one small table over the phases of both carriers serves every pixel and every shift. It is a sum of
harmonics ``cos 2 pi (m t1 + n t2)`` of the carriers' turns t1, t2: (1, 0) and (0, 1) alone if light
is proportional to the pattern's level. Each has a frequency on the pattern, and blur takes exp(-2
pi^2 q F^2) of it, as of a sinusoid of a single direction. Between the centres of projector pixels
light is linear here too. The pattern's rounding to 8 bits, 0.3 grey levels RMS, is left out.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import GREY_LEVELS, MM_PER_M
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.light import ProjectorLight
from fpp_ml_bench.machine import njit
from fpp_ml_bench.optics.patterns import pattern_profile
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, DIRECTIONS, AnySequence, Frame
from fpp_ml_bench.portable import (
    cosine_of_turns,
    exponential,
    gaussian_weights,
    power,
    sine_of_turns,
)

FINE = 4
"""Samples a projector pixel where blur depends on the distance; linear interpolation between them
costs a sinusoid of 18 px 0.06% of its modulation. Without such blur a sample a pixel, which is what
the pixels say."""
MOST_DEFOCUS_PX = 100.0
"""Largest sigma within the range and on the background plane."""
ALONG_V, ALONG_U, ALONG_BOTH = 0, 1, 2
"""The projector coordinate that a frame varies along; crossed fringes vary along both."""
SIDE = 128
"""Entries a turn: linear interpolation between them costs 0.02% of a carrier's modulation."""
HARMONICS = 16
"""The highest m and n of a response that is no line; a projector gamma of 2.2 leaves 2e-6 of the
light beyond."""
_LEAST = 1e-9
"""Least share of a term of the light's cosine series that is summed: smaller ones add no light that
a sensor tells."""


class PatternPlace(NamedTuple):
    """Where n surface points read `PatternLight`: of u and of v the sample, uint16 (n,), and the
    weight of the next one, float32 (n,); for blur the ``level`` uint8 (n,) and the weight of the
    next one, empty where there is one level.
    """

    u_index: NDArray[np.uint16]
    u_weight: NDArray[np.float32]
    v_index: NDArray[np.uint16]
    v_weight: NDArray[np.float32]
    level: NDArray[np.uint8]
    level_weight: NDArray[np.float32]


class PatternLight(NamedTuple):
    """Linear light of every frame along the coordinate it varies with.

    ``table`` float32 (F, S, L + 1) in [0, 1]: per frame and blur level, ``per_px`` samples a
    projector pixel, the last one repeated; crossed frames read ``crossed`` instead, a `phase_table`
    with S levels, at the turns of their ``waves`` float64 (F, 2, 3): of both carriers the cycles
    per projector px along u and v, and the turns at pixel (0, 0). ``variance_px2`` float64 (S,),
    ascending: the blur of each level. ``along`` uint8 (F,): `ALONG_V` and so on; black and white
    vary along neither.
    """

    table: NDArray[np.float32]
    along: NDArray[np.uint8]
    variance_px2: NDArray[np.float64]
    per_px: int
    crossed: NDArray[np.float32]
    waves: NDArray[np.float64]

    @classmethod
    def of(cls, rig: Rig, light: ProjectorLight, pixel_area: bool = True) -> "PatternLight":
        """The light of a rig's patterns; with ``pixel_area`` as a camera pixel averages it at the
        standoff."""
        still = light.pixel_blur_px**2
        levels, per_px = np.array([0.0]), 1
        if light.defocus_px > 0:
            levels, per_px = _levels(defocus_variance_px2(rig, light, _distances(rig)).max()), FINE
        response = response_table(light.response)
        length = max(rig.projector.width, rig.projector.height)
        fine = np.arange((length - 1) * per_px + 1) / per_px
        footprint = {
            direction: rig.projector_px_per_image_px(direction) ** 2 / 12
            for direction in DIRECTIONS
        }
        table = np.zeros((len(rig.sequence), len(levels), len(fine)), dtype=np.float32)
        for frame, rows in zip(rig.sequence, table, strict=True):
            if frame.kind == "crossed":
                continue
            linear = response[pattern_profile(rig, frame.index)]
            whole = np.interp(fine, np.arange(len(linear)), linear)
            area = footprint[frame.direction] if frame.direction and pixel_area else 0.0
            for row, level in zip(rows, levels, strict=True):
                row[:] = blurred(whole, (level + still + area) * per_px**2)
        table = np.pad(table, ((0, 0), (0, 0), (0, 1)), mode="edge")
        along = np.array([_along(frame) for frame in rig.sequence], dtype=np.uint8)
        waves, crossed = np.zeros((len(along), 2, 3)), np.zeros((0, 2, 2), dtype=np.float32)
        if rig.crossed is not None:
            area_px2 = np.array([footprint[direction] if pixel_area else 0.0 for direction in AXES])
            blur = (levels + still)[:, None] + area_px2
            crossed = phase_table(rig.crossed, lambda level: respond(light.response, level), blur)
            for index, shifts in zip(
                rig.sequence.crossed_frames, rig.crossed.shifts_deg, strict=True
            ):
                waves[index, :, :2], waves[index, :, 2] = (
                    rig.crossed.cycles_per_px,
                    np.divide(shifts, 360),
                )
        return cls(table, along, levels, per_px, crossed, waves)

    def modes(self, sequence: AnySequence) -> tuple["PatternLight", NDArray[np.float32]]:
        """Fewer patterns that stand for all in diffuse light: black is left out, and the steps of a
        direction's sinusoids are their mean and first harmonic. Higher harmonics, of a response
        that is no line, do not survive the way over another surface. Returns them and the weights
        ``mix`` float32 (F, J) that give every frame again."""
        count = len(self.table)
        taken, given, like = (
            [],
            [],
            [],
        )  # per mode: the weight of each frame in it, in each frame, a frame of its kind
        sets = sequence.equal_steps()
        for indices, turns in sets:
            frames = list(indices)
            cosine, sine = cosine_of_turns(turns), sine_of_turns(turns)
            for weights, scale in ((np.ones(len(frames)), 1.0), (cosine, 2.0), (sine, 2.0)):
                taken.append(np.zeros(count))
                given.append(np.zeros(count))
                taken[-1][frames], given[-1][frames] = scale / len(frames) * weights, weights
                like.append(frames[0])
        sinusoids = {index for indices, _ in sets for index in indices}
        for frame in (
            frame for frame in range(count) if frame not in sinusoids and frame != sequence.black
        ):
            taken.append(np.eye(count)[frame])
            given.append(np.eye(count)[frame])
            like.append(frame)
        table = np.zeros((len(taken), *self.table.shape[1:]))
        for row, weights in zip(table, taken, strict=True):
            for place in np.flatnonzero(weights):  # in order, on every processor
                row += weights[place] * self.table[place]
        mix = np.stack(given, axis=1).astype(np.float32)
        return self._replace(
            table=table.astype(np.float32), along=self.along[like], waves=self.waves[like]
        ), mix

    def uniform(self, rig: Rig) -> "PatternLight":
        """The mean light of each frame over the projector's pixels, which end where the pattern is
        carried on."""
        table = np.empty_like(self.table)
        for frame, along in enumerate(self.along):
            length = rig.projector.width if along == ALONG_U else rig.projector.height
            known = self.table[frame, :, : (length - 1) * self.per_px + 1]
            table[frame] = known.mean(axis=1, keepdims=True)
        crossed = np.empty_like(self.crossed)
        crossed[:] = self.crossed[:, :-1, :-1].mean(axis=(1, 2), keepdims=True)
        return self._replace(table=table, crossed=crossed)

    def place(
        self,
        u_px: NDArray[np.float64],
        v_px: NDArray[np.float64],
        distance_m: NDArray[np.float64],
        rig: Rig,
        light: ProjectorLight,
    ) -> PatternPlace:
        """The place of projector pixels (n,) at a distance (n,) along the projector's axis; beyond
        the outer pixel centres the outer pixel is read."""
        level, level_weight = np.empty(0, dtype=np.uint8), np.empty(0, dtype=np.float32)
        if len(self.variance_px2) > 1:
            variance = np.clip(
                np.nan_to_num(defocus_variance_px2(rig, light, distance_m)),
                0,
                self.variance_px2[-1],
            )
            below = np.clip(
                np.searchsorted(self.variance_px2, variance, "right") - 1,
                0,
                len(self.variance_px2) - 2,
            )
            step = self.variance_px2[below + 1] - self.variance_px2[below]
            level, level_weight = (
                below.astype(np.uint8),
                ((variance - self.variance_px2[below]) / step).astype("f4"),
            )
        return PatternPlace(
            *self._sample(u_px, rig.projector.width),
            *self._sample(v_px, rig.projector.height),
            level,
            level_weight,
        )

    def read(self, place: PatternPlace, irradiance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Irradiance in every frame, float64 (F, n), at points whose irradiance under white is
        ``irradiance`` (n,)."""
        out = np.empty((len(self.table), irradiance.size))
        read_kernel(out, irradiance, self, place)
        return out

    def _sample(self, coordinate_px: NDArray[np.float64], length: int) -> tuple[NDArray, NDArray]:
        last = (length - 1.0) * self.per_px
        inside = np.clip(np.nan_to_num(coordinate_px) * self.per_px, 0.0, last)
        index = np.minimum(np.floor(inside), last - 1)
        return index.astype(np.uint16), (inside - index).astype(np.float32)


def response_table(response: float | tuple[float, ...]) -> NDArray[np.float64]:
    """Linear light of each 8-bit pattern level, float64 (256,) in [0, 1]: a power of it, or a
    measured curve given at evenly spaced levels from 0 to 255, interpolated."""
    return respond(response, np.arange(GREY_LEVELS + 1) / GREY_LEVELS)


def respond(response: float | tuple[float, ...], level: NDArray[np.float64]) -> NDArray[np.float64]:
    """The response to ``level`` (n,) in [0, 1], float64 (n,) in [0, 1]."""
    if isinstance(response, tuple):
        return np.interp(level, np.linspace(0.0, 1.0, len(response)), response)
    return level if response == 1.0 else power(level, response)


def defocus_variance_px2(
    rig: Rig, light: ProjectorLight, distance_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Variance of the defocus in projector px^2 at distances (n,) from the projector, along its
    axis."""
    far_m = rig.working_range_mm[1] / MM_PER_M
    focus = 1.0 / light.focus_m
    sigma = light.defocus_px * (1.0 / distance_m - focus) / (1.0 / far_m - focus)
    return sigma * sigma


def check_focus(rig: Rig, light: ProjectorLight) -> None:
    """Raise `BuildError` where the far end of the range, at which ``defocus_px`` is the blur, is
    all but in focus."""
    with np.errstate(divide="ignore", invalid="ignore"):
        most = float(np.sqrt(defocus_variance_px2(rig, light, _distances(rig)).max()))
    if light.defocus_px > 0 and not most <= MOST_DEFOCUS_PX:
        raise BuildError(
            f"projector.focus_m {light.focus_m:g} with defocus_px {light.defocus_px:g} at the far "
            f"end of the working "
            f"range, {rig.working_range_mm[1]:g} mm: the blur elsewhere would exceed "
            f"{MOST_DEFOCUS_PX:g} px; focus "
            "farther from that end"
        )


def blurred(signal: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    """The signal (n,) convolved with a Gaussian of ``variance`` samples^2, its ends repeated;
    float64 (n,)."""
    if variance == 0.0:
        return signal
    weights = gaussian_weights(variance)
    reach = len(weights) // 2
    padded = np.pad(signal, reach, mode="edge")
    total = np.zeros_like(signal)
    for shift, weight in enumerate(weights):  # in order, on every processor
        total += weight * padded[shift : shift + len(signal)]
    return total


def _distances(rig: Rig) -> NDArray[np.float64]:
    near_m, far_m = rig.range_m
    return np.array([near_m, far_m, rig.background])


def _along(frame: Frame) -> int:
    if frame.kind == "crossed":
        return ALONG_BOTH
    return ALONG_U if frame.direction == "vertical" else ALONG_V


def _levels(most: float) -> NDArray[np.float64]:
    """Variances from 0 to ``most`` px^2, so close that between them light is linear to 1e-4 at a
    pitch of 18 px."""
    levels = [0.0, 1.0 / FINE**2]
    while levels[-1] < most:
        levels.append(levels[-1] * 1.06 + 0.4)
    return np.array(levels)


def phase_table(
    crossed: Crossed,
    light_of_level: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    variance_px2: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Light in [0, 1] over the carriers' turns, float32 (S, SIDE + 1, SIDE + 1), the first entry
    repeated at the end. ``light_of_level`` maps pattern levels in [0, 1] to linear light;
    ``variance_px2`` (S, 2): of the blur along u and v."""
    turns, orders = np.arange(SIDE) / SIDE, range(HARMONICS + 1)
    cosine, sine = (
        function(np.array(orders)[:, None] * turns) for function in (cosine_of_turns, sine_of_turns)
    )
    first, second = (weight * cosine[1] for weight in crossed.weights)
    share = _cosine_series(
        light_of_level(np.clip(0.5 + 0.5 * (first[:, None] + second), 0.0, 1.0)), cosine
    )
    table = np.zeros((len(variance_px2), SIDE, SIDE))
    for n in orders:  # in order, on every processor
        even, odd = np.zeros((2, len(variance_px2), SIDE))
        for m in (m for m in orders if abs(share[m, n]) > _LEAST):
            summed, differing = (
                _kept(crossed, m, sign * n, variance_px2)[:, None] for sign in (1, -1)
            )
            even += share[m, n] / 2 * (summed + differing) * cosine[m]
            odd += share[m, n] / 2 * (differing - summed) * sine[m]
        if even.any():
            table += even[:, :, None] * cosine[n] + odd[:, :, None] * sine[n]
    return np.pad(np.clip(table, 0.0, 1.0), ((0, 0), (0, 1), (0, 1)), mode="wrap").astype(
        np.float32
    )


def _cosine_series(values: NDArray[np.float64], cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients c of ``values[k, l] = sum c[m, n] cos(2 pi m k / K) cos(2 pi n l / K)``; (M,
    N)."""
    for _ in range(2):  # first over the rows, then over what were the columns
        total = np.zeros((len(cosine), values.shape[1]))
        for row, weights in zip(values, cosine.T, strict=True):
            total += weights[:, None] * row
        total *= np.where(np.arange(len(cosine)) > 0, 2.0, 1.0)[:, None] / SIDE
        values = total.T
    return values


def _kept(
    crossed: Crossed, m: int, n: int, variance_px2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """What blur and the interpolation between pixels leave of the harmonic (m, n); float64 (S,)."""
    kept = np.zeros(len(variance_px2))
    frequencies = [
        m * first + n * second for first, second in zip(*crossed.cycles_per_px, strict=True)
    ]
    for axis, frequency in enumerate(frequencies):
        kept -= 2 * math.pi**2 * frequency**2 * variance_px2[:, axis]
    kept = exponential(np.maximum(kept, -20.0))
    for frequency in frequencies:
        if frequency != 0:
            kept *= (float(sine_of_turns(frequency / 2)) / (math.pi * frequency)) ** 2
    return kept


@njit
def fill_pattern(light, profiles, index, weight, level, level_weight):  # type: ignore[no-untyped-def]
    """Pattern light of n points in a frame: fills ``light`` (n,) from its ``profiles`` (S, L +
    1)."""
    if profiles.shape[0] == 1:
        profile = profiles[0]
        for k in range(light.size):
            low = profile[index[k]]
            light[k] = low + weight[k] * (profile[index[k] + 1] - low)
    else:
        for k in range(light.size):
            sharp, soft, i = profiles[level[k]], profiles[level[k] + 1], index[k]
            low = sharp[i] + level_weight[k] * (soft[i] - sharp[i])
            high = sharp[i + 1] + level_weight[k] * (soft[i + 1] - sharp[i + 1])
            light[k] = low + weight[k] * (high - low)


@njit
def fill_crossed(light, table, waves, per_px, place):  # type: ignore[no-untyped-def]
    """Pattern light of n points in a crossed frame: fills ``light`` (n,) from a `phase_table` and
    the frame's ``waves``."""
    side = table.shape[1] - 1
    for k in range(light.size):
        u = (place.u_index[k] + np.float64(place.u_weight[k])) / per_px
        v = (place.v_index[k] + np.float64(place.v_weight[k])) / per_px
        first = waves[0, 0] * u + waves[0, 1] * v + waves[0, 2]
        second = waves[1, 0] * u + waves[1, 1] * v + waves[1, 2]
        first, second = (first - np.floor(first)) * side, (second - np.floor(second)) * side
        i, j = min(np.int64(first), side - 1), min(np.int64(second), side - 1)
        a, b = first - i, second - j
        low = 0 if table.shape[0] == 1 else np.int64(place.level[k])
        sharp = table[low]
        value = _between(sharp, i, j, a, b)
        if table.shape[0] > 1:
            value += place.level_weight[k] * (_between(table[low + 1], i, j, a, b) - value)
        light[k] = value


@njit
def _between(sheet, i, j, a, b):  # type: ignore[no-untyped-def]
    top = sheet[i, j] + b * (sheet[i, j + 1] - sheet[i, j])
    bottom = sheet[i + 1, j] + b * (sheet[i + 1, j + 1] - sheet[i + 1, j])
    return top + a * (bottom - top)


@njit
def fill_frame(light, frame, pattern, place):  # type: ignore[no-untyped-def]
    """Light of n points in ``frame`` of a `PatternLight`: fills ``light`` (n,)."""
    if pattern.along[frame] == ALONG_U:
        fill_pattern(
            light,
            pattern.table[frame],
            place.u_index,
            place.u_weight,
            place.level,
            place.level_weight,
        )
    elif pattern.along[frame] == ALONG_V:
        fill_pattern(
            light,
            pattern.table[frame],
            place.v_index,
            place.v_weight,
            place.level,
            place.level_weight,
        )
    else:
        fill_crossed(light, pattern.crossed, pattern.waves[frame], pattern.per_px, place)


@njit
def read_kernel(out, irradiance, pattern, place):  # type: ignore[no-untyped-def]
    for frame in range(pattern.table.shape[0]):
        fill_frame(out[frame], frame, pattern, place)
        for k in range(irradiance.size):
            out[frame, k] *= irradiance[k]
