"""Folders at a URL of any kind that fsspec knows: ``s3://bucket/set``, ``gs://``,
``file:///net/set``."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from fpp_ml_bench.errors import FppBenchError, RemoteError
from fpp_ml_bench.files import cause_of, path_problem, printable

TEMPORARY = ".tmp"
"""Suffix of a file that is not yet whole."""


@dataclass(frozen=True)
class RemoteFolder:
    """A folder at ``url``; every process that holds one opens its own connection. Files are named
    relative to the folder, with ``/``. All methods raise `RemoteError` where the service or the
    network refuses."""

    url: str

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> "RemoteFolder":
        return RemoteFolder(f"{self.url}/{name}")

    def sizes(self) -> dict[str, int]:
        """Bytes of every file below the folder by name; empty where there is no folder."""
        with self._opened("can't be read") as files:
            files.invalidate_cache()
            return {name: int(info["size"]) for name, info in files.find("", detail=True).items()}

    def has(self, name: str) -> bool:
        """Whether a file is there."""
        with self._opened("can't be read") as files:
            return bool(files.exists(name))

    def put(self, file: Path, name: str) -> None:
        """Copy a file there. Under its name it is there whole or not at all."""
        target = PurePosixPath(name)
        temporary = str(target.with_name(f".{target.name}.{uuid4().hex}{TEMPORARY}"))
        with self._opened("can't be written") as files:
            files.makedirs(name.rpartition("/")[0], exist_ok=True)
            files.put_file(str(file), temporary)
            files.mv(temporary, name)

    def get(self, name: str, file: Path) -> None:
        """Copy a file from there; its folder is made. A ``name`` that leaves the folder is
        refused."""
        if problem := path_problem(name):
            raise RemoteError(
                f"{self.url}: holds a file {printable(name)!r}, {problem}; remove it there"
            )
        file.parent.mkdir(parents=True, exist_ok=True)
        with self._opened("can't be read") as files:
            files.get_file(name, str(file))

    def remove(self, name: str) -> None:
        """Remove a file, or a folder with all below it."""
        with self._opened("can't be written") as files:
            files.rm(name, recursive=True)

    @contextmanager
    def _opened(self, failure: str) -> Iterator[Any]:
        """The folder as a file system of its own."""
        from fsspec.core import url_to_fs
        from fsspec.implementations.dirfs import DirFileSystem

        try:
            files, root = url_to_fs(self.url)
            yield DirFileSystem(root.rstrip("/"), files)
        except Exception as error:  # each service raises errors of its own library
            reason = cause_of(error).strip().partition("\n")[0] or type(error).__name__
            raise RemoteError(f"{self.url}: {failure} ({reason})") from error


def place(text: str) -> Path | RemoteFolder:
    """The folder that a command's argument names: a path, or a URL."""
    return RemoteFolder(text.rstrip("/")) if "://" in text else Path(text)


@contextmanager
def working_copy(folder: Path | RemoteFolder) -> Iterator[tuple[Path, Callable[[], None]]]:
    """A local folder to work in, and a function that saves what changed there; a local ``folder``
    is itself. Of a remote one it is a temporary copy, saved at the end in any case, in the order in
    which files were written. Hidden files are not saved."""
    if isinstance(folder, Path):
        yield folder, lambda: None
        return
    with TemporaryDirectory(prefix="fpp-bench-") as temporary:
        copy = Path(temporary)
        for name in folder.sizes():
            folder.get(name, copy / name)
        saved = _stamps(copy)

        def save() -> None:
            nonlocal saved
            stamps = _stamps(copy)
            for name, _ in sorted(stamps.items() - saved.items(), key=itemgetter(1)):
                folder.put(copy / name, name)
            for name in saved.keys() - stamps.keys():
                folder.remove(name)
            saved = stamps

        try:
            yield copy, save
        except FppBenchError as error:
            error.args = tuple(str(arg).replace(str(copy), folder.url) for arg in error.args)
            raise
        finally:
            save()


def _stamps(folder: Path) -> dict[str, tuple[int, int]]:
    """Time of change, ns, and bytes of every file below a folder that is not hidden."""
    paths = [path for path in folder.rglob("[!.]*") if path.is_file()]
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_mtime_ns, path.stat().st_size)
        for path in paths
    }
