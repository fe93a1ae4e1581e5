"""The classical decoder: a stack of frames to depth, with a reason for every pixel without depth.

Wrapped phase by N steps, fringe order from the half-period Gray code, triangulation from one or both projector
coordinates (paper Section 2.1). Frames are read once, in blocks; nothing is filtered, interpolated or guessed: a pixel
that can't be decoded has depth 0 and a reason.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decoding.blocks import (
    Coordinates,
    DirectionPlan,
    Limits,
    Reason,
    decode_direction,
    depth_and_reason,
    plan_direction,
    reach_is_bounded,
    within_reach,
)
from fpp_ml_bench.decoding.checks import check_frames
from fpp_ml_bench.decoding.fewest import JointCode, decode_wrapped, fewest_plans, nearest_pair, with_order
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import DIRECTIONS, Direction, Rig
from fpp_ml_bench.skipping import skipping_enabled

BLOCK_PX = 1 << 15
"""Pixels in a block: its grey levels, 0.8 MB per direction, and its results stay in the processor's cache."""
MOST_PICKED_SHARE = 0.6
"""Up to this share of a block, the pixels that need the second direction are read by index. Above it, reading the whole
block in order is faster."""
SAMPLING = 32
"""Every 32nd pixel of a block is tested to see whether reading by index can be faster."""
Pixels = slice | NDArray[np.intp]
"""Pixels of a block: a slice of the flat image, or flat indices."""


@dataclass(frozen=True)
class Measured:
    """The image's measurement in one direction, (H, W) each: ``coordinate_px`` float64 (NaN = not decoded),
    ``modulation`` float32 grey levels and ``phase`` float64 rad in [-pi, pi)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float32]
    phase: NDArray[np.float64]


class DecodedImage:
    """Results of the whole image as flat arrays, filled block by block; no pixel belongs to two blocks."""

    def __init__(
        self,
        frames: dict[int, NDArray],
        rig: Rig,
        plans: list[DirectionPlan],
        limits: Limits,
        mask_indices: NDArray[np.intp] | None,
        details: bool,
        depth_alone: bool,
        joint: JointCode | None,
    ) -> None:
        size = rig.camera.height * rig.camera.width
        self.frames, self.rig, self.plans, self.limits, self.mask_indices = frames, rig, plans, limits, mask_indices
        self.depth_alone, self.joint = depth_alone, joint
        self.pixel_count = size if mask_indices is None else len(mask_indices)
        self.depth_mm = np.zeros(size, dtype=np.float32)
        self.reason = np.full(size, Reason.NOT_ASKED, dtype=np.uint8)
        self.rays = tuple(axis.reshape(-1) for axis in rig.camera.rays())
        self.details: dict[Direction, Coordinates] = {}
        if details:
            for plan in plans:
                u, b, phi = (np.full(size, np.nan) for _ in range(3))
                self.details[plan.direction] = Coordinates(u, b, phi, reason=np.zeros(size, dtype=np.uint8))

    def decode_from(self, start: int) -> int:
        """Decode a block; returns the number of its pixels that were read in every direction."""
        stop = min(start + BLOCK_PX, self.pixel_count)
        pixels = slice(start, stop) if self.mask_indices is None else self.mask_indices[start:stop]
        first_direction = self.plans[0].direction
        coordinates = {first_direction: self._coordinates(self.plans[0], pixels, stop - start)}
        if self.depth_alone:
            first = coordinates[first_direction]
            selected = self._within_reach(first, pixels)
            if selected is not None:
                no_depth = np.where(first.reason == 0, Reason.OUTSIDE_RANGE, first.reason)
                pixels, coordinates = self._reduced(start, pixels, coordinates, selected, no_depth)
        count = len(coordinates[first_direction].reason)
        for plan in self.plans[1:]:
            coordinates[plan.direction] = self._coordinates(plan, pixels, count)
        if self.joint:
            pixels, coordinates = self._with_orders(start, pixels, coordinates, self.joint)
        rays = self.rays[0][pixels], self.rays[1][pixels]
        self.depth_mm[pixels], self.reason[pixels] = depth_and_reason(
            coordinates, rays, self.plans, self.rig, self.limits
        )
        for direction, details in self.details.items():
            measured = coordinates[direction]
            details.coordinate_px[pixels] = np.where(measured.reason == 0, measured.coordinate_px, np.nan)
            details.modulation[pixels], details.phase[pixels] = measured.modulation, measured.phase
        return count

    def _with_orders(
        self, start: int, pixels: Pixels, coordinates: dict[Direction, Coordinates], joint: JointCode
    ) -> tuple[Pixels, dict[Direction, Coordinates]]:
        """The block with the fringe orders that both phases give together, reduced to the pixels that have orders."""
        rays = self.rays[0][pixels], self.rays[1][pixels]
        orders, distance_px = nearest_pair(coordinates, rays, self.rig, joint.tolerance_px)
        # NOT_ASKED, the highest code, marks pixels without a reason here.
        reasons = (np.where(c.reason == 0, Reason.NOT_ASKED, c.reason) for c in coordinates.values())
        lowest = np.minimum(*reasons)
        unclear = (lowest == Reason.NOT_ASKED) & ~(distance_px <= joint.tolerance_px)
        reason = np.where(unclear, Reason.DIRECTIONS_DISAGREE, lowest)
        selected = None if self.details else self._indices_if_few(reason == Reason.NOT_ASKED)
        if selected is not None:
            pixels, coordinates = self._reduced(start, pixels, coordinates, selected, reason)
            orders = {direction: order[selected] for direction, order in orders.items()}
        else:
            for measured in coordinates.values():
                measured.reason[unclear] = Reason.DIRECTIONS_DISAGREE
        return pixels, {
            direction: with_order(measured, orders[direction], self.rig, direction)
            for direction, measured in coordinates.items()
        }

    def _within_reach(self, first: Coordinates, pixels: Pixels) -> NDArray[np.intp] | None:
        """Indices into the block of the pixels that can still get a depth after the first direction, if they are few.

        A sample of the block is tested first: where the object fills the block, skipping costs no more than that test.
        """
        rays = self.rays[0][pixels], self.rays[1][pixels]

        def undecided(part: slice) -> NDArray[np.bool_]:
            coordinate, x, y = (np.ascontiguousarray(values[part]) for values in (first.coordinate_px, *rays))
            reached = within_reach(coordinate, (x, y), self.plans[0], self.rig, self.limits)
            return reached & (first.reason[part] == 0)

        if self._indices_if_few(undecided(slice(None, None, SAMPLING))) is None:
            return None
        return self._indices_if_few(undecided(slice(None)))

    @staticmethod
    def _indices_if_few(mask: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        """Indices of the True entries of ``mask`` (n,), if they are few enough to be picked out."""
        indices = np.flatnonzero(mask)
        return indices if len(indices) <= MOST_PICKED_SHARE * len(mask) else None

    def _reduced(
        self,
        start: int,
        pixels: Pixels,
        coordinates: dict[Direction, Coordinates],
        selected: NDArray[np.intp],
        reason: NDArray[np.uint8],
    ) -> tuple[Pixels, dict[Direction, Coordinates]]:
        """The block with only the ``selected`` pixels; ``reason`` (n,) of the block is stored for all others."""
        self.reason[pixels] = reason
        remaining = selected + start if isinstance(pixels, slice) else pixels[selected]
        return remaining, {direction: measured.at(selected) for direction, measured in coordinates.items()}

    def _coordinates(self, plan: DirectionPlan, pixels: Pixels, count: int) -> Coordinates:
        """Coordinates of a direction at ``count`` pixels; gathers the grey levels of its frames first."""
        levels = np.empty((len(plan.rows), count), dtype=np.uint8)
        for row, index in zip(levels, plan.rows, strict=True):
            if index in plan.constant_levels:
                row[:] = plan.constant_levels[index]
            elif isinstance(pixels, slice):
                row[:] = self.frames[index][pixels]
            else:
                # All indices lie in the image; mode "clip" only saves the bounds check and a copy.
                self.frames[index].take(pixels, out=row, mode="clip")
        decode = decode_wrapped if self.joint else decode_direction
        return decode(levels, plan, self.limits)

    def clear_outside(self, mask: NDArray[np.bool_]) -> None:
        """Remove the results outside ``mask`` bool (H * W,)."""
        self.depth_mm[~mask], self.reason[~mask] = 0.0, Reason.NOT_ASKED

    def measured(self, direction: Direction, shape: tuple[int, int]) -> Measured:
        """Details of ``direction`` as images of ``shape`` (H, W)."""
        details = self.details[direction]
        return Measured(
            details.coordinate_px.reshape(shape),
            details.modulation.astype(np.float32).reshape(shape),
            details.phase.reshape(shape),
        )


Directions = Literal["horizontal", "vertical", "both"]


@dataclass(frozen=True)
class Decoded:
    """``depth_mm`` float32 (H, W), 0 = none; ``reason`` uint8 (H, W), a `Reason` code each; ``counts`` pixels per
    reason (lower-case names, all present); ``frames_used`` indices into the sequence; ``details`` by direction, empty
    unless `decode_stack` was called with ``details``."""

    depth_mm: NDArray[np.float32]
    reason: NDArray[np.uint8]
    counts: dict[str, int]
    frames_used: tuple[int, ...]
    details: dict[Direction, Measured] = field(default_factory=dict)
    second_px: int = 0
    """Pixels at which the second direction's frames were read; `decode_stack` with ``reasons=False`` may skip some."""


def _used_frames(frames: Sequence[NDArray | None] | NDArray, used: tuple[int, ...], rig: Rig) -> dict[int, NDArray]:
    """The frames at the indices ``used``, checked and flattened to (H * W,)."""
    expected = (rig.camera.height, rig.camera.width)
    if len(frames) != len(rig.sequence):
        raise DecodeError(
            f"expected the {len(rig.sequence)} frames of the rig's sequence, got {len(frames)}; "
            "put None in the place of a frame that was not captured"
        )
    flat, described = {}, rig.sequence.frames
    for index in used:
        frame, title = frames[index], f"frame {described[index].title}"
        if frame is None:
            raise DecodeError(f"{title}: expected an image, got None; this decoding needs the frame, capture it")
        image = np.asarray(frame)
        if image.dtype != np.uint8:
            raise DecodeError(f"{title}: expected uint8 grey levels, got dtype {image.dtype}")
        if image.shape != expected:
            raise DecodeError(
                f"{title}: expected shape (H, W) = {expected} of the rig's camera, got {image.shape}; "
                "use rig.scaled(width) for a resized image"
            )
        flat[index] = image.reshape(-1)
    return flat


def _checked_mask(mask: NDArray | None, shape: tuple[int, int]) -> NDArray[np.intp] | None:
    if mask is None:
        return None
    if np.asarray(mask).dtype != np.bool_ or np.shape(mask) != shape:
        raise DecodeError(f"mask: expected bool {shape}, got {np.asarray(mask).dtype} {np.shape(mask)}")
    return np.flatnonzero(mask)


def _checked_limits(limits: Limits) -> None:
    for name in ("min_modulation", "max_disagreement_px", "ambiguous_fraction"):
        value = getattr(limits, name)
        if not (np.isfinite(value) and value > 0):
            raise DecodeError(f"{name}: expected a positive finite number, got {value!r}")
    if limits.max_clipped_steps is not None and limits.max_clipped_steps < 0:
        raise DecodeError(f"max_clipped_steps: expected 0 or more, got {limits.max_clipped_steps!r}")


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

    ``frames``: all frames of ``rig.sequence`` in order, uint8 (H, W) each: a list of views (nothing is stacked or
    kept) or an array (F, H, W); a frame that is not needed may be None. Black and white are never needed: the
    threshold of the Gray code is the sinusoids' own mean.

    ``direction``: "vertical" fringes measure the projector's u and "horizontal" its v, each enough for a depth; "both"
    needs both at every pixel, weighs them by (modulation / pitch)^2, and rejects pixels at which the two coordinates
    disagree by more than ``limits.max_disagreement_px`` across the epipolar line.

    ``steps``: how many of each direction's N sinusoids to use, 3 to N (default: all), spread as evenly as possible.
    Where they can't be even (N is not a multiple), the phase is the least-squares solution.

    ``mask`` bool (H, W): pixels to decode; all others get `Reason.NOT_ASKED` and have no influence. The result is the
    same bit by bit for any number of ``threads``, and inside the mask the same as without a mask. ``details``: also
    return coordinates, modulation and wrapped phase.

    ``reasons`` False: only the depth has to be right. A pixel that the first direction shows to lie outside the working
    range (`decoding.blocks`), or to have no coordinate, is then not read in the second direction. The depth
    is the same bit by bit; the reason is the first direction's, or OUTSIDE_RANGE.

    ``fewest``: read only the Gray frames that the rig's working range needs (`decoding.fewest`). With "both"
    usually none is needed, and the fringe orders come from the two phases together. A depth in range is the same bit
    by bit, except at pixels whose directions disagree by nearly the allowed distance (`JointCode.tolerance_px`).

    Depths outside ``rig.working_range_mm`` become 0 with the reason OUTSIDE_RANGE; this also removes the background
    plane. Raises `DecodeError` for frames, steps, mask or limits that don't fit, and for a sinusoid whose capture
    failed (`fpp_ml_bench.decoding.checks`).
    """
    if direction != "both" and direction not in DIRECTIONS:
        raise DecodeError(f"direction: expected horizontal, vertical or both, got {direction!r}")
    if isinstance(threads, bool) or not isinstance(threads, int) or threads < 1:
        raise DecodeError(f"threads: expected a whole number from 1, got {threads!r}")
    limits = limits or Limits()
    _checked_limits(limits)
    step_count = rig.sequence.steps if steps is None else steps
    directions: tuple[Direction, ...] = DIRECTIONS if direction == "both" else (direction,)
    plans = [plan_direction(rig, name, step_count, limits) for name in directions]
    joint: JointCode | None = None
    if fewest:
        plans, joint = fewest_plans(rig, plans)
    used = tuple(sorted(index for plan in plans for index in plan.frames))
    flat = _used_frames(frames, used, rig)
    shape = (rig.camera.height, rig.camera.width)
    mask_indices = _checked_mask(mask, shape)
    for plan in plans:
        check_frames(flat, plan, mask_indices, rig.sequence)
    depth_alone = not reasons and not details and len(plans) == 2 and reach_is_bounded(rig) and skipping_enabled()
    # With a mask of most of the image, decoding whole blocks and clearing the rest is faster than reading by index.
    dense = (
        mask_indices is not None
        and not details
        and len(mask_indices) > MOST_PICKED_SHARE * shape[0] * shape[1]
        and skipping_enabled()
    )
    image = DecodedImage(
        flat, rig, plans, limits, None if dense else mask_indices, details, depth_alone and joint is None, joint
    )
    starts, second_px = range(0, image.pixel_count, BLOCK_PX), 0
    if threads == 1 or len(starts) < 2:
        for start in starts:
            second_px += image.decode_from(start)
    else:
        with ThreadPoolExecutor(threads) as pool:
            second_px = sum(pool.map(image.decode_from, starts))
    if dense and mask is not None:
        image.clear_outside(np.asarray(mask).reshape(-1))
    counts = np.bincount(image.reason, minlength=len(Reason))
    return Decoded(
        depth_mm=image.depth_mm.reshape(shape),
        reason=image.reason.reshape(shape),
        counts={reason.name.lower(): int(counts[reason]) for reason in Reason},
        frames_used=used,
        details={name: image.measured(name, shape) for name in directions} if details else {},
        second_px=second_px if len(plans) == 2 else 0,
    )
