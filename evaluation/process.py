"""What a command that scores sets up in its own process; together it halves the time of scoring a test split.

A library must not do this to its caller's process, so nothing here runs on import.
"""

import gc
import os
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
_KEPT_BYTES = 1 << 30


def prepare_process() -> None:
    """Keep freed memory, look for no pydantic plugins, and collect no cyclic garbage.

    - glibc's allocator returns every freed array of an image's size to the system and fetches the next anew, page by
      page, and the page faults take longer than the arithmetic. It is asked to keep up to 1 GiB. Linux only.
    - pydantic reads the metadata of every installed package, in search of plugins that nobody here uses.
    - The garbage collector walks over everything that was imported again and again; scoring leaves no cycles behind.
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
