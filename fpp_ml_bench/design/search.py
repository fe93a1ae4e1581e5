"""The search for two carriers: every pair of periods and angles within limits, what it costs, and the one to take; and
a picture of it: the lines on the torus, the rival distance over depth and over the two periods."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.crossed import LEAST_ANGLE_DEG, Crossed
from fpp_ml_bench.design.rivals import (
    TAU,
    EpipolarLines,
    background_distance,
    nearest,
    rival_distance,
    wrong_order_rate,
)
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import flag_of, option, options_of
from fpp_ml_bench.style import figure, figure_png, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ANGLES_DEG = tuple(float(angle) for angle in range(0, 180, 15))
FLAT_TURNS = 0.05
"""A carrier that turns less over the whole range tells no depth."""
BACKGROUND_SIGMAS = 3.0
"""Phase errors that the background must be away from every depth, so that it is known as background. Rivals must be
much farther: each is a depth like the true one, and half of the way to it is enough."""
_CHUNK = 20_000
_PLACES = np.linspace(0.0, 1.0, 400)
SIGMA_PERIOD_PX = 20.0
"""Image px of the period at which a phase error is stated."""


def _pair(text: str) -> tuple[float, float]:
    try:
        least, most = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError("expected two numbers with a comma between them, such as 10,40") from None
    return least, most


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """What the figures of a pair rest on. Raises `RigError` for numbers that are not above 0 and finite.

    ``image_px``: shortest and longest period in the image; the longest also of the beats of the two carriers, since a
    window must tell their spectra from each other and from the mean light. ``surfaces_mm``: where surfaces are
    expected, None for anywhere in the range; a rival may be anywhere in it. ``phase_sigma``: error in rad of a phase
    from a single frame, at a period of `SIGMA_PERIOD_PX` in the image and in proportion to it, since the spectra of
    edges and texture fall with the frequency; it decides orders. ``blur_px``: sigma of the projector's blur, projector
    px, which takes modulation from fine periods. ``wrong_percent``: percentage of wrong orders that may be left to the
    neighbours. ``noise_grey``: the camera's noise, which alone decides the depth noise on smooth surfaces, with
    ``white_grey``, the grey level of white at the near end (falling with the square of the distance), and a Gaussian
    window of ``window_px`` (sigma, image px).
    """

    HEADING = "design of crossed fringes"
    image_px: tuple[float, float] = option(
        (12.0, 40.0),
        "limits of a period in the image, px; MOST of a beat too (default: 12,40)",
        "LEAST,MOST",
        parse=_pair,
    )
    surfaces_mm: tuple[float, float] | None = option(
        None,
        "where surfaces are expected, mm, for the share of wrong orders (default: the whole range)",
        "NEAR,FAR",
        flag="--surfaces",
        parse=_pair,
    )
    phase_sigma: float = option(0.2, "error of a phase at 20 image px a period, for orders (default: 0.2)", "RAD")
    blur_px: float = option(1.0, "sigma of the projector's blur, projector px (default: 1)", "PX", flag="--blur")
    wrong_percent: float = option(
        0.02, "wrong orders that may be left to the neighbours (default: 0.02)", "PERCENT", flag="--wrong"
    )
    noise_grey: float = option(
        1.0, "camera noise, grey levels of 255, for the depth noise (default: 1)", "GREY", flag="--noise"
    )
    white_grey: float = option(180.0, "grey level of white at the near end (default: 180)", "GREY", flag="--white")
    window_px: float = option(
        6.0, "Gaussian window, sigma in image px, for the depth noise (default: 6)", "PX", flag="--window"
    )

    def __post_init__(self) -> None:
        for entry in options_of(Assumptions):
            given = getattr(self, entry.name)
            if isinstance(given, float) and not 0 < given < 1e6:
                raise RigError(f"{flag_of(entry)}: expected a number above 0, got {given:g}")
        least, most = self.image_px
        if not 0 < least < most < 1e5:
            raise RigError(f"--image-px: expected LEAST,MOST such as 10,40, got {least:g},{most:g}")


@dataclass(frozen=True)
class Candidate:
    """Two carriers and what is expected of them.

    ``rival_rad``: distance of the nearest rival order. ``background_rad``: of the background plane, None where none is
    known. ``sigma_rad``: error of the two phases in the direction of rivals. ``noise_mm``: depth noise at the far end.
    ``wrong_share``: expected share of wrong orders before neighbours help. ``image_px``: periods in the image.
    ``turns``: periods that the carriers cross over the range, the most of any pixel.
    """

    crossed: Crossed
    rival_rad: float
    background_rad: float | None
    sigma_rad: float
    noise_mm: float
    wrong_share: float
    image_px: tuple[float, float]
    turns: tuple[float, float]

    @property
    def flat(self) -> tuple[int, ...]:
        """Carriers, 0 or 1, that run along the epipolar lines and tell no depth."""
        return tuple(k for k in (0, 1) if self.turns[k] < FLAT_TURNS)


class Design(NamedTuple):
    """The outcome of a search over ``searched`` pairs: those that no other beats in both depth noise and the distance
    of rivals in phase errors (``front``, the largest distance first), all clear of the background, and the one
    ``proposed`` with its ``reason``."""

    proposed: Candidate
    reason: str
    front: tuple[Candidate, ...]
    searched: int


def describe(rig: Rig, families: Sequence[Crossed], assumed: Assumptions) -> list[Candidate]:
    """The figures of ``families`` on ``rig``, whatever their periods are. Raises `RigError` where no pixel sees the
    pattern."""
    if not families:
        return []
    lines = EpipolarLines.of(rig)
    near_mm, far_mm = lines.range_mm
    first, last = map(float, lines.places(np.array(assumed.surfaces_mm or (near_mm, far_mm))))
    if not -1e-9 <= first < last <= 1 + 1e-9:
        raise RigError(f"surfaces: expected a part of the working range {near_mm:g} to {far_mm:g} mm")
    cycles = np.array([family.cycles_per_px for family in families])
    image_px = np.array([[rig.image_px_of_carrier(tuple(carrier)) for carrier in family] for family in cycles])
    pitches, weights = (np.array([getattr(f, name) for f in families]) for name in ("pitches_px", "weights"))
    turns, rival, background, sigma, noise = _figures(lines, assumed, cycles, pitches, image_px, weights)
    figures = (
        rival.tolist(),
        [None] * len(families) if background is None else background.tolist(),
        sigma.max(axis=1).tolist(),
        noise.tolist(),
        wrong_order_rate(turns, sigma, (first, last)).max(axis=-1).tolist(),
        map(tuple, image_px.tolist()),
        map(tuple, np.abs(turns).max(axis=1).tolist()),
    )
    return [Candidate(*of_pair) for of_pair in zip(families, *figures, strict=True)]


class _Figures(NamedTuple):
    """Of K pairs on n lines: turns over the range (K, n, 2), rival and background distance in rad (K,), error of the
    two phases across the line, the direction of rivals, in rad (K, n), and depth noise at the far end in mm (K,)."""

    turns: NDArray[np.float64]
    rival: NDArray[np.float64]
    background: NDArray[np.float64] | None
    sigma: NDArray[np.float64]
    noise: NDArray[np.float64]


def _figures(
    lines: EpipolarLines,
    assumed: Assumptions,
    cycles_per_px: NDArray[np.float64],
    pitches_px: NDArray[np.float64],
    image_px: NDArray[np.float64],
    weights: NDArray[np.float64] | float = 0.5,
) -> _Figures:
    """The figures of pairs of carriers: frequencies (K, 2, 2), periods on the projector and in the image and shares of
    the modulation (K, 2). A phase in a Gaussian window of sigma W has the noise ``s / (B W sqrt(2 pi))`` at noise s and
    modulation B."""
    turns, slopes = (along @ cycles_per_px.swapaxes(1, 2) for along in (lines.across_px, lines.far_px_per_mm))
    background = None if lines.background is None else background_distance(turns, lines.background).min(axis=1)
    kept = np.exp(-2 * (math.pi * assumed.blur_px / pitches_px) ** 2)  # of the modulation, by the blur
    sigmas = (assumed.phase_sigma * image_px / (SIGMA_PERIOD_PX * kept))[:, None]
    length = np.maximum(np.hypot(turns[..., 0], turns[..., 1]), np.finfo(np.float64).tiny)
    sigma = np.hypot(sigmas[..., 0] * turns[..., 1], sigmas[..., 1] * turns[..., 0]) / length
    near_mm, far_mm = lines.range_mm
    modulation = weights * kept * (assumed.white_grey / 2 * (near_mm / far_mm) ** 2)
    phase_noise = assumed.noise_grey / (modulation * assumed.window_px * math.sqrt(TAU))
    precision = ((TAU * slopes / phase_noise[:, None]) ** 2).sum(axis=-1)
    with np.errstate(divide="ignore"):
        noise = (1.0 / np.sqrt(precision)).max(axis=-1)
    return _Figures(turns, rival_distance(turns).min(axis=1), background, sigma, noise)


def search(
    rig: Rig,
    assumed: Assumptions,
    pitches_px: Iterable[float] | None = None,
    angles_deg: Iterable[float] = ANGLES_DEG,
) -> Design:
    """The best pairs of carriers out of all ``pitches_px`` (by default all whole numbers that the image can hold) and
    ``angles_deg``. Proposed is the one with the least depth noise of those with few enough wrong orders. Raises
    `RigError` where the limits leave none."""
    carriers = _carriers(rig, assumed, pitches_px, angles_deg)
    pairs = _apart(rig, carriers, assumed)
    if not len(pairs):
        raise RigError(
            f"no two of {len(carriers)} carriers have periods and beats of {assumed.image_px[0]:g} to "
            f"{assumed.image_px[1]:g} px in an image of {rig.camera.width} x {rig.camera.height} px; give other "
            "--pitches and --angles, or wider limits (--image-px)"
        )
    lines, cycles = EpipolarLines.of(rig), _cycles(carriers)
    image_px = np.array([rig.image_px_of_carrier(tuple(carrier)) for carrier in cycles])
    clearance, noise = np.empty((2, len(pairs)))
    for start in range(0, len(pairs), _CHUNK):
        part = slice(start, start + _CHUNK)
        of_part = (values[pairs[part]] for values in (cycles, carriers[:, 0], image_px))
        _, rival, background, across, noise[part] = _figures(lines, assumed, *of_part)
        sigma = np.maximum(across.max(axis=-1), np.finfo(np.float64).tiny)
        clearance[part] = rival / sigma
        if background is not None:
            clearance[part][background < BACKGROUND_SIGMAS * sigma] = 0.0
    if not clearance.any():
        raise RigError(
            f"all {len(pairs):,} pairs show the background at {rig.background:g} m as they show a depth in the range; "
            "give other --pitches and --angles, or leave background_m out of the rig"
        )
    families = [Crossed(*map(tuple, carriers[pairs[index]].T.tolist())) for index in _front(clearance, noise)]
    front = tuple(describe(rig, families, assumed))
    limit = f"{assumed.wrong_percent:g}% wrong orders"
    few = [candidate for candidate in front if 100 * candidate.wrong_share <= assumed.wrong_percent]
    if few:
        return Design(few[-1], f"the least depth noise of those with at most {limit}", front, len(pairs))
    return Design(front[0], f"none has at most {limit}; the largest distance", front, len(pairs))


def _carriers(
    rig: Rig, assumed: Assumptions, pitches_px: Iterable[float] | None, angles_deg: Iterable[float]
) -> NDArray[np.float64]:
    """Period and angle of every carrier whose period in the image is within the limits, (n, 2)."""
    carriers: list[tuple[float, float]] = []
    for angle in sorted({float(angle) % 180.0 for angle in angles_deg}):
        (cycles, _) = Crossed((10.0, 10.0), (angle, angle + 90.0)).cycles_per_px
        per_px = rig.image_px_of_carrier(cycles) / 10.0
        if not math.isfinite(per_px):
            continue
        least, most = (limit / per_px for limit in assumed.image_px)
        longest = math.hypot(rig.projector.width, rig.projector.height)
        if pitches_px is None:
            pitches = [float(pitch) for pitch in range(max(math.ceil(least), 4), int(min(most, longest)) + 1)]
        else:
            pitches = [float(pitch) for pitch in pitches_px if least <= pitch <= most]
        carriers += [(pitch, angle) for pitch in sorted(set(pitches))]
    return np.array(carriers).reshape(-1, 2)


def _cycles(carriers: NDArray[np.float64]) -> NDArray[np.float64]:
    turned = np.radians(carriers[:, 1])
    return np.column_stack([np.sin(turned), np.cos(turned)]) / carriers[:, :1]


def _apart(rig: Rig, carriers: NDArray[np.float64], assumed: Assumptions) -> NDArray[np.intp]:
    """Indices of pairs of carriers that can be told apart in the image, (n, 2)."""
    pairs = np.array(list(combinations(range(len(carriers)), 2)), dtype=np.intp).reshape(-1, 2)
    if not len(pairs):
        return pairs
    # The pattern's frequencies in the image are a linear map of those on the projector.
    columns = [rig.image_frequency(unit) for unit in ((1.0, 0.0), (0.0, 1.0))]
    cycles = _cycles(carriers) @ np.array(columns)
    first, second = cycles[pairs[:, 0]], cycles[pairs[:, 1]]
    least = 1.0 / assumed.image_px[1]
    apart = [np.hypot(*(first + sign * second).T) >= least for sign in (1, -1)]
    first_deg, second_deg = carriers[pairs, 1].T
    across = np.abs((first_deg - second_deg + 90.0) % 180.0 - 90.0) >= LEAST_ANGLE_DEG
    return pairs[apart[0] & apart[1] & across]


def _front(clearance: NDArray[np.float64], noise: NDArray[np.float64]) -> list[int]:
    """Indices of the pairs that no other beats in both, the largest clearance first; none without clearance. Rounded,
    so that equal pairs stay in their order on every processor."""
    clearance, noise = np.round(clearance, 6), np.round(noise, 9)
    front: list[int] = []
    for index in np.lexsort((noise, -clearance)).tolist():
        if clearance[index] > 0 and (not front or noise[index] < noise[front[-1]]):
            front.append(index)
    return front


@styled
def draw_design(rig: Rig, proposed: Candidate, other: Candidate, assumed: Assumptions) -> bytes:
    """PNG of the ``proposed`` pair beside an ``other`` one on ``rig``: both lines on the torus, the distance of the
    nearest rival over depth, and that distance for all pairs of periods at the proposed angles."""
    lines = EpipolarLines.of(rig)
    drawn = figure(11, 10)
    plots = drawn.subplots(2, 2)
    for axes, candidate in zip(plots[0], (other, proposed), strict=True):
        _draw_torus(axes, lines, candidate)
    for candidate in (other, proposed):
        turns = lines.turns(candidate.crossed)[:, None, :]
        distance = nearest(turns, -_PLACES, 1.0 - _PLACES).min(axis=0)
        plots[1, 0].plot(lines.depths_mm(_PLACES), distance, label=_title(candidate.crossed))
    plots[1, 0].set(
        title="nearest rival over depth", xlabel="depth, mm", ylabel="distance of the phases, rad", ylim=(0, None)
    )
    plots[1, 0].legend()
    _draw_map(plots[1, 1], rig, lines, proposed, assumed)
    return figure_png(drawn, reduced=True)


def _title(crossed: Crossed) -> str:
    (first, second), (first_deg, second_deg) = crossed.pitches_px, crossed.angles_deg
    return f"{first:g} / {second:g} px at {first_deg:g} / {second_deg:g} degrees"


def _draw_torus(axes: "Axes", lines: EpipolarLines, candidate: Candidate) -> None:
    """The phases of both carriers in turns, of the pixel with the nearest rival."""
    turns = lines.turns(candidate.crossed)
    pixel = int(np.argmin(rival_distance(turns)))
    wrapped = _wrapped(turns[pixel], _PLACES)
    axes.plot(*wrapped.T, lw=2, color="C0", label="working range")
    for place, marker, label in ((0.0, "o", "near end"), (1.0, "s", "far end")):
        axes.plot(*_wrapped(turns[pixel], np.array([place]))[0], marker, ms=9, color="C0", label=label)
    if lines.background is not None:
        axes.plot(
            *_wrapped(turns[pixel], lines.background[pixel : pixel + 1])[0],
            "x",
            ms=11,
            mew=3,
            color="C1",
            label="background",
        )
    axes.set(
        title=f"{_title(candidate.crossed)}\nnearest rival {candidate.rival_rad:.2f} rad",
        xlim=(0, 1),
        ylim=(0, 1),
        xlabel="phase of carrier 1, turns (near end: 0.5)",
        ylabel="phase of carrier 2, turns",
        aspect="equal",
    )
    axes.legend(loc="best")


def _wrapped(turns: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Phases (n, 2) in turns from 0 to 1, NaN where the line leaves the square."""
    phases = (places[:, None] * turns + 0.5) % 1.0
    phases[1:][(np.abs(np.diff(phases, axis=0)) > 0.5).any(axis=1)] = np.nan
    return phases


def _draw_map(axes: "Axes", rig: Rig, lines: EpipolarLines, proposed: Candidate, assumed: Assumptions) -> None:
    first, second = (
        np.arange(round(assumed.image_px[0] * pitch / image_px), round(assumed.image_px[1] * pitch / image_px) + 1.0)
        for pitch, image_px in zip(proposed.crossed.pitches_px, proposed.image_px, strict=True)
    )
    turns = lines.turns(proposed.crossed) * np.array(proposed.crossed.pitches_px)
    grid = np.stack(np.meshgrid(first, second, indexing="ij"), axis=-1)
    distance = rival_distance(turns / grid[:, :, None, :]).min(axis=-1)
    image = axes.imshow(
        distance.T, origin="lower", extent=(first[0] - 0.5, first[-1] + 0.5, second[0] - 0.5, second[-1] + 0.5)
    )
    axes.plot(*proposed.crossed.pitches_px, "*", ms=14, color="white", mec="black")
    first_deg, second_deg = proposed.crossed.angles_deg
    axes.set(
        title=f"nearest rival by periods, at {first_deg:g} / {second_deg:g} degrees",
        xlabel="period of carrier 1, projector px",
        ylabel="period of carrier 2, projector px",
    )
    axes.figure.colorbar(image, ax=axes, label="distance of the phases, rad")
