"""What publishing would change: a folder of staged files compared with the files of a repository on the Hub.

This module uses no network. Files are compared by the hashes that the Hub stores (SHA-256 of a large file, git's hash
of a small file), so a file that the repository already has is never sent again.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha1, sha256
from pathlib import Path
from typing import Any, Literal

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import printable

Kind = Literal["dataset", "space", "model"]
Status = Literal["new", "changed", "unchanged", "deleted"]

MARK = "fpp-bench.json"
"""File that marks a repository as published by this command, and says what it holds: the next run may replace it."""
_HUB_OWN = frozenset({".gitattributes", "README.md"})
"""Files of a repository that was just made on the Hub's web page."""
_CHUNK = 1 << 24


@dataclass(frozen=True)
class Publication:
    """Files staged for a repository; every file below ``folder`` is part of it, hidden files included.

    ``owned`` are folders (ending in ``/``) that only this publication fills: any other file in them is deleted.
    ``message`` is the commit message. With ``must_exist`` no repository is made.
    """

    kind: Kind
    repo: str
    folder: Path
    message: str
    owned: tuple[str, ...] = ()
    must_exist: bool = False


@dataclass(frozen=True)
class RemoteFile:
    """A file in a repository: its bytes, git's hash of it, and its SHA-256 where it is stored as a large file."""

    path: str
    bytes: int
    git_sha1: str
    sha256: str | None = None


@dataclass(frozen=True)
class Remote:
    """The current state of a repository: ``commit`` is None where it does not exist, or this token may not see it."""

    commit: str | None
    private: bool = False
    files: Mapping[str, RemoteFile] = field(default_factory=dict)

    @property
    def exists(self) -> bool:
        return self.commit is not None


@dataclass(frozen=True)
class Change:
    """The change of a file; ``bytes`` is its size after the change, or before it where the file is deleted."""

    status: Status
    path: str
    bytes: int


def mark_bytes(publishes: str, **about: Any) -> bytes:
    """Content of `MARK`: what is published, by which version, and ``about`` (JSON values)."""
    content = {"publishes": publishes, "package": f"fpp-ml-bench {__version__}", **about}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False).encode() + b"\n"


def staged_files(folder: Path) -> dict[str, Path]:
    """Every file below a staged folder by its path in the repository, sorted. Raises `PublishError` for a link."""
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise PublishError(f"{path}: is a symbolic link; put the file itself there")
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = path
    return files


def changes(publication: Publication, remote: Remote) -> list[Change]:
    """What publishing does to each file of ``publication``, sorted by path, and what it deletes.

    Reads every staged file once. Other files of the repository outside ``owned`` stay as they are.
    """
    files = dict(remote.files)
    planned = []
    staged = staged_files(publication.folder)
    for name, path in staged.items():
        remote_file = files.get(name)
        size = path.stat().st_size
        if remote_file is None:
            planned.append(Change("new", name, size))
        else:
            planned.append(Change("unchanged" if _same(path, size, remote_file) else "changed", name, size))
    planned += [
        Change("deleted", name, file.bytes)
        for name, file in files.items()
        if name not in staged and name.startswith(publication.owned or ("\0",))
    ]
    return sorted(planned, key=lambda change: change.path)


def _same(path: Path, size: int, remote_file: RemoteFile) -> bool:
    if remote_file.bytes != size:
        return False
    digest = sha256() if remote_file.sha256 is not None else sha1(f"blob {size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest() == (remote_file.sha256 if remote_file.sha256 is not None else remote_file.git_sha1)


def check_replaceable(publication: Publication, remote: Remote, adopt: bool) -> None:
    """Refuse, with `PublishError`, to write into a repository that this command did not fill, unless ``adopt``."""
    if adopt or publication.kind == "model" or not remote.exists:
        return
    foreign = sorted(set(remote.files) - _HUB_OWN)
    if foreign and MARK not in remote.files:
        named = ", ".join(printable(name, 80) for name in foreign[:3])
        raise PublishError(
            f"{publication.repo}: this {publication.kind} holds {len(foreign)} files that fpp-bench did not publish "
            f"({named}, ...); give the name of a new one, or --adopt to publish into it (nothing is deleted outside "
            f"{', '.join(publication.owned) or 'its own files'})"
        )
