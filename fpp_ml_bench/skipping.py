"""The switch for skipping: leaving out work that a scene does not need (the default), or doing all of it.

The results are the same bit by bit either way. ``FPP_BENCH_SKIP=0`` in the environment switches
skipping off, to measure its gain or to exclude it as the cause of a problem.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from time import process_time
from typing import Any

SWITCH = "FPP_BENCH_SKIP"


def skipping_enabled() -> bool:
    """Whether work that a scene does not need is left out; reads ``FPP_BENCH_SKIP`` on every call."""
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


REPEATS = 3


@dataclass(frozen=True)
class LeftOut:
    """A kind of work, ``what``: ``done`` and ``left_out`` count ``unit``; ``bytes_saved`` neither read nor written
    (None: none involved); ``seconds_saved`` of processor time by ``rule``, or None with the reason in ``rule``."""

    what: str
    unit: str
    done: int
    left_out: int
    bytes_saved: int | None
    seconds_saved: float | None
    rule: str

    @property
    def share(self) -> float:
        total = self.done + self.left_out
        return self.left_out / total if total else 0.0


@dataclass(frozen=True)
class Explanation:
    """The account of a run. ``skipping`` False: nothing was left out, and the lines count what would have been."""

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
            "seconds_saved": sum(line.seconds_saved for line in self.lines if line.seconds_saved is not None),
            "bytes_saved": sum(line.bytes_saved or 0 for line in self.lines),
        }


def explained(command: str, subject: str, lines: list[LeftOut]) -> Explanation:
    """The account of a run, with skipping as switched in this process; lines with nothing left out are dropped."""
    return Explanation(command, subject, tuple(line for line in lines if line.left_out), skipping_enabled())


def _timed(work: Callable[[], object]) -> float:
    started = process_time()
    work()
    return process_time() - started


def seconds_of(work: Callable[[], object]) -> float:
    """Processor seconds of ``work``: the shortest of `REPEATS` calls."""
    return min(_timed(work) for _ in range(REPEATS))


def saved_by(work: Callable[[], object], left_out_here: int, left_out: int) -> float | None:
    """Processor seconds saved by leaving out ``left_out`` units, scaled up from ``work``, which leaves out
    ``left_out_here`` of them. Below 0 where skipping costs more than it saves; None where ``left_out_here`` is 0."""
    if not left_out_here:
        return None
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for enabled in (True, False) * (REPEATS + 1):
        with skipping(enabled):
            seconds[enabled].append(_timed(work))
    on, off = (min(measured[1:]) for measured in seconds.values())  # the first call of each warms up
    return (off - on) * left_out / left_out_here
