"""How many threads the linear algebra below NumPy may start.

It reads that from the environment when NumPy is loaded. Left alone it takes every core, also for the small systems of
this package, and its idle threads spin: the work then takes longer, and on a busy machine several times as long.
"""

import os

THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads(threads: int) -> None:
    """Let linear algebra have ``threads``; call it before NumPy is loaded, for later it does nothing."""
    os.environ.update(dict.fromkeys(THREAD_COUNTS, str(max(threads, 1))))
