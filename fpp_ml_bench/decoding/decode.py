"""The classical decoder: a stack of frames to depth, with a reason for every pixel without depth.

Wrapped phase by N steps, fringe order from the half-period Gray code, triangulation from one or
both projector coordinates (paper Section 2.1). Frames are read once, in blocks; nothing is
filtered, interpolated or guessed: a pixel that can't be decoded has depth 0 and a reason.

What can't be decoded is refused: frames, masks and limits that don't fit, and sinusoids whose
capture failed. A failed frame would cause a phase error of up to (2/N) (A + B) / B. Means over any
set of pixels follow ``A + C cos delta_n + S sin delta_n`` as each pixel does; with seven or more
steps, redundant equations tell a frame that contradicts the others from a scene that violates the
model. With four to six steps only a black frame can be detected.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding.code import Coordinates, Limits, Reason
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding import blocks
from fpp_ml_bench.decoding.blocks import CodePlan
from fpp_ml_bench.decoding.fewest import (
    JointCode,
    decode_wrapped,
    fewest_plans,
    nearest_pair,
    with_order,
)
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics.pinhole import Maps
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import DIRECTIONS, Direction
from fpp_ml_bench.skipping import skipping_enabled

SAMPLED_PX = 4096
"""Pixels, at most, on which the frames are tested: enough for means of many periods, and a small
part of the decoding time."""
LEAST_PX = 64
"""With fewer pixels the mean depends more on the scene than on the frame."""
LEAST_OFF_GREY = 16.0
"""Deviation of a frame's mean in grey levels, from the one that the others predict, below which no
frame is wrong: on dark captures a share alone would be a few levels."""
LEAST_OFF_SHARE = 0.3
"""The same limit as a share: a frame is wrong when its mean deviates by more than both, since no
lamp flickers by 30%."""
AGREEMENT_GREY = 3.0
"""Largest residual of the other frames' means. Above it, the scene does not follow the model (a
strong gamma on a few pixels), and no frame is reported."""
LEAST_STEPS_FOR_MEANS = 7
"""Steps from which on means are tested. With fewer, too few other frames tell which one is wrong,
and only a black frame is looked for."""
OPPOSITE_SPAN_GREY = 40
"""A correct frame is black only where all phases are within 0.2 rad of its minimum; the frame half
a period later then spans at most a fifth of the modulation."""
BLOCK_PX = 1 << 15
"""Pixels in a block: its grey levels, 0.8 MB per direction, and its results stay in the processor's
cache."""
MOST_PICKED_SHARE = 0.6
"""Up to this share of a block, the pixels that need the second direction are read by index. Above
it, reading the whole block in order is faster."""
SAMPLING = 32
"""Every 32nd pixel of a block is tested to see whether reading by index can be faster."""
Directions = Literal["horizontal", "vertical", "both"]


def check_limits(limits: Limits) -> None:
    """Raise `DecodeError` for a limit that is no limit."""
    for name in ("min_modulation", "max_disagreement_px", "ambiguous_fraction"):
        value = getattr(limits, name)
        if not (np.isfinite(value) and value > 0):
            raise DecodeError(f"{name}: expected a positive finite number, got {value!r}")
    if limits.max_clipped_steps is not None and limits.max_clipped_steps < 0:
        raise DecodeError(
            f"max_clipped_steps: expected 0 or more, got {limits.max_clipped_steps!r}"
        )


def grey_levels(image: NDArray) -> NDArray:
    """An image as an array; int64, which ``datasets`` makes of uint8 ``with_format("numpy")``, as
    uint8 again where no value changes. Not uint16: a dark image of a deeper camera has small
    values, too."""
    levels = np.asarray(image)
    if (
        levels.dtype == np.int64
        and levels.size
        and 0 <= levels.min() <= levels.max() <= GREY_LEVELS
    ):
        return levels.astype(np.uint8)
    return levels


def flat_frames(
    frames: Sequence[NDArray | None] | NDArray, used: tuple[int, ...], rig: Rig
) -> dict[int, NDArray]:
    """The frames at the indices ``used``, checked and flattened to uint8 or float32 (H * W,), all
    of one dtype."""
    expected = (rig.camera.height, rig.camera.width)
    if len(frames) != len(rig.sequence):
        raise DecodeError(
            f"expected the {len(rig.sequence)} frames of the rig's sequence, got {len(frames)}; "
            "put None in the place of a frame that was not captured"
        )
    flat: dict[int, NDArray] = {}
    for index in used:
        frame, title = frames[index], f"frame {rig.sequence.frames[index].title}"
        if frame is None:
            raise DecodeError(
                f"{title}: expected an image, got None; this decoding needs the frame, capture it"
            )
        image = grey_levels(frame)
        if image.dtype not in (np.uint8, np.float32):
            raise DecodeError(
                f"{title}: expected uint8 grey levels, or float32 of 0 to 255 for deeper images, "
                f"got {image.dtype}"
            )
        if flat and image.dtype != next(iter(flat.values())).dtype:
            raise DecodeError(f"{title}: expected the dtype of the other frames, got {image.dtype}")
        if image.dtype == np.float32 and not (
            np.isfinite(image).all() and image.min() >= 0 and image.max() <= GREY_LEVELS
        ):
            raise DecodeError(
                f"{title}: expected float32 grey levels of 0 to 255; scale them by 255 / full scale"
            )
        if image.shape != expected:
            raise DecodeError(
                f"{title}: expected shape (H, W) = {expected} of the rig's camera, got "
                f"{image.shape}; "
                "use rig.scaled(width) for a resized image"
            )
        flat[index] = image.reshape(-1)
    return flat


def mask_indices(mask: NDArray | None, shape: tuple[int, int]) -> NDArray[np.intp] | None:
    """Flat indices of the pixels in ``mask``; None without a mask."""
    if mask is None:
        return None
    if np.asarray(mask).dtype != np.bool_ or np.shape(mask) != shape:
        raise DecodeError(
            f"mask: expected bool {shape}, got {np.asarray(mask).dtype} {np.shape(mask)}"
        )
    return np.flatnonzero(mask)


def check_frames(
    flat: Mapping[int, NDArray], plan: CodePlan, indices: NDArray | None, rig: Rig
) -> None:
    """Raise `DecodeError`, naming the frame, where a sinusoid of ``plan`` contradicts the others.
    ``flat`` frames by index, uint8 (pixels,); at most `SAMPLED_PX` of the pixels at ``indices``
    (None: all) are tested."""
    pixel_count = len(flat[plan.sinusoids[0]]) if indices is None else len(indices)
    if pixel_count < LEAST_PX or len(plan.sinusoids) < 4:
        return
    step = -(-pixel_count // SAMPLED_PX)
    sampled = slice(None, None, step) if indices is None else indices[::step]
    levels = [flat[index][sampled] for index in plan.sinusoids]
    if len(levels) >= LEAST_STEPS_FOR_MEANS:
        steps = [rig.sequence.frames[index].step for index in plan.sinusoids]
        shifts = 2 * np.pi * np.array(steps) / rig.sequence.steps
        model = np.stack([np.ones(len(shifts)), np.cos(shifts), np.sin(shifts)], axis=1)
        wrong = _contradicting_mean(
            np.array([level.mean() for level in levels]), model, plan.weights
        )
    else:
        wrong = _black_frame(levels)
    if wrong is not None:
        title = rig.sequence.frames[plan.sinusoids[wrong[0]]].title
        raise DecodeError(
            f"frame {title}: {wrong[1]}: its capture failed (dead, dimmed or flashed frame); take "
            f"it again, or decode "
            "with steps that leave it out"
        )


def _contradicting_mean(means: NDArray, model: NDArray, weights: NDArray) -> tuple[int, str] | None:
    """Position of the frame whose mean contradicts the others, and what is wrong with it."""
    fitted = model @ (weights @ means)
    influence = np.einsum("ij,ji->i", model, weights)
    deviations = np.abs(means - fitted) / (
        1 - influence
    )  # from the prediction of the other frames alone
    for position in np.flatnonzero(deviations > LEAST_OFF_GREY):
        others = np.arange(len(means)) != position
        fit = np.linalg.lstsq(model[others], means[others], rcond=None)[0]
        expected = float(model[position] @ fit)
        agree = np.abs(model[others] @ fit - means[others]).max() <= AGREEMENT_GREY
        if agree and deviations[position] > LEAST_OFF_SHARE * max(expected, 0.0):
            fault = (
                f"its mean grey level is {means[position]:.0f}, and by the other steps it should "
                f"be {expected:.0f}"
            )
            return int(position), fault
    return None


def _black_frame(levels: list[NDArray[np.uint8]]) -> tuple[int, str] | None:
    """Position of the frame that is black at every pixel while the frame half a period later
    varies, and the fault."""
    for position, level in enumerate(levels):
        opposite = levels[(position + len(levels) // 2) % len(levels)]
        if not level.any() and np.ptp(opposite) >= OPPOSITE_SPAN_GREY:
            return position, "it is black all over while the other steps vary"
    return None


@dataclass(frozen=True)
class Measured:
    """The image's measurement in one direction, (H, W) each: ``coordinate_px`` float64 (NaN = not
    decoded), ``modulation`` float32 grey levels and ``phase`` float64 rad in [-pi, pi)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float32]
    phase: NDArray[np.float64]


@dataclass(frozen=True)
class Decoded:
    """``depth_mm`` float32 (H, W), 0 = none; ``reason`` uint8 (H, W), a `Reason` code each;
    ``counts`` pixels per reason (lower-case names, all present); ``frames_used`` indices into the
    sequence; ``details`` by direction, empty unless asked for; ``second_px`` pixels at which the
    second direction's frames were read."""

    depth_mm: NDArray[np.float32]
    reason: NDArray[np.uint8]
    counts: dict[str, int]
    frames_used: tuple[int, ...]
    details: dict[Direction, Measured] = field(default_factory=dict)
    second_px: int = 0


@dataclass
class _Block:
    """Some of the image's pixels, a slice of the flat image or flat indices, and what was measured
    there so far."""

    pixels: slice | NDArray[np.intp]
    measured: dict[Direction, Coordinates] = field(default_factory=dict)

    def __len__(self) -> int:
        return (
            self.pixels.stop - self.pixels.start
            if isinstance(self.pixels, slice)
            else len(self.pixels)
        )

    def keep(self, selected: NDArray[np.intp]) -> None:
        """Reduce the block to its pixels at ``selected``."""
        pixels = self.pixels
        self.pixels = selected + pixels.start if isinstance(pixels, slice) else pixels[selected]
        self.measured = {
            direction: measured.at(selected) for direction, measured in self.measured.items()
        }


@dataclass
class _Image:
    """What is decoded and how, and the results, filled block by block; no pixel belongs to two
    blocks. ``pixels`` flat indices of those to decode (None: all). ``depth_alone``: whether the
    second direction may be left out where the first shows that there is no depth."""

    frames: dict[int, NDArray[np.uint8]]
    rig: Rig
    plans: list[CodePlan]
    limits: Limits
    joint: JointCode | None
    pixels: NDArray[np.intp] | None
    depth_alone: bool
    details: dict[Direction, Measured]

    def __post_init__(self) -> None:
        size = self.rig.camera.height * self.rig.camera.width
        self.pixel_count = size if self.pixels is None else len(self.pixels)
        self.depth_mm = np.zeros(size, dtype=np.float32)
        self.reason = np.full(size, Reason.NOT_ASKED, dtype=np.uint8)
        self.rays = tuple(axis.reshape(-1) for axis in self.rig.camera.rays())

    def decode_from(self, start: int) -> int:
        """Decode a block; returns the number of its pixels that were read in every direction."""
        stop = min(start + BLOCK_PX, self.pixel_count)
        block = _Block(slice(start, stop) if self.pixels is None else self.pixels[start:stop])
        self._measure(block, self.plans[0])
        if self.depth_alone:
            self._keep_within_reach(block)
        count = len(block)
        for plan in self.plans[1:]:
            self._measure(block, plan)
        if self.joint:
            self._find_orders(block, self.joint)
        pixels, measured = block.pixels, block.measured
        results = blocks.depth_and_reason(measured, self._rays(block), self.rig, self.limits)
        self.depth_mm[pixels], self.reason[pixels] = results
        for direction, details in self.details.items():
            coordinates = measured[direction]
            details.coordinate_px.reshape(-1)[pixels] = np.where(
                coordinates.reason == 0, coordinates.coordinate_px, np.nan
            )
            details.modulation.reshape(-1)[pixels], details.phase.reshape(-1)[pixels] = (
                coordinates.modulation,
                coordinates.phase,
            )
        return count

    def _rays(self, block: _Block) -> Maps:
        return self.rays[0][block.pixels], self.rays[1][block.pixels]

    def _measure(self, block: _Block, plan: CodePlan) -> None:
        """Measure a direction at the block's pixels; gathers the grey levels of its frames
        first."""
        levels = np.empty(
            (len(plan.rows), len(block)), dtype=next(iter(self.frames.values())).dtype
        )
        for row, index in zip(levels, plan.rows, strict=True):
            if index in plan.constant_levels:
                row[:] = plan.constant_levels[index]
            elif isinstance(block.pixels, slice):
                row[:] = self.frames[index][block.pixels]
            else:
                # All indices lie in the image; mode "clip" only saves the bounds check and a copy.
                self.frames[index].take(block.pixels, out=row, mode="clip")
        if self.joint:
            block.measured[plan.direction] = decode_wrapped(levels, plan, self.limits)
        else:
            block.measured[plan.direction] = plan.decode(levels, self.limits)

    def _keep_within_reach(self, block: _Block) -> None:
        """Reduce the block to the pixels that can still get a depth after the first direction, if
        they are few. A sample of the block is tested first: where the object fills the block,
        skipping costs no more than that test."""
        ((direction, first),) = block.measured.items()
        values = first.coordinate_px, *self._rays(block)
        for part in (slice(None, None, SAMPLING), slice(None)):
            coordinate, x, y = (np.ascontiguousarray(value[part]) for value in values)
            reached = blocks.within_reach(coordinate, (x, y), direction, self.rig, self.limits)
            selected = np.flatnonzero(reached & (first.reason[part] == 0))
            if len(selected) > MOST_PICKED_SHARE * len(reached):
                return
        self.reason[block.pixels] = np.where(first.reason == 0, Reason.OUTSIDE_RANGE, first.reason)
        block.keep(selected)

    def _find_orders(self, block: _Block, joint: JointCode) -> None:
        """The fringe orders that both phases give together; reduces the block to the pixels that
        have orders."""
        orders, distance_px = nearest_pair(block.measured, self._rays(block), self.rig, joint)
        # NOT_ASKED, the highest code, marks pixels without a reason here.
        lowest = np.minimum(
            *(np.where(m.reason == 0, Reason.NOT_ASKED, m.reason) for m in block.measured.values())
        )
        unclear = (lowest == Reason.NOT_ASKED) & ~(distance_px <= joint.tolerance_px)
        reason = np.where(unclear, Reason.DIRECTIONS_DISAGREE, lowest)
        selected = np.flatnonzero(reason == Reason.NOT_ASKED)
        if len(selected) <= MOST_PICKED_SHARE * len(reason) and not self.details:
            self.reason[block.pixels] = reason
            block.keep(selected)
            orders = {direction: order[selected] for direction, order in orders.items()}
        else:
            for measured in block.measured.values():
                measured.reason[unclear] = Reason.DIRECTIONS_DISAGREE
        for direction, order in orders.items():
            block.measured[direction] = with_order(
                block.measured[direction], order, self.rig, direction
            )


def decode_stack(
    frames: Sequence[NDArray | None] | NDArray,
    rig: Rig,
    direction: Directions = "both",
    steps: int | None = None,
    mask: NDArray[np.bool_] | None = None,
    limits: Limits | None = None,
    details: bool = False,
    threads: int = 1,
    reasons: bool = True,
    fewest: bool = False,
) -> Decoded:
    """Depth in mm from a captured sequence.

    ``frames``: all frames of ``rig.sequence`` in order, uint8, or float32 of 0 to 255 for deeper
    images, (H, W) each: a list of views or an array (F, H, W); a frame that is not needed may be
    None. Behind sinusoids black and white never
    are: the Gray code's threshold is the sinusoids' mean. ``direction``: "vertical" fringes measure
    the projector's u and "horizontal" its v, each enough for a depth; "both", all that the rig
    codes, needs them at every pixel, weighs them by 1 / sigma^2, and rejects pixels at which the
    two coordinates disagree by more than ``limits.max_disagreement_px`` across the epipolar line.
    ``steps``: how many of each direction's N sinusoids to use, 3 to N (default: all), spread as
    evenly as possible; with the paper's kind of code only. Where they can't be even (N is not a
    multiple), the phase is the least-squares solution. ``mask`` bool (H, W): pixels to decode; all
    others get `Reason.NOT_ASKED` and have no influence. The result is the same bit by bit for any
    number of ``threads``, and inside the mask the same as without a mask. ``details``: also return
    coordinates, modulation and wrapped phase. ``reasons`` False: a pixel that the first direction
    shows to lie outside the working range (`decoding.blocks`), or to have no coordinate, is not
    read in the second direction. The depth is the same bit by bit; the reason is the first
    direction's, or OUTSIDE_RANGE.
    ``fewest``: read only the Gray frames that the rig's working range needs (`decoding.fewest`).
    With "both" usually none is needed, and the fringe orders come from the two phases together. A
    depth in range is the same bit by bit, except at pixels whose directions disagree by nearly the
    allowed distance (`JointCode.tolerance_px`).

    Depths outside ``rig.working_range_mm`` become 0 with the reason OUTSIDE_RANGE; this also
    removes the background plane. Raises `DecodeError` for frames, steps, mask or limits that don't
    fit, and for a sinusoid whose capture failed (`check_frames`)."""
    if direction != "both" and direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal, vertical or both, got {direction!r}")
    if isinstance(threads, bool) or not isinstance(threads, int) or threads < 1:
        raise DecodeError(f"threads: expected a whole number from 1, got {threads!r}")
    check_limits(limits := limits or Limits())
    directions: tuple[Direction, ...] = rig.directions if direction == "both" else (direction,)
    if not directions:
        raise DecodeError(
            "crossed fringes alone can't be decoded pixel by pixel; project the horizontal or "
            "vertical code too, or "
            "use a method for crossed fringes"
        )
    if len(directions) == 2:
        # A code in cells misses the epipolar line by up to its own step.
        step_px = math.hypot(*(rig.code(name).step_px for name in directions))
        limits = replace(limits, max_disagreement_px=limits.max_disagreement_px + step_px)
    plans, joint = [blocks.plan_direction(rig, name, steps) for name in directions], None
    if fewest:
        plans, joint = fewest_plans(rig, plans)
    used = tuple(sorted(index for plan in plans for index in plan.frames))
    flat, shape = flat_frames(frames, used, rig), (rig.camera.height, rig.camera.width)
    pixels = mask_indices(mask, shape)
    for plan in plans:
        if plan.sinusoids:
            check_frames(flat, plan, pixels, rig)
    # With a mask of most of the image, decoding whole blocks and clearing the rest is faster than
    # reading by index.
    dense = (
        pixels is not None and not details and len(pixels) > MOST_PICKED_SHARE * shape[0] * shape[1]
    )
    dense = dense and skipping_enabled()
    depth_alone = (
        len(plans) == 2 and joint is None and not (reasons or details or rig.projector.is_distorted)
    )
    depth_alone = depth_alone and skipping_enabled()
    measured = {
        name: Measured(
            np.full(shape, np.nan), np.full(shape, np.nan, dtype=np.float32), np.full(shape, np.nan)
        )
        for name in (directions if details else ())
    }
    image = _Image(
        flat, rig, plans, limits, joint, None if dense else pixels, depth_alone, measured
    )
    starts = range(0, image.pixel_count, BLOCK_PX)
    if threads == 1 or len(starts) < 2:
        second_px = sum(map(image.decode_from, starts))
    else:
        with ThreadPoolExecutor(threads) as pool:
            second_px = sum(pool.map(image.decode_from, starts))
    if dense:
        outside = ~np.asarray(mask).reshape(-1)
        image.depth_mm[outside], image.reason[outside] = 0.0, Reason.NOT_ASKED
    counts = np.bincount(image.reason, minlength=len(Reason))
    by_reason = {reason.name.lower(): int(counts[reason]) for reason in Reason}
    depth_mm, reason = image.depth_mm.reshape(shape), image.reason.reshape(shape)
    return Decoded(depth_mm, reason, by_reason, used, measured, second_px if len(plans) == 2 else 0)
