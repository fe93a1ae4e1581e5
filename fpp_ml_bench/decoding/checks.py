"""What can't be decoded is refused: frames, masks and limits that don't fit, and sinusoids whose capture failed.

A failed frame would cause a phase error of up to (2/N) (A + B) / B. Means over any set of pixels follow ``A + C cos
delta_n + S sin delta_n`` as each pixel does; with seven or more steps, redundant equations tell a frame that
contradicts the others from a scene that violates the model. With four to six steps only a black frame can be detected.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.coding import Limits
from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.decoding.blocks import DirectionPlan
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.optics import Rig

SAMPLED_PX = 4096
LEAST_PX = 64
"""With fewer pixels the mean depends more on the scene than on the frame."""
LEAST_OFF_GREY = 16.0
LEAST_OFF_SHARE = 0.3
"""A frame is wrong when its mean deviates by more than both limits: no lamp flickers by 30%."""
AGREEMENT_GREY = 3.0
"""Largest residual of the other frames' means. Above it, the scene does not follow the model (a strong gamma on a few
pixels), and no frame is reported."""
LEAST_STEPS_FOR_MEANS = 7
OPPOSITE_SPAN_GREY = 40
"""A correct frame is black only where all phases are within 0.2 rad of its minimum; the frame half a period later then
spans at most a fifth of the modulation."""


def check_limits(limits: Limits) -> None:
    """Raise `DecodeError` for a limit that is no limit."""
    for name in ("min_modulation", "max_disagreement_px", "ambiguous_fraction"):
        value = getattr(limits, name)
        if not (np.isfinite(value) and value > 0):
            raise DecodeError(f"{name}: expected a positive finite number, got {value!r}")
    if limits.max_clipped_steps is not None and limits.max_clipped_steps < 0:
        raise DecodeError(f"max_clipped_steps: expected 0 or more, got {limits.max_clipped_steps!r}")


def grey_levels(image: NDArray) -> NDArray:
    """An image as an array; int64, which ``datasets`` makes of uint8 ``with_format("numpy")``, as uint8 again where no
    value changes. Not uint16: a dark image of a deeper camera has small values, too."""
    levels = np.asarray(image)
    if levels.dtype == np.int64 and levels.size and 0 <= levels.min() <= levels.max() <= GREY_LEVELS:
        return levels.astype(np.uint8)
    return levels


def flat_frames(frames: Sequence[NDArray | None] | NDArray, used: tuple[int, ...], rig: Rig) -> dict[int, NDArray]:
    """The frames at the indices ``used``, checked and flattened to uint8 or float32 (H * W,), all of one dtype."""
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
            raise DecodeError(f"{title}: expected an image, got None; this decoding needs the frame, capture it")
        image = grey_levels(frame)
        if image.dtype not in (np.uint8, np.float32):
            raise DecodeError(
                f"{title}: expected uint8 grey levels, or float32 of 0 to 255 for deeper images, got {image.dtype}"
            )
        if flat and image.dtype != next(iter(flat.values())).dtype:
            raise DecodeError(f"{title}: expected the dtype of the other frames, got {image.dtype}")
        if image.dtype == np.float32 and not (
            np.isfinite(image).all() and image.min() >= 0 and image.max() <= GREY_LEVELS
        ):
            raise DecodeError(f"{title}: expected float32 grey levels of 0 to 255; scale them by 255 / full scale")
        if image.shape != expected:
            raise DecodeError(
                f"{title}: expected shape (H, W) = {expected} of the rig's camera, got {image.shape}; "
                "use rig.scaled(width) for a resized image"
            )
        flat[index] = image.reshape(-1)
    return flat


def mask_indices(mask: NDArray | None, shape: tuple[int, int]) -> NDArray[np.intp] | None:
    """Flat indices of the pixels in ``mask``; None without a mask."""
    if mask is None:
        return None
    if np.asarray(mask).dtype != np.bool_ or np.shape(mask) != shape:
        raise DecodeError(f"mask: expected bool {shape}, got {np.asarray(mask).dtype} {np.shape(mask)}")
    return np.flatnonzero(mask)


def check_frames(flat: Mapping[int, NDArray], plan: DirectionPlan, indices: NDArray | None, rig: Rig) -> None:
    """Raise `DecodeError`, naming the frame, where a sinusoid of ``plan`` contradicts the others. ``flat`` frames by
    index, uint8 (pixels,); at most `SAMPLED_PX` of the pixels at ``indices`` (None: all) are tested."""
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
        wrong = _contradicting_mean(np.array([level.mean() for level in levels]), model, plan.weights)
    else:
        wrong = _black_frame(levels)
    if wrong is not None:
        title = rig.sequence.frames[plan.sinusoids[wrong[0]]].title
        raise DecodeError(
            f"frame {title}: {wrong[1]}: its capture failed (dead, dimmed or flashed frame); take it again, or decode "
            "with steps that leave it out"
        )


def _contradicting_mean(means: NDArray, model: NDArray, weights: NDArray) -> tuple[int, str] | None:
    """Position of the frame whose mean contradicts the others, and what is wrong with it."""
    fitted = model @ (weights @ means)
    influence = np.einsum("ij,ji->i", model, weights)
    deviations = np.abs(means - fitted) / (1 - influence)  # from the prediction of the other frames alone
    for position in np.flatnonzero(deviations > LEAST_OFF_GREY):
        others = np.arange(len(means)) != position
        fit = np.linalg.lstsq(model[others], means[others], rcond=None)[0]
        expected = float(model[position] @ fit)
        agree = np.abs(model[others] @ fit - means[others]).max() <= AGREEMENT_GREY
        if agree and deviations[position] > LEAST_OFF_SHARE * max(expected, 0.0):
            fault = f"its mean grey level is {means[position]:.0f}, and by the other steps it should be {expected:.0f}"
            return int(position), fault
    return None


def _black_frame(levels: list[NDArray[np.uint8]]) -> tuple[int, str] | None:
    """Position of the frame that is black at every pixel while the frame half a period later varies, and the fault."""
    for position, level in enumerate(levels):
        opposite = levels[(position + len(levels) // 2) % len(levels)]
        if not level.any() and np.ptp(opposite) >= OPPOSITE_SPAN_GREY:
            return position, "it is black all over while the other steps vary"
    return None
