"""What a command left out and what that saved: the account that ``--explain`` prints.

Each line says how much of some unit was done and left out, the bytes that were therefore neither read nor written, and
the seconds, which can't be measured for work that was not done: they come from a rule that the line states.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from time import process_time
from typing import Any

from fpp_ml_bench.skipping import skipping, skipping_enabled

REPEATS = 3


@dataclass(frozen=True)
class LeftOut:
    """One kind of work: ``done`` and ``left_out`` count ``unit``; ``bytes_saved`` neither read nor written, or None
    where bytes are not what it is about; ``seconds_saved`` of processor time by ``rule``, or None with the reason in
    ``rule``."""

    what: str
    unit: str
    done: int
    left_out: int
    bytes_saved: int | None
    seconds_saved: float | None
    rule: str

    @property
    def share(self) -> float:
        """Part of the whole that was left out, 0 to 1."""
        whole = self.done + self.left_out
        return self.left_out / whole if whole else 0.0


@dataclass(frozen=True)
class Explanation:
    """The account of one run. ``skipping`` False: nothing was left out, and the lines say what would have been."""

    command: str
    subject: str
    lines: tuple[LeftOut, ...]
    skipping: bool

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        lines = [{**asdict(line), "share": round(line.share, 6)} for line in self.lines]
        known = [line.seconds_saved for line in self.lines if line.seconds_saved is not None]
        return {
            "command": self.command,
            "subject": self.subject,
            "skipping": self.skipping,
            "left_out": lines,
            "seconds_saved": sum(known),
            "bytes_saved": sum(line.bytes_saved or 0 for line in self.lines),
        }


def explained(command: str, subject: str, lines: list[LeftOut]) -> Explanation:
    """The account of a run in this process's state of the switch; lines of which nothing could be left out go."""
    return Explanation(command, subject, tuple(line for line in lines if line.left_out), skipping_enabled())


def seconds_on_and_off(work: Callable[[], object]) -> tuple[float, float]:
    """Processor seconds of ``work`` with skipping on and off: the least of `REPEATS` calls each, taken in turns."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for number in range(REPEATS + 1):
        for enabled, taken in found.items():
            with skipping(enabled):
                started = process_time()
                work()
                if number:
                    taken.append(process_time() - started)
    return min(found[True]), min(found[False])


def seconds_of(work: Callable[[], object]) -> float:
    """Processor seconds of ``work``: the least of `REPEATS` calls."""
    taken = []
    for _ in range(REPEATS):
        started = process_time()
        work()
        taken.append(process_time() - started)
    return min(taken)


def saved_by(work: Callable[[], object], left_out_here: int, left_out: int) -> float | None:
    """Processor seconds that leaving out ``left_out`` units saved, from what ``left_out_here`` of them save in
    ``work``; may be below 0 where skipping costs more than it saves. None where nothing is left out here."""
    if not left_out_here:
        return None
    on, off = seconds_on_and_off(work)
    return (off - on) * left_out / left_out_here
