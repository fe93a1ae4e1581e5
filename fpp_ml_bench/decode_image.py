"""The work of decoding one image, block by block: which pixels of a block are looked at in which direction, and when.

`fpp_ml_bench.decoding` checks what came and makes the plans; `decode_blocks` knows what is done to a pixel.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decode_blocks import Coordinates, DirectionPlan, Limits, Reason, decode_direction, verdict
from fpp_ml_bench.decode_fewest import nearest_pair, with_order, wrapped
from fpp_ml_bench.decode_reach import within_reach
from fpp_ml_bench.fewest import JointCode
from fpp_ml_bench.frames import Direction
from fpp_ml_bench.rig import Rig

BLOCK_PX = 1 << 15
"""Pixels worked off at a time: the grey levels of a block, 0.8 MB a direction, and its results stay in the cache."""
WORTH_PICKING = 0.6
"""Up to this part of a block, its pixels are picked out one by one for the second direction; beyond, reading the whole
block in order is faster."""
SAMPLED = 32
"""Of so many pixels one is looked at to see whether picking pixels out will be worth it."""


@dataclass(frozen=True)
class Measured:
    """One direction of the image: ``coordinate_px`` float64 (NaN = not decoded), ``modulation`` float32 grey levels and
    ``phase`` float64 rad in [-pi, pi), each (H, W)."""

    coordinate_px: NDArray[np.float64]
    modulation: NDArray[np.float32]
    phase: NDArray[np.float64]


class DecodedImage:
    """The flat results, and the work on one block of them; blocks touch disjoint pixels."""

    def __init__(
        self,
        frames: dict[int, NDArray],
        rig: Rig,
        plans: list[DirectionPlan],
        limits: Limits,
        chosen: NDArray[np.intp] | None,
        details: bool,
        depth_alone: bool,
        joint: JointCode | None,
    ) -> None:
        size = rig.camera.height * rig.camera.width
        self.frames, self.rig, self.plans, self.limits, self.chosen = frames, rig, plans, limits, chosen
        self.depth_alone, self.joint = depth_alone, joint
        self.pixels = size if chosen is None else len(chosen)
        self.depth_mm = np.zeros(size, dtype=np.float32)
        self.reason = np.full(size, Reason.NOT_ASKED, dtype=np.uint8)
        self.rays = tuple(axis.reshape(-1) for axis in rig.camera.rays())
        self.details: dict[Direction, Coordinates] = {}
        if details:
            for plan in plans:
                u, b, phi = (np.full(size, np.nan) for _ in range(3))
                self.details[plan.direction] = Coordinates(u, b, phi, reason=np.zeros(size, dtype=np.uint8))

    def decode_from(self, start: int) -> int:
        """Decode one block; returns of how many of its pixels every direction was looked at."""
        stop = min(start + BLOCK_PX, self.pixels)
        where = slice(start, stop) if self.chosen is None else self.chosen[start:stop]
        found = {self.plans[0].direction: self._coordinates(self.plans[0], where, stop - start)}
        if self.depth_alone:
            first = found[self.plans[0].direction]
            kept = self._reached(first, where)
            if kept is not None:
                no_depth = np.where(first.reason == 0, Reason.OUTSIDE_RANGE, first.reason)
                where, found = self._narrowed(start, where, found, kept, no_depth)
        looked_at = len(next(iter(found.values())).reason)
        for plan in self.plans[1:]:
            found[plan.direction] = self._coordinates(plan, where, looked_at)
        if self.joint:
            where, found = self._ordered(start, where, found, self.joint)
        rays = self.rays[0][where], self.rays[1][where]
        self.depth_mm[where], self.reason[where] = verdict(found, rays, self.plans, self.rig, self.limits)
        for direction, kept_details in self.details.items():
            one = found[direction]
            kept_details.coordinate_px[where] = np.where(one.reason == 0, one.coordinate_px, np.nan)
            kept_details.modulation[where], kept_details.phase[where] = one.modulation, one.phase
        return looked_at

    def _ordered(
        self, start: int, where: slice | NDArray[np.intp], found: dict[Direction, Coordinates], joint: JointCode
    ) -> tuple[slice | NDArray[np.intp], dict[Direction, Coordinates]]:
        """The block with the orders that both phases give together, reduced to pixels that have them."""
        rays = self.rays[0][where], self.rays[1][where]
        orders, off_px = nearest_pair(found, rays, self.rig, joint.tolerance_px)
        measured = np.minimum(*(np.where(one.reason == 0, Reason.NOT_ASKED, one.reason) for one in found.values()))
        unclear = (measured == Reason.NOT_ASKED) & ~(off_px <= joint.tolerance_px)
        reason = np.where(unclear, Reason.DIRECTIONS_DISAGREE, measured)
        kept = None if self.details else self._few(reason == Reason.NOT_ASKED)
        if kept is not None:
            where, found = self._narrowed(start, where, found, kept, reason)
            orders = {name: order[kept] for name, order in orders.items()}
        else:
            for one in found.values():
                one.reason[unclear] = Reason.DIRECTIONS_DISAGREE
        return where, {name: with_order(one, orders[name], self.rig, name) for name, one in found.items()}

    def _reached(self, first: Coordinates, where: slice | NDArray[np.intp]) -> NDArray[np.intp] | None:
        """Places of the pixels whose first direction leaves a depth possible, if they are few. A sample of the block
        is looked at first: where the object fills it, that is all that skipping costs."""
        rays = self.rays[0][where], self.rays[1][where]

        def open_yet(part: slice) -> NDArray[np.bool_]:
            coordinate, x, y = (np.ascontiguousarray(values[part]) for values in (first.coordinate_px, *rays))
            reached = within_reach(coordinate, (x, y), self.plans[0], self.rig, self.limits)
            return reached & (first.reason[part] == 0)

        return None if self._few(open_yet(slice(None, None, SAMPLED))) is None else self._few(open_yet(slice(None)))

    @staticmethod
    def _few(open_yet: NDArray[np.bool_]) -> NDArray[np.intp] | None:
        """Places of the pixels that are ``open_yet`` (n,), if they are few enough to be worth picking out."""
        kept = np.flatnonzero(open_yet)
        return kept if len(kept) <= WORTH_PICKING * len(open_yet) else None

    def _narrowed(
        self,
        start: int,
        where: slice | NDArray[np.intp],
        found: dict[Direction, Coordinates],
        kept: NDArray[np.intp],
        reason: NDArray[np.uint8],
    ) -> tuple[slice | NDArray[np.intp], dict[Direction, Coordinates]]:
        """A block reduced to the pixels ``kept``; the others get their ``reason``."""
        self.reason[where] = reason
        there = kept + start if isinstance(where, slice) else where[kept]
        return there, {direction: one.at(kept) for direction, one in found.items()}

    def _coordinates(self, plan: DirectionPlan, where: slice | NDArray[np.intp], count: int) -> Coordinates:
        """One direction at ``count`` pixels, its frames' grey levels gathered first."""
        levels = np.empty((len(plan.rows), count), dtype=np.uint8)
        for row, index in zip(levels, plan.rows, strict=True):
            if index in plan.known:
                row[:] = plan.known[index]
            elif isinstance(where, slice):
                row[:] = self.frames[index][where]
            else:
                # Every index is one of the image's: "clip" only saves the check, and a copy with it.
                self.frames[index].take(where, out=row, mode="clip")
        return wrapped(levels, plan, self.limits) if self.joint else decode_direction(levels, plan, self.limits)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Forget what lies outside ``mask`` (pixels,)."""
        self.depth_mm[~mask], self.reason[~mask] = 0.0, Reason.NOT_ASKED

    def measured(self, direction: Direction, shape: tuple[int, int]) -> Measured:
        kept = self.details[direction]
        return Measured(
            kept.coordinate_px.reshape(shape),
            kept.modulation.astype(np.float32).reshape(shape),
            kept.phase.reshape(shape),
        )
