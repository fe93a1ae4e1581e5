"""Reading a file of unknown origin: only a regular file of bounded size, and no link."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from fpp_ml_bench.errors import PredictionError


@contextmanager
def opened(path: Path) -> Iterator[tuple[IO[bytes], int]]:
    """The file and its size in bytes.

    Raises PredictionError, without the file's name, for anything but a regular file.
    """
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError as error:
        linked = path.is_symlink()
        reason = "is a symbolic link; put the file itself there" if linked else f"can't be read: {error.strerror}"
        raise PredictionError(reason) from None
    info = os.fstat(descriptor)
    if not stat.S_ISREG(info.st_mode):
        os.close(descriptor)
        raise PredictionError("is not a regular file; put the prediction's file there")
    with os.fdopen(descriptor, "rb", buffering=0) as stream:
        yield stream, info.st_size


def fill(stream: IO[Any], view: memoryview) -> int:
    """Fill ``view`` from the stream; the number of bytes read, fewer where the stream ends early."""
    done = 0
    while done < len(view):
        count = stream.readinto(view[done:])  # type: ignore[attr-defined]
        if not count:
            break
        done += count
    return done


def read_bounded(path: Path, limit: int) -> bytes:
    """All bytes of the file at ``path``. Raises PredictionError as `opened`, or when they are more than ``limit``."""
    with opened(path) as (stream, size):
        if size > limit:
            raise PredictionError(f"has {size} bytes, expected at most {limit} for a map of this size; write it again")
        content = bytearray(size)
        length = fill(stream, memoryview(content))
    if length != size:
        raise PredictionError(f"ended early: expected {size} bytes, got {length}; write it again")
    return bytes(content)
