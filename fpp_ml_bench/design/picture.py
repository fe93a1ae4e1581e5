"""A picture of a design: the lines on the torus, the rival distance over depth and over the two periods."""

from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import Crossed
from fpp_ml_bench.design.epipolar import EpipolarLines
from fpp_ml_bench.design.rivals import nearest, rival_distance
from fpp_ml_bench.design.search import Assumptions, Candidate
from fpp_ml_bench.optics import Rig

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PLACES = np.linspace(0.0, 1.0, 400)


def draw_design(rig: Rig, proposed: Candidate, other: Candidate, assumed: Assumptions) -> bytes:
    """PNG of the ``proposed`` pair beside an ``other`` one on ``rig``: both lines on the torus, the distance of the
    nearest rival over depth, and that distance for all pairs of periods at the proposed angles."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    lines = EpipolarLines.of(rig)
    figure = Figure(figsize=(11, 10), layout="constrained", dpi=90)
    plots = figure.subplots(2, 2)
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
    picture = BytesIO()
    FigureCanvasAgg(figure).print_png(picture)
    return picture.getvalue()


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
            color="C3",
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
    axes.legend(loc="best", fontsize=8)


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
