"""The order of a raw scan's files: named orders, and the check of an order on the images.

The paper lists 18 horizontal, 18 vertical, 7 + 7 Gray, black, white. That the files ``A_0 .. A_51``
have this order is likely but not confirmed. So the order can be chosen by name, and every folder is
checked against it: which frames are darkest and brightest, which have two grey levels, along which
image axis they vary, and the phase shift between sinusoids. The check uses a few image rows and
columns and takes a few ms per folder.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, compress, product

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.gray_code import gray_to_binary
from fpp_ml_bench.coding.phase_shift import phase_weights, weighted_sums
from fpp_ml_bench.errors import LayoutError
from fpp_ml_bench.examination.signals import lines_at
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AXES, DIRECTIONS, Direction, Frame, Sequence

AUTO = "auto"
_Run = tuple[str, Direction]
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
"""A sinusoid has a third of its pixels in the middle half of its range, a two-valued frame only its
blurred edges."""
_LEAST_SHARE = 0.4
"""Share of the sequence's modulation: a frame of the sequence has about 1, a frame of other fringes
about 0.1."""
_LEAST_EDGES_A_LINE = 0.5
"""The coarsest bit changes once per line across the pattern; fewer changes come from outlines of
the object."""


@dataclass(frozen=True)
class FrameOrder:
    """Which frame of the sequence each file of a raw scan is. ``layout`` is a key of `LAYOUTS`;
    black and white come last. Of `MODIFIERS`, ``white-first``: white before black.
    ``backward-steps``: the phase shifts are -2 pi n / N, so that file n is step (N - n) mod N.
    ``least-bit-first``: Gray code from the least significant bit."""

    layout: str = "paper"
    modifiers: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        return "+".join([self.layout, *(name for name in MODIFIERS if name in self.modifiers)])

    def frames(self, sequence: Sequence) -> tuple[Frame, ...]:
        """The frames in file order."""
        order: list[int] = []
        for kind, direction in LAYOUTS[self.layout]:
            indices = list(
                sequence.sinusoids(direction) if kind == "sinusoid" else sequence.gray(direction)
            )
            if kind == "sinusoid" and BACKWARD_STEPS in self.modifiers:
                indices[1:] = indices[:0:-1]
            if kind == "gray" and LEAST_BIT_FIRST in self.modifiers:
                indices.reverse()
            order += indices
        ends = [frame.index for frame in sequence if frame.direction is None]
        order += reversed(ends) if WHITE_FIRST in self.modifiers else ends
        return tuple(sequence.frames[i] for i in order)


def parse_order(name: str) -> FrameOrder | None:
    """The order called ``name``, e.g. ``paper`` or ``vertical-first+white-first``; None for
    ``auto``. Raises `LayoutError` for an unknown name."""
    if name == AUTO:
        return None
    layout, *modifiers = name.split("+")
    if layout not in LAYOUTS or not set(modifiers) <= set(MODIFIERS):
        raise LayoutError(
            f"frame order {name!r}: expected {AUTO}, or one of {', '.join(LAYOUTS)}, followed by "
            f"any of " + ", ".join(f"+{modifier}" for modifier in MODIFIERS)
        )
    return FrameOrder(layout, frozenset(modifiers))


def all_orders() -> Iterator[FrameOrder]:
    """All named orders, the paper's first."""
    for *used, layout in product((False, True), (False, True), (False, True), LAYOUTS):
        yield FrameOrder(layout, frozenset(compress(MODIFIERS, used)))


def find_order(files: list[NDArray[np.uint8]], rig: Rig) -> FrameOrder | None:
    """The named order that the images of a raw scan fit, or None."""
    scan = _Scan(files, rig)
    return next((order for order in all_orders() if not _misfits(scan, order)), None)


def check_order(files: list[NDArray[np.uint8]], order: FrameOrder, rig: Rig) -> list[str]:
    """Contradictions between ``order`` and the images of a raw scan, uint8 (H, W) in file order;
    empty if they fit."""
    return _misfits(_Scan(files, rig), order)


class _Scan:
    """A raw scan on some image rows and columns: ``lines``, float32, of the pixels that the
    projector reaches by the darkest and the brightest image; the least share of these along x and
    along y, ``lit_share``; and which of them have their successor as neighbour along x and along y,
    ``pairs``."""

    def __init__(self, files: list[NDArray[np.uint8]], rig: Rig) -> None:
        places = [
            np.unique(np.linspace(0, side - 1, _LINES).astype(int)) for side in files[0].shape
        ]
        lines = lines_at(files, rig, *places)
        self.mean = np.array([float(image.mean(dtype=np.float64)) for image in files])
        self.darkest, self.brightest = int(self.mean.argmin()), int(self.mean.argmax())
        lit = lines.levels[self.brightest] >= lines.levels[self.darkest] + _LEAST_CONTRAST
        self.lit_share = min(float(lit[lines.across == across].mean()) for across in (True, False))
        self.lines = replace(lines, levels=lines.levels.astype(np.float32)).at(np.flatnonzero(lit))
        self.pairs = [
            (self.lines.joined & (self.lines.across == across))[:-1] for across in (True, False)
        ]
        self.line_counts = [len(place) for place in places]

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """Share of each image's pixels in the middle half between black and white; (F,)."""
        grey = self.lines.levels
        share = (grey - grey[self.darkest]) / (grey[self.brightest] - grey[self.darkest])
        return ((share > _MIDDLE[0]) & (share < _MIDDLE[1])).mean(axis=1)


def _misfits(scan: _Scan, order: FrameOrder) -> list[str]:
    """Contradictions between the files and ``order``. Cheap checks come first; the others run only
    if those pass."""
    sequence = scan.lines.rig.paper_sequence
    frames = order.frames(sequence)
    file_of_frame = {frame.index: number for number, frame in enumerate(frames)}
    black, white = (file_of_frame[frame.index] for frame in sequence if frame.direction is None)
    darkest, brightest = scan.darkest, scan.brightest
    # A code with more bits than its cells need has a first frame that is black all over, too.
    if (
        max(scan.mean[black] - scan.mean[darkest], scan.mean[brightest] - scan.mean[white])
        > _SAME_MEAN
    ):
        return [
            f"A_{darkest}.png is the darkest and A_{brightest}.png the brightest image; expected "
            f"black in "
            f"A_{black}.png and white in A_{white}.png"
        ]
    if scan.lit_share < _LEAST_LIT:
        return [
            f"A_{white}.png is hardly brighter than A_{black}.png: too little contrast to check an "
            f"order"
        ]
    problems = []
    for number, frame in enumerate(frames):
        if frame.kind == "gray" and scan.middle[number] > _MOST_MIDDLE_OF_GRAY:
            problems.append(
                f"A_{number}.png: expected a Gray code frame with two grey levels, got many levels "
                f"between"
            )
        if frame.kind == "sinusoid" and scan.middle[number] < _LEAST_MIDDLE_OF_SINUSOID:
            problems.append(f"A_{number}.png: expected a sinusoid, got an image of two grey levels")
    if not problems:
        for direction in DIRECTIONS:
            expected = _expected_gradient(direction, scan.lines.rig)
            sinusoids, codes = sequence.sinusoids(direction), sequence.gray(direction)
            problems += _sinusoids(scan, [file_of_frame[i] for i in sinusoids], direction, expected)
            problems += _codes(
                scan, [file_of_frame[i] for i in codes], direction, int(np.abs(expected).argmax())
            )
    return problems


def _expected_gradient(direction: Direction, rig: Rig) -> NDArray[np.float64]:
    """Change of the projector coordinate (px) over half an image pixel in x and in y, on the
    background plane; (2,)."""
    camera = rig.camera
    rays = camera.normalised(
        camera.width / 2 - np.array([0.5, 0, 0.5]), camera.height / 2 - np.array([0.5, 0.5, 0])
    )
    coordinate_px = rig.seen(rays, rig.background)[AXES.index(direction)]
    return coordinate_px[1:] - coordinate_px[0]


def _sinusoids(
    scan: _Scan, numbers: list[int], direction: Direction, expected: NDArray[np.float64]
) -> list[str]:
    steps = len(numbers)
    shifts = 2 * np.pi * np.arange(steps) / steps
    levels = scan.lines.levels[numbers]
    mean, cosine, sine = weighted_sums(levels, phase_weights(shifts))
    wave = cosine - 1j * sine
    turn = np.angle(wave[1:] * wave[:-1].conj())
    gradients = [float(np.median(turn[pairs])) for pairs in scan.pairs]
    # I_n - A = C cos(delta_n) + S sin(delta_n), solved for delta_n over all pixels.
    solved = np.linalg.lstsq(np.stack([cosine, sine], axis=1), (levels - mean).T, rcond=None)[0]
    foreign = np.flatnonzero(np.hypot(*solved) < _LEAST_SHARE)
    if foreign.size:
        # A foreign image disturbs the phase of all others a little, so only the foreign images are
        # reported.
        return [
            f"A_{numbers[n]}.png: expected {direction} sinusoid step {n}, got an image of other "
            f"fringes"
            for n in foreign
        ]
    measured_shifts = np.arctan2(solved[1], solved[0])
    errors = np.angle(np.exp(1j * (measured_shifts - shifts)))
    problems = [
        f"A_{numbers[n]}.png: expected {direction} sinusoid step {n}, phase shift "
        f"{np.degrees(shifts[n]):.0f} degrees; "
        f"the image has {np.degrees(measured_shifts[n]) % 360:.0f}"
        for n in np.flatnonzero(np.abs(errors) > np.pi / steps / 2)
    ]
    axis = int(np.abs(expected).argmax())
    files = f"A_{min(numbers)}.png to A_{max(numbers)}.png"
    if np.abs(gradients).argmax() != axis:
        problems.append(
            f"{files}: expected {direction} fringes, varying along image {'xy'[axis]}; these files "
            f"do not"
        )
    elif np.sign(gradients[axis]) != np.sign(expected[axis]):
        problems.append(f"{files}: the {direction} sinusoids' phase shifts run backwards")
    return problems


def _codes(scan: _Scan, numbers: list[int], direction: Direction, axis: int) -> list[str]:
    levels, grey = scan.lines.levels, scan.lines.levels[numbers]
    code = grey > (levels[scan.darkest] + levels[scan.brightest]) / 2
    # Changes of each bit per image line: (bits,) along x and along y.
    changes = np.diff(code)
    edges = [
        changes[:, pairs].sum(axis=1) / count
        for pairs, count in zip(scan.pairs, scan.line_counts, strict=True)
    ]
    along, across = edges[axis], edges[1 - axis]
    own = scan.lines.across == (axis == 0)
    grey, code, pairs = grey[:, own], code[:, own], scan.lines.joined[own][:-1]
    problems = [
        f"A_{numbers[i]}.png: expected {direction} Gray bit {i}, varying along image {'xy'[axis]}; "
        f"it does not"
        for i in np.flatnonzero((across > along) & (across > _LEAST_EDGES_A_LINE))
    ]
    exchanges = list(combinations(range(len(numbers)), 2))
    problems += [
        f"A_{numbers[i]}.png and A_{numbers[j]}.png: the same image, expected two Gray bits"
        for i, j in exchanges
        if along[i] > _LEAST_EDGES_A_LINE and np.array_equal(grey[i], grey[j])
    ]
    if problems:
        return problems
    straight = np.arange(len(numbers))
    values = 1 << straight[::-1]

    def jumps(order: NDArray[np.intp]) -> int:
        """How irregular the code is along the lines, with its bits in ``order``."""
        cells = gray_to_binary(np.tensordot(values, code[order], 1))
        return int(np.abs(np.diff(cells))[pairs].sum())

    as_is = jumps(straight)
    return [
        f"A_{numbers[i]}.png and A_{numbers[j]}.png: expected {direction} Gray bits {i} and {j}, "
        f"most significant "
        "first; the code is more regular with the two exchanged"
        for i, j in exchanges
        if jumps(np.where(straight == i, j, np.where(straight == j, i, straight))) < as_is
    ]
