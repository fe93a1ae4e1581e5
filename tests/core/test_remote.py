"""Folders at a URL, on fsspec's file system in memory."""

from pathlib import Path
from uuid import uuid4

import pytest

from fpp_ml_bench.errors import RemoteError
from fpp_ml_bench.remote import RemoteFolder, place, working_copy


@pytest.fixture
def remote():
    return RemoteFolder(f"memory://{uuid4().hex}")


def test_an_argument_is_a_path_or_a_url():
    assert place("data/set") == Path("data/set")
    assert (
        place("s3://bucket/set/") == RemoteFolder("s3://bucket/set")
        and str(place("s3://b/s")) == "s3://b/s"
    )


@pytest.mark.parametrize("kind", ["memory", "file"])
def test_files_go_and_come_whole(kind, tmp_path):
    remote = RemoteFolder(
        f"memory://{uuid4().hex}" if kind == "memory" else (tmp_path / "there").as_uri()
    )
    assert remote.sizes() == {} and not remote.has("a/b.bin")
    file = tmp_path / "file"
    for content in (b"first", b"second one"):
        file.write_bytes(content)
        remote.put(file, "a/b.bin")
        assert remote.sizes() == {"a/b.bin": len(content)} and remote.has("a/b.bin")
    remote.get("a/b.bin", tmp_path / "deep" / "copy")
    assert (tmp_path / "deep" / "copy").read_bytes() == b"second one"
    remote.remove("a")
    assert remote.sizes() == {}


def test_a_url_that_fails_is_named(tmp_path):
    with pytest.raises(
        RemoteError, match=r"nosuch://bucket: can't be read \(Protocol not known: nosuch\)"
    ):
        RemoteFolder("nosuch://bucket").sizes()
    file = tmp_path / "file"
    file.write_bytes(b"x")
    with pytest.raises(RemoteError, match=r"can't be written \(.*(exists|directory)"):
        RemoteFolder(file.as_uri()).put(file, "a/b.bin")


def test_a_working_copy_saves_what_changed(remote, tmp_path):
    file = tmp_path / "file"
    for name in ("kept", "changed", "sub/removed"):
        file.write_text(name)
        remote.put(file, name)
    with pytest.raises(KeyboardInterrupt), working_copy(remote) as (folder, save):
        (folder / "changed").write_text("other words")
        (folder / ".lock").write_text("")
        save()
        assert remote.sizes() == {"kept": 4, "changed": 11, "sub/removed": 11}
        (folder / "sub/removed").unlink()
        (folder / "sub/new").write_text("new")
        raise KeyboardInterrupt
    assert remote.sizes() == {"kept": 4, "changed": 11, "sub/new": 3}
    with working_copy(tmp_path) as (folder, save):
        save()
        assert folder == tmp_path
