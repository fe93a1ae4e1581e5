"""Phase-shifted sinusoids: the wrapped phase of N frames (paper Eqs. 1 and 2), and the code of one
or more periods, with or without Gray code.

``I_n = A + B cos(phi + delta_n)`` with ``delta_n = 2 pi n / N`` is linear as ``A + C cos delta_n +
S sin delta_n``, C = B cos phi, S = -B sin phi: least squares is a weighted sum of the frames for
each of A, C and S, and ``phi = -atan2(S, C)``. For equal steps the weights are 1/N, (2/N) cos
delta_n and (2/N) sin delta_n (Eq. 2).

Along the projector coordinate w, ``phi = 2 pi (w - origin) / P``. The fringe order comes from a
Gray code, or from sinusoids of other periods. With several periods the order is the one whose
coordinate fits all of their phases best, each weighed by its noise: one rule for a unit-frequency
cue, a hierarchy and heterodyne or number-theoretical sets (they only differ in how many candidates
fit, and how closely).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from fpp_ml_bench.coding.code import (
    CLIPPED_STEPS_DIVISOR,
    SMALLEST_PITCH_PX,
    Code,
    Coordinates,
    Limits,
    Shown,
    mapping,
    number,
    numbers,
    require,
    whole,
)
from fpp_ml_bench.coding.gray_code import GrayCells
from fpp_ml_bench.constants import GREY_LEVELS, TAU
from fpp_ml_bench.errors import DecodeError, RigError
from fpp_ml_bench.portable import cosine_of_turns, sine_of_turns

CLEAR_RATIO = 4.0
"""An order is taken where every other one fits at least so many times worse (in squares): a third
of the way to the middle between two candidates remains."""
FINE_RATIO = 2.0
"""Periods up to so many times the finest one help its coordinate; of a coarser one, gamma would do
more harm."""
_KEYS = ("pitch_px", "pitches_px", "steps", "sign", "shifts_deg", "origin_px", "gray")


class Phase(NamedTuple):
    """``phase`` in rad, [-pi, pi); ``modulation`` B and ``mean`` A in grey levels; all (H, W)."""

    phase: NDArray[np.floating]
    modulation: NDArray[np.floating]
    mean: NDArray[np.floating]


def choose_steps(steps: int, count: int) -> tuple[int, ...]:
    """``count`` of ``steps`` frames, spread as evenly as they go: floor(i steps / count + 1/2).
    Raises `DecodeError` for fewer than 3 or more than ``steps``."""
    if (
        isinstance(count, bool)
        or not isinstance(count, int | np.integer)
        or not 3 <= count <= steps
    ):
        raise DecodeError(
            f"steps: expected a whole number from 3 to the {steps} that were projected, got "
            f"{count!r}"
        )
    return tuple((2 * i * steps + count) // (2 * count) for i in range(count))


def phase_weights(shifts_rad: ArrayLike) -> NDArray[np.float64]:
    """Weights of the frames in A, C and S: float64 (3, N) for N phase shifts in rad. Closed form
    for equal steps, else the least-squares pseudo-inverse. Raises `DecodeError` for fewer than
    three different shifts."""
    shifts = np.asarray(shifts_rad, dtype=np.float64)
    if shifts.ndim != 1 or len(shifts) < 3 or not np.all(np.isfinite(shifts)):
        raise DecodeError(
            f"shifts_rad: expected at least 3 finite phase shifts in rad, got {shifts_rad!r}"
        )
    count, turns = len(shifts), shifts / (2 * np.pi)
    model = np.stack([np.ones(count), cosine_of_turns(turns), sine_of_turns(turns)], axis=1)
    weights = model.T * np.array([[1.0], [2.0], [2.0]]) / count
    if np.abs(weights @ model - np.eye(3)).max() < 1e-12:
        return np.ascontiguousarray(weights)
    if np.linalg.cond(model) > 1e6:
        listed = shifts.tolist()
        raise DecodeError(
            f"shifts_rad: the shifts {listed} don't determine a phase; 3 different ones are needed"
        )
    return np.ascontiguousarray(np.linalg.pinv(model))


def wrapped_phase(
    frames: Iterable[ArrayLike], shifts_rad: ArrayLike | None = None, dtype: DTypeLike = np.float64
) -> Phase:
    """Wrapped phase, modulation and mean of N >= 3 frames (N, H, W), or N images (H, W), in grey
    levels. ``shifts_rad`` (N,) defaults to equal steps, 2 pi n / N. Sums are float64 whatever
    ``dtype`` (float32 or float64) the results have. A phase of exactly +pi comes out as -pi. Where
    nothing is modulated the phase means nothing: look at the modulation. Raises `DecodeError` for
    too few frames, unequal shapes, or dtypes that hold no grey levels."""
    if np.dtype(dtype) not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise DecodeError(f"dtype: expected float32 or float64, got {np.dtype(dtype)}")
    images = [np.asarray(frame) for frame in frames]
    if len(images) < 3:
        raise DecodeError(f"a phase needs at least 3 frames, got {len(images)}")
    for i, image in enumerate(images):
        if image.ndim != 2 or image.shape != images[0].shape:
            raise DecodeError(
                f"frame {i}: expected shape (H, W) = {images[0].shape} like frame 0, got "
                f"{image.shape}"
            )
        if image.dtype.kind not in "uif":
            raise DecodeError(
                f"frame {i}: expected integer or real grey levels, got dtype {image.dtype}"
            )
    if shifts_rad is None:
        shifts_rad = 2 * np.pi * np.arange(len(images)) / len(images)
    weights = phase_weights(shifts_rad)
    if weights.shape[1] != len(images):
        raise DecodeError(
            f"shifts_rad: expected one for each of the {len(images)} frames, got {weights.shape[1]}"
        )
    mean, cosine, sine = weighted_sums(images, weights)
    phase = minus_atan2(sine, cosine).astype(dtype)
    phase[
        phase >= np.asarray(np.pi, dtype=dtype)
    ] = -np.pi  # float32 rounds the last values below pi up to it
    modulation = np.sqrt(cosine * cosine + sine * sine)
    return Phase(phase, modulation.astype(dtype, copy=False), mean.astype(dtype, copy=False))


def weighted_sums(
    images: Iterable[NDArray], weights: NDArray[np.float64]
) -> list[NDArray[np.float64]]:
    """One weighted sum of the images for each row of ``weights``, added in frame order in
    float64."""
    sums: list[NDArray[np.float64]] = []
    for image, column in zip(images, weights.T, strict=True):
        grey = image.astype(np.float64)
        terms = [weight * grey for weight in column]
        for total, term in zip(sums, terms, strict=False):
            total += term
        sums = sums or terms
    return sums


def minus_atan2(sine: NDArray[np.float64], cosine: NDArray[np.float64]) -> NDArray[np.float64]:
    """``-atan2(sine, cosine)`` in [-pi, pi), float64 to 2 ulp, with the same bits on every
    processor."""
    from fpp_ml_bench.coding import kernels  # imports numba, which takes longer than most commands

    phase = np.empty(np.shape(sine))
    kernels.minus_atan2_all(np.ravel(sine), np.ravel(cosine), phase.ravel())
    return phase


@dataclass(frozen=True)
class Fringes:
    """Sinusoids of one period: ``shifts_deg`` delta_n of every step."""

    pitch_px: float
    shifts_deg: tuple[float, ...]

    @property
    def turns(self) -> NDArray[np.float64]:
        return np.array(self.shifts_deg) / 360.0

    @property
    def steps(self) -> int:
        return len(self.shifts_deg)

    def equal_steps(self, sign: int = 1) -> bool:
        """Whether step n is shifted by ``sign`` n / N of a period."""
        return self.shifts_deg == equal_shifts(self.steps, sign)


def equal_shifts(steps: int, sign: int) -> tuple[float, ...]:
    """``sign`` 360 n / N degrees."""
    return tuple(sign * 360.0 * step / steps + 0.0 for step in range(steps))


@dataclass(frozen=True)
class PhaseShift(Code):
    """``fringes`` in the order of their frames, ``origin_px`` where their phase is 0, and the Gray
    code behind them."""

    scheme: ClassVar[str] = "phase-shift"
    fringes: tuple[Fringes, ...]
    origin_px: float = 0.0
    gray: GrayCells | None = None

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any], length_px: int) -> "PhaseShift":
        mapping(entries, (), "", _KEYS)
        pitches = entries.get(
            "pitches_px", [entries["pitch_px"]] if "pitch_px" in entries else None
        )
        if (
            not isinstance(pitches, list)
            or not pitches
            or ("pitch_px" in entries and "pitches_px" in entries)
        ):
            raise RigError(
                "pitches_px: expected a list of periods in projector px (or pitch_px: a single one)"
            )
        periods = numbers(pitches, len(pitches), "pitches_px")
        shifts = entries.get("shifts_deg")
        if shifts is not None:
            if "steps" in entries or "sign" in entries:
                raise RigError("shifts_deg: give it, or steps and sign, not both")
            if not isinstance(shifts, list) or not shifts:
                raise RigError(f"shifts_deg: expected a list of degrees, got {shifts!r}")
            lists = shifts if isinstance(shifts[0], list) else [shifts] * len(periods)
            if not all(isinstance(listed, list) for listed in lists):
                raise RigError(
                    f"shifts_deg: expected a list of degrees, or one for each period, got "
                    f"{shifts!r}"
                )
            angles = [
                numbers(listed, len(listed), f"shifts_deg[{i}]") for i, listed in enumerate(lists)
            ]
        else:
            require("steps" in entries, "steps: missing")
            steps, sign = entries["steps"], entries.get("sign", 1)
            if sign not in (1, -1):
                raise RigError(
                    f"sign: expected 1 (step n is shifted by +360 n / N degrees) or -1, got "
                    f"{sign!r}"
                )
            counts = steps if isinstance(steps, list) else [steps] * len(periods)
            angles = [equal_shifts(whole(count, "steps", 1, 1000), sign) for count in counts]
        if len(angles) != len(periods):
            raise RigError(
                f"steps or shifts_deg: expected one entry for each of {len(periods)} periods"
            )
        fringes = tuple(
            Fringes(pitch, listed) for pitch, listed in zip(periods, angles, strict=True)
        )
        gray = entries.get("gray")
        finest = min(periods)
        require(
            gray is None or isinstance(gray, Mapping),
            f"gray: expected a mapping of Gray cells, got {gray!r}",
        )
        cells = None if gray is None else GrayCells.from_entries(gray, length_px, finest / 2)
        return cls(fringes, number(entries.get("origin_px", 0.0), "origin_px"), cells)

    def to_dict(self) -> dict[str, Any]:
        content: dict[str, Any] = {
            "scheme": self.scheme,
            "pitches_px": [fringe.pitch_px for fringe in self.fringes],
        }
        for sign in (1, -1):
            if all(fringe.equal_steps(sign) for fringe in self.fringes):
                content |= {"steps": [fringe.steps for fringe in self.fringes], "sign": sign}
                break
        else:
            content["shifts_deg"] = [list(fringe.shifts_deg) for fringe in self.fringes]
        content["origin_px"] = self.origin_px
        return content if self.gray is None else {**content, "gray": self.gray.to_dict()}

    @property
    def title(self) -> str:
        pitches = " + ".join(f"{fringe.pitch_px:g}" for fringe in self.fringes)
        return f"{self.scheme} {pitches} px" + (" + Gray code" if self.gray else "")

    @property
    def shown(self) -> tuple[Shown, ...]:
        frames = [
            Shown("sinusoid", step, number)
            for number, fringe in enumerate(self.fringes)
            for step in range(fringe.steps)
        ]
        return (*frames, *(self.gray.shown if self.gray else ()))

    @cached_property
    def finest(self) -> int:
        """Which of ``fringes`` has the shortest period."""
        return min(range(len(self.fringes)), key=lambda number: self.fringes[number].pitch_px)

    @property
    def pitch_px(self) -> float:
        return self.fringes[self.finest].pitch_px

    @property
    def is_plain(self) -> bool:
        """Whether it is the paper's kind: equal steps of one period from pixel 0, Gray code in half
        periods."""
        (first, *others), gray = self.fringes, self.gray
        plain = not others and first.equal_steps() and first.steps >= 3 and self.origin_px == 0.0
        return plain and gray is not None and gray == GrayCells(first.pitch_px / 2, gray.bits)

    def check(self, length_px: int) -> None:
        for index, fringe in enumerate(self.fringes):
            if not fringe.pitch_px >= SMALLEST_PITCH_PX:
                raise RigError(
                    f"pitches_px[{index}]: expected {SMALLEST_PITCH_PX:g} px and more, got "
                    f"{fringe.pitch_px:g} px"
                )
        if self.gray:
            self.gray.check(length_px)
            if self.gray.cell_px > self.pitch_px:
                raise RigError(
                    f"gray.cell_px: {self.gray.cell_px:g} px exceed the finest period, "
                    f"{self.pitch_px:g} px"
                )

    def profiles(self, length_px: int) -> NDArray[np.uint8]:
        rows, position, half = [], np.arange(length_px), GREY_LEVELS / 2
        for fringe in self.fringes:
            steps = fringe.steps
            for step, turns in enumerate(fringe.turns):
                if fringe.equal_steps() and self.origin_px == 0.0:
                    angle = (position * steps + step * fringe.pitch_px) / (fringe.pitch_px * steps)
                else:
                    angle = (position - self.origin_px) / fringe.pitch_px + turns
                rows.append(np.rint(half + half * cosine_of_turns(angle)).astype(np.uint8))
        own = np.array(rows)
        return own if self.gray is None else np.concatenate([own, self.gray.profiles(length_px)])

    def decode(self, levels: NDArray, length_px: int, limits: Limits) -> Coordinates:
        phases, modulations, means, first = [], [], [], 0
        saturated = np.zeros(levels.shape[1], dtype=bool)
        for fringe in self.fringes:
            steps = fringe.steps
            if steps < 3:
                raise DecodeError(
                    f"a period of {fringe.pitch_px:g} px was projected with {steps} step(s); a "
                    f"phase needs at least 3 "
                    "at every pixel (methods for one frame: fpp-bench predict phase)"
                )
            frames = levels[first : first + steps]
            mean, cosine, sine = weighted_sums(frames, phase_weights(TAU * fringe.turns))
            phases.append(minus_atan2(sine, cosine) / TAU)
            modulations.append(np.sqrt(cosine * cosine + sine * sine))
            means.append(mean)
            most = (
                steps // CLIPPED_STEPS_DIVISOR
                if limits.max_clipped_steps is None
                else limits.max_clipped_steps
            )
            saturated |= (frames >= GREY_LEVELS).sum(axis=0) > most
            first += steps
        finest = self.finest
        if self.gray is not None:
            cells = self.gray.cells_of(
                levels[first:], means[finest], modulations[finest], limits.ambiguous_fraction
            )
            near = self.gray.centre_px(cells.number, length_px)
            away = near - self.origin_px
            order = np.floor(away / self.pitch_px - phases[finest] + 0.5)
            coordinate = (phases[finest] + order) * self.pitch_px + self.origin_px
            # Up to half a period from cell centre to edge, and for half cells half as much for a
            # bit misread there.
            reach = (
                0.375 * self.pitch_px
                if self.gray.cell_px <= self.pitch_px / 2
                else 0.5 * self.pitch_px
            )
            trusted = cells.trusted if self.gray.cell_px <= self.pitch_px / 2 else cells.clear()
            inconsistent = ~trusted | ~(np.abs(coordinate - near) <= reach)
        else:
            coordinate, inconsistent = self._best_order(phases, modulations, length_px)
        coordinate = self._refined(coordinate, phases, modulations)
        return Coordinates.judged(
            coordinate,
            modulations[finest],
            phases[finest] * TAU,
            saturated,
            inconsistent,
            length_px,
            limits,
        )

    def _best_order(
        self, phases: list[NDArray], modulations: list[NDArray], length_px: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """The coordinate on the pattern that fits all phases (turns) best, and where another fits
        nearly as well."""
        finest, count = self.finest, phases[0].size
        pitch = self.fringes[finest].pitch_px
        best, second, chosen = (
            np.full(count, np.inf),
            np.full(count, np.inf),
            np.full(count, np.nan),
        )
        others = [other for other in range(len(self.fringes)) if other != finest]
        for order in range(
            math.floor(-self.origin_px / pitch) - 1,
            math.ceil((length_px - self.origin_px) / pitch) + 1,
        ):
            away = (phases[finest] + order) * pitch
            misfit = np.zeros(count)
            for other in others:
                turns = away / self.fringes[other].pitch_px - phases[other]
                turns -= np.rint(turns)
                misfit += self.fringes[other].steps * (modulations[other] * turns) ** 2
            misfit[(away + self.origin_px < -0.5) | (away + self.origin_px > length_px - 0.5)] = (
                np.inf
            )
            better = misfit < best
            second = np.where(better, best, np.minimum(second, misfit))
            chosen[better] = away[better] + self.origin_px
            best = np.where(better, misfit, best)
        with np.errstate(invalid="ignore"):
            unclear = ~(CLEAR_RATIO * best <= second) | ~np.isfinite(best) | (best == second)
        # Off the pattern by the noise of its ends: judged by the coordinate, not by the order.
        return np.where(np.isfinite(chosen), chosen, -np.inf), unclear

    def _refined(
        self, coordinate_px: NDArray[np.float64], phases: list[NDArray], modulations: list[NDArray]
    ) -> NDArray[np.float64]:
        """The coordinate from all nearly finest periods, each weighed by its noise."""
        fine = [
            n
            for n, fringe in enumerate(self.fringes)
            if fringe.pitch_px <= FINE_RATIO * self.pitch_px
        ]
        if len(fine) == 1:
            return coordinate_px
        total, weights = np.zeros_like(coordinate_px), np.zeros_like(coordinate_px)
        for index in fine:
            fringe = self.fringes[index]
            turns = (coordinate_px - self.origin_px) / fringe.pitch_px - phases[index]
            with np.errstate(invalid="ignore"):
                own = coordinate_px - (turns - np.rint(turns)) * fringe.pitch_px
            weight = fringe.steps * (modulations[index] / fringe.pitch_px) ** 2
            total, weights = total + weight * own, weights + weight
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(weights > 0, total / weights, coordinate_px)

    def sigma_px(self, modulation: ArrayLike, noise_grey: ArrayLike) -> NDArray[np.float64]:
        precision = sum(
            fringe.steps / 2 / fringe.pitch_px**2
            for fringe in self.fringes
            if fringe.pitch_px <= FINE_RATIO * self.pitch_px
        )
        with np.errstate(divide="ignore"):
            relative = np.asarray(noise_grey, dtype=np.float64) / np.asarray(
                modulation, dtype=np.float64
            )
        return relative / (TAU * math.sqrt(precision))
