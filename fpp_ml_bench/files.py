"""Files of any room: text of unknown origin, bounded reading, atomic writing, hashes, locks, and strict YAML."""

import os
import re
import stat
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

from fpp_ml_bench.errors import BuildError, FppBenchError, PredictionError

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


def cause_of(error: Exception) -> str:
    """An error as text, that of the operating system without its number and path."""
    return getattr(error, "strerror", None) or str(error)


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
    """The file and its size in bytes; PredictionError, without the file's name, for anything but a regular file."""
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
    while count := stream.readinto(view[done:]):  # type: ignore[attr-defined]
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


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that it is there complete or not at all, also after a power cut."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_files(folder: Path, contents: Mapping[str, bytes], error_type: type[FppBenchError]) -> list[Path]:
    """Write ``contents`` by file name into ``folder``, which is made if it is missing; returns their paths. Raises
    ``error_type`` for a folder that can't be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in contents.items():
            write_atomically(folder / name, content)
    except OSError as error:
        raise error_type(f"{folder}: can't be written ({error.strerror or error}); choose another folder") from error
    return [folder / name for name in contents]


def file_hash(path: Path) -> str:
    """XXH3 128-bit hash of a file's bytes, hex; a memory map, so a file in the page cache goes at memory speed."""
    import mmap

    import xxhash

    digest = xxhash.xxh3_128()
    if path.stat().st_size:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            view = memoryview(content)
            for start in range(0, len(view), 1 << 24):
                digest.update(view[start : start + (1 << 24)])
            view.release()
    return digest.hexdigest()


@contextmanager
def exclusive(lock_file: Path, folder: Path, activity: str) -> Iterator[None]:
    """Hold ``lock_file``, created with its folder if absent; `BuildError` for ``folder`` if another process has it.
    The operating system releases the lock when the process ends in any way."""
    import filelock

    lock = filelock.FileLock(lock_file, timeout=0)
    try:
        lock_file.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except filelock.Timeout:
        raise BuildError(f"{folder}: another process is {activity}; wait for it or choose another folder") from None
    except OSError as error:
        raise BuildError(f"{folder}: can't be written ({error.strerror or error})") from error
    try:
        yield
    finally:
        lock.release()


@cache
def _strict_loader() -> type:
    import yaml

    class StrictLoader(yaml.SafeLoader):
        """SafeLoader without aliases, without duplicate keys, and with 1e-3 read as the number it is."""

        def compose_node(self, parent: Any, index: Any) -> Any:
            if self.check_event(yaml.events.AliasEvent):
                mark = self.peek_event().start_mark
                raise yaml.YAMLError(f"line {mark.line + 1} uses an alias (*); write the value out")
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            seen = set()
            for key, _ in node.value:
                if not isinstance(key, yaml.ScalarNode) or key.tag != "tag:yaml.org,2002:str":
                    raise yaml.YAMLError(f"line {key.start_mark.line + 1}: expected text as key")
                if key.value in seen:
                    line, name = key.start_mark.line + 1, printable(key.value, 60)
                    raise yaml.YAMLError(f"line {line}: key {name!r} is given twice")
                seen.add(key.value)
            return super().construct_mapping(node, deep=deep)

    StrictLoader.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(r"^[-+]?\d+(\.\d*)?[eE][-+]?\d+$"), list("-+0123456789")
    )
    return StrictLoader


def strict_yaml(text: str) -> Any:
    """The plain values of a YAML text. Raises ``yaml.YAMLError``, also for an alias or a key given twice."""
    import yaml

    return yaml.load(text, _strict_loader())  # a subclass of SafeLoader: builds plain values only
