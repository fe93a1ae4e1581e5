"""The switch between compiled (numba) and plain NumPy kernels.

Kernels live in modules of their own that are imported only when `numba_enabled` says so, each beside a NumPy function
that gives the same numbers; ray casting has no such function and is always compiled. The environment variable
``FPP_BENCH_NUMBA=0`` selects NumPy; so does a machine on which numba can't be imported.
"""

import os
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., object])

SWITCH = "FPP_BENCH_NUMBA"


@cache
def _importable() -> bool:
    try:
        import numba  # noqa: F401
    except ImportError:  # numba also raises it for a NumPy version that it does not support
        return False
    return True


def numba_enabled() -> bool:
    """Whether compiled kernels are to be used; reads ``FPP_BENCH_NUMBA`` on every call."""
    return os.environ.get(SWITCH, "1") != "0" and _importable()


def njit(function: Function) -> Function:
    """Compile ``function`` to run without the GIL; the machine code is kept on disk for the next process.

    No ``fastmath``, and no multiplication is fused with an addition: the order of every sum stays as written, so the
    same input gives the same bytes on every processor and for any number of threads. Without numba the function is
    returned as it is (correct and very slow).
    """
    if not _importable():
        return function
    import numba

    compiled: Any
    try:
        compiled = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # neither the package folder nor the user's cache folder can be written
        compiled = numba.njit(nogil=True, error_model="numpy")(function)
    return compiled
