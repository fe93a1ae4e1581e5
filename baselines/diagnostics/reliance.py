"""The phase-reliance score (own definition): how far a prediction follows the fringe's phase and nothing else, 0 to 1.

For a sample, take its target pixels and all moves of the phase within the object. Brightness is kept, so only the phase
changes. Let t be the change of depth that a move implies and d the change of the prediction. With sums over pixels and
moves,

    gain = <d, t> / <t, t>,  purity = <d, t> / sqrt(<d, d> <t, t>),
    follows = purity min(gain, 1 / gain), 0 where <d, t> is not positive.

It is 1 for a prediction that changes by exactly t, and 0 for a prediction that does not change or whose change is
uncorrelated with t. Under other outlines, over the pixels whose phase stays the same,

    change = rms(d) / rms(t),  ignores outline = 1 - change, 0 where the change is above 1,

so it is 0 for a method that changes as much with the outline as it should with the phase. The sample's score is the
product of the two. The method's score is the mean over samples, with a bootstrap over objects.

The score uses the units of the prediction. For mm, t is in mm. A prediction normalised to the sample's depth range is
compared with the truth normalised as in training, each scene by its own range, which a perfect network would predict.
Where another outline changes that range, both a constant prediction and one that follows the range count as ignoring
the outline.

A pixel without a prediction (0 where the unit is mm) does not follow. A pixel that loses its prediction under another
outline counts as a change by rms(t).

*Order-free* values allow errors of whole periods: with p the phase of a prediction in mm, Dp its change and Dt the
expected change,

    follows = 1 - (1 - <cos(Dp - Dt)>) / (1 - <cos Dt>), at least 0,
    change = rms(2 sin(Dp / 2)) / rms(2 sin(Dt / 2)),

where <> is the mean. A single fringe does not determine its order, so a method that reads the phase may still be wrong
by a period. A random prediction gets no credit: its <cos(Dp - Dt)> is 0, below that of a constant prediction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Map = NDArray[np.floating]


@dataclass(frozen=True)
class Change:
    """Change of the prediction in a counterfactual scene, at the pixels that are compared.

    ``expected`` and ``actual`` change (n,) in the prediction's units; ``answered`` bool (n,): a prediction exists
    before and after.
    """

    expected: NDArray[np.float64]
    actual: NDArray[np.float64]
    answered: NDArray[np.bool_]

    @classmethod
    def of(cls, before: Map, after: Map, expected: Map, where: NDArray[np.bool_], zero_is_none: bool) -> "Change":
        """From two predictions and the expected change, maps (H, W), at the pixels ``where`` (H, W).

        With ``zero_is_none`` a 0 means that there is no prediction, and the actual change there is 0.
        """
        first, second = before[where].astype(np.float64), after[where].astype(np.float64)
        answered = (first != 0) & (second != 0) if zero_is_none else np.ones(first.shape, dtype=bool)
        return cls(np.asarray(expected[where], dtype=np.float64), np.where(answered, second - first, 0.0), answered)


def follows(changes: Sequence[Change]) -> float | None:
    """Purity times min(gain, 1 / gain) of the ``changes``; None where no change is expected."""
    product, actual, expected = (
        sum(float(np.dot(getattr(change, a), getattr(change, b))) for change in changes)
        for a, b in (("actual", "expected"), ("actual", "actual"), ("expected", "expected"))
    )
    if expected <= 0:
        return None
    if product <= 0:
        return 0.0
    gain, purity = product / expected, product / np.sqrt(actual * expected)
    return float(min(purity, 1.0) * min(gain, 1 / gain))


def rms_expected(changes: Sequence[Change]) -> float:
    """Root mean square of the expected change over all pixels of ``changes``; 0 without pixels."""
    values = np.concatenate([change.expected for change in changes]) if changes else np.zeros(0)
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def relative_change(changes: Sequence[Change], unit: float) -> float | None:
    """Root mean square of actual minus expected change, or of the actual change if that is less, divided by ``unit``.

    A pixel that lost its prediction counts as ``unit``. None without pixels or with ``unit`` 0.
    """
    if unit <= 0 or not sum(change.actual.size for change in changes):
        return None
    total = 0.0
    for change in changes:
        differences = [np.where(change.answered, change.actual - expected, unit) for expected in (change.expected, 0.0)]
        total += min(float(np.dot(values, values)) for values in differences)
    return float(np.sqrt(total / sum(change.actual.size for change in changes)) / unit)


def order_free_follows(changes: Sequence[Change]) -> float | None:
    """`follows` for changes of phase in rad, modulo whole periods; without a prediction the change is 0."""
    actual, expected = (np.concatenate([getattr(change, key) for change in changes]) for key in ("actual", "expected"))
    standing_still = 1 - float(np.mean(np.cos(expected))) if expected.size else 0.0
    return (
        max(0.0, 1 - (1 - float(np.mean(np.cos(actual - expected)))) / standing_still) if standing_still > 0 else None
    )


def order_free(changes: Sequence[Change]) -> list[Change]:
    """Changes of phase in rad as chords, for `relative_change`: a whole period is no change."""
    return [
        Change(2 * np.sin(change.expected / 2), 2 * np.sin(change.actual / 2), change.answered) for change in changes
    ]


def sample_score(follow: float | None, change: float | None) -> float | None:
    """The score of a sample; an outline that could not be changed counts as ignored."""
    if follow is None:
        return None
    return follow * (1.0 if change is None else max(0.0, 1.0 - change))
