"""The phase-reliance score: how far an answer follows the fringe's phase and nothing but it, in [0, 1]. Own definition.

For one sample, over its target pixels and all moves of the phase within the object (brightness kept, so that nothing
else moves), let t be the change of depth that a move asks for and d the change of the answer. With sums over pixels and
moves,

    gain = <d, t> / <t, t>,  purity = <d, t> / sqrt(<d, d> <t, t>),
    follows = purity min(gain, 1 / gain), 0 where <d, t> is not positive.

An answer that makes the change and no other has 1; one that does not change, or changes across what is asked, 0.
Under other outlines, with the phase of what is left untouched,

    change = rms(d) / rms(t),  ignores outline = 1 - change, 0 where the change is above 1,

that is, 0 for who moves as much with the outline as it should with the phase. The sample's score is their product, and
the method's score the mean over samples, with a bootstrap over objects.

Units are those of the answer. For mm, t is in mm. An answer normalised to the sample's depth range is held against the
truth normalised as in training, each scene by its own range: that is the answer a perfect network would give. Where
another outline changes that range, standing still and moving with the range both count as ignoring it.

A pixel without an answer (0 where the unit is mm) has not followed; one that loses its answer under another outline has
changed by rms(t).

*Order-free* values allow whole periods: with p the phase of an answer in mm, Dp its change and Dt what is asked,

    follows = 1 - (1 - <cos(Dp - Dt)>) / (1 - <cos Dt>), at least 0,
    change = rms(2 sin(Dp / 2)) / rms(2 sin(Dt / 2)),

<> being means. A single fringe can't tell its order, so a method that reads it may jump by a period and still have read
it. An answer at random gets no credit: its <cos(Dp - Dt)> is 0, which is below that of an answer that stands still.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.floating]


@dataclass(frozen=True)
class Change:
    """What became of one counterfactual, at the pixels that are compared: ``asked`` and ``made`` change (n,) in the
    units of the answer, ``answered`` bool (n,): there before and after."""

    asked: NDArray[np.float64]
    made: NDArray[np.float64]
    answered: NDArray[np.bool_]

    @classmethod
    def of(cls, before: Map, after: Map, asked: Map, where: NDArray[np.bool_], zero_is_none: bool) -> "Change":
        """From two answers and the change asked for, maps (H, W), at ``where`` (H, W). With ``zero_is_none`` a 0 is no
        answer, and the change made there is 0."""
        first, second = before[where].astype(np.float64), after[where].astype(np.float64)
        answered = (first != 0) & (second != 0) if zero_is_none else np.ones(first.shape, dtype=bool)
        return cls(np.asarray(asked[where], dtype=np.float64), np.where(answered, second - first, 0.0), answered)


def follows(changes: Sequence[Change]) -> float | None:
    """Purity times gain (at most 1 / gain) of the ``changes`` made with those asked; None where none was asked."""
    both, made, asked = (
        sum(float(np.dot(getattr(one, a), getattr(one, b))) for one in changes)
        for a, b in (("made", "asked"), ("made", "made"), ("asked", "asked"))
    )
    if asked <= 0:
        return None
    if both <= 0:
        return 0.0
    gain, purity = both / asked, both / np.sqrt(made * asked)
    return float(min(purity, 1.0) * min(gain, 1 / gain))


def rms_asked(changes: Sequence[Change]) -> float:
    """Root mean square of what was asked, over all pixels of ``changes``; 0 without any."""
    values = np.concatenate([one.asked for one in changes]) if changes else np.zeros(0)
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def relative_change(changes: Sequence[Change], unit: float) -> float | None:
    """Root mean square of the change made beyond the one asked, or at all if that is less, over ``unit``; a pixel whose
    answer is gone counts ``unit``. None without pixels or with ``unit`` 0."""
    if unit <= 0 or not sum(one.made.size for one in changes):
        return None
    total = 0.0
    for one in changes:
        moved = [np.where(one.answered, one.made - asked, unit) for asked in (one.asked, 0.0)]
        total += min(float(np.dot(values, values)) for values in moved)
    return float(np.sqrt(total / sum(one.made.size for one in changes)) / unit)


def order_free_follows(changes: Sequence[Change]) -> float | None:
    """`follows` for changes of phase in rad, whole periods aside; what has no answer has not moved."""
    made, asked = (np.concatenate([getattr(one, key) for one in changes]) for key in ("made", "asked"))
    room = 1 - float(np.mean(np.cos(asked))) if asked.size else 0.0
    return max(0.0, 1 - (1 - float(np.mean(np.cos(made - asked)))) / room) if room > 0 else None


def order_free(changes: Sequence[Change]) -> list[Change]:
    """Changes of phase in rad as chords, for `relative_change`: a whole period is no change."""
    return [Change(2 * np.sin(one.asked / 2), 2 * np.sin(one.made / 2), one.answered) for one in changes]


def sample_score(follow: float | None, change: float | None) -> float | None:
    """The score of one sample; an outline that could not be changed counts as ignored."""
    if follow is None:
        return None
    return follow * (1.0 if change is None else max(0.0, 1.0 - change))
