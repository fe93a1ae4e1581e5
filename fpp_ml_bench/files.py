"""Text of unknown origin (names in submissions, file names, JSON values): how it is checked and printed."""

import os
import stat
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from fpp_ml_bench.errors import PredictionError

NAME_LIMIT = 200
"""Longest text a submission may hold in any one value, in characters."""

# Control, format (bidirectional overrides, zero-width), surrogate, and line or paragraph separators.
_FORBIDDEN = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})


def text_problem(value: str, limit: int = NAME_LIMIT) -> str | None:
    """What is wrong with a one-line text, or None: empty, over ``limit`` characters, or with control characters."""
    if not value.strip():
        return "expected some text, got an empty one"
    if len(value) > limit:
        return f"expected at most {limit} characters, got {len(value)}"
    bad = next((c for c in value if unicodedata.category(c) in _FORBIDDEN), None)
    if bad is not None:
        return f"expected printable text, got the control character U+{ord(bad):04X}"
    return None


def printable(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` as text that is safe in a terminal: control characters escaped, cut at ``limit`` characters."""
    text = value if isinstance(value, str) else repr(value)
    escaped = "".join(
        c if unicodedata.category(c) not in _FORBIDDEN else c.encode("unicode_escape", "backslashreplace").decode()
        for c in text[:limit]
    )
    return escaped + ("..." if len(text) > limit else "")


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
