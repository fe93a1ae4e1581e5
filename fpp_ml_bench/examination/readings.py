"""Other readings of a capture: the same images in another order, seen another way round, with bits
read another way.

Each is tried on some thousand pixels. It fits by the share of the lit pixels that get a depth in
the range, times what neighbours say: phases go on at the edges of Gray cells, and on a surface that
both devices see the projector's coordinates grow along the image as they do on a plane (the
ordering constraint of stereo vision).
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, groupby, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Coordinates, Reason
from fpp_ml_bench.coding.gray_code import GrayCells, GrayOnly
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decoding.blocks import depth_and_reason, plan_direction
from fpp_ml_bench.examination.signals import Lines, fringe_sets, gray_edges
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, Direction, Frame

LARGEST_MISFIT = 0.2
"""Largest RMS distance of grey levels from their sinusoid, in modulations, where four steps and
more tell."""
CLEARLY_LIT_GREY = 30.0
"""Pixels whose grey levels differ by so much from frame to frame have to be lit by any reading."""
LARGEST_DISAGREEMENT_PX = 8.0
"""Distance across the epipolar line from which a pixel contradicts: less is a calibration's
error."""
GOOD = 0.8
"""Share of fitting pixels from which on another reading may be named."""
FEWER = 3.0
"""How many times fewer pixels such a reading must leave that contradict it than the one given."""
_FIRST_PX = 600
"""Pixels, about, on which all readings are tried: few, since there are many readings."""
_SECOND_PX = 4000
"""Pixels, about, on which the best of these are judged, as the one given is
(`examine._SCORED_PX`)."""
_FEWEST_PAIRS = 40
"""Pairs of neighbours that are needed to judge how orders or depths go on along a line; with fewer
the measure is left out."""
_KEPT = 8
"""Best readings of the first round that are tried on more pixels. With fewer, noise in the first
round could lose the right one."""
_BACKGROUND_SHARE = 0.03
"""Distance from the rig's background plane, as a share of its own, within which a depth counts as
inside the range."""
_WIDE_MM = (1e-6, 1e12)
"""Nearest and farthest depth, in mm, that a reading may give before its range is judged: any at
all."""


Change = Callable[[Lines], Lines]


@dataclass(frozen=True)
class Reading:
    """A way to read the images: ``what`` is different from the rig file, the ``change`` to do, and
    ``seen``, which gives the lines as this reading has them."""

    what: str
    change: str
    seen: Change = lambda lines: lines


def _in_order(place: Sequence[int]) -> Change:
    """Frames of the sequence at other places of the capture, ``place[index]`` for each of them."""
    return lambda lines: replace(lines, levels=lines.levels[list(place)])


def _with_levels(change: Callable[[NDArray], NDArray]) -> Change:
    return lambda lines: replace(lines, levels=change(lines.levels))


def _flipped(across: bool, down: bool) -> Change:
    def seen(lines: Lines) -> Lines:
        height, width = lines.shape
        column = width - 1 - lines.column if across else lines.column
        return replace(lines, column=column, row=height - 1 - lines.row if down else lines.row)

    return seen


def _inverse_pose(lines: Lines) -> Lines:
    rig = lines.rig
    turned: Any = tuple(tuple(column) for column in rig.R.T.tolist())
    shift: Any = tuple((-rig.R.T @ rig.t).tolist())
    return replace(lines, rig=replace(rig, rotation=turned, translation_m=shift))


@dataclass(frozen=True)
class Fit:
    """Shares of the lit pixels: ``coherent`` with the code and their neighbours, and so and in the
    range, ``fitting``; ``contradicting`` the code. ``agreeing``: what neighbours say, 1 or less.
    ``depth_mm``: of coherent pixels, whatever the range. ``against`` bool (n,): which of the
    ``lit`` pixels, bool (n,), contradict the code."""

    coherent: float = 0.0
    fitting: float = 0.0
    contradicting: float = 0.0
    agreeing: float = 1.0
    depth_mm: NDArray[np.float64] | None = None
    lit: NDArray[np.bool_] | None = None
    against: NDArray[np.bool_] | None = None


AS_GIVEN = Reading("as the rig file says", "")


def decoded_lines(lines: Lines) -> dict[Direction, Coordinates]:
    """The projector's coordinates of the lines' pixels."""
    plans = [plan_direction(lines.rig, direction, None) for direction in lines.directions]
    return {
        plan.direction: plan.decode(
            np.ascontiguousarray(lines.levels[list(plan.rows)]), lines.limits
        )
        for plan in plans
    }


def fit(lines: Lines, reading: Reading) -> Fit:
    """How well the reading fits; of a rig that is not calibrated depth and order don't count."""
    lines = reading.seen(lines)
    rig, directions, levels = lines.rig, lines.directions, lines.levels
    measured, edges = decoded_lines(lines), 1.0
    reasons = np.stack([coordinates.reason for coordinates in measured.values()])
    reason = np.where(reasons == 0, np.uint8(Reason.NOT_ASKED), reasons).min(axis=0)
    reason[reason == Reason.NOT_ASKED] = 0
    saturated = reason == Reason.SATURATED
    lit = (reason != Reason.LOW_MODULATION) & ~saturated
    # Gray code alone has no second opinion: a doubtful bit there is blur.
    alone = all(isinstance(rig.code(way), GrayOnly) for way in directions)
    contradicting = lit & (reason != 0) & ~(alone & (reason == Reason.INCONSISTENT_ORDER))
    for fringe_set in fringe_sets(lines):
        if fringe_set.steps > 3:
            shown = fringe_set.mean + fringe_set.modulation * np.cos(
                fringe_set.phase + fringe_set.shifts_rad[:, None]
            )
            misfit = ((fringe_set.levels - shown) ** 2).mean(axis=0)
            reason[(reason == 0) & (misfit > (LARGEST_MISFIT * fringe_set.modulation) ** 2)] = (
                Reason.INCONSISTENT_ORDER
            )
        cell_edges = gray_edges(lines, fringe_set)
        edges *= (
            1.0
            if cell_edges is None or cell_edges.edges < _FEWEST_PAIRS
            else min(cell_edges.agreeing, cell_edges.forward)
        )
    bright = max(int((lit | saturated).sum()), 1)
    counted = (lit | (np.ptp(levels, axis=0) >= CLEARLY_LIT_GREY)) & ~saturated
    if not counted.any():
        return Fit()
    if not lines.calibrated:
        share = edges * float((reason[counted] == 0).mean())
        return Fit(
            share, share, float(contradicting.sum()) / bright, edges, None, lit, contradicting
        )
    x, y = (axis[lines.row, lines.column] for axis in rig.camera.rays())
    forward = min(
        (
            _forward(lines, (x, y), measured[way].coordinate_px, reason == 0, way)
            for way in directions
        ),
        default=1.0,
    )
    apart_px = LARGEST_DISAGREEMENT_PX + math.hypot(*(rig.code(way).step_px for way in directions))
    wide, loose = rig.with_range(_WIDE_MM), replace(lines.limits, max_disagreement_px=apart_px)
    depth_mm, of_depth = depth_and_reason(measured, (x, y), wide, loose)
    good = (reason == 0) & (of_depth == 0)
    contradicting |= lit & (reason == 0) & (of_depth != 0)
    inside = rig.in_range(depth_mm)
    if rig.background_m is not None:
        inside |= (
            np.abs(depth_mm - rig.background_m * MM_PER_M)
            < _BACKGROUND_SHARE * rig.background_m * MM_PER_M
        )
    coherent, fitting = float(good[counted].mean()), float((good & inside)[counted].mean())
    weight, against = edges * min(1.0, 2 * forward), float(contradicting.sum()) / bright
    depths_mm = depth_mm[good].astype(np.float64)
    return Fit(weight * coherent, weight * fitting, against, weight, depths_mm, lit, contradicting)


def _forward(
    lines: Lines,
    rays: Maps,
    coordinate_px: NDArray,
    known: NDArray[np.bool_],
    direction: Direction,
) -> float:
    """Share of neighbours between which the coordinate grows as it does on a plane in the middle of
    the range."""
    rig = lines.rig
    middle_m = sum(rig.working_range_mm) / 2 / MM_PER_M
    on_plane = np.diff(rig.seen(rays, middle_m)[AXES.index(direction)])
    change = np.diff(coordinate_px)
    with np.errstate(invalid="ignore"):
        used = lines.joined[:-1] & known[:-1] & known[1:] & (change != 0) & np.isfinite(on_plane)
        if used.sum() < _FEWEST_PAIRS:
            return 1.0
        used &= np.abs(on_plane) > 0.5 * np.quantile(np.abs(on_plane[used]), 0.9)
    if not used.any():
        return 1.0
    near = np.abs(change[used]) < 4 * np.abs(on_plane[used]) + 3 * rig.code(direction).step_px
    return float((near & (np.sign(change[used]) == np.sign(on_plane[used]))).mean())


def search(lines: Lines, given: Fit) -> list[tuple[Reading, Fit]]:
    """The readings that fit far better than the one ``given``, best first; none where none does."""
    few, more = lines.part(_FIRST_PX), lines.part(_SECOND_PX)
    for candidates in (_single(lines.rig, lines.calibrated), _exchanges(lines.rig)):
        first = [(reading, fit(few, reading)) for reading in candidates]
        first.sort(key=lambda pair: -pair[1].fitting)
        second = [(reading, fit(more, reading)) for reading, _ in first[:_KEPT]]
        needed = max(GOOD, 1 - (1 - given.fitting) / FEWER)
        named = sorted(
            (pair for pair in second if pair[1].fitting >= needed),
            key=lambda pair: -pair[1].fitting,
        )
        if named:
            best = named[0][1].fitting
            return [pair for pair in named if 1 - pair[1].fitting <= FEWER * (1 - best) + 0.02]
    return []


def _single(rig: Rig, solid: bool) -> Iterator[Reading]:
    """All readings but exchanges of two frames."""
    frames = rig.sequence.frames
    everything = list(range(len(frames)))
    runs = [
        [frame.index for frame in run]
        for _, run in groupby(frames, key=lambda frame: (frame.kind, frame.direction, frame.fringe))
    ]
    if solid:
        for flips, name in (
            ((True, False), "mirrored left to right"),
            ((False, True), "mirrored top to bottom"),
            ((True, True), "turned by 180 degrees"),
        ):
            change = f"write the images as the calibrated camera sees them: they are {name}"
            yield Reading(f"images that are {name}", change, _flipped(*flips))
        change = "invert rotation and translation of the rig"
        yield Reading("a pose that goes from the projector to the camera", change, _inverse_pose)
    alone = rig.directions if len(rig.directions) > 1 else ()
    for ways, of in ((rig.directions, ""), *(((way,), f"{way} ") for way in alone)):
        for reading in _of_code(rig, [run for run in runs if frames[run[0]].direction in ways]):
            yield replace(reading, what=of + reading.what)
    yield Reading(
        "all frames inverted (black for white)", "invert the images", _with_levels(_inverted)
    )
    change = "rename the files in the opposite order"
    yield Reading("all frames in the opposite order", change, _in_order(everything[::-1]))
    for shift in range(1, len(frames)):
        change = f"rename the files: the first {len(frames) - shift} are the sequence's last ones"
        captured = everything[shift:] + everything[:shift]
        yield Reading(
            f"a capture that starts with frame {frames[shift].title}", change, _captured(captured)
        )
    orders = dict.fromkeys(
        tuple(index for run in ordered for index in run) for ordered in _orders(frames, runs)
    )
    for order in orders:
        if list(order) != everything:
            change = "write this order in the rig file's sequence, or rename the files"
            yield Reading(
                f"frames in the order {', '.join(_names(frames, order))}", change, _captured(order)
            )


def _captured(indices: Sequence[int]) -> Change:
    """The frames of the sequence where they are in a capture that holds ``indices`` in this
    order."""
    return _in_order(np.argsort(indices).tolist())


def _of_code(rig: Rig, own: list[list[int]]) -> Iterator[Reading]:
    """What may be different in the codes whose runs of frames are ``own``."""
    frames, everything = rig.sequence.frames, list(range(len(rig.sequence)))
    sinusoids = [run for run in own if frames[run[0]].kind == "sinusoid" and len(run) > 2]
    bits = [run for run in own if frames[run[0]].kind == "gray"]

    def moved(runs: list[list[int]], change: Callable[[list[int]], list[int]]) -> list[int]:
        """Everything with the frames of each run in another order."""
        place = list(everything)
        for run in runs:
            for index, other in zip(run, change(run), strict=True):
                place[index] = other
        return place

    def rearranged(run: list[int], changes: Mapping[str, Any]) -> list[int]:
        """Where the Gray frames of ``run`` are, when captured as with ``changes`` of their
        `GrayCells`."""
        code: Any = rig.code(frames[run[0]].direction or "vertical")
        cells: GrayCells = code if isinstance(code, GrayOnly) else code.gray
        if "inverse" in changes and cells.inverse == "none":
            return run
        shown = replace(cells, **changes).shown
        return [run[shown.index(frame)] for frame in cells.shown]

    if sinusoids:
        flipped = moved(sinusoids, lambda run: [run[0], *run[:0:-1]])
        yield Reading(
            "phase shifts of the other sign",
            "change the entry sign of the sequence (1, -1)",
            _in_order(flipped),
        )
        for quarters in (1, 2, 3):
            if all(quarters * len(run) % 4 == 0 for run in sinusoids):
                turned = moved(sinusoids, partial(_turned, quarters))
                what = f"phases that are {90 * quarters} degrees further (sine for cosine)"
                yield Reading(what, "give shifts_deg with this angle added", _in_order(turned))
        backward, change = moved(sinusoids, lambda run: run[::-1]), "give shifts_deg in this order"
        yield Reading(
            "phase steps in the opposite order",
            f"rename the files, or {change}",
            _in_order(backward),
        )
    if bits:
        for key, value, what in (
            ("least_first", True, "with the least significant bit first"),
            ("least_first", False, "with the most significant bit first"),
            ("inverse", "after each", "whose inverse frames come after each"),
            ("inverse", "after all", "whose inverse frames come after all"),
        ):
            place = moved(bits, partial(rearranged, changes={key: value}))
            if place != everything:
                yield Reading(
                    f"Gray code {what}", f"write {key}: {str(value).lower()}", _in_order(place)
                )
        change = "project it as the rig file says, or exchange white and black of its images"
        levels = _with_levels(partial(_gray_levels, bits, True))
        yield Reading("Gray code that is inverted (black for white)", change, levels)
        change = "project Gray code: at the edges of binary numbers several bits change at once"
        yield Reading(
            "binary numbers for Gray code", change, _with_levels(partial(_gray_levels, bits, False))
        )


def _turned(quarters: int, run: list[int]) -> list[int]:
    return np.roll(run, quarters * len(run) // 4).tolist()  # type: ignore[no-any-return]


def _inverted(levels: NDArray) -> NDArray:
    return levels.max(axis=0) + (
        levels.min(axis=0) - levels
    )  # unsigned grey levels wrap twice, and come out right


def _gray_levels(runs: list[list[int]], invert: bool, levels: NDArray) -> NDArray:
    """Grey levels with the Gray frames inverted, or turned from binary numbers into Gray code."""
    result, low, high = levels.copy(), levels.min(axis=0), levels.max(axis=0)
    for run in runs:
        if invert:
            result[run] = low + (high - levels[run])
            continue
        bits = levels[run] > (low.astype(np.float64) + high) / 2
        bits[1:] ^= bits[:-1].copy()
        result[run] = np.where(bits, high, low)
    return result


def _orders(frames: Sequence[Frame], runs: list[list[int]]) -> Iterator[list[list[int]]]:
    """Other orders of the runs: by kind and direction, and with two runs exchanged."""
    firsts = [frames[run[0]] for run in runs]
    directions = dict.fromkeys(frame.direction for frame in firsts if frame.direction)
    for kinds in permutations(dict.fromkeys(frame.kind for frame in firsts)):
        for ways in permutations(directions):
            ranks = [
                (kinds.index(frame.kind), (None, *ways).index(frame.direction)) for frame in firsts
            ]
            for major in (0, 1):
                keys = [(rank[major], rank[1 - major]) for rank in ranks]
                yield [runs[i] for i in sorted(range(len(runs)), key=keys.__getitem__)]
    for first, second in combinations(range(len(runs)), 2):
        ordered = list(runs)
        ordered[first], ordered[second] = runs[second], runs[first]
        yield ordered


def _names(frames: Sequence[Frame], captured: Sequence[int]) -> list[str]:
    """The runs of a capture in words."""
    several = any(frame.fringe for frame in frames)

    def name(index: int) -> str:
        frame = frames[index]
        kind = {"sinusoid": "sinusoids", "gray": "Gray code"}.get(frame.kind, frame.kind)
        period = f" of period {frame.fringe}" if several and frame.kind == "sinusoid" else ""
        return f"{frame.direction} {kind}{period}" if frame.direction else kind

    return [named for named, _ in groupby(captured, name)]


def _exchanges(rig: Rig) -> Iterator[Reading]:
    frames = rig.sequence.frames
    coded = [frame.index for frame in frames if frame.direction is not None]
    for first, second in combinations(coded, 2):
        place = list(range(len(frames)))
        place[first], place[second] = second, first
        titles = [frames[index].title for index in (first, second)]
        yield Reading(
            f"frames that changed places: {titles[0]} and {titles[1]}",
            "rename these two files",
            _in_order(place),
        )
