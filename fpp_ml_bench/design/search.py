"""The search for two carriers: pairs of every period within limits, what each costs, and the one to
take; and a picture of it: the lines on the torus, the rival distance over depth, and the expected
error over the period."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import SMALLEST_PITCH_PX
from fpp_ml_bench.coding.crossed import WINDOW_PERIODS, Crossed
from fpp_ml_bench.design.rivals import (
    TAU,
    EpipolarLines,
    background_distance,
    nearest,
    rival_distance,
    wrong_orders,
)
from fpp_ml_bench.errors import RigError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.options import flag_of, option, options_of
from fpp_ml_bench.style import figure, figure_png, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FLAT_TURNS = 0.05
"""A carrier that turns less over the whole range tells no depth."""
LEFT_WRONG = 0.2
"""Of the wrong orders of single pixels, those that neighbours leave: a guess, within 0.1 to
0.86 of `benchmarks/crossed_sweep.py`."""
LEAST_RIVAL_RAD = 0.15
"""Phase of the nearest rival order of a pair that is proposed: three times what crossed fringes'
phases are off by in a clean image. Nearer ones are chosen for any noise."""
_PLACES = np.linspace(0.0, 1.0, 400)


def _pair(text: str) -> tuple[float, float]:
    try:
        least, most = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError("expected two numbers with a comma between them, such as 10,40") from None
    return least, most


@dataclass(frozen=True, kw_only=True)
class Assumptions:
    """What the figures of a pair rest on. Raises `RigError` for numbers that are not above 0 and
    finite.

    ``image_px``: shortest and longest period in the image. ``surfaces_mm``: where surfaces are
    expected, None for anywhere in the range; a rival may be anywhere in it. ``phase_error``: mean
    error in rad, along the line of depths, of the two phases of a window; ``edge_share`` and
    ``edge_sigma``: share of the pixels near edges and texture, and the standard deviation in rad of
    their errors across the line, which decide orders. These three are those of the validation
    objects in the lights `paper` and `workshop`, for periods of 5 to 31 image px on three rigs: in
    rad they hardly depend on the period (docs/results/crossed.md). ``blur_px``: sigma of the
    projector's blur, projector px, which takes modulation from fine periods. ``noise_grey``: the
    camera's noise, with ``white_grey``, the grey level of white at the near end (falling with the
    square of the distance).
    """

    HEADING = "design of crossed fringes"
    image_px: tuple[float, float] = option(
        (6.0, 40.0),
        "limits of a period in the image, px (default: 6,40)",
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
    phase_error: float = option(
        0.12, "mean error of the phases along the line of depths (default: 0.12)", "RAD"
    )
    edge_share: float = option(
        0.35, "share of the pixels near edges and texture (default: 0.35)", "SHARE"
    )
    edge_sigma: float = option(
        0.2, "error of their phases across that line, for orders (default: 0.2)", "RAD"
    )
    blur_px: float = option(
        0.5, "sigma of the projector's blur, projector px (default: 0.5)", "PX", flag="--blur"
    )
    noise_grey: float = option(
        1.0,
        "camera noise, grey levels of 255, for the phase error (default: 1)",
        "GREY",
        flag="--noise",
    )
    white_grey: float = option(
        180.0, "grey level of white at the near end (default: 180)", "GREY", flag="--white"
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

    ``rival_rad``: distance of the nearest rival order. ``background_rad``: of the background plane,
    None where none is known. ``phase_mm``: mean error of a depth of the right order.
    ``wrong_share``: expected share of wrong orders before neighbours help, and ``wrong_mm``: what
    those that are left after them add to the mean error. ``image_px``: periods in the image.
    ``turns``: periods that the carriers cross over the range, the most of any pixel.
    """

    crossed: Crossed
    rival_rad: float
    background_rad: float | None
    phase_mm: float
    wrong_share: float
    wrong_mm: float
    image_px: tuple[float, float]
    turns: tuple[float, float]

    @property
    def expected_mm(self) -> float:
        """Mean error of a depth."""
        return self.phase_mm + self.wrong_mm

    @property
    def flat(self) -> tuple[int, ...]:
        """Carriers, 0 or 1, that run along the epipolar lines and tell no depth."""
        return tuple(k for k in (0, 1) if self.turns[k] < FLAT_TURNS)


class Design(NamedTuple):
    """The outcome of a search: the pairs that were ``searched``, the finest first, and the one of
    them ``proposed``, that of the least expected error."""

    proposed: Candidate
    searched: tuple[Candidate, ...]


def describe(rig: Rig, families: Sequence[Crossed], assumed: Assumptions) -> list[Candidate]:
    """The figures of ``families`` on ``rig``, whatever their periods are. Raises `RigError` where
    no pixel sees the pattern."""
    if not families:
        return []
    lines = EpipolarLines.of(rig)
    near_mm, far_mm = lines.range_mm
    first, last = map(float, lines.places(np.array(assumed.surfaces_mm or (near_mm, far_mm))))
    if not -1e-9 <= first < last <= 1 + 1e-9:
        raise RigError(
            f"surfaces: expected a part of the working range {near_mm:g} to {far_mm:g} mm"
        )
    return [_described(rig, lines, family, assumed, (first, last)) for family in families]


def _described(
    rig: Rig,
    lines: EpipolarLines,
    family: Crossed,
    assumed: Assumptions,
    surfaces: tuple[float, float],
) -> Candidate:
    """Errors are means over the lines; a phase in a Gaussian window of sigma W has the noise ``s /
    (B W sqrt(2 pi))`` at noise s and modulation B."""
    cycles, pitches = np.array(family.cycles_per_px), np.array(family.pitches_px)
    image_px = [rig.image_px_of_carrier(carrier) for carrier in family.cycles_per_px]
    turns, slopes = lines.across_px @ cycles.T, lines.far_px_per_mm @ cycles.T
    kept = np.exp(-2 * (math.pi * assumed.blur_px / pitches) ** 2)  # of the modulation, by the blur
    near_mm, far_mm = lines.range_mm
    modulation = (
        np.array(family.weights) * kept * (assumed.white_grey / 2 * (near_mm / far_mm) ** 2)
    )
    noise = assumed.noise_grey / (modulation * WINDOW_PERIODS * max(image_px) * math.sqrt(TAU))
    error = np.hypot(assumed.phase_error / kept, noise)
    places = np.linspace(*surfaces, 41)
    nearer = float(
        ((lines.depths_mm(places) / far_mm) ** 2).mean()
    )  # the same phase is less depth there
    with np.errstate(divide="ignore"):
        phase_mm = nearer / np.sqrt(((TAU * slopes / error) ** 2).sum(axis=-1))
    sigmas = assumed.edge_sigma / kept
    length = np.maximum(np.hypot(turns[:, 0], turns[:, 1]), np.finfo(np.float64).tiny)
    across = np.hypot(sigmas[0] * turns[:, 1], sigmas[1] * turns[:, 0]) / length
    share, wrong_mm = wrong_orders(lines, turns, across, assumed.edge_share, surfaces)
    apart = (
        None
        if lines.background is None
        else float(background_distance(turns, lines.background).min())
    )
    return Candidate(
        crossed=family,
        rival_rad=float(rival_distance(turns).min()),
        background_rad=apart,
        phase_mm=float(phase_mm.mean()),
        wrong_share=float(share.max()),
        wrong_mm=LEFT_WRONG * float(wrong_mm.mean()),
        image_px=(image_px[0], image_px[1]),
        turns=tuple(np.abs(turns).max(axis=0).tolist()),  # type: ignore[arg-type]
    )


def square_pair(lines: EpipolarLines, pitch_px: float) -> Crossed:
    """Two carriers of one period, square to each other. The first is turned from the direction in
    which the phase changes fastest by ``atan(1 / (T + 1))``, T its turns over the range, so that
    the second, which then changes by less than one turn, is at another phase at each of them."""
    turns = float(np.hypot(*lines.across_px.T).max()) / pitch_px
    first = lines.flat_angle_deg + 90.0 + math.degrees(math.atan(1.0 / (turns + 1.0)))
    return Crossed(
        (pitch_px, pitch_px), (round(first % 180.0, 1), round((first - 90.0) % 180.0, 1))
    )


def search(rig: Rig, assumed: Assumptions, pitches_px: Iterable[float] | None = None) -> Design:
    """The best `square_pair` of all ``pitches_px``, by default all whole numbers that the image can
    hold: the one of the least expected error of those without a rival nearer than `LEAST_RIVAL_RAD`.
    Raises `RigError` where the limits leave none."""
    lines, (least, most) = EpipolarLines.of(rig), assumed.image_px
    longest = int(math.hypot(rig.projector.width, rig.projector.height))
    pitches = [
        float(pitch)
        for pitch in (
            range(math.ceil(SMALLEST_PITCH_PX), longest + 1) if pitches_px is None else pitches_px
        )
    ]
    families = [
        square_pair(lines, pitch) for pitch in sorted(set(pitches)) if pitch >= SMALLEST_PITCH_PX
    ]

    def fits(family: Crossed) -> bool:
        return all(
            least <= rig.image_px_of_carrier(carrier) <= most for carrier in family.cycles_per_px
        )

    families = [family for family in families if fits(family)]
    if not families:
        raise RigError(
            f"none of {len(pitches)} periods covers {least:g} to {most:g} px in an image of "
            f"{rig.camera.width} x "
            f"{rig.camera.height} px; give other --pitches, or wider limits (--image-px)"
        )
    searched = tuple(describe(rig, families, assumed))
    apart = [candidate for candidate in searched if candidate.rival_rad >= LEAST_RIVAL_RAD]
    if not apart:
        nearest_rad = max(candidate.rival_rad for candidate in searched)
        raise RigError(
            f"each of {len(searched)} periods has a wrong order within {nearest_rad:.2g} rad of the "
            f"right one somewhere in the range, and {LEAST_RIVAL_RAD:g} rad are needed; shorten the "
            f"working range, or allow other periods (--pitches, --image-px)"
        )
    return Design(min(apart, key=lambda candidate: round(candidate.expected_mm, 9)), searched)


@styled
def draw_design(rig: Rig, design: Design, other: Candidate) -> bytes:
    """PNG of the proposed pair beside an ``other`` one on ``rig``: both lines on the torus, the
    distance of the nearest rival over depth, and the expected error of all pairs that were
    searched."""
    lines, proposed = EpipolarLines.of(rig), design.proposed
    drawn = figure(11, 10)
    plots = drawn.subplots(2, 2)
    for axes, candidate in zip(plots[0], (other, proposed), strict=True):
        _draw_torus(axes, lines, candidate)
    for candidate in (other, proposed):
        turns = lines.turns(candidate.crossed)[:, None, :]
        distance = nearest(turns, -_PLACES, 1.0 - _PLACES).min(axis=0)
        plots[1, 0].plot(lines.depths_mm(_PLACES), distance, label=_title(candidate.crossed))
    plots[1, 0].set(
        title="nearest rival over depth",
        xlabel="depth, mm",
        ylabel="distance of the phases, rad",
        ylim=(0, None),
    )
    pitches = [candidate.crossed.pitches_px[0] for candidate in design.searched]
    for name, label in (
        ("phase_mm", "phases"),
        ("wrong_mm", "wrong orders"),
        ("expected_mm", "both"),
    ):
        plots[1, 1].plot(
            pitches, [getattr(candidate, name) for candidate in design.searched], ".-", label=label
        )
    plots[1, 1].set(
        title="expected error",
        xlabel="period of both carriers, projector px",
        ylabel="mean error, mm",
        ylim=(0, 1.1 * max(candidate.expected_mm for candidate in design.searched)),
    )
    for axes in plots[1]:
        axes.legend()
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
        axes.plot(
            *_wrapped(turns[pixel], np.array([place]))[0], marker, ms=9, color="C0", label=label
        )
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
