"""The switch for skipping: leaving out work that a scene does not need (the default), or doing all of it.

Code that leaves work out checks `skipping_enabled`. The results are the same bit by bit either way (the tests compare
them); only time, memory traffic and the number of rays change. ``FPP_BENCH_SKIP=0`` in the environment, or the option
``--no-skip`` of a command, switches skipping off, to measure its gain or to exclude it as the cause of a problem.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

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
        if before is None:
            os.environ.pop(SWITCH, None)
        else:
            os.environ[SWITCH] = before
