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

from fpp_ml_bench.decode_blocks import Limits, Reason, plan_direction
from fpp_ml_bench.decode_fewest import fewest_plans
from fpp_ml_bench.decode_image import BLOCK_PX, MOST_PICKED_SHARE, DecodedImage, Measured
from fpp_ml_bench.decode_reach import reach_is_bounded
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.fewest import JointCode
from fpp_ml_bench.frame_check import check_frames
from fpp_ml_bench.frames import DIRECTIONS, Direction
from fpp_ml_bench.rig import Rig
from fpp_ml_bench.skipping import skipping_enabled

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
    range (`fpp_ml_bench.decode_reach`), or to have no coordinate, is then not read in the second direction. The depth
    is the same bit by bit; the reason is the first direction's, or OUTSIDE_RANGE.

    ``fewest``: read only the Gray frames that the rig's working range needs (`fpp_ml_bench.fewest`). With "both"
    usually none is needed, and the fringe orders come from the two phases together. A depth in range is the same bit
    by bit, except at pixels whose directions disagree by nearly the allowed distance (`JointCode.tolerance_px`).

    Depths outside ``rig.working_range_mm`` become 0 with the reason OUTSIDE_RANGE; this also removes the background
    plane. Raises `DecodeError` for frames, steps, mask or limits that don't fit, and for a sinusoid whose capture
    failed (`fpp_ml_bench.frame_check`).
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
