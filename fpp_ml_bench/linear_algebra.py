"""How many threads NumPy's linear algebra library may start.

The library reads the number from the environment when NumPy is loaded. Without it, the library uses every core even for
the small systems of this package, and its idle threads spin: the work takes longer, on a busy machine several times.
"""

import os

THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads(threads: int) -> None:
    """Limit linear algebra to ``threads``; works only before NumPy is loaded."""
    os.environ.update(dict.fromkeys(THREAD_COUNTS, str(max(threads, 1))))
