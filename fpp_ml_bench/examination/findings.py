"""What an examination finds, as data: a name, how bad it is, the evidence, the likely cause, and
what to change."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from fpp_ml_bench.constants import GREY_LEVELS
from fpp_ml_bench.errors import CaptureError

Severity = Literal["refuse", "warn", "note"]


@dataclass(frozen=True)
class Finding:
    """``severity`` "refuse": the depth can't be trusted; "warn": it is doubtful; "note": it is
    worth knowing. ``evidence`` says what was measured, ``cause`` what most likely made it ("":
    nothing that was tried fits), and ``change`` what to do, a clause each."""

    name: str
    severity: Severity
    evidence: str
    cause: str
    change: str

    def __str__(self) -> str:
        cause = f"probably {self.cause}" if self.cause else "no cause that was tried fits"
        return f"{self.name}: {self.evidence}; {cause}; {self.change}"


@dataclass(frozen=True)
class Examination:
    """The ``findings``, worst first; what the frames of this rig can't tell (``not_checked``);
    ``measured`` figures by name; ``systematic_rad``, by direction, the RMS error of the finest
    phase that the response of projector and camera and an epipolar pattern cause (0 where none
    shows); ``full_grey``: the grey level at which pixels are saturated."""

    findings: tuple[Finding, ...] = ()
    not_checked: tuple[str, ...] = ()
    measured: Mapping[str, float] = field(default_factory=dict)
    systematic_rad: Mapping[str, float] = field(default_factory=dict)
    full_grey: float = GREY_LEVELS

    @property
    def refused(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.severity == "refuse")


class RefusedCapture(CaptureError):
    """A capture whose depth can't be trusted, by its ``examination``; ``where`` names it."""

    def __init__(self, where: str, examination: Examination) -> None:
        self.where, self.examination = where, examination
        listed = "\n  ".join(map(str, examination.refused))
        super().__init__(
            f"{where}: {listed}\n  --anyway goes on all the same; its depth is not to be trusted"
        )

    def __reduce__(self) -> tuple[type["RefusedCapture"], tuple[str, Examination]]:
        return type(self), (self.where, self.examination)  # from worker processes, too
