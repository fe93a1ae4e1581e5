"""Decoding an image block by block: which pixels of a block are read in which direction, and in which order.

`fpp_ml_bench.decoding` checks the input and makes the plans; `decode_blocks` decodes the pixels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decode_blocks import Coordinates, DirectionPlan, Limits, Reason, decode_direction, depth_and_reason
from fpp_ml_bench.decode_fewest import decode_wrapped, nearest_pair, with_order
from fpp_ml_bench.decode_reach import within_reach
from fpp_ml_bench.fewest import JointCode
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.rig import Rig

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
