"""Writing without the page cache: all bytes, the right hash, and errors of the disk."""

import errno
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import xxhash
from disks import small_disk

from fpp_ml_bench.loaders.storage import shards
from fpp_ml_bench.loaders.storage.shards import DirectFile

BLOCK = 1 << 16


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of 64 KiB, so that a few hundred kB fill every block several times."""
    monkeypatch.setattr(shards, "BLOCK_BYTES", BLOCK)


def noise(size, seed=0):
    return np.random.default_rng(seed).bytes(size)


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def write(path, pieces):
    with ThreadPoolExecutor(1) as thread, ExitStack() as at_the_end:
        file = DirectFile(path, thread)
        at_the_end.callback(file.close)  # again, after the close below, or after an error
        for piece in pieces:
            assert file.write(piece) == memoryview(piece).nbytes
        file.close()
    assert file.closed
    return file


@pytest.mark.parametrize(
    "size", [0, 1, 511, 512, 4096, BLOCK - 1, BLOCK, BLOCK + 1, 4 * BLOCK, 9 * BLOCK, 9 * BLOCK + 777]
)
def test_content_size_and_hash(tmp_path, small_blocks, size):
    content = noise(size)
    file = write(tmp_path / "x", [content])
    assert (tmp_path / "x").read_bytes() == content
    assert (file.size, file.xxh3_128) == (size, xxhash.xxh3_128_hexdigest(content))


def test_pieces_of_any_size_and_type(tmp_path, small_blocks):
    rng = np.random.default_rng(1)
    pieces = [noise(int(n), i) for i, n in enumerate(rng.integers(0, 2 * BLOCK, 40))]
    array = rng.random((30, 1000)).astype(np.float32)
    file = write(tmp_path / "x", [*pieces, array, memoryview(b"end"), bytearray(b"!")])
    content = b"".join(pieces) + array.tobytes() + b"end!"
    assert (tmp_path / "x").read_bytes() == content and file.xxh3_128 == xxhash.xxh3_128_hexdigest(content)


def test_a_block_is_not_filled_again_before_the_slow_disk_has_it(tmp_path, small_blocks, monkeypatch):
    write_block = shards._write_block

    def slow(descriptor, view):
        time.sleep(0.005)
        write_block(descriptor, view)

    monkeypatch.setattr(shards, "_write_block", slow)
    content = noise(20 * BLOCK + 5)
    write(tmp_path / "x", [content])
    assert (tmp_path / "x").read_bytes() == content


def test_several_files_share_a_thread(tmp_path, small_blocks):
    contents = [noise(5 * BLOCK + i, i) for i in range(4)]
    with ThreadPoolExecutor(1) as thread:
        files = [DirectFile(tmp_path / str(i), thread) for i in range(4)]
        for start in range(0, 6 * BLOCK, 10_000):
            for file, content in zip(files, contents, strict=True):
                file.write(content[start : start + 10_000])
        for file in files:
            file.close()
    assert [(tmp_path / str(i)).read_bytes() for i in range(4)] == contents


@pytest.mark.parametrize("refusing", ["open", "write", "never"])
def test_file_systems_without_direct_writes(tmp_path, small_blocks, monkeypatch, refusing):
    opened, written = os.open, os.write

    def no_direct_open(path, flags, *more):
        if refusing == "open" and flags & os.O_DIRECT:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return opened(path, flags, *more)

    def no_direct_write(descriptor, data):
        import fcntl

        if refusing == "write" and fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_DIRECT:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))
        return written(descriptor, data)

    monkeypatch.setattr(os, "open", no_direct_open)
    monkeypatch.setattr(os, "write", no_direct_write)
    content = noise(7 * BLOCK + 100)
    write(tmp_path / "x", [content])
    assert (tmp_path / "x").read_bytes() == content


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_errors_of_the_disk_arrive(tmp_path, small_blocks, monkeypatch, number):
    calls, written = [], os.write

    def fails_later(descriptor, data):
        calls.append(len(data))
        if len(calls) == 3:
            raise OSError(number, os.strerror(number))
        return written(descriptor, data)

    monkeypatch.setattr(os, "write", fails_later)
    descriptors = open_files()
    with ThreadPoolExecutor(1) as thread:
        file = DirectFile(tmp_path / "x", thread)
        with pytest.raises(OSError) as caught:
            file.write(noise(12 * BLOCK))
            file.close()
        if not file.closed:
            file.close()
    assert caught.value.errno == number
    assert open_files() == descriptors


def test_short_writes_are_completed(tmp_path, small_blocks, monkeypatch):
    written = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: written(descriptor, data[: max(4096, len(data) // 2)]))
    content = noise(3 * BLOCK + 99)
    write(tmp_path / "x", [content])
    assert (tmp_path / "x").read_bytes() == content


def test_really_full_disk(tmp_path, small_blocks):
    with small_disk(tmp_path / "disk", "400k") as disk, pytest.raises(OSError, match="No space left"):
        write(disk / "x", [noise(1 << 20)])
