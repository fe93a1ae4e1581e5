"""Stability cases: how they are declared, run, judged and reported: JSON with every case, and a
picture of them all.

A case runs a computation of the benchmark where it is ill-conditioned, and compares it with a
reliable reference: 50-digit arithmetic, a closed form, or exact sums. The error is compared with a
bound from theory: a condition number times the unit round-off, or the propagation of noise and
quantisation. The bound comes from the derivation that the case states, never from the measured
error.
"""

import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fpp_ml_bench.errors import FppBenchError, StabilityError
from fpp_ml_bench.evaluation.result.file import environment, write_file, write_json
from fpp_ml_bench.style import figure, figure_png, styled

Expects = Literal["number", "refusal", "either"]
Run = Callable[..., "Outcome"]
Floats = NDArray[np.float64]

U64 = 2.0**-53
"""Unit round-off of float64."""
U32 = 2.0**-24
"""Unit round-off of float32."""
GROUPS = {
    "phase": "frames",
    "order": "frames",
    "triangulation": "geometry",
    "rig": "geometry",
    "normalisation": "scores",
    "metrics": "scores",
    "networks": "networks",
    "scenes": "geometry",
    "crossed": "frames",
}
"""Groups of cases, and the module that declares them; only ``networks`` imports torch."""
VERDICTS = {"within": "#2f9470", "flagged": "#8d96a0", "FAIL": "#d1242f"}
"""The verdicts of a case, and their colours: the error is within its bound; correctly refused, by
an exception or an invalid mask; anything else."""
_SMALLEST_RATIO = 1e-6
"""What the picture shows of smaller ones."""


@dataclass(frozen=True)
class Outcome:
    """The measurement of a case at its worst element, which has the largest error / bound.
    ``error`` is None where the code refused to compute; ``note`` then holds its message.
    ``flagged_share``: share of elements that were refused. ``condition``: the condition number
    behind the bound, if any."""

    error: float | None
    bound: float = 0.0
    flagged_share: float = 0.0
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
    return Outcome(math.inf, note=note)


@dataclass(frozen=True)
class Case:
    """An ill-conditioned or extreme case. ``run`` gives the `Outcome` for the ``parameters``.
    ``computes``, ``reference`` and ``predicts`` describe in a line each what is computed, its
    reference, and how the bound is derived. ``expects``: a number, a refusal (an `FppBenchError`,
    or every element masked), or either. ``heavy`` cases take seconds or gigabytes and are left out
    of a quick run."""

    group: str
    family: str
    parameters: Mapping[str, float | str]
    computes: str
    reference: str
    predicts: str
    unit: str
    run: Run = field(repr=False)
    expects: Expects = "number"
    heavy: bool = False

    @property
    def name(self) -> str:
        """``family, parameter value, ...``"""
        return ", ".join(
            [self.family, *(f"{key} {value}" for key, value in self.parameters.items())]
        )


CASES: list[Case] = []
"""The cases of all modules of `GROUPS` that have been imported."""


def family(
    group: str,
    name: str,
    unit: str,
    /,
    *,
    against: str,
    bound: str,
    expects: Expects | Callable[..., Expects] = "number",
    heavy: Callable[..., bool] = lambda **_: False,
    **grid: Iterable[float | str],
) -> Callable[[Run], Run]:
    """Declare a function as a family of `CASES`: a case for each combination of the grid's values,
    which the function, ``expects`` and ``heavy`` get by name. Its docstring says what it computes,
    ``against`` what reference, and ``bound`` how theory predicts the error."""

    def declare(run: Run) -> Run:
        computes = " ".join((run.__doc__ or "").split())
        for values in product(*grid.values()):
            given = dict(zip(grid, values, strict=True))
            expected = expects(**given) if callable(expects) else expects
            CASES.append(
                Case(
                    group,
                    name,
                    given,
                    computes,
                    against,
                    bound,
                    unit,
                    run,
                    expected,
                    heavy(**given),
                )
            )
        return run

    return declare


def all_cases(groups: Iterable[str] = tuple(GROUPS), quick: bool = False) -> list[Case]:
    """The cases of ``groups``, without the heavy ones when ``quick``. Raises `StabilityError`."""
    cases: list[Case] = []
    for group in groups:
        if group not in GROUPS:
            raise StabilityError(f"unknown group {group!r}; there are {', '.join(GROUPS)}")
        import_module(f"{__package__}.{GROUPS[group]}")
        cases += [case for case in CASES if case.group == group and not (quick and case.heavy)]
    return cases


@dataclass(frozen=True)
class Row:
    """A case with its outcome; ``against`` is the reason where it failed, ``cpu_seconds`` the
    processor time of all threads, so that a busy machine does not show."""

    case: Case
    outcome: Outcome
    against: str
    cpu_seconds: float

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        return "FAIL" if self.against else "flagged" if self.outcome.error is None else "within"


def run_cases(cases: Sequence[Case], done: Callable[[Row], None] = lambda _: None) -> list[Row]:
    """Run cases in order; ``done`` is called with each row. An error of the package is a refusal,
    any other exception of the code under test a FAIL, which does not end the run."""
    rows = []
    for case in cases:
        started = time.process_time()
        try:
            with np.errstate(all="ignore"):
                outcome = case.run(**case.parameters)
        except FppBenchError as error:
            outcome = Outcome(None, flagged_share=1.0, note=str(error))
        except Exception as error:
            outcome = wrong(f"{type(error).__name__}: {error}")
        rows.append(Row(case, outcome, judge(case, outcome), time.process_time() - started))
        done(rows[-1])
    return rows


def judge(case: Case, outcome: Outcome) -> str:
    """Why a case fails; nothing where it does not."""
    if outcome.error is None:
        return f"refused what can be computed: {outcome.note}" if case.expects == "number" else ""
    if not math.isfinite(outcome.bound):
        return "theory predicts no finite error, so the number is meaningless and should be refused"
    if not outcome.error <= outcome.bound:  # NaN is not
        return (
            f"error {outcome.error:.3g} exceeds its bound "
            f"{outcome.bound:.3g}{outcome.note and f': {outcome.note}'}"
        )
    if case.expects == "refusal":
        return "gave a number where there is none"
    if case.expects == "number" and outcome.flagged_share:
        return f"refused {outcome.flagged_share:.2%} of what can be computed"
    return ""


def worst(
    errors: ArrayLike,
    bounds: ArrayLike = 0.0,
    flagged: ArrayLike = False,
    condition: ArrayLike | None = None,
) -> Outcome:
    """The outcome of many elements: the worst of those that are not flagged, and the largest of
    their ``condition`` numbers. NaN errors stay NaN."""
    largest = None if condition is None else float(np.max(condition))
    parts = np.broadcast_arrays(
        np.abs(np.asarray(errors, float)), np.asarray(bounds, float), np.asarray(flagged)
    )
    error, bound, refused = (np.ravel(part) for part in parts)
    if refused.all():
        return Outcome(None, 0.0, 1.0, "every element is masked", largest)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error == 0, 0.0, error / bound)
    index = int(np.argmax(np.where(refused, -1.0, ratio)))  # the first NaN, if any
    return Outcome(
        float(error[index]), float(bound[index]), float(refused.mean()), condition=largest
    )


@cache
def high_precision() -> Any:
    """A separate mpmath context of 50 digits, so that the global precision does not change."""
    import mpmath

    context = mpmath.MPContext()
    context.dps = 50
    return context


def wide(values: ArrayLike) -> NDArray[np.object_]:
    """Numbers as an array of mpmath's, with which NumPy's operators compute in 50 digits."""
    return np.asarray(np.frompyfunc(high_precision().mpf, 1, 1)(np.asarray(values, float)))


def minus_arctangent2(
    sine: NDArray[np.object_], cosine: NDArray[np.object_]
) -> NDArray[np.object_]:
    """-atan2 of mpmath's numbers, in 50 digits."""
    return -np.frompyfunc(high_precision().atan2, 2, 1)(sine, cosine)


def difference(values: NDArray, exact: NDArray[np.object_]) -> Floats:
    """``values`` minus high-precision numbers, subtracted before it is rounded."""
    return (wide(values) - exact).astype(np.float64)


def gamma(operations: float, unit: float = U64) -> float:
    """Largest relative error of ``operations`` roundings in a row: n u / (1 - n u)  (Higham, Lemma
    3.1)."""
    return operations * unit / (1 - operations * unit)


def summary(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """By group, and under "all": cases per verdict, the largest error / bound (None where nothing
    was computed), and processor time."""
    groups: dict[str, dict[str, Any]] = {}
    for group in [*dict.fromkeys(row.case.group for row in rows), "all"]:
        part = [row for row in rows if group in (row.case.group, "all")]
        ratios = [row.outcome.ratio for row in part if row.outcome.ratio is not None]
        groups[group] = {
            "cases": len(part),
            **{verdict: sum(row.verdict == verdict for row in part) for verdict in VERDICTS},
            "largest_ratio": max(ratios, default=None),
            "cpu_seconds": round(sum(row.cpu_seconds for row in part), 2),
        }
    return groups


def document(rows: Sequence[Row]) -> dict[str, Any]:
    """The whole run as JSON values; NaN and infinity by name."""
    cases = []
    for row in rows:
        content = {
            **vars(row.case),
            "verdict": row.verdict,
            **vars(row.outcome),
            "ratio": row.outcome.ratio,
        }
        content |= {"against": row.against, "cpu_seconds": round(row.cpu_seconds, 3)}
        cases.append({key: value for key, value in content.items() if key not in ("run", "heavy")})
    content = {
        "schema_version": "1.0.0",
        "summary": summary(rows),
        "environment": environment().model_dump(mode="json"),
        "cases": cases,
    }
    named: dict[str, Any] = json.loads(
        json.dumps(content), parse_constant=lambda name: str(float(name))
    )
    return named


@styled
def picture(rows: Sequence[Row]) -> bytes:
    """PNG: a line for each family, and on it error / bound of each of its cases; flagged ones,
    which have none, stand at 0, at the left."""
    families = list(dict.fromkeys((row.case.group, row.case.family) for row in rows))
    drawn = figure(8, 0.19 * len(families) + 1)
    axes = drawn.subplots()
    for verdict, colour in VERDICTS.items():
        part = [row for row in rows if row.verdict == verdict]
        ratios = [np.clip(row.outcome.ratio or 0, _SMALLEST_RATIO, 1e3) for row in part]
        places = [families.index((row.case.group, row.case.family)) for row in part]
        marker = "x" if verdict == "flagged" else "o"
        axes.plot(
            ratios,
            places,
            marker,
            color=colour,
            alpha=0.6,
            ms=5,
            mew=1,
            label=f"{verdict}: {len(part)}",
        )
    axes.axvline(1, color=VERDICTS["FAIL"], lw=1)
    axes.set(
        xscale="log",
        xlabel="error / bound; smaller ones, 0, and what was refused stand at the left edge",
    )
    axes.set_yticks(range(len(families)), map(": ".join, families))
    axes.margins(y=0.01)
    axes.invert_yaxis()
    axes.grid(lw=0.5)
    drawn.legend(ncols=3, loc="outside upper center")
    return figure_png(drawn, reduced=True)


def write_report(rows: Sequence[Row], folder: Path) -> list[Path]:
    """Write the data and the picture into ``folder``, which is made; their paths. Raises
    `SubmissionError`."""
    data, image = folder / "stability.json", folder / "stability.png"
    write_file(picture(rows), image, new_folder=True)
    write_json(document(rows), data)
    return [data, image]
