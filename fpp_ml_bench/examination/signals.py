"""What sinusoids and Gray code say about a capture: equal frames, wrong steps, ripples of the
phase, common offsets.

Looked at are some rows and columns of the image, whose pixels have neighbours (`Lines`). A frame
that shows another step than it should leaves a residual in the first harmonic of its set, and a
ripple of twice the phase in the decoded phase. A response that is not straight leaves higher
harmonics, and a ripple of N times the phase with N steps (K. Hibino et al., Phase shifting for
nonsinusoidal waveforms with phase-shift errors, JOSA A 1995). Both are measured from what
neighbours can't have in common with the scene: a surface is smooth within a few periods.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import MIN_MODULATION, Limits
from fpp_ml_bench.coding.phase_shift import TAU, PhaseShift, phase_weights, wrapped_phase
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

LINES = 40
"""Most lines, rows and columns of each, that are looked at: they cross everything that a capture
shows, at a small part of the time."""
MOST_PX = 150_000
"""Most pixels on these lines; of large images fewer lines are taken."""
LEAST_LIT_GREY = 3 * MIN_MODULATION
"""A pixel is lit where its grey levels differ by so much from frame to frame."""
_LOOKED_AT_PX = 40_000
"""Pixels of the coarse image, about, in which the lit part is found before lines are laid through
it."""
LEAST_PX = 200
"""Fewest pixels from which frames are compared or phases are measured. With fewer, chance
decides."""
WINDOW_PERIODS = 2.5
"""Length of the windows in which a surface is taken for a cubic; a period must be seen by 4 px and
more."""
SHORTEST_PERIOD_PX = 4.0
"""Shortest period in the image, in px, of which ripples are measured: below it, a pixel averages
the fringe away."""
LONGEST_WINDOW_PX = 400
"""Longest window, in px, in which a surface is taken for a cubic. In longer ones few surfaces
are."""
FEWEST_WINDOWS = 30
"""Fewest windows from which ripples are measured: their mean must stand out of chance."""
WHITE_RATIO = 1.8
"""Two frames are equal where the mean square of their difference is below so many times that of its
noise: then it is white."""
EQUAL_SHARE = 0.35
"""And where it is below this share of what the steps of the frames would make."""
GAIN = 0.1
"""And where the gain between the frames is within this of 1."""
_EQUAL_PX = 30_000
"""Pixels, about, that are compared, evenly spread: enough for the figures and quick."""
SYMMETRIC = 0.3
"""Largest share of the cosine in a ripple that a response can make: a response alone makes none."""
SIGMAS = 6.0
"""Standard errors above which a figure is none of chance."""
BANDS = 16
"""Of rows and of columns, each looked at by itself: a tear is missed in the last sixteenth of the
image at most."""
ONE_PHASE = 0.7
"""Mean resultant length of the phases in a band that fringes hardly cross: two steps may be equally
bright there."""
PILED_SHARE = 0.01
"""Share of the levels that must be exactly the highest one for it to be taken for saturation."""
PILE_DEPTH = 0.03
"""Part of the span below the highest level in which at least half of the levels must be the highest
one itself. In a whole crest, fewer are."""
CLEAR_LEVELS = 0.15
"""Distance from the middle grey level, in spans, from which a pixel is bright or dark: Gray frames
have 0.5, sinusoids 0.35 in the median, and blurred fringes less."""


Side = Literal["rows", "columns"]


@dataclass(frozen=True)
class Lines:
    """``levels`` (F, n) of n pixels at ``column`` and ``row``, line after line. ``joined``: the
    next pixel is the neighbour on the same line; ``across``: the line is a row; ``lit`` pixels
    change from frame to frame. They are of images of ``shape`` (H, W) by ``rig``, of which the
    ``directions`` are looked at, and decoded within ``limits``; ``calibrated`` False: lenses, pose
    and range of the rig are placeholders."""

    levels: NDArray
    column: NDArray[np.intp]
    row: NDArray[np.intp]
    joined: NDArray[np.bool_]
    across: NDArray[np.bool_]
    lit: NDArray[np.bool_]
    shape: tuple[int, int]
    rig: Rig
    directions: tuple[Direction, ...] = ()
    limits: Limits = field(default_factory=Limits)
    calibrated: bool = True

    def part(self, most_px: int) -> "Lines":
        """The lit pixels of some of the lines, ``most_px`` and up to a line more."""
        starts = np.flatnonzero(np.append(True, ~self.joined[:-1]))
        line = np.cumsum(np.append(True, ~self.joined[:-1])) - 1
        step = max(1, int(self.lit.sum() // most_px))
        # Every step-th row and every step-th column: both kinds stay.
        order = np.arange(len(starts))
        return self.at(np.flatnonzero(self.lit & (order % step == step // 2)[line]))

    def at(self, picked: NDArray[np.intp]) -> "Lines":
        """The pixels at the ascending indices ``picked``."""
        return replace(
            self,
            levels=self.levels[:, picked],
            column=self.column[picked],
            row=self.row[picked],
            joined=self.joined[picked] & np.append(np.diff(picked) == 1, False),
            across=self.across[picked],
            lit=self.lit[picked],
        )

    def banded(self) -> Iterator[tuple["Band", NDArray[np.bool_]]]:
        """The bands of the image, of rows and then of columns, and which pixels (n,) lie in
        each."""
        sides: tuple[tuple[Side, NDArray[np.intp]], ...] = (
            ("rows", self.row),
            ("columns", self.column),
        )
        for (side, position), length in zip(sides, self.shape, strict=True):
            number = position * BANDS // length
            for band in range(BANDS):
                first, end = (-(-count * length // BANDS) for count in (band, band + 1))
                yield Band(side, first, end - 1), number == band


class Band(NamedTuple):
    """Neighbouring rows or columns, ``first`` to ``last``."""

    side: Side
    first: int
    last: int


def _thinned(pixels: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Indices of some `_EQUAL_PX` of the pixels, evenly spread."""
    return np.flatnonzero(pixels)[:: max(1, int(pixels.sum() // _EQUAL_PX))]


def take_lines(stack: NDArray, rig: Rig, mask: NDArray[np.bool_] | None = None) -> Lines:
    """The lines of frames, ``stack`` (F, H, W), that hold the most lit pixels, evenly spread; those
    in ``mask`` alone count."""
    height, width = stack.shape[1:]
    step = max(1, int(np.sqrt(height * width / _LOOKED_AT_PX)))
    coarse = np.ptp(stack[:, ::step, ::step], axis=0) >= LEAST_LIT_GREY
    if mask is not None:
        coarse &= mask[::step, ::step]
    count = max(4, min(LINES, MOST_PX // (height + width)))
    chosen = []
    for counts in (coarse.sum(axis=1), coarse.sum(axis=0)):
        cumulated = np.cumsum(counts) / max(counts.sum(), 1)
        spread = np.searchsorted(cumulated, (np.arange(count) + 0.5) / count)
        chosen.append(np.unique(spread.clip(0, len(counts) - 1)) * step)
    lines = lines_at(stack, rig, *chosen)
    lit = np.ptp(lines.levels, axis=0) >= LEAST_LIT_GREY
    return replace(lines, lit=lit if mask is None else lit & mask[lines.row, lines.column])


def lines_at(
    frames: Sequence[NDArray] | NDArray,
    rig: Rig,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> Lines:
    """These rows, then these columns of ``frames`` (F, H, W); all pixels count as lit."""
    height, width = frames[0].shape
    row = np.concatenate([np.repeat(rows, width), np.tile(np.arange(height), len(columns))])
    column = np.concatenate([np.tile(np.arange(width), len(rows)), np.repeat(columns, height)])
    across = np.arange(len(row)) < len(rows) * width
    last = np.where(across, column == width - 1, row == height - 1)
    return Lines(
        np.stack([frame[row, column] for frame in frames]),
        column,
        row,
        ~last,
        across,
        np.ones(len(row), bool),
        (height, width),
        rig,
    )


class Estimate(NamedTuple):
    """A ``value`` and its standard error ``sigma``."""

    value: float
    sigma: float

    def exceeds(self, least: float) -> bool:
        """Whether it is larger than ``least``, either way, and none of chance."""
        return abs(self.value) > max(least, SIGMAS * self.sigma)


@dataclass(frozen=True)
class FringeSet:
    """The sinusoids of one period: ``frames`` their indices, ``shifts_rad`` (N,), ``levels`` (N,
    n), mean, modulation and phase (n,) of the lines' pixels, and ``good`` pixels: modulated and
    never saturated."""

    direction: Direction
    number: int
    pitch_px: float
    frames: tuple[int, ...]
    shifts_rad: NDArray[np.float64]
    levels: NDArray
    mean: NDArray[np.floating]
    phase: NDArray[np.floating]
    modulation: NDArray[np.floating]
    good: NDArray[np.bool_]

    @property
    def steps(self) -> int:
        return len(self.frames)

    @property
    def one_phase(self) -> bool:
        """Whether the pixels have nearly the same phase."""
        return not self.good.any() or bool(
            abs(np.exp(1j * self.phase[self.good]).mean()) > ONE_PHASE
        )


def fringe_sets(lines: Lines) -> list[FringeSet]:
    """The sets of three and more steps, with what the lines show of them."""
    sets = []
    for direction in lines.directions:
        code = lines.rig.code(direction)
        for number, fringe in enumerate(code.fringes if isinstance(code, PhaseShift) else ()):
            frames = lines.rig.sequence.period(direction, number)
            if len(frames) < 3:
                continue
            shifts, levels = TAU * fringe.turns, lines.levels[list(frames)]
            phase, modulation, mean = (part[0] for part in wrapped_phase(levels[:, None], shifts))
            good = lines.lit & (modulation >= MIN_MODULATION) & (levels < GREY_LEVELS).all(axis=0)
            sets.append(
                FringeSet(
                    direction,
                    number,
                    fringe.pitch_px,
                    frames,
                    shifts,
                    levels,
                    mean,
                    phase,
                    modulation,
                    good,
                )
            )
    return sets


def equal_frames(
    lines: Lines, sets: Sequence[FringeSet], following: bool = False
) -> list[tuple[int, int]]:
    """Pairs of frames that should differ and show the same, but for noise and a few percent of
    brightness: within a set (``following``: only if they follow one another), and one after the
    other."""
    pairs = []
    for fringe_set in sets:
        part = lines.at(_thinned(fringe_set.good))
        middle = (
            float(np.median(fringe_set.modulation[fringe_set.good]))
            if fringe_set.good.any()
            else 0.0
        )
        for i, j in (
            pairwise(range(fringe_set.steps))
            if following
            else combinations(range(fringe_set.steps), 2)
        ):
            apart = fringe_set.shifts_rad[i] - fringe_set.shifts_rad[j]
            most = EQUAL_SHARE * math.sqrt(2) * abs(math.sin(apart / 2)) * middle
            if most > 0 and _same(part, fringe_set.frames[i], fringe_set.frames[j], most):
                pairs.append((fringe_set.frames[i], fringe_set.frames[j]))
    levels = lines.levels[:, _thinned(lines.lit)].astype(np.float64)
    low, high = levels.min(axis=0), levels.max(axis=0)
    from_middle, span = levels - (low + high) / 2, float(np.median(high - low))
    bright, dark = ((sign * from_middle > CLEAR_LEVELS * span).mean(axis=1) for sign in (1, -1))
    coded = [
        frame.index
        for frame in lines.rig.sequence
        if frame.direction is None or frame.direction in lines.directions
    ]
    for i, j in pairwise(coded):
        same_set = any({i, j} <= set(fringe_set.frames) for fringe_set in sets)
        # A frame that is bright or dark all over may well be followed by another one.
        varied = all(min(bright[k], dark[k]) > 0.05 for k in (i, j))
        apart = np.abs(levels[i] - levels[j])
        if (
            not same_set
            and varied
            and np.median(apart) < 0.02 * span
            and (apart < 0.1 * span).mean() > 0.98
        ):
            pairs.append((i, j))
    return pairs


def _same(part: Lines, i: int, j: int, most: float) -> bool:
    """Whether two frames show the same but for noise and brightness, with less than ``most`` grey
    levels between."""
    first, second = (part.levels[k].astype(np.float64) for k in (i, j))
    if len(first) < LEAST_PX or np.array_equal(first, second):
        return len(first) >= LEAST_PX
    gain = float(np.cov(first, second)[0, 1] / max(first.var(), 1e-12))
    if abs(gain - 1) > GAIN:
        return False
    rest = second - second.mean() - gain * (first - first.mean())
    steps = np.diff(rest)[part.joined[:-1]]
    if len(steps) < LEAST_PX:
        return False
    size, noise = _trimmed(rest**2), max(_trimmed(steps**2) / 2, 1 / 12)
    return size < min(most**2, WHITE_RATIO * noise)


def turns(lines: Lines, index: int) -> float:
    """How often a frame turns from bright to dark or back along a line, in the mean over rows or
    columns, whichever has more."""
    low, high = lines.levels.min(axis=0).astype(np.float64), lines.levels.max(axis=0)
    bright = lines.levels[index] > (low + high) / 2
    turned = np.append((bright[1:] != bright[:-1]) & lines.joined[:-1], False)
    ends = ~lines.joined
    return max(
        float(turned[kind].sum() / max(1, ends[kind].sum()))
        for kind in (lines.across, ~lines.across)
    )


def _trimmed(values: NDArray) -> float:
    """Mean without the largest tenth: edges of the scene count for nothing."""
    return float(np.sort(values)[: -(-9 * len(values) // 10)].mean())


def step_errors(fringe_set: FringeSet) -> tuple[int, Estimate] | None:
    """Of four steps and more: the position of the step whose shift is farthest from the rig file's,
    and by how many rad (with four, all are as far). None where too little tells, and where a narrow
    range of phases can't tell it from other faults."""
    picked = _thinned(fringe_set.good)
    if fringe_set.steps < 4 or len(picked) < LEAST_PX:
        return None
    mean, phase, modulation = (
        fringe_set.mean[picked],
        fringe_set.phase[picked],
        fringe_set.modulation[picked],
    )
    weights = phase_weights(fringe_set.shifts_rad)
    model = np.stack(
        [np.ones(fringe_set.steps), np.cos(fringe_set.shifts_rad), np.sin(fringe_set.shifts_rad)],
        axis=1,
    )
    influence = np.einsum("ij,ji->i", model, weights)
    worst: tuple[int, Estimate] | None = None
    for n, shift in enumerate(fringe_set.shifts_rad):
        residual = fringe_set.levels[n, picked] - mean - modulation * np.cos(phase + shift)
        waves = [wave(angle) for angle in (phase, 2 * (phase + shift)) for wave in (np.cos, np.sin)]
        terms = np.stack([mean, *(modulation * wave for wave in waves)], axis=1)
        scaled = terms / np.maximum(np.linalg.norm(terms, axis=0), 1e-12)
        if np.linalg.cond(scaled) > 60:
            return None
        kept = np.abs(residual) < 6 * np.median(np.abs(residual)) + 1.0
        solution = np.linalg.lstsq(terms[kept], residual[kept], rcond=None)[0] / (1 - influence[n])
        error = residual[kept] / (1 - influence[n]) - terms[kept] @ solution
        covariance = (
            np.linalg.inv(terms[kept].T @ terms[kept]) * error.var() * 4
        )  # neighbours share their errors
        along = np.array([0, -math.sin(shift), -math.cos(shift), 0, 0])
        estimate = Estimate(float(along @ solution), float(np.sqrt(along @ covariance @ along)))
        if worst is None or abs(estimate.value) > abs(worst[1].value):
            worst = n, estimate
    return worst


class Ripple(NamedTuple):
    """Amplitude in rad of an error of the phase, and its part that goes with the cosine. With equal
    steps, what makes the same of the same brightness at every pixel has a sine of N times the phase
    alone: its waves are symmetric."""

    size: Estimate
    cosine: Estimate

    @property
    def symmetric(self) -> bool:
        return not self.cosine.exceeds(SYMMETRIC * self.size.value)


def ripples(lines: Lines, fringe_set: FringeSet) -> dict[int, Ripple]:
    """By harmonic, the error of the phase that goes with twice and N times the phase; none where
    the image shows too few windows of two periods and more."""
    slopes = []
    for across in (True, False):
        pixels = fringe_set.good & (lines.across == across)
        pairs = np.flatnonzero(pixels[:-1] & pixels[1:] & lines.joined[:-1])
        if len(pairs) >= LEAST_PX:
            slopes.append(
                (
                    float(
                        np.median(
                            np.abs(_wrapped(fringe_set.phase[pairs + 1] - fringe_set.phase[pairs]))
                        )
                    ),
                    across,
                )
            )
    slope, across = max(slopes, default=(0.0, True))
    period = TAU / slope if slope > 0 else math.inf
    if not SHORTEST_PERIOD_PX <= period <= LONGEST_WINDOW_PX / WINDOW_PERIODS:
        return {}
    windows = _windows(
        fringe_set.good & (lines.across == across), lines.joined, math.ceil(WINDOW_PERIODS * period)
    )
    if len(windows) < FEWEST_WINDOWS:
        return {}
    phase = np.unwrap(fringe_set.phase[windows], axis=1) + fringe_set.shifts_rad[0]
    harmonics = [1, 2, *([fringe_set.steps] if 2 < fringe_set.steps <= period / 2.5 else [])]
    place = np.linspace(-1, 1, phase.shape[1])
    surface = np.linalg.qr(np.stack([np.ones_like(place), place, place**2, place**3], axis=1))[0]

    def flat(values: NDArray) -> NDArray:
        return values - (values @ surface) @ surface.T

    rest = flat(phase)
    terms = np.stack(
        [flat(wave(h * phase)) for h in harmonics for wave in (np.cos, np.sin)], axis=-1
    )
    size = np.sqrt((rest**2).mean(axis=1))
    kept = size <= min(3 * float(np.median(size)), 1.0)
    for _ in range(3):
        design, target = terms[kept].reshape(-1, terms.shape[-1]), rest[kept].ravel()
        solution = np.linalg.lstsq(design, target, rcond=None)[0]
        size = np.sqrt(((rest - terms @ solution) ** 2).mean(axis=1))
        kept = size <= 2.5 * float(np.median(size))
    # Each window is one observation of the coefficients: its own errors go together.
    bread = np.linalg.pinv(design.T @ design)
    scores = np.einsum("wlt,wl->wt", terms[kept], (rest - terms @ solution)[kept])
    covariance = bread @ (scores.T @ scores) @ bread
    by_harmonic = {}
    for k, harmonic in enumerate(harmonics):
        pair = solution[2 * k : 2 * k + 2]
        sigma = float(np.sqrt(np.trace(covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2]) / 2))
        by_harmonic[harmonic] = Ripple(
            Estimate(float(np.hypot(*pair)), sigma), Estimate(float(pair[0]), sigma)
        )
    return by_harmonic


def _windows(pixels: NDArray[np.bool_], joined: NDArray[np.bool_], length: int) -> NDArray[np.intp]:
    """Indices (w, length) of windows of neighbours that are all in ``pixels``."""
    run = np.cumsum(np.append(True, ~(joined[:-1] & pixels[:-1] & pixels[1:])))
    index = np.flatnonzero(pixels)
    _, first, inverse = np.unique(run[index], return_index=True, return_inverse=True)
    position = np.arange(len(index)) - first[inverse]
    count = np.bincount(inverse)[inverse]
    starts = index[(position % length == 0) & (position + length <= count)]
    return starts[:, None] + np.arange(length)


def _wrapped(angle: NDArray) -> NDArray[np.float64]:
    return angle - TAU * np.rint(angle / TAU)


def marked_saturated(lines: Lines) -> tuple[Lines, float]:
    """The lines with their saturated levels at `GREY_LEVELS`, and the level at which they are
    saturated: below that where the levels of sinusoids pile up there, as in a sum of saturated
    exposures."""
    sinusoids = [index for fringe_set in fringe_sets(lines) for index in fringe_set.frames]
    levels = lines.levels[sinusoids][:, lines.lit]
    top = levels.max() if levels.size else GREY_LEVELS
    near = levels > top - PILE_DEPTH * (top - levels.min()) if levels.size else levels
    piled = np.count_nonzero(levels == top)
    if (
        top >= GREY_LEVELS
        or piled < PILED_SHARE * levels.size
        or piled < np.count_nonzero(near) / 2
    ):
        return lines, float(GREY_LEVELS)
    return replace(
        lines, levels=np.where(lines.levels >= top, levels.dtype.type(GREY_LEVELS), lines.levels)
    ), float(top)


class Edges(NamedTuple):
    """At the edges of Gray cells: the common ``offset_turns`` of the phase there, the share of
    edges within an eighth of a period of it (``agreeing``), the share at which phase and cells grow
    the same way, and how many."""

    offset_turns: Estimate
    agreeing: float
    forward: float
    edges: int

    @property
    def clear(self) -> bool:
        """Whether nearly all edges agree, so that a common offset means something."""
        return self.agreeing > 0.8 and self.forward > 0.8


def gray_edges(lines: Lines, fringe_set: FringeSet) -> Edges | None:
    """What the edges of the Gray cells say about the phase of the set; None without Gray code or
    with few edges."""
    rig, direction = lines.rig, fringe_set.direction
    code = rig.code(direction)
    if not isinstance(code, PhaseShift) or code.gray is None or fringe_set.number != code.finest:
        return None
    length, levels = rig.pattern_length(direction), lines.levels[list(rig.sequence.gray(direction))]
    cells = code.gray.cells_of(
        levels, fringe_set.mean, fringe_set.modulation, lines.limits.ambiguous_fraction
    )
    usable = fringe_set.good & cells.trusted
    first = np.flatnonzero(usable[:-1] & usable[1:] & lines.joined[:-1])
    first = first[np.abs(cells.number[first + 1] - cells.number[first]) == 1]
    step = _wrapped(fringe_set.phase[first + 1] - fringe_set.phase[first])
    kept = np.abs(step) < TAU / 4
    first, step = first[kept], step[kept]
    edge_px = (
        code.gray.centre_px(cells.number[first], length)
        + code.gray.centre_px(cells.number[first + 1], length)
    ) / 2
    offset = _wrapped(
        fringe_set.phase[first] + step / 2 - TAU * (edge_px - code.origin_px) / code.pitch_px
    )
    known = np.isfinite(offset)
    if known.sum() < 40:
        return None
    first, step, offset = first[known], step[known], offset[known]
    grows = (cells.number[first + 1] > cells.number[first]) == (step > 0)
    middle = float(np.angle(np.mean(np.exp(1j * offset))))
    for _ in range(3):  # the circular median
        middle += float(np.median(_wrapped(offset - middle)))
    away = np.abs(_wrapped(offset - middle))
    sigma = 1.2533 * 1.4826 * float(np.median(away)) / math.sqrt(len(first) / 4)
    middle = float(_wrapped(np.array(middle)))
    offset_turns = Estimate(middle / TAU, sigma / TAU)
    return Edges(offset_turns, float(np.mean(away < TAU / 8)), float(grows.mean()), len(first))
