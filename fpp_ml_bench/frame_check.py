"""A sinusoid frame that can't be what it should: dead, dimmed or flashed. Found from the frames' mean grey levels.

Every pixel follows ``A + C cos delta_n + S sin delta_n``, and so does the mean over any set of pixels. From seven steps
on a mean that the others contradict therefore shows, whatever the scene, and three spare equations keep a scene that
bends the law (gamma on a few pixels) from being taken for a wrong frame. With four to six only a black frame is sure to
be wrong: the one half a period on vouches. Three steps have no redundancy. A wrong frame would otherwise pass in
silence, as a phase error of up to (2/N) (A + B) / B.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.decode_blocks import DirectionPlan
from fpp_ml_bench.errors import DecodeError
from fpp_ml_bench.frames import Sequence

SAMPLED_PX = 4096
LEAST_PX = 64
"""Fewer pixels than this say more about themselves than about a frame."""
LEAST_OFF_GREY = 16.0
LEAST_OFF_SHARE = 0.3
"""A frame is wrong when its mean is off by more than both: 30% is more than any lamp flickers."""
AGREEMENT_GREY = 3.0
"""Largest residual of the other frames' means: quantisation, noise and clipping leave less, unless the scene itself
does not follow the model (a strong gamma on a few pixels), and then no frame is accused."""
LEAST_STEPS_FOR_MEANS = 7
OPPOSITE_SPAN_GREY = 40
"""A frame is black by right where all phases stand within 0.2 rad of its minimum; the frame half a period on, or 36
degrees beside that for five steps, then spans at most a fifth of the modulation."""


def check_frames(
    flat: Mapping[int, NDArray[np.uint8]], plan: DirectionPlan, chosen: NDArray[np.intp] | None, sequence: Sequence
) -> None:
    """Raise `DecodeError`, naming the frame, where one of ``plan``'s sinusoids can't belong to the others.

    ``flat`` frames by index, uint8 (pixels,); ``chosen`` flat indices of the pixels that are asked for (None: all). At
    most `SAMPLED_PX` of them are looked at, evenly spread.
    """
    first = flat[plan.sinusoids[0]]
    asked = len(first) if chosen is None else len(chosen)
    if asked < LEAST_PX or len(plan.sinusoids) < 4:
        return
    step = -(-asked // SAMPLED_PX)
    where = slice(None, None, step) if chosen is None else chosen[::step]
    levels = [flat[index][where] for index in plan.sinusoids]
    if len(levels) >= LEAST_STEPS_FOR_MEANS:
        shifts = 2 * np.pi * np.array([sequence.frames[index].step for index in plan.sinusoids]) / sequence.steps
        model = np.stack([np.ones(len(shifts)), np.cos(shifts), np.sin(shifts)], axis=1)
        wrong = _off(np.array([level.mean() for level in levels]), model, plan.weights)
    else:
        wrong = _black(levels)
    if wrong is not None:
        place, what = wrong
        raise DecodeError(
            f"frame {sequence.frames[plan.sinusoids[place]].title}: {what}: its capture failed (dead, dimmed or "
            "flashed frame); take it again, or decode with steps that leave it out"
        )


def _off(
    means: NDArray[np.float64], model: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[int, str] | None:
    """The frame whose mean the others contradict, and what is wrong with it; None where there is none."""
    fitted = model @ (weights @ means)
    influence = np.einsum("ij,ji->i", model, weights)
    off = np.abs(means - fitted) / (1 - influence)  # from what the other frames alone predict
    for place in np.flatnonzero(off > LEAST_OFF_GREY):
        others = np.arange(len(means)) != place
        fit = np.linalg.lstsq(model[others], means[others], rcond=None)[0]
        expected = float(model[place] @ fit)
        agree = np.abs(model[others] @ fit - means[others]).max() <= AGREEMENT_GREY
        if agree and off[place] > LEAST_OFF_SHARE * max(expected, 0.0):
            found = f"its mean grey level is {means[place]:.0f}, and by the other steps it should be {expected:.0f}"
            return int(place), found
    return None


def _black(levels: list[NDArray[np.uint8]]) -> tuple[int, str] | None:
    """The frame that is black at every pixel while the one half a period on varies. Both are at an extreme of the
    fringe there, so one can't vary if the other does not."""
    for place, level in enumerate(levels):
        opposite = levels[(place + len(levels) // 2) % len(levels)]
        if not level.any() and int(opposite.max()) - int(opposite.min()) >= OPPOSITE_SPAN_GREY:
            return place, "it is black all over while the other steps vary"
    return None
