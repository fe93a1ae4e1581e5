"""Stability cases and their verdicts.

A case runs a computation of the benchmark where it is ill-conditioned, and compares it with a reliable reference:
50-digit arithmetic, a closed form, or exact sums. The error is compared with a bound from theory: a condition number
times the unit round-off, or the propagation of noise and quantisation. The bound comes from the derivation that the
case states, never from the measured error.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from itertools import product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Scalar = float | int | str
Expects = Literal["number", "refusal", "either"]


class Verdict(StrEnum):
    """WITHIN: the error is within its bound. FLAGGED: correctly refused, by an exception or an invalid mask."""

    WITHIN = "within"
    FLAGGED = "flagged"
    FAIL = "FAIL"


@dataclass(frozen=True)
class Outcome:
    """The measurement of a case at its worst element, which has the largest error / bound.

    ``error`` is None where the code refused to compute; ``note`` then holds its message. ``flagged``: share of elements
    that were refused; ``may_flag``: largest share that theory allows. ``condition``: the condition number behind the
    bound, if any.
    """

    error: float | None
    bound: float = 0.0
    flagged: float = 0.0
    may_flag: float = 0.0
    note: str = ""
    condition: float | None = None

    @property
    def ratio(self) -> float | None:
        """Error / bound; 0 where both are 0, None where nothing was computed."""
        if self.error is None:
            return None
        if self.error == 0:
            return 0.0
        return self.error / self.bound if self.bound > 0 else math.inf


@dataclass(frozen=True)
class Case:
    """An ill-conditioned or extreme case.

    ``run()`` gives the `Outcome`. ``computes``, ``reference`` and ``predicts`` describe in a line each what is
    computed, its reference, and how the bound is derived. ``expects``: a number, a refusal, or either. ``heavy`` cases
    take seconds or gigabytes and are left out of a quick run.
    """

    group: str
    family: str
    parameters: Mapping[str, Scalar]
    computes: str
    reference: str
    predicts: str
    unit: str
    run: Callable[[], Outcome] = field(repr=False)
    expects: Expects = "number"
    heavy: bool = False

    @property
    def name(self) -> str:
        """``family, parameter value, ...``"""
        return ", ".join([self.family, *(f"{key} {parameter_text(value)}" for key, value in self.parameters.items())])


def parameter_text(value: Scalar) -> str:
    """A parameter as text: six digits where they are exact, else all digits."""
    if not isinstance(value, float):
        return str(value)
    short = f"{value:.6g}"
    return short if float(short) == value or value != value else repr(value)


def family(
    group: str,
    name: str,
    run: Callable[..., Outcome],
    grid: Mapping[str, Iterable[Scalar]],
    *,
    computes: str,
    reference: str,
    predicts: str,
    unit: str,
    expects: Expects | Callable[..., Expects] = "number",
    heavy: Callable[..., bool] = lambda **_: False,
) -> list[Case]:
    """Cases of a family: one for each combination of the grid's values, which ``run`` and ``expects`` get by name."""
    cases = []
    for values in product(*grid.values()):
        parameters = dict(zip(grid, values, strict=True))
        expected = expects(**parameters) if callable(expects) else expects
        cases.append(
            Case(
                group,
                name,
                parameters,
                computes,
                reference,
                predicts,
                unit,
                partial(run, **parameters),
                expected,
                heavy(**parameters),
            )
        )
    return cases


def judge(case: Case, outcome: Outcome) -> tuple[Verdict, str]:
    """The verdict on a case, and the reason where it failed."""
    if outcome.error is None:
        if case.expects == "number":
            return Verdict.FAIL, f"refused what can be computed: {outcome.note}"
        return Verdict.FLAGGED, ""
    if case.expects == "refusal":
        return Verdict.FAIL, "gave a number where there is none"
    if not math.isfinite(outcome.bound):
        return Verdict.FAIL, "theory predicts no finite error, so the number is meaningless and should be refused"
    if not outcome.error <= outcome.bound:  # NaN is not
        return Verdict.FAIL, f"error {outcome.error:.3g} exceeds its bound {outcome.bound:.3g}"
    if outcome.flagged > outcome.may_flag:
        return Verdict.FAIL, f"refused {outcome.flagged:.2%}, theory allows {outcome.may_flag:.2%}"
    return Verdict.WITHIN, ""


def worst(
    errors: ArrayLike,
    bounds: ArrayLike,
    flagged: ArrayLike | None = None,
    may_flag: float = 0.0,
    condition: float | None = None,
    note: str = "",
) -> Outcome:
    """The outcome of many elements: the worst of those that are not flagged. Their NaN errors stay NaN."""
    masked = False if flagged is None else np.asarray(flagged)
    parts = np.broadcast_arrays(np.abs(np.asarray(errors, float)), np.asarray(bounds, float), masked)
    error, bound, refused = (np.ravel(part) for part in parts)
    share = float(refused.mean()) if refused.size else 0.0
    unflagged = np.flatnonzero(~refused)
    if not unflagged.size:
        return Outcome(
            None, flagged=1.0, may_flag=may_flag, note=note or "every element is masked", condition=condition
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error[unflagged] == 0, 0.0, error[unflagged] / bound[unflagged])
    index = unflagged[int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio)))]
    return Outcome(float(error[index]), float(bound[index]), share, may_flag, note, condition)


def refusal(call: Callable[[], object], *errors: type[BaseException]) -> Outcome:
    """Outcome of a call that should raise one of ``errors``: the message if it does, else an error of 0."""
    try:
        call()
    except errors as error:
        return Outcome(None, flagged=1.0, note=str(error))
    return Outcome(0.0, 0.0)
