"""The examination of a capture: before it is decoded, on some of its lines, from all that its
frames and rig tell."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from fpp_ml_bench.coding.code import Limits
from fpp_ml_bench.coding.phase_shift import TAU, PhaseShift
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.examination.alignment import Pattern, epipolar_pattern
from fpp_ml_bench.examination.findings import Examination, Finding
from fpp_ml_bench.examination.readings import AS_GIVEN, Fit, Reading, decoded_lines, fit, search
from fpp_ml_bench.examination.signals import (
    LEAST_PX,
    Band,
    Edges,
    Estimate,
    FringeSet,
    Lines,
    Side,
    equal_frames,
    fringe_sets,
    gray_edges,
    marked_saturated,
    ripples,
    step_errors,
    take_lines,
    turns,
)
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import Direction

OFFSET_TURNS = 0.02
"""Smallest common offset of phase and Gray code that is a finding: 0.4 px of 18 px, which no light
of ours makes by more than chance."""
OFFSET_EDGES = 100
"""Edges between Gray cells that are needed to measure that offset. With fewer, chance makes it."""
RIPPLE_RAD = 0.02
"""Smallest ripple of twice the phase that is a finding, in rad. One of 8 frames half late makes
0.05, one of 18 0.01; lamps that flicker by 2% make 0.012 with three steps."""
STEP_RAD = 0.1
"""Smallest error of a step's shift that is a finding, in rad. One of 8 frames half late makes 0.37,
one of 18 0.17; lamps that flicker turn no shift."""
RESPONSE_RAD = 0.006
"""Smallest ripple of N times the phase that is named: patterns of 8 bits make 0.003."""
TRIED = 0.1
"""Other readings are tried where more than this share of the lit pixels contradict the code, where
twice this share of neighbours contradict each other, or where fewer are coherent."""
IN_RANGE = 0.05
"""Share of the coherent pixels that must have a depth in the range; other readings are tried where
fewer have."""
MISALIGNED_SHARE = 0.0025
"""Of the projector's larger side: an epipolar pattern (RMS) from which the depth can't be trusted,
3.2 px of 1280. The calibration that the authors of public captures used leaves 0.0017; depths by it
are 1.2 mm off at 400 mm."""
ALONG: dict[Direction | None, Side] = {"vertical": "rows", "horizontal": "columns"}
"""Bands along which a code runs through many cells. Across them it has a few, which two bits may
show alike."""
MOST_UNLIKE_STEPS = 6
"""Up to so many steps those that follow one another are 60 degrees and more apart."""
FEWEST_TURNS = 3.0
"""Turns from bright to dark along a line from which two bits can't be alike by chance: silhouettes
make one or two."""
TORN_SHARE = 0.8
"""Largest share of the bands that are torn where a tear, and not the whole capture, is at fault."""
FEWEST_IN_BAND = 60
"""Lit pixels that a band needs to be judged: with fewer, noise makes any share."""
MORE_IN_BAND = 0.4
"""How much more of a torn band's lit pixels contradict the code than of the best band's: strong
noise alone makes 0.2."""
CONTRADICTING = 0.6
"""Share of the lit pixels that contradict the code above which depth is not to be trusted: the
capture is refused."""
DOUBTFUL = 0.5
"""Share of the lit pixels that contradict the code above which depth is doubtful: a warning."""
MOVED_SHARE = 0.05
"""Share of the lit pixels at which mean images must differ for the scene to have moved. A smaller
one takes reflections and noise for motion."""
NEIGHBOURS_PX = 9
"""Pixels along a line over which that difference is averaged: they share no noise."""
_FINEST = 2.0
"""Fringes of a pitch up to so many times the finest are tested for ripples: coarser ones do not act
on the coordinate (`coding.phase_shift.FINE_RATIO`)."""
_SCORED_PX = 4000
"""Pixels of the lines, about, on which the reading that was given is judged: enough for shares of a
percent."""
CAPTURE_IN_TIME = (
    "capture again: trigger the camera by the projector, or wait longer after each pattern"
)
_UNITS = {
    1000.0: "metres were read as mm",
    10.0: "cm were read as mm",
    0.01: "cm were read as metres",
    0.001: "mm were read as metres",
}


def examine(
    frames: NDArray,
    rig: Rig,
    names: Sequence[str] | None = None,
    *,
    directions: Sequence[Direction] | None = None,
    mask: NDArray[np.bool_] | None = None,
    limits: Limits | None = None,
    calibrated: bool = True,
) -> Examination:
    """Examine the ``frames`` (F, H, W) of a rig's sequence, grey levels of 0 to 255; ``names`` are
    their files'.

    ``directions``: those that will be decoded (all). Pixels outside ``mask`` (H, W) don't count.
    ``calibrated`` False: the rig's lenses, pose and range are placeholders, and only the code is
    looked at."""
    limits, directions = limits or Limits(), tuple(directions or rig.directions)
    if not directions:
        return Examination((), ("anything: no direction is coded pixel by pixel",))
    titles = [frame.title for frame in rig.sequence] if names is None else list(names)
    taken = replace(
        take_lines(frames, rig, mask), directions=directions, limits=limits, calibrated=calibrated
    )
    lines, full_grey = marked_saturated(taken)
    not_checked = _not_checked(lines)
    if lines.lit.sum() < LEAST_PX:
        return Examination(
            (), (*not_checked, f"anything: only {lines.lit.sum()} pixels looked at are lit")
        )
    sets = fringe_sets(lines)
    pairs = equal_frames(lines, sets)
    if pairs:
        return Examination((_equal(pairs, titles),), not_checked)
    findings: list[Finding] = []
    part = lines.part(_SCORED_PX)
    given = fit(part, AS_GIVEN)
    measured = {
        "coherent_share": given.coherent,
        "in_range_share": given.fitting,
        "contradicting_share": given.contradicting,
    }
    systematic: dict[str, float] = {}
    for fringe_set in sets:
        findings += _steps_and_response(lines, fringe_set, titles, measured, systematic)
    for fringe_set in sets:
        if (edges := gray_edges(lines, fringe_set)) is None:
            continue
        measured[f"{fringe_set.direction}_offset_turns"] = edges.offset_turns.value
        # A frame that is late shifts all phases, too.
        if _is_offset(edges) and not any(finding.severity == "refuse" for finding in findings):
            torn = _torn(lines, sets, titles)
            return Examination(
                tuple(torn) or (_offset(edges, rig, fringe_set.direction),), not_checked, measured
            )
    doubtful = (
        given.contradicting > TRIED or given.agreeing < 1 - 2 * TRIED or given.coherent < TRIED
    )
    doubtful = doubtful or given.fitting < IN_RANGE * given.coherent
    if doubtful and (other := search(lines, given)):
        return Examination((_another_reading(other, given),), not_checked, measured)
    if torn := _torn(lines, sets, titles):
        return Examination(tuple(torn), not_checked, measured)
    findings += _exchanged_flat(lines) or _moved(sets)
    pattern = epipolar_pattern(part, decoded_lines(part)) if calibrated else None
    where = _contradicting_bands(part, given)
    if pattern is not None:
        findings.append(_misaligned(pattern, rig))
        for direction in directions:
            wave_rad = TAU * pattern.rms_px / (rig.code(direction).pitch_px or math.inf)
            systematic[direction] = math.hypot(systematic.get(direction, 0.0), wave_rad)
    if pattern is not None and pattern.causes:
        pass  # pixels contradict each other because of it
    elif given.contradicting > DOUBTFUL or where:
        findings.append(_contradictions(given, where))
    elif calibrated and given.fitting == 0.0 and given.depth_mm is not None:
        # Fewer come by chance.
        findings += (
            [_out_of_range(given.depth_mm, rig)]
            if len(given.depth_mm) > part.levels.shape[1] / 5
            else []
        )
    findings.sort(key=lambda finding: ("refuse", "warn", "note").index(finding.severity))
    return Examination(tuple(findings), not_checked, measured, systematic, full_grey)


def _not_checked(lines: Lines) -> tuple[str, ...]:
    """What frames of such a rig can't tell, whatever they show."""
    parts = []
    if len(lines.directions) < 2:
        parts.append(
            "images mirrored along the fringes, an inverted pose, another window of a sensor, and "
            "a camera or "
            "projector that moved, turned or zoomed since its calibration: one direction of "
            "fringes can't tell"
        )
    for way in lines.directions:
        code = lines.rig.code(way)
        if isinstance(code, PhaseShift):
            if code.gray is None:
                parts.append(
                    f"an offset of the {way} phases by whole fringes, or of all alike: no Gray "
                    f"code tells"
                )
            if max(fringe.steps for fringe in code.fringes) == 3:
                parts.append(f"noise of the {way} frames: three steps fit any three grey levels")
    if not lines.calibrated:
        parts.append("depth: the rig is not calibrated yet")
    return tuple(parts)


def _equal(pairs: Sequence[tuple[int, int]], titles: Sequence[str]) -> Finding:
    listed = ", ".join(f"{titles[i]} and {titles[j]}" for i, j in pairs[:4]) + (
        " and others" if len(pairs) > 4 else ""
    )
    return Finding(
        "equal frames",
        "refuse",
        f"{listed} show the same image, and their patterns differ",
        "the camera delivered a frame twice, or a pattern was not shown in time, or a file was "
        "copied",
        CAPTURE_IN_TIME,
    )


def _exchanged_flat(lines: Lines) -> list[Finding]:
    sequence = lines.rig.sequence
    black, white = sequence.black, sequence.white
    if black is None or white is None:
        return []
    dark, bright = (
        lines.levels[index][lines.lit].astype(np.float64).mean() for index in (black, white)
    )
    exchanged = Finding(
        "white and black",
        "refuse",
        f"white has {bright:.0f} grey levels, and black {dark:.0f}",
        "they changed places, or the frames are in another order",
        "rename the files, or correct the sequence's order",
    )
    return [exchanged] if bright < dark else []


def _is_offset(edges: Edges) -> bool:
    return edges.clear and edges.edges >= OFFSET_EDGES and edges.offset_turns.exceeds(OFFSET_TURNS)


def _misaligned(pattern: Pattern, rig: Rig) -> Finding:
    alike = " (these frames can't tell which)" if len(pattern.causes) > 1 else ""
    width_px = max(rig.projector.width, rig.projector.height)
    return Finding(
        "calibration",
        "refuse" if pattern.rms_px > MISALIGNED_SHARE * width_px else "note",
        f"the two directions miss each other's epipolar lines by {pattern.rms_px:.2f} projector px "
        f"(RMS, and "
        f"{pattern.rest_px:.2f} px by noise), in a pattern over the image",
        "; or ".join(pattern.causes) + alike,
        "the stated uncertainty holds an error of this size; calibrate again as the devices stand "
        "now, or give the rig "
        "that took these frames",
    )


def _offset(edges: Edges, rig: Rig, direction: Direction) -> Finding:
    code = rig.code(direction)
    pitch, turns = rig.pitch(direction), edges.offset_turns
    origin_px = (code.origin_px if isinstance(code, PhaseShift) else 0.0) - turns.value * pitch
    return Finding(
        "phase and Gray code",
        "refuse",
        f"the {direction} phase at the edges of the Gray cells is {360 * turns.value:.1f} +- "
        f"{360 * turns.sigma:.1f} degrees off, {abs(turns.value) * pitch:.2f} projector px, "
        f"at {100 * edges.agreeing:.0f}% of {edges.edges} edges",
        "the sinusoids begin elsewhere than at the Gray code's first pixel (another origin, or "
        "sine for cosine)",
        f"if the Gray code begins at the pattern's first pixel: origin_px: {origin_px:.2f} "
        f"({direction}), or "
        f"{360 * turns.value:+.1f} degrees to every shift in shifts_deg",
    )


def _another_reading(readings: Sequence[tuple[Reading, Fit]], given: Fit) -> Finding:
    listed = "; or ".join(
        f"{reading.what} ({100 * fits.fitting:.0f}%)" for reading, fits in readings[:4]
    )
    alike = " (these frames can't tell which)" if len(readings) > 1 else ""
    return Finding(
        "another reading fits",
        "refuse",
        f"{100 * given.fitting:.0f}% of the lit pixels fit as the rig file says, and far more fit "
        f"another reading",
        f"{listed}{alike}",
        "; or ".join(dict.fromkeys(reading.change for reading, _ in readings[:4])),
    )


def _steps_and_response(
    lines: Lines,
    fringe_set: FringeSet,
    titles: Sequence[str],
    measured: dict[str, float],
    systematic: dict[str, float],
) -> list[Finding]:
    """A step that is not what it should be, and the response, which is no fault of the capture."""
    waves = (
        ripples(lines, fringe_set)
        if fringe_set.pitch_px <= _FINEST * lines.rig.pitch(fringe_set.direction)
        else {}
    )
    name, faults = f"{fringe_set.direction} fringes of {fringe_set.pitch_px:g} px", []
    if (step := step_errors(fringe_set)) is not None and step[1].exceeds(STEP_RAD):
        which = (
            f"of {titles[fringe_set.frames[step[0]]]}"
            if fringe_set.steps > 4
            else "of one of four steps"
        )
        faults.append(f"the shift {which} is {abs(np.rad2deg(step[1].value)):.0f} degrees off")
    if (twice := waves.get(2)) is not None:
        measured[f"{fringe_set.direction}_{fringe_set.pitch_px:g}px_ripple_rad"] = twice.size.value
        if twice.size.exceeds(RIPPLE_RAD):
            faults.append(
                f"the phase has an error of {twice.size.value:.3f} rad that repeats twice a period"
            )
    if faults:
        return [
            Finding(
                "wrong step",
                "refuse",
                f"{name}: {', and '.join(faults)}, which neither noise nor gamma explains",
                "a frame that was exposed while the pattern changed, came late, or was shown at "
                "another brightness",
                CAPTURE_IN_TIME,
            )
        ]
    bent = waves.get(fringe_set.steps)
    if bent is None or not bent.size.exceeds(RESPONSE_RAD):
        return []
    systematic[fringe_set.direction] = max(
        systematic.get(fringe_set.direction, 0.0), bent.size.value / math.sqrt(2)
    )
    return [
        Finding(
            "response",
            "note",
            f"{name}: the phase has an error of {bent.size.value:.3f} rad that repeats "
            f"{fringe_set.steps} times a period",
            "the response of projector and camera is not straight (gamma)"
            if bent.symmetric
            else "",
            "the stated uncertainty holds it; set projector and camera to gamma 1, or use more "
            "steps",
        )
    ]


def _moved(sets: Sequence[FringeSet], torn: NDArray[np.bool_] | None = None) -> list[Finding]:
    """Sets of sinusoids whose mean images differ: all of them show the scene under the same mean
    light. With ``torn`` pixels (n,) of the lines: the others alone are looked at."""
    for first, other in combinations(sets, 2):
        both = first.good & other.good
        if torn is not None:
            both &= ~torn
        if both.sum() < LEAST_PX:
            continue
        gain = float(np.median(other.mean[both]) / max(float(np.median(first.mean[both])), 1e-9))
        # Over some neighbours, which share no noise.
        difference = uniform_filter1d(other.mean - gain * first.mean, NEIGHBOURS_PX)[both]
        apart = np.abs(difference) > 0.25 * first.modulation[both] + 6.0
        if apart.mean() > MOVED_SHARE:
            return [
                Finding(
                    "scene moved",
                    "refuse",
                    f"the mean images of the {first.direction} fringes of {first.pitch_px:g} px "
                    f"and the "
                    f"{other.direction} ones "
                    f"of {other.pitch_px:g} px differ at {100 * apart.mean():.0f}% of the lit "
                    f"pixels",
                    "object or camera moved between them, the frames are of two captures, or a "
                    "frame failed",
                    "put the frames of one capture, of a scene at rest, into the folder",
                )
            ]
    return []


def _torn(lines: Lines, sets: Sequence[FringeSet], titles: Sequence[str]) -> list[Finding]:
    """Frames of which some rows or columns show another pattern than the rest; or, where the rest
    of the image differs between the ``sets`` as well, a scene that moved: two scenes in one capture
    make lines look torn here and there."""
    torn: dict[Side, dict[Band, list[str]]] = {"rows": {}, "columns": {}}
    sizes: dict[tuple[Side, str, float], dict[Band, Estimate]] = {}
    for band, inside in lines.banded():
        if np.count_nonzero(inside & lines.lit) < LEAST_PX:
            continue
        part = lines.at(np.flatnonzero(inside))
        of_band = fringe_sets(part)
        crossed = [fringe_set for fringe_set in of_band if not fringe_set.one_phase]
        for i, j in equal_frames(part, crossed, following=True):
            if not _never_alike(part, band.side, i, j):
                continue
            torn[band.side].setdefault(band, []).append(
                f"{titles[j]} shows the image of {titles[i]}"
            )
        for fringe_set in of_band:
            name = f"the {fringe_set.direction} fringes of {fringe_set.pitch_px:g} px"
            if (step := step_errors(fringe_set)) is not None:
                sizes.setdefault((band.side, f"a step of {name} is wrong", STEP_RAD), {})[band] = (
                    step[1]
                )
            edges = gray_edges(part, fringe_set)
            if edges is not None and edges.clear:
                fault = f"{name} are shifted against the Gray code"
                sizes.setdefault((band.side, fault, OFFSET_TURNS), {})[band] = edges.offset_turns
    for (side, fault, least), of_bands in sizes.items():
        smallest = min(of_bands.values(), key=lambda size: abs(size.value))
        wrong = []
        for band, size in of_bands.items():
            apart = Estimate(
                abs(size.value) - abs(smallest.value), math.hypot(size.sigma, smallest.sigma)
            )
            if size.exceeds(least) and apart.exceeds(least):
                wrong.append(band)
        # Edges of Gray cells in fringes of few image px look shifted here and there; what is read
        # late reaches an end.
        bands = list(of_bands)
        if least == STEP_RAD or wrong in (bands[: len(wrong)], bands[len(bands) - len(wrong) :]):
            for band in wrong:
                torn[side].setdefault(band, []).append(fault)
    fewest = min(
        (side for side in torn if torn[side]), key=lambda side: len(torn[side]), default=None
    )
    if fewest is None:
        return []
    shown = sorted(torn[fewest], key=lambda band: band.first)
    position = lines.row if fewest == "rows" else lines.column
    lost = [place for band in shown for place in range(band.first, band.last + 1)]
    if moved := _moved(sets, np.isin(position, lost)):
        return moved
    said = list(dict.fromkeys(fault for band in shown for fault in torn[fewest][band]))
    more = f", and {len(said) - 3} more" if len(said) > 3 else ""
    return [
        Finding(
            "torn frames",
            "refuse",
            f"{_ranges(shown)} differ from the other {fewest}: {', '.join(said[:3])}{more}",
            f"the projector changed its picture while the camera exposed or read these {fewest} "
            f"(no synchronisation, "
            "or a rolling shutter)",
            CAPTURE_IN_TIME + "; a rolling shutter needs exposures of whole projector frames",
        )
    ]


def _never_alike(part: Lines, side: Side, i: int, j: int) -> bool:
    """Whether two frames that follow one another can't look alike in a band of such a ``side``,
    unless one is torn."""
    sequence = part.rig.sequence
    first, second = sequence.frames[i], sequence.frames[j]
    along = all(ALONG.get(frame.direction, side) == side for frame in (first, second))
    of_one_set = (first.kind, first.direction, first.fringe) == (
        second.kind,
        second.direction,
        second.fringe,
    )
    if of_one_set and first.kind == "sinusoid" and first.direction is not None:
        # Steps near each other differ little, and with many of them a torn one is a wrong step
        # anyway.
        return along or len(sequence.period(first.direction, first.fringe)) <= MOST_UNLIKE_STEPS
    its_inverse = of_one_set and first.step == second.step
    return along or its_inverse or turns(part, j) >= FEWEST_TURNS


def _ranges(bands: Sequence[Band]) -> str:
    """Where bands of one side are, those beside each other together."""
    ends: list[list[int]] = []
    for band in bands:
        if ends and band.first == ends[-1][1] + 1:
            ends[-1][1] = band.last
        else:
            ends.append([band.first, band.last])
    return f"{bands[0].side} " + ", ".join(f"{first} to {last}" for first, last in ends)


def _contradicting_bands(part: Lines, given: Fit) -> str:
    """The rows or columns in which far more of the lit pixels contradict the code than in others,
    in words; "" where none do. They reach an end of the image, as those do that were read too late;
    what a scene does may be anywhere."""
    if given.lit is None or given.against is None:
        return ""
    shares: dict[Side, dict[Band, float]] = {"rows": {}, "columns": {}}
    for band, inside in part.banded():
        lit = inside & given.lit
        if np.count_nonzero(lit) >= FEWEST_IN_BAND:
            shares[band.side][band] = float(given.against[lit].mean())
    for of_bands in shares.values():
        more = [
            band
            for band, share in of_bands.items()
            if share > min(of_bands.values()) + MORE_IN_BAND
        ]
        bands = list(of_bands)
        if 0 < len(more) <= TORN_SHARE * len(bands) and more in (
            bands[: len(more)],
            bands[-len(more) :],
        ):
            return f", most in {_ranges(more)}"
    return ""


def _contradictions(given: Fit, where: str) -> Finding:
    return Finding(
        "contradictions",
        "refuse" if given.contradicting > CONTRADICTING else "warn",
        f"{100 * given.contradicting:.0f}% of the lit pixels contradict the code{where}, and no "
        f"other reading fits",
        "",
        "look whether sequence, projector size and pose in the rig file are those of this capture, "
        "and whether the "
        "scene moved: compare the first and last image with the first and last pattern (fpp-bench "
        "patterns)",
    )


def _out_of_range(depth_mm: NDArray[np.float64], rig: Rig) -> Finding:
    low, middle, high = np.quantile(depth_mm, (0.02, 0.5, 0.98))
    near, far = rig.working_range_mm
    cause, change = (
        "another working range than the rig file's",
        f"give the range: --working-range {low:.0f},{high:.0f}",
    )
    if units := [
        f"{why} ({factor:g} times)"
        for factor, why in _UNITS.items()
        if near <= factor * middle <= far
    ]:
        cause = f"a wrong unit of the rig's translation: {units[0]}"
        change = "correct the translation or the calibration's unit"
    baseline = MM_PER_M * rig.baseline_m
    return Finding(
        "nothing in the range",
        "refuse",
        f"depths of {low:.4g} to {high:.4g} mm, a baseline of {baseline:.4g} mm, and a range of "
        f"{near:g} to {far:g} mm",
        cause,
        change,
    )
