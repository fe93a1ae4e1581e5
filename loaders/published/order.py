"""The order of a raw scan's files: named orders, and the check of an order on the images.

The paper lists 18 horizontal, 18 vertical, 7 + 7 Gray, black, white. That the files ``A_0 .. A_51`` have this order is
likely but not confirmed. So the order can be chosen by name, and every folder is checked against it: which frames are
darkest and brightest, which have two grey levels, along which image axis they vary, and the phase shift between
sinusoids. The check uses a few image rows and columns and takes a few ms per folder.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, compress, product

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.phase_shift import phase_weights, weighted_sums
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction, Frame, Sequence

AUTO = "auto"
_Run = tuple[str, Direction]
_Lit = list[NDArray[np.bool_]]
"""Which pixels of `_Lines.parts` the projector reaches: (lines, W) and (lines, H)."""
_SH: _Run = "sinusoid", "horizontal"
_SV: _Run = "sinusoid", "vertical"
_GH: _Run = "gray", "horizontal"
_GV: _Run = "gray", "vertical"
LAYOUTS: dict[str, tuple[_Run, ...]] = {
    "paper": (_SH, _SV, _GH, _GV),
    "vertical-first": (_SV, _SH, _GV, _GH),
    "by-direction": (_SH, _GH, _SV, _GV),
    "by-direction-vertical-first": (_SV, _GV, _SH, _GH),
}
WHITE_FIRST, BACKWARD_STEPS, LEAST_BIT_FIRST = "white-first", "backward-steps", "least-bit-first"
MODIFIERS = (WHITE_FIRST, BACKWARD_STEPS, LEAST_BIT_FIRST)

_LINES = 24
_LEAST_CONTRAST = 10.0
_LEAST_LIT = 0.02
_SAME_MEAN = 0.1
"""Grey levels by which the means of two images of the same may differ by noise."""
_MIDDLE = (0.25, 0.75)
_MOST_MIDDLE_OF_GRAY, _LEAST_MIDDLE_OF_SINUSOID = 0.15, 0.2
"""A sinusoid has a third of its pixels in the middle half of its range, a two-valued frame only its blurred edges."""
_LEAST_SHARE = 0.4
"""Share of the sequence's modulation: a frame of the sequence has about 1, a frame of other fringes about 0.1."""
_LEAST_EDGES_A_LINE = 0.5
"""The coarsest bit changes once per line across the pattern; fewer changes come from outlines of the object."""


@dataclass(frozen=True)
class FrameOrder:
    """Which frame of the sequence each file of a raw scan is. ``layout`` is a key of `LAYOUTS`; black and white come
    last. Of `MODIFIERS`, ``white-first``: white before black. ``backward-steps``: the phase shifts are -2 pi n / N, so
    that file n is step (N - n) mod N. ``least-bit-first``: Gray code from the least significant bit."""

    layout: str = "paper"
    modifiers: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        return "+".join([self.layout, *(name for name in MODIFIERS if name in self.modifiers)])

    def frames(self, sequence: Sequence) -> tuple[Frame, ...]:
        """The frames in file order."""
        frames: list[Frame] = []
        for kind, direction in LAYOUTS[self.layout]:
            indices = list(sequence.sinusoids(direction) if kind == "sinusoid" else sequence.gray(direction))
            if kind == "sinusoid" and BACKWARD_STEPS in self.modifiers:
                indices = [indices[-n % len(indices)] for n in range(len(indices))]
            if kind == "gray" and LEAST_BIT_FIRST in self.modifiers:
                indices.reverse()
            frames += [sequence.frames[i] for i in indices]
        ends = [sequence.black, sequence.white]
        frames += [sequence.frames[i] for i in (reversed(ends) if WHITE_FIRST in self.modifiers else ends)]
        return tuple(frames)


def parse_order(name: str) -> FrameOrder | None:
    """The order called ``name``, e.g. ``paper`` or ``vertical-first+white-first``; None for ``auto``. Raises
    `LayoutError` for an unknown name."""
    if name == AUTO:
        return None
    layout, *modifiers = name.split("+")
    if layout not in LAYOUTS or not set(modifiers) <= set(MODIFIERS):
        raise LayoutError(
            f"frame order {name!r}: expected {AUTO}, or one of {', '.join(LAYOUTS)}, followed by any of "
            + ", ".join(f"+{modifier}" for modifier in MODIFIERS)
        )
    return FrameOrder(layout, frozenset(modifiers))


def all_orders() -> Iterator[FrameOrder]:
    """All named orders, the paper's first."""
    for *used, layout in product((False, True), (False, True), (False, True), LAYOUTS):
        yield FrameOrder(layout, frozenset(compress(MODIFIERS, used)))


def find_order(files: list[NDArray[np.uint8]], rig: Rig) -> FrameOrder | None:
    """The named order that the images of a raw scan fit, or None."""
    measured = _Lines(files)
    sequence = rig.paper_sequence
    return next((order for order in all_orders() if not _misfits(measured, order.frames(sequence), rig)), None)


def check_order(files: list[NDArray[np.uint8]], order: FrameOrder, rig: Rig) -> list[str]:
    """Contradictions between ``order`` and the images of a raw scan, uint8 (H, W) in file order; empty if they fit."""
    return _misfits(_Lines(files), order.frames(rig.paper_sequence), rig)


class _Lines:
    """A raw scan on some image rows and columns: ``parts`` along x (F, lines, W) and along y (F, lines, H), float32."""

    def __init__(self, files: list[NDArray[np.uint8]]) -> None:
        height, width = files[0].shape
        rows = np.unique(np.linspace(0, height - 1, _LINES).astype(int))
        columns = np.unique(np.linspace(0, width - 1, _LINES).astype(int))
        along_x, along_y = [image[rows] for image in files], [image[:, columns].T for image in files]
        self.parts = tuple(np.stack(lines).astype(np.float32) for lines in (along_x, along_y))
        self.mean = np.array([float(image.mean(dtype=np.float64)) for image in files])


def _misfits(lines: _Lines, frames: tuple[Frame, ...], rig: Rig) -> list[str]:
    """Contradictions between the files and ``frames``. Cheap checks come first; the others run only if those pass."""
    file_of_frame = {frame.index: number for number, frame in enumerate(frames)}
    black, white = file_of_frame[rig.paper_sequence.black], file_of_frame[rig.paper_sequence.white]
    darkest, brightest = int(lines.mean.argmin()), int(lines.mean.argmax())
    # A code with more bits than its cells need has a first frame that is black all over, too.
    if max(lines.mean[black] - lines.mean[darkest], lines.mean[brightest] - lines.mean[white]) > _SAME_MEAN:
        return [
            f"A_{darkest}.png is the darkest and A_{brightest}.png the brightest image; expected black in "
            f"A_{black}.png and white in A_{white}.png"
        ]
    lit = [part[white] - part[black] >= _LEAST_CONTRAST for part in lines.parts]
    if min(float(part.mean()) for part in lit) < _LEAST_LIT:
        return [f"A_{white}.png is hardly brighter than A_{black}.png: too little contrast to check an order"]
    problems = _two_valued(lines, frames, lit, black, white)
    if not problems:
        for direction in DIRECTIONS:
            sinusoids, codes = rig.paper_sequence.sinusoids(direction), rig.paper_sequence.gray(direction)
            problems += _sinusoids(lines, [file_of_frame[i] for i in sinusoids], lit, direction, rig)
            limit = [(part[black] + part[white]) / 2 for part in lines.parts]
            problems += _codes(lines, [file_of_frame[i] for i in codes], lit, direction, rig, limit)
    return problems


def _two_valued(lines: _Lines, frames: tuple[Frame, ...], lit: _Lit, black: int, white: int) -> list[str]:
    problems = []
    parts = [part[:, part_lit] for part, part_lit in zip(lines.parts, lit, strict=True)]
    grey = np.concatenate(parts, axis=1)
    share = (grey - grey[black]) / (grey[white] - grey[black])
    middle = ((share > _MIDDLE[0]) & (share < _MIDDLE[1])).mean(axis=1)
    for number, frame in enumerate(frames):
        if frame.kind == "gray" and middle[number] > _MOST_MIDDLE_OF_GRAY:
            problems.append(f"A_{number}.png: expected a Gray code frame with two grey levels, got many levels between")
        if frame.kind == "sinusoid" and middle[number] < _LEAST_MIDDLE_OF_SINUSOID:
            problems.append(f"A_{number}.png: expected a sinusoid, got an image of two grey levels")
    return problems


def _expected_gradient(direction: Direction, rig: Rig) -> NDArray[np.float64]:
    """Change of the projector coordinate (px) over half an image pixel in x and in y, on the background plane; (2,)."""
    camera = rig.camera
    centre = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    coordinates_px = []
    for offset in ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5)):
        x, y = camera.normalised(*(centre + offset))
        point = np.array([float(np.asarray(x)), float(np.asarray(y)), 1.0]) * rig.background
        coordinates_px.append(float(rig.project(point)[0 if direction == "vertical" else 1]))
    return np.array([coordinates_px[1] - coordinates_px[0], coordinates_px[2] - coordinates_px[0]])


def _sinusoids(lines: _Lines, numbers: list[int], lit: _Lit, direction: Direction, rig: Rig) -> list[str]:
    steps = len(numbers)
    shifts = 2 * np.pi * np.arange(steps) / steps
    weights = phase_weights(shifts)
    residuals, real, imaginary, gradients = [], [], [], []
    for part, part_lit in zip(lines.parts, lit, strict=True):
        stack = part[numbers]
        mean, cosine, sine = weighted_sums(stack, weights)
        wave = cosine - 1j * sine
        turn = np.angle(wave[:, 1:] * wave[:, :-1].conj())
        gradients.append(float(np.median(turn[part_lit[:, 1:] & part_lit[:, :-1]])))
        residuals.append((stack - mean)[:, part_lit])
        real.append(wave.real[part_lit])
        imaginary.append(wave.imag[part_lit])
    # I_n - A = Re(wave) cos(delta_n) - Im(wave) sin(delta_n), solved for delta_n over all pixels.
    model = np.stack([np.concatenate(real), -np.concatenate(imaginary)], axis=1)
    solved = np.linalg.lstsq(model, np.concatenate(residuals, axis=1).T, rcond=None)[0]
    foreign = np.flatnonzero(np.hypot(*solved) < _LEAST_SHARE)
    if foreign.size:
        # A foreign image disturbs the phase of all others a little, so only the foreign images are reported.
        return [
            f"A_{numbers[n]}.png: expected {direction} sinusoid step {n}, got an image of other fringes"
            for n in foreign
        ]
    measured_shifts = np.arctan2(solved[1], solved[0])
    errors = np.angle(np.exp(1j * (measured_shifts - shifts)))
    problems = [
        f"A_{numbers[n]}.png: expected {direction} sinusoid step {n}, phase shift {np.degrees(shifts[n]):.0f} degrees; "
        f"the image has {np.degrees(measured_shifts[n]) % 360:.0f}"
        for n in np.flatnonzero(np.abs(errors) > np.pi / steps / 2)
    ]
    expected = _expected_gradient(direction, rig)
    axis = int(np.abs(expected).argmax())
    files = f"A_{min(numbers)}.png to A_{max(numbers)}.png"
    if np.abs(gradients).argmax() != axis:
        problems.append(f"{files}: expected {direction} fringes, varying along image {'xy'[axis]}; these files do not")
    elif np.sign(gradients[axis]) != np.sign(expected[axis]):
        problems.append(f"{files}: the {direction} sinusoids' phase shifts run backwards")
    return problems


def _codes(
    lines: _Lines, numbers: list[int], lit: _Lit, direction: Direction, rig: Rig, limit: list[NDArray[np.float32]]
) -> list[str]:
    axis = int(np.abs(_expected_gradient(direction, rig)).argmax())
    codes = [part[numbers] > middle for part, middle in zip(lines.parts, limit, strict=True)]
    pairs = [part_lit[:, 1:] & part_lit[:, :-1] for part_lit in lit]
    # Changes of each bit per image line: (bits,) along x and along y.
    edges = [
        ((code[:, :, 1:] != code[:, :, :-1]) & pair).sum(axis=(1, 2)) / code.shape[1]
        for code, pair in zip(codes, pairs, strict=True)
    ]
    along, across = edges[axis], edges[1 - axis]
    problems = [
        f"A_{numbers[i]}.png: expected {direction} Gray bit {i}, varying along image {'xy'[axis]}; it does not"
        for i in np.flatnonzero((across > along) & (across > _LEAST_EDGES_A_LINE))
    ]
    grey = lines.parts[axis][numbers]
    problems += [
        f"A_{numbers[i]}.png and A_{numbers[j]}.png: the same image, expected two Gray bits"
        for i, j in combinations(range(len(numbers)), 2)
        if along[i] > _LEAST_EDGES_A_LINE and np.array_equal(grey[i], grey[j])
    ]
    if problems:
        return problems
    return [
        f"A_{numbers[i]}.png and A_{numbers[j]}.png: expected {direction} Gray bits {i} and {j}, most significant "
        "first; the code is more regular with the two exchanged"
        for i, j in _exchanged_bits(codes[axis], pairs[axis])
    ]


def _exchanged_bits(code: NDArray[np.bool_], pairs: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Pairs of bits that give a more regular code along the lines when exchanged; ``code`` bool (bits, lines, L)."""

    def jumps(order: list[int]) -> int:
        cells, bit = np.zeros(code.shape[1:], dtype=np.int32), np.zeros(code.shape[1:], dtype=np.bool_)
        for number in order:
            bit ^= code[number]
            cells += cells
            cells += bit
        return int(np.abs(np.diff(cells, axis=-1))[pairs].sum())

    straight = list(range(len(code)))
    as_is = jumps(straight)
    exchanged = {(i, j): [{i: j, j: i}.get(k, k) for k in straight] for i, j in combinations(straight, 2)}
    return [pair for pair, order in exchanged.items() if jumps(order) < as_is]
