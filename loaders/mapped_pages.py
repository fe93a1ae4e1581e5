"""Letting go of the pages of a memory-mapped file, so that a long run does not gather the whole file in its memory.

What a process has read of a map counts as its memory until the map is closed or the machine is short of memory:
scoring 300 samples would end with all their depth maps resident. `let_go` tells the kernel (madvise(2), MADV_DONTNEED)
that this process is done with some pages. They stay in the page cache, and views of them stay valid: reading one again
maps it again.
"""

import ctypes
import mmap
import sys
from functools import cache
from typing import Any

from numpy.typing import NDArray

_MADV_DONTNEED = 4
FAULT_AROUND_BYTES = 1 << 16
"""A page fault on a file maps its neighbours too, in aligned windows of this size (Linux's default)."""


@cache
def _madvise() -> Any:
    if not sys.platform.startswith("linux"):
        return None
    function = getattr(ctypes.CDLL(None), "madvise", None)
    if function is not None:
        function.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    return function


def let_go(view: NDArray[Any], address: int, length: int) -> None:
    """Let go of the pages that ``view``, a contiguous array, lies on, and of those that came with them.

    ``address`` and ``length`` (bytes) are those of the whole READ-ONLY FILE map that ``view`` lies in: nothing outside
    is touched, which matters, because the same call empties memory that is not backed by a file. Elsewhere than on
    Linux, or for a view that does not lie in the map, nothing happens.
    """
    madvise = _madvise()
    start = view.ctypes.data
    stop = start + view.nbytes
    if madvise is None or not view.nbytes or start < address or stop > address + length:
        return
    page = mmap.PAGESIZE
    first = max(start // FAULT_AROUND_BYTES * FAULT_AROUND_BYTES, address // page * page)
    last = min(-(-stop // FAULT_AROUND_BYTES) * FAULT_AROUND_BYTES, -(-(address + length) // page) * page)
    madvise(first, last - first, _MADV_DONTNEED)
