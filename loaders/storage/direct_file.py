"""Writing large files without the page cache, and hashing them meanwhile.

Gigabytes of shards would push everything else out of memory, and copying them into the cache takes longer than
rendering them. Blocks therefore go to the disk directly (``O_DIRECT``) from a separate thread while the next block is
being filled. Where the file system can't do that (tmpfs, some network mounts), the same code writes through the cache.
"""

import errno
import fcntl
import mmap
import os
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import xxhash

BLOCK_BYTES = 1 << 22
_BLOCKS = 4


class DirectFile:
    """A new file for sequential writing, in the form that ``pyarrow.PythonFile`` takes.

    ``thread`` writes the blocks; several files may share it. After `close`, ``size`` bytes with hash ``xxh3_128`` are
    on the disk. Errors of the disk are raised as ``OSError`` by a later `write` or by `close`.
    """

    def __init__(self, path: Path, thread: ThreadPoolExecutor) -> None:
        self._hash = xxhash.xxh3_128()
        self._thread = thread
        # Anonymous maps are page-aligned, as direct writes demand.
        self._blocks = [mmap.mmap(-1, BLOCK_BYTES) for _ in range(_BLOCKS)]
        self._pending: list[Future[None] | None] = [None] * _BLOCKS
        self._current, self._filled = 0, 0
        self.size = 0
        self.closed = False
        self._descriptor = _open_for_writing(path)

    def write(self, data: object) -> int:
        """Append ``data`` (any bytes-like object); returns its length."""
        view = memoryview(data).cast("B")  # type: ignore[arg-type]
        length = len(view)
        self._hash.update(view)
        self.size += length
        while len(view):
            count = min(len(view), BLOCK_BYTES - self._filled)
            self._blocks[self._current][self._filled : self._filled + count] = view[:count]
            self._filled += count
            view = view[count:]
            if self._filled == BLOCK_BYTES:
                self._pending[self._current] = self._thread.submit(
                    _write_block, self._descriptor, memoryview(self._blocks[self._current])
                )
                self._current, self._filled = (self._current + 1) % _BLOCKS, 0
                self._wait(self._current)
        return length

    def _wait(self, block: int) -> None:
        pending, self._pending[block] = self._pending[block], None
        if pending is not None:
            pending.result()

    def flush(self) -> None:
        """Does nothing: full blocks are written at once, and `close` writes the rest."""

    def close(self) -> None:
        """Write the rest and wait until everything is on the disk."""
        if self.closed:
            return
        self.closed = True
        try:
            for block in range(_BLOCKS):
                self._wait(block)
            if self._filled:
                _set_direct(self._descriptor, False)  # the rest is not a whole number of disk blocks
                _write_block(self._descriptor, memoryview(self._blocks[self._current])[: self._filled])
            os.fdatasync(self._descriptor)
        finally:
            for pending in self._pending:
                if pending is not None:
                    pending.exception()  # wait: the thread may still read the block
            os.close(self._descriptor)

    @property
    def xxh3_128(self) -> str:
        """Hash of everything written."""
        return self._hash.hexdigest()


def _open_for_writing(path: Path) -> int:
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    try:
        return os.open(path, flags | getattr(os, "O_DIRECT", 0), 0o644)
    except OSError as error:
        if error.errno != errno.EINVAL:
            raise
        return os.open(path, flags, 0o644)


def _set_direct(descriptor: int, direct: bool) -> None:
    mode = getattr(os, "O_DIRECT", 0)
    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | mode if direct else flags & ~mode)


def _write_block(descriptor: int, view: memoryview) -> None:
    while len(view):
        try:
            done = os.write(descriptor, view)
        except OSError as error:
            direct = fcntl.fcntl(descriptor, fcntl.F_GETFL) & getattr(os, "O_DIRECT", 0)
            if error.errno != errno.EINVAL or not direct:
                raise
            _set_direct(descriptor, False)  # a file system that opens for direct writes and then refuses them
            continue
        view = view[done:]
