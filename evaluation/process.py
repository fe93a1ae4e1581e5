"""Settings of a scoring command's own process, which save time.

A library must not change its caller's process like this, so nothing here runs on import.
"""

import gc
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 1 << 30


def prepare_process() -> None:
    """Keep freed memory, look for no pydantic plugins, and collect no cyclic garbage.

    - glibc's allocator returns every freed array of an image's size to the system and requests new memory for the next
      one; the page faults take longer than the arithmetic. It is told to keep up to 1 GiB. Linux only.
    - pydantic searches the metadata of every installed package for plugins, and this package uses none.
    - The garbage collector visits every imported object again and again; scoring leaves no reference cycles.
    """
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.disable()
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
