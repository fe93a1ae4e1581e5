"""Lists and runs the cases."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module

import numpy as np

from fpp_ml_bench.baselines.stability.case import Case, Outcome, Verdict, judge
from fpp_ml_bench.errors import StabilityError

GROUPS = ("phase", "order", "triangulation", "rig", "normalisation", "metrics", "networks", "scenes")
"""Groups of cases, each in a module ``cases_{group}`` beside this one; only ``networks`` imports torch."""

# A crash of the code under test is a FAIL and does not end the run; numerical code raises these.
_CRASHES = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


@dataclass(frozen=True)
class Row:
    """A case with its outcome and verdict; ``against`` is the reason where it failed.

    ``cpu_seconds``: processor time of all threads, so that a busy machine does not show.
    """

    case: Case
    outcome: Outcome
    verdict: Verdict
    against: str
    cpu_seconds: float


def all_cases(groups: Iterable[str] = GROUPS, quick: bool = False) -> list[Case]:
    """The cases of ``groups``, without the heavy ones when ``quick``. Raises `StabilityError`."""
    cases: list[Case] = []
    for group in groups:
        if group not in GROUPS:
            raise StabilityError(f"unknown group {group!r}; there are {', '.join(GROUPS)}")
        cases += import_module(f"{__package__}.cases_{group}").cases()
    return [case for case in cases if not (quick and case.heavy)]


def run_case(case: Case) -> Row:
    """Run one case. A crash of the code under test, even a refusal that the case did not name, is a FAIL."""
    started = time.process_time()
    try:
        with np.errstate(all="ignore"):
            outcome = case.run()
    except _CRASHES as error:
        outcome = Outcome(None, note=f"{type(error).__name__}: {error}")
        verdict, against = Verdict.FAIL, f"ended in {outcome.note}"
    else:
        verdict, against = judge(case, outcome)
    return Row(case, outcome, verdict, against, time.process_time() - started)


def run_cases(cases: Sequence[Case], done: Callable[[Row], None] = lambda _: None) -> list[Row]:
    """Run cases in order; ``done`` is called with each row."""
    rows = []
    for case in cases:
        rows.append(run_case(case))
        done(rows[-1])
    return rows
