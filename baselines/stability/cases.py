"""Stability cases: how they are declared, run and judged.

A case runs a computation of the benchmark where it is ill-conditioned, and compares it with a reliable reference:
50-digit arithmetic, a closed form, or exact sums. The error is compared with a bound from theory: a condition number
times the unit round-off, or the propagation of noise and quantisation. The bound comes from the derivation that the
case states, never from the measured error.
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache, partial
from importlib import import_module
from itertools import product
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.errors import StabilityError

Scalar = float | int | str
Expects = Literal["number", "refusal", "either"]
Run = Callable[..., Any]
"""Of a case; gives its `Outcome`, or anything where a refusal is expected."""
Refusals = type[Exception] | tuple[type[Exception], ...]
Floats = NDArray[np.float64]

U64, U32, UB16 = 2.0**-53, 2.0**-24, 2.0**-8
"""Unit round-offs."""

MODULES = {
    "phase": "frames",
    "order": "frames",
    "triangulation": "geometry",
    "rig": "geometry",
    "normalisation": "scores",
    "metrics": "scores",
    "networks": "networks",
    "scenes": "scenes",
    "crossed": "scenes",
}
"""Groups of cases, and the module whose constant of that name declares them; only ``networks`` imports torch."""

# A crash of the code under test is a FAIL and does not end the run; numerical code raises these.
_CRASHES = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


class Verdict(StrEnum):
    """WITHIN: the error is within its bound. FLAGGED: correctly refused, by an exception or an invalid mask."""

    WITHIN = "within"
    FLAGGED = "flagged"
    FAIL = "FAIL"


@dataclass(frozen=True)
class Outcome:
    """The measurement of a case at its worst element, which has the largest error / bound. ``error`` is None where the
    code refused to compute; ``note`` then holds its message. ``flagged``: share of elements that were refused;
    ``may_flag``: largest share that theory allows (default: none where a number is expected, else all). ``condition``:
    the condition number behind the bound, if any."""

    error: float | None
    bound: float = 0.0
    flagged: float = 0.0
    may_flag: float | None = None
    note: str = ""
    condition: float | None = None

    @property
    def ratio(self) -> float | None:
        """Error / bound; 0 where both are 0, None where nothing was computed."""
        if not self.error:
            return self.error
        return self.error / self.bound if self.bound > 0 else math.inf


def wrong(note: str = "") -> Outcome:
    """The outcome of a result that no bound allows."""
    return Outcome(math.inf, 0.0, note=note)


@dataclass(frozen=True)
class Case:
    """An ill-conditioned or extreme case. ``run()`` gives the `Outcome`. ``computes``, ``reference`` and ``predicts``
    describe in a line each what is computed, its reference, and how the bound is derived. ``expects``: a number, a
    refusal, or either; ``refuses``: the exceptions that are a refusal. ``heavy`` cases take seconds or gigabytes and
    are left out of a quick run."""

    group: str
    family: str
    parameters: Mapping[str, Scalar]
    computes: str
    reference: str
    predicts: str
    unit: str
    run: Run = field(repr=False)
    expects: Expects = "number"
    refuses: Refusals = ()
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


@dataclass
class Group:
    """The cases of a group, in the order in which their families are declared; ``reference`` and ``predicts`` are those
    of the families that do not say theirs."""

    name: str
    reference: str = ""
    predicts: str = ""
    cases: list[Case] = field(default_factory=list)

    def family(
        self,
        name: str,
        unit: str,
        /,
        *,
        about: str = "",
        expects: Expects | Callable[..., Expects] = "number",
        refuses: Refusals = (),
        heavy: Callable[..., bool] = lambda **_: False,
        **grid: Iterable[Scalar],
    ) -> Callable[[Run], Run]:
        """Declare a function as a family: a case for each combination of the grid's values, which the function,
        ``expects`` and ``heavy`` get by name. Its docstring (or ``about``) says in this form what it computes: "depth;
        against its reference; bound: how theory predicts it"."""

        def declare(run: Run) -> Run:
            of, _, bound = " ".join((about or run.__doc__ or "").split()).partition("; bound: ")
            of, _, against = of.partition("; against ")
            texts = of, against or self.reference, bound or self.predicts, unit
            for values in product(*grid.values()):
                given = dict(zip(grid, values, strict=True))
                expected, call = expects(**given) if callable(expects) else expects, partial(run, **given)
                self.cases.append(Case(self.name, name, given, *texts, call, expected, refuses, heavy(**given)))
            return run

        return declare


def all_cases(groups: Iterable[str] = tuple(MODULES), quick: bool = False) -> list[Case]:
    """The cases of ``groups``, without the heavy ones when ``quick``. Raises `StabilityError`."""
    cases: list[Case] = []
    for group in groups:
        if group not in MODULES:
            raise StabilityError(f"unknown group {group!r}; there are {', '.join(MODULES)}")
        cases += getattr(import_module(f"{__package__}.{MODULES[group]}"), group.upper()).cases
    return [case for case in cases if not (quick and case.heavy)]


@dataclass(frozen=True)
class Row:
    """A case with its outcome and verdict; ``against`` is the reason where it failed, ``cpu_seconds`` the processor
    time of all threads, so that a busy machine does not show."""

    case: Case
    outcome: Outcome
    verdict: Verdict
    against: str
    cpu_seconds: float


def run_cases(cases: Sequence[Case], done: Callable[[Row], None] = lambda _: None) -> list[Row]:
    """Run cases in order; ``done`` is called with each row. A crash of the code under test, even a refusal that the
    case did not name, is a FAIL."""
    rows = []
    for case in cases:
        started, failure = time.process_time(), ""
        try:
            with np.errstate(all="ignore"):
                outcome = case.run()
            outcome = outcome if isinstance(outcome, Outcome) else Outcome(0.0)
        except case.refuses as error:
            outcome = Outcome(None, flagged=1.0, note=str(error))
        except _CRASHES as error:
            outcome = Outcome(None, note=f"{type(error).__name__}: {error}")
            failure = f"ended in {outcome.note}"
        verdict, against = (Verdict.FAIL, failure) if failure else judge(case, outcome)
        rows.append(Row(case, outcome, verdict, against, time.process_time() - started))
        done(rows[-1])
    return rows


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
    allowed = float(case.expects != "number") if outcome.may_flag is None else outcome.may_flag
    if outcome.flagged > allowed:
        return Verdict.FAIL, f"refused {outcome.flagged:.2%}, theory allows {allowed:.2%}"
    return Verdict.WITHIN, ""


def worst(
    errors: ArrayLike,
    bounds: ArrayLike = 0.0,
    flagged: ArrayLike = False,
    may_flag: float | None = None,
    condition: float | None = None,
    note: str = "",
) -> Outcome:
    """The outcome of many elements: the worst of those that are not flagged. Their NaN errors stay NaN."""
    parts = np.broadcast_arrays(np.abs(np.asarray(errors, float)), np.asarray(bounds, float), np.asarray(flagged))
    error, bound, refused = (np.ravel(part) for part in parts)
    if refused.all():
        return Outcome(None, 0.0, 1.0, may_flag, note or "every element is masked", condition)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error == 0, 0.0, error / bound)
    ratio = np.where(refused, -1.0, np.where(np.isnan(ratio), np.inf, ratio))
    index = int(np.argmax(ratio))
    return Outcome(float(error[index]), float(bound[index]), float(refused.mean()), may_flag, note, condition)


@cache
def high_precision(digits: int = 50) -> Any:
    """A separate mpmath context, so that the global precision does not change."""
    import mpmath

    context = mpmath.MPContext()
    context.dps = digits
    return context


def wide(values: ArrayLike, digits: int = 50) -> NDArray[np.object_]:
    """Numbers as an array of mpmath's, with which NumPy's operators compute in ``digits`` digits."""
    return np.asarray(np.frompyfunc(high_precision(digits).mpf, 1, 1)(np.asarray(values, float)))


def by_mpmath(name: str, *values: NDArray[np.object_]) -> NDArray[np.object_]:
    """A function of mpmath, of each element."""
    return np.frompyfunc(getattr(high_precision(), name), len(values), 1)(*values)


def difference(values: NDArray, exact: NDArray[np.object_]) -> Floats:
    """``values`` minus high-precision numbers, subtracted before it is rounded."""
    return (wide(values) - exact).astype(np.float64)


def gamma(operations: float, unit: float = U64) -> float:
    """Largest relative error of ``operations`` roundings in a row: n u / (1 - n u)  (Higham, Lemma 3.1)."""
    return operations * unit / (1 - operations * unit)
