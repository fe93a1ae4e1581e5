"""The switch for skipping: leaving out work that a scene does not need (the default), or doing all
of it.

The results are the same bit by bit either way. ``FPP_BENCH_SKIP=0`` in the environment switches
skipping off, to measure its gain or to exclude it as the cause of a problem.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

SWITCH = "FPP_BENCH_SKIP"


def skipping_enabled() -> bool:
    """Whether work that a scene does not need is left out; reads ``FPP_BENCH_SKIP`` on every
    call."""
    return os.environ.get(SWITCH, "1") != "0"


@contextmanager
def skipping(enabled: bool) -> Iterator[None]:
    """Switch skipping on or off inside the block, for this process and the processes it starts."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "1" if enabled else "0"
    try:
        yield
    finally:
        os.environ.pop(SWITCH, None)
        if before is not None:
            os.environ[SWITCH] = before


@dataclass(frozen=True)
class LeftOut:
    """A kind of work, ``what``: ``done`` and ``left_out`` count ``unit``; ``bytes_saved`` neither
    read nor written (None: none involved); ``counted``: on which part of the data, and scaled up
    from it ("": on all)."""

    what: str
    unit: str
    done: int
    left_out: int
    bytes_saved: int | None = None
    counted: str = ""

    @property
    def share(self) -> float:
        total = self.done + self.left_out
        return self.left_out / total if total else 0.0


@dataclass(frozen=True)
class Explanation:
    """The account of a run. ``skipping`` False: nothing was left out, and the lines count what
    would have been."""

    command: str
    subject: str
    lines: tuple[LeftOut, ...]
    skipping: bool

    def to_dict(self) -> dict[str, Any]:
        return {
            "command": self.command,
            "subject": self.subject,
            "skipping": self.skipping,
            "left_out": [{**asdict(line), "share": round(line.share, 6)} for line in self.lines],
            "bytes_saved": sum(line.bytes_saved or 0 for line in self.lines),
        }


def explained(command: str, subject: str, lines: list[LeftOut]) -> Explanation:
    """The account of a run, with skipping as switched in this process; lines with nothing left out
    are dropped."""
    return Explanation(
        command, subject, tuple(line for line in lines if line.left_out), skipping_enabled()
    )
