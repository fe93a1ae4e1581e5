"""Files that are hashed while they are written: all bytes, the right hash, and errors of the disk."""

import errno
from pathlib import Path

import numpy as np
import pytest
import xxhash
from disks import small_disk

from fpp_ml_bench.loaders.storage import shards
from fpp_ml_bench.loaders.storage.shards import HashedFile


def noise(size, seed=0):
    return np.random.default_rng(seed).bytes(size)


def open_files():
    return len(list(Path("/proc/self/fd").iterdir()))


def write(path, pieces):
    file = HashedFile(path)
    try:
        for piece in pieces:
            assert file.write(piece) == memoryview(piece).nbytes
        file.close()
    finally:
        file.close()  # again, or after an error
    assert file.closed
    return file


@pytest.mark.parametrize("size", [0, 1, 511, 4096, 1 << 20, 9_000_001])
def test_content_size_and_hash(tmp_path, size):
    content = noise(size)
    file = write(tmp_path / "x", [content])
    assert (tmp_path / "x").read_bytes() == content
    assert (file.size, file.xxh3_128) == (size, xxhash.xxh3_128_hexdigest(content))


def test_pieces_of_any_size_and_type(tmp_path):
    rng = np.random.default_rng(1)
    pieces = [noise(int(n), i) for i, n in enumerate(rng.integers(0, 100_000, 40))]
    array = rng.random((30, 1000)).astype(np.float32)
    file = write(tmp_path / "x", [*pieces, array, memoryview(b"end"), bytearray(b"!")])
    content = b"".join(pieces) + array.tobytes() + b"end!"
    assert (tmp_path / "x").read_bytes() == content and file.xxh3_128 == xxhash.xxh3_128_hexdigest(content)


def test_short_writes_are_completed(tmp_path):
    class Short:
        def __init__(self, file):
            self.file = file

        def write(self, view):
            return self.file.write(view[: max(4096, len(view) // 2)])

        def __getattr__(self, name):
            return getattr(self.file, name)

    file = HashedFile(tmp_path / "x")
    file._file = Short(file._file)
    content = noise(300_099)
    assert file.write(content) == len(content)
    file.close()
    assert (tmp_path / "x").read_bytes() == content


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EIO, errno.EDQUOT])
def test_errors_of_the_disk_arrive(tmp_path, monkeypatch, number):
    def fails(descriptor):
        raise OSError(number, "")

    monkeypatch.setattr(shards.os, "fdatasync", fails)
    descriptors = open_files()
    with pytest.raises(OSError) as caught:
        write(tmp_path / "x", [noise(100_000)])
    assert caught.value.errno == number
    assert open_files() == descriptors


def test_really_full_disk(tmp_path):
    with small_disk(tmp_path / "disk", "400k") as disk, pytest.raises(OSError, match="No space left"):
        write(disk / "x", [noise(1 << 20)])
