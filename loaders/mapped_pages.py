"""Releasing the pages of a memory-mapped file, so that a long run does not keep the whole file in memory.

The pages of a map that a process has read count as its memory until the map is closed or memory gets short: after
scoring 300 samples, all their depth maps would be resident. `release_pages` tells the kernel (madvise(2),
MADV_DONTNEED) that this process no longer needs some pages. They stay in the page cache, and views of them stay valid:
reading a page again maps it again.
"""

import ctypes
import mmap
import sys
from functools import cache
from typing import Any

from numpy.typing import NDArray

_MADV_DONTNEED = 4
FAULT_AROUND_BYTES = 1 << 16
"""A page fault on a file also maps the neighbouring pages, in aligned windows of this size (Linux's default)."""


@cache
def _madvise() -> Any:
    if not sys.platform.startswith("linux"):
        return None
    function = getattr(ctypes.CDLL(None), "madvise", None)
    if function is not None:
        function.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int
    return function


def release_pages(view: NDArray[Any], address: int, size: int) -> None:
    """Release the pages that contain ``view``, a contiguous array, and the pages mapped together with them.

    ``address`` and ``size`` (bytes) are those of the whole READ-ONLY FILE map that contains ``view``. No page outside
    is touched: on memory that is not backed by a file, the same call would erase the data. On systems other than Linux,
    or for a view outside the map, this does nothing.
    """
    madvise = _madvise()
    start = view.ctypes.data
    stop = start + view.nbytes
    if madvise is None or not view.nbytes or start < address or stop > address + size:
        return
    page = mmap.PAGESIZE
    begin = max(start // FAULT_AROUND_BYTES * FAULT_AROUND_BYTES, address // page * page)
    end = min(-(-stop // FAULT_AROUND_BYTES) * FAULT_AROUND_BYTES, -(-(address + size) // page) * page)
    madvise(begin, end - begin, _MADV_DONTNEED)
