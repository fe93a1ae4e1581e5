"""The one switch between leaving out what a scene does not need (the default) and computing it all the same.

Every place that leaves something out asks `skipping_enabled`. The results are bit by bit the same either way (the tests
compare them); what changes is the time, the memory traffic and the number of rays. ``FPP_BENCH_SKIP=0`` in the
environment, or ``--no-skip`` of a command, switches skipping off: to see what it is worth, or to rule it out.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

SWITCH = "FPP_BENCH_SKIP"


def skipping_enabled() -> bool:
    """Whether what a scene does not need is left out; looks at ``FPP_BENCH_SKIP`` on every call."""
    return os.environ.get(SWITCH, "1") != "0"


@contextmanager
def skipping(enabled: bool) -> Iterator[None]:
    """Switch skipping on or off inside, for this process and the ones it starts."""
    before = os.environ.get(SWITCH)
    os.environ[SWITCH] = "1" if enabled else "0"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(SWITCH, None)
        else:
            os.environ[SWITCH] = before
