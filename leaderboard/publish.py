"""What publishing would change: a folder of staged files against the files that a repository on the Hub has.

No network here. Files are compared by the hashes the Hub itself keeps (SHA-256 of a large file, git's own hash of a
small one), so whatever is already there is never sent again, whoever put it there.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha1, sha256
from pathlib import Path
from typing import Any, Literal

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.evaluation.text import printable

Kind = Literal["dataset", "space", "model"]
Status = Literal["new", "changed", "unchanged", "deleted"]

MARK = "fpp-bench.json"
"""File that says a repository is published by this command, and what of: the next run may replace what it finds."""
_HUB_OWN = frozenset({".gitattributes", "README.md"})
"""What a repository that was just made on the Hub's web page holds."""
_CHUNK = 1 << 24


@dataclass(frozen=True)
class Publication:
    """Files staged for one repository; every file below ``folder`` is part of it, hidden ones included.

    ``owned`` are folders (ending in ``/``) that this publication fills alone: what else is found there is deleted.
    ``message`` becomes the commit's. ``must_exist`` keeps it from making a repository.
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
    """A repository as it stands: ``commit`` is None where there is none yet (or none that this token may see)."""

    commit: str | None
    private: bool = False
    files: Mapping[str, RemoteFile] = field(default_factory=dict)

    @property
    def exists(self) -> bool:
        return self.commit is not None


@dataclass(frozen=True)
class Change:
    """What becomes of one file; ``bytes`` is its size after the change, or before it where it is deleted."""

    status: Status
    path: str
    bytes: int


def mark_bytes(publishes: str, **about: Any) -> bytes:
    """Content of `MARK`: what is published, by which version, and ``about`` (JSON values)."""
    content = {"publishes": publishes, "package": f"fpp-ml-bench {__version__}", **about}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False).encode() + b"\n"


def staged_files(folder: Path) -> dict[str, Path]:
    """Every file below a staged folder by its path in the repository, sorted. Raises `PublishError` for a link."""
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise PublishError(f"{path}: is a symbolic link; put the file itself there")
        if path.is_file():
            found[path.relative_to(folder).as_posix()] = path
    return found


def changes(publication: Publication, remote: Remote) -> list[Change]:
    """What publishing does to each file of ``publication``, sorted by path, and what it deletes.

    Reads every staged file once. Files of the repository outside ``owned`` that aren't part of it stay as they are.
    """
    files = dict(remote.files)
    planned = []
    staged = staged_files(publication.folder)
    for name, path in staged.items():
        there = files.get(name)
        size = path.stat().st_size
        if there is None:
            planned.append(Change("new", name, size))
        else:
            planned.append(Change("unchanged" if _same(path, size, there) else "changed", name, size))
    planned += [
        Change("deleted", name, file.bytes)
        for name, file in files.items()
        if name not in staged and name.startswith(publication.owned or ("\0",))
    ]
    return sorted(planned, key=lambda change: change.path)


def _same(path: Path, size: int, there: RemoteFile) -> bool:
    if there.bytes != size:
        return False
    digest = sha256() if there.sha256 is not None else sha1(f"blob {size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            digest.update(chunk)
    return digest.hexdigest() == (there.sha256 if there.sha256 is not None else there.git_sha1)


def check_replaceable(publication: Publication, remote: Remote, adopt: bool) -> None:
    """Refuse, with `PublishError`, to write into a repository that someone filled in another way, unless ``adopt``."""
    if adopt or publication.kind == "model" or not remote.exists:
        return
    foreign = sorted(set(remote.files) - _HUB_OWN)
    if foreign and MARK not in remote.files:
        shown = ", ".join(printable(name, 80) for name in foreign[:3])
        raise PublishError(
            f"{publication.repo}: this {publication.kind} holds {len(foreign)} files that fpp-bench did not publish "
            f"({shown}, ...); give the name of a new one, or --adopt to publish into it (nothing is deleted outside "
            f"{', '.join(publication.owned) or 'its own files'})"
        )
