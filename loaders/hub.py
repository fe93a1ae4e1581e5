"""Datasets on the Hugging Face Hub. A folder of staged files: what publishing would change, and
sending it. Staging a dataset: Parquet that the Hub's viewer shows, meshes, rig, and the head of the
card. And of a dataset of the published layout the files that an import reads, and downloading them
into the cache of ``huggingface_hub``, where a download that was stopped continues.

Files are compared by the hashes that the Hub stores (SHA-256 of a large file, git's hash of a small
one), so a dry run can tell what would change. Every error of the client becomes a `PublishError`
that says what to do; the client reads ``HF_ENDPOINT``, ``HF_TOKEN`` and ``HF_HUB_OFFLINE`` itself.
"""

import json
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from hashlib import file_digest, sha256
from pathlib import Path
from threading import Thread
from typing import Any, Literal, TypeVar

import cv2
import pyarrow
from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    constants,
    get_token,
    try_to_load_from_cache,
)
from huggingface_hub import errors as hub_errors
from huggingface_hub.hf_api import RepoFile
from huggingface_hub.utils import disable_progress_bars, filter_repo_objects
from huggingface_hub.utils.sha import git_hash

from fpp_ml_bench import __version__
from fpp_ml_bench.constants import FULL_SIZE, REPOSITORY_NAME
from fpp_ml_bench.errors import DatasetError, LayoutError, PublishError, RemoteError
from fpp_ml_bench.files import (
    LOCK_FILE,
    check_space,
    exclusive,
    printable,
    read_json,
    write_atomically,
)
from fpp_ml_bench.loaders.published.importing import Source
from fpp_ml_bench.loaders.published.tree import FRINGE, INFO, RAW_SCANS, TRAINING, VARIANT_FOLDERS
from fpp_ml_bench.loaders.storage.card import NAME, RIG_FILE, front_matter
from fpp_ml_bench.loaders.storage.croissant import FILE as CROISSANT_FILE
from fpp_ml_bench.loaders.storage.croissant import croissant
from fpp_ml_bench.loaders.storage.manifest import GENERATED, MESH_FOLDER, damage_of
from fpp_ml_bench.loaders.storage.parquet import (
    card_configs,
    data_shards,
    overview,
    published_features,
    write_shard,
)
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.rig_file import save_rig
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

T = TypeVar("T")
Kind = Literal["dataset", "space", "model"]
Status = Literal["new", "changed", "unchanged", "deleted"]

MARK = "fpp-bench.json"
"""File that marks a repository as published by this command, and says what it holds: the next run
may replace it."""
ANSWER_S = 45
"""A question to the Hub is answered within so many seconds, or nobody is there; files take as long
as they take."""
_BATCH_FILES = 8
"""Files are sent before the commit so many at a time, for the progress bar."""
_ANSWERS = {
    401: "the Hub does not accept the token (401); run 'hf auth login' again or set another HF_TOKEN",
    403: "the token may not do that (403); it needs write access to this owner and repository",
    404: "no such repository, or this token may not see it (404); check the name",
    409: "somebody else is changing it (409); run the same command again",
    412: "somebody else committed meanwhile (412); run the same command again",
    413: "too large for the Hub (413)",
    429: "too many requests (429); wait some minutes, then run the same command again",
}
PICTURE = "overview.png"
OWNED = ("data/", f"{MESH_FOLDER}/")
_LICENCE = re.compile(r"[a-z0-9][a-z0-9.-]{0,39}")
_IDENTITY, _FILES = "staged.sha256", "files"
_SCAN_FRAMES = f"{RAW_SCANS}/*/A_*.png"
_DEPTH_BYTES = 4


class Unreachable(PublishError, RemoteError):
    """Nothing could be asked of the Hub: no network, or HF_HUB_OFFLINE."""


@dataclass(frozen=True)
class Publication:
    """Files staged for a repository; every file below ``folder`` is part of it, hidden files
    included. ``owned`` are folders (ending in ``/``) that only this publication fills: any other
    file in them is deleted. ``message`` is the commit message. ``whole``: it fills the repository,
    and does not add to one of somebody."""

    kind: Kind
    repo: str
    folder: Path
    message: str
    owned: tuple[str, ...] = ()
    whole: bool = True


@dataclass(frozen=True)
class Remote:
    """The current state of a repository: ``commit`` is None where it does not exist, or this token
    may not see it, or the Hub was not ``asked``."""

    commit: str | None
    private: bool = False
    files: Mapping[str, RepoFile] = field(default_factory=dict)
    asked: bool = True

    @property
    def exists(self) -> bool:
        return self.commit is not None


@dataclass(frozen=True)
class Change:
    """The change of a file; ``bytes`` is its size after the change, or before it where the file is
    deleted."""

    status: Status
    path: str
    bytes: int


def mark_bytes(publishes: str, **about: Any) -> bytes:
    """Content of `MARK`: what is published, by which version, and ``about`` (JSON values)."""
    content = {"publishes": publishes, "package": f"fpp-ml-bench {__version__}", **about}
    return json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False).encode() + b"\n"


def staged_files(folder: Path) -> dict[str, Path]:
    """Every file below a staged folder by its path in the repository, sorted. Raises `PublishError`
    for a link."""
    files: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            raise PublishError(f"{path}: is a symbolic link; put the file itself there")
        if path.is_file():
            files[path.relative_to(folder).as_posix()] = path
    return files


def changes(publication: Publication, remote: Remote) -> list[Change]:
    """What publishing does to each file of ``publication``, sorted by path, and what it deletes.
    Reads every staged file once. Other files of the repository outside ``owned`` stay as they
    are."""
    staged = staged_files(publication.folder)
    planned = [
        Change(_status(at, remote.files.get(name)), name, at.stat().st_size)
        for name, at in staged.items()
    ]
    gone = (
        name for name in remote.files if name not in staged and name.startswith(publication.owned)
    )
    planned += [Change("deleted", name, remote.files[name].size) for name in gone]
    return sorted(planned, key=lambda change: change.path)


def _status(path: Path, stored: RepoFile | None) -> Status:
    if stored is None:
        return "new"
    if stored.lfs is None:
        same = git_hash(path.read_bytes()) == stored.blob_id
    else:
        with path.open("rb") as file:
            same = file_digest(file, "sha256").hexdigest() == stored.lfs.sha256
    return "unchanged" if same else "changed"


def check_replaceable(publication: Publication, remote: Remote, adopt: bool) -> None:
    """Refuse, with `PublishError`, to write into a repository that this command did not fill,
    unless ``adopt``."""
    if adopt or not publication.whole or not remote.exists:
        return
    foreign = sorted(
        set(remote.files) - {".gitattributes", "README.md"}
    )  # of one just made on the Hub's web page
    if foreign and MARK not in remote.files:
        named = ", ".join(printable(name, 80) for name in foreign[:3])
        raise PublishError(
            f"{publication.repo}: this {publication.kind} holds {len(foreign)} files that "
            f"fpp-bench did not publish "
            f"({named}, ...); give the name of a new one, or --adopt to publish into it (nothing "
            f"is deleted outside "
            f"{', '.join(publication.owned) or 'its own files'})"
        )


def check_repo_name(repo: str) -> str:
    """``repo`` itself when it is an OWNER/NAME that the Hub can have, else `PublishError`."""
    if not REPOSITORY_NAME.fullmatch(repo):
        raise PublishError(
            f"expected a repository as OWNER/NAME (letters, digits, '-', '_', '.'), got "
            f"{printable(repo, 80)!r}"
        )
    return repo


class Hub:
    """A connection to the Hub. Its constructor uses no network. Errors are `PublishError`, or,
    where nothing is to be sent, `RemoteError`."""

    def __init__(self, sending: bool = True) -> None:
        if sending:
            disable_progress_bars()  # ours shows all files together
        self._error = PublishError if sending else RemoteError
        self._participle, self._continues = (
            ("sent", "it sends only what is missing")
            if sending
            else ("downloaded", "it continues where it stopped")
        )
        self._api = HfApi(library_name="fpp-ml-bench", library_version=__version__)
        self.endpoint: str = self._api.endpoint
        if not self.endpoint.startswith(("https://", "http://")):
            raise self._error(
                f"HF_ENDPOINT: expected a URL like https://huggingface.co, got {self.endpoint!r}"
            )

    def url(self, kind: Kind, repo: str) -> str:
        return f"{self.endpoint}/{constants.REPO_TYPES_URL_PREFIXES.get(kind, '')}{repo}"

    def check_token(self) -> set[str]:
        """Names that the token may publish under: its user and their organisations. `PublishError`
        without a token."""
        with self._explained("asking who the token belongs to"):
            me = _answer(self._api.whoami)
            return {str(me.get("name"))} | {str(org.get("name")) for org in me.get("orgs") or ()}

    def check_may_create(self, repo: str, names: set[str]) -> None:
        """`PublishError` where the token may not make repositories for the owner of ``repo``."""
        if repo.split("/")[0].lower() not in {name.lower() for name in names}:
            owners = ", ".join(printable(name, 60) for name in sorted(names))
            raise PublishError(
                f"{repo}: does not exist, and this token may make repositories of {owners} only"
            )

    def state(self, kind: Kind, repo: str, revision: str | None = None) -> Remote:
        """A repository's commit, visibility and files at a branch, tag or commit, by default on its
        main branch; a `Remote` without a commit where no repository is visible."""
        with self._explained(f"reading {kind} {repo}"):
            try:
                info = _answer(lambda: self._api.repo_info(repo, repo_type=kind, revision=revision))
            except hub_errors.RevisionNotFoundError as error:
                raise self._error(
                    f"{repo}: has no branch, tag or commit {printable(revision, 60)!r}"
                ) from error
            except hub_errors.GatedRepoError:
                raise
            except hub_errors.RepositoryNotFoundError as error:
                # Without a token the Hub answers 401, not 404, for a repository that is private or
                # missing.
                if error.response.status_code == 401 and get_token():
                    raise
                return Remote(None)
            tree = partial(
                self._api.list_repo_tree, repo, repo_type=kind, recursive=True, revision=info.sha
            )
            files = {
                entry.path: entry
                for entry in _answer(lambda: list(tree()))
                if isinstance(entry, RepoFile)
            }
            if not all(
                isinstance(name, str) and isinstance(file.size, int) for name, file in files.items()
            ):
                raise TypeError("files without names or sizes")
            return Remote(info.sha or "", bool(info.private), files)

    def download(self, repo: str, commit: str, patterns: list[str], kind: Kind = "dataset") -> Path:
        """Download files of a repository whose names match ``patterns`` into the client's cache,
        but for those that are there; returns the folder of the commit in the cache."""
        with self._explained(f"downloading {kind} {repo}"):
            folder = self._api.snapshot_download(
                repo, repo_type=kind, revision=commit, allow_patterns=patterns
            )
        return Path(folder)

    def mark(self, kind: Kind, repo: str, remote: Remote) -> dict[str, Any]:
        """Content of `MARK` in a repository; `PublishError` where the file is missing or
        damaged."""
        if not remote.exists:
            raise PublishError(
                f"{repo}: no such {kind} on {self.endpoint}, or this token may not see it; check "
                f"the name, or publish "
                f"it first: fpp-bench publish {kind} ... --repo {repo}"
            )
        if MARK not in remote.files or remote.files[MARK].size > 1 << 20:
            raise PublishError(
                f"{repo}: this {kind} was not published by fpp-bench (no {MARK} there)"
            )
        with (
            tempfile.TemporaryDirectory() as cache,
            self._explained(f"reading {MARK} of {kind} {repo}"),
        ):
            download = partial(
                self._api.hf_hub_download, repo, MARK, repo_type=kind, revision=remote.commit
            )
            path = _answer(lambda: download(cache_dir=cache))
            about = read_json(
                Path(path), PublishError, f"it is of {repo}: publish the {kind} again"
            )
        return about if isinstance(about, dict) else {}

    def send(
        self,
        publication: Publication,
        changes: list[Change],
        remote: Remote,
        private: bool,
        sent: Callable[[int], None],
    ) -> str:
        """Make the repository where there is none, send new and changed files, and commit; returns
        the commit's URL. All files become visible together; a run after an interrupted one sends
        only what is missing. ``sent`` is called with the bytes of each batch. Raises
        `PublishError`, also after a commit by someone else meanwhile."""
        repo, kind = publication.repo, publication.kind
        if not remote.exists:
            with self._explained(f"making {kind} {repo}"):
                make = partial(self._api.create_repo, repo, repo_type=kind, private=private or None)
                _answer(lambda: make(space_sdk="static" if kind == "space" else None))
        with self._explained(f"sending to {kind} {repo}"):
            to_send = [change.path for change in changes if change.status in ("new", "changed")]
            additions = [CommitOperationAdd(path, publication.folder / path) for path in to_send]
            for start in range(0, len(additions), _BATCH_FILES):
                batch = additions[start : start + _BATCH_FILES]
                self._api.preupload_lfs_files(repo, batch, repo_type=kind, free_memory=False)
                sent(sum(addition.upload_info.size for addition in batch))
            deletions = [
                CommitOperationDelete(c.path, is_folder=False)
                for c in changes
                if c.status == "deleted"
            ]
            done = self._api.create_commit(
                repo,
                [*additions, *deletions],
                commit_message=publication.message,
                repo_type=kind,
                parent_commit=remote.commit or None,
            )
        return str(done.commit_url)

    @contextmanager
    def _explained(self, doing: str) -> Iterator[None]:
        try:
            yield
        except hub_errors.OfflineModeIsEnabled as error:
            reason = f"HF_HUB_OFFLINE is set, so nothing may be {self._participle}; unset it"
            raise Unreachable(f"{doing}: {reason}") from error
        except hub_errors.LocalTokenNotFoundError as error:
            raise PublishError(
                f"{doing}: no token for the Hub: run 'hf auth login' once or set HF_TOKEN, with a "
                f"token that may "
                "write; --dry-run needs none for what is public"
            ) from error
        except hub_errors.GatedRepoError as error:
            raise self._error(
                f"{doing}: its owner gives it only to those who accept the conditions on its page "
                f"on {self.endpoint}; "
                "accept them there, then run 'hf auth login' once or set HF_TOKEN"
            ) from error
        except hub_errors.HfHubHTTPError as error:
            status, said = (
                error.response.status_code,
                " ".join((error.server_message or "").split()),
            )
            fault = (
                f"the Hub has a fault ({status}); run the same command again later, "
                f"{self._continues}"
            )
            answer = _ANSWERS.get(status, f"the Hub refused ({status})") if status < 500 else fault
            raise self._error(
                f"{doing}: {answer}{f'. The Hub says: {printable(said)}' if said else ''}"
            ) from error
        except (hub_errors.HTTPError, hub_errors.LocalEntryNotFoundError) as error:
            cause = error if isinstance(error, hub_errors.HTTPError) else error.__cause__ or error
            raise Unreachable(
                f"{doing}: {self.endpoint} can't be reached "
                f"({printable(str(cause)) or type(cause).__name__}); check "
                f"the network and HF_ENDPOINT, then run the same command again: {self._continues}"
            ) from error
        except TimeoutError as error:
            raise Unreachable(
                f"{doing}: {self.endpoint} gave no answer within {ANSWER_S} s; check the network "
                f"and HF_ENDPOINT"
            ) from error
        except (AttributeError, TypeError, LookupError) as error:
            raise self._error(
                f"{doing}: {self.endpoint} gave an answer that is not one of the Hub "
                f"({printable(str(error))}); check "
                "HF_ENDPOINT, and whether a proxy answers in its place"
            ) from error
        except (ValueError, RuntimeError, OSError) as error:
            # The client's refusals of an answer or a card (ValueError), and its transfer library
            # (RuntimeError).
            lines = " ".join(printable(line) for line in str(error).splitlines())
            raise self._error(
                f"{doing}: {lines or type(error).__name__}; run the same command again"
            ) from error


def _answer(question: Callable[[], T]) -> T:
    """What the Hub answers. TimeoutError after `ANSWER_S`: the client itself would wait for
    ever."""
    answer: Future[T] = Future()

    def ask() -> None:
        try:
            answer.set_result(question())
        except BaseException as error:  # raised where the answer is waited for
            answer.set_exception(error)

    Thread(target=ask, daemon=True).start()
    return answer.result(ANSWER_S)


@contextmanager
def staging_folder(chosen: Path | None, identity: str) -> Iterator[Path]:
    """Yield the folder for staged files: a temporary folder, or ``files/`` in ``chosen``, kept for
    the next run. ``identity`` says what is staged. Files that an earlier run left in ``chosen`` are
    kept for the same identity and removed for another. Raises `PublishError` for a folder that
    holds anything else, ``OSError`` for a failed write."""
    if chosen is None:
        with tempfile.TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
            yield Path(folder)
        return
    mark, files = chosen / _IDENTITY, chosen / _FILES
    # With the versions that the bytes of a Parquet file or a PNG depend on.
    writers = f"{__version__} {pyarrow.__version__} {cv2.__version__}"
    expected = sha256(f"{identity}\n{writers}".encode()).hexdigest()
    with exclusive(chosen / LOCK_FILE, chosen, "staging there", PublishError):
        held = (
            mark.read_text(encoding="ascii", errors="replace").strip() if mark.is_file() else None
        )
        if held is None and any(path.name != LOCK_FILE for path in chosen.iterdir()):
            raise PublishError(
                f"--staging {chosen}: holds files that are not of this command; give a new folder"
            )
        if held != expected:
            shutil.rmtree(files, ignore_errors=True)
            write_atomically(mark, f"{expected}\n".encode())
        files.mkdir(exist_ok=True)
        for unfinished in files.rglob(".*.tmp"):  # of a run that was killed
            unfinished.unlink()
        yield files


def dataset_licence(dataset: DatasetFolder, license_id: str | None) -> str:
    """Licence identifier for the card: ``license_id``, or MIT for generated data. `PublishError`
    for other data."""
    origin = dataset.manifest.origin
    if license_id is None and origin != GENERATED:
        raise PublishError(
            f"{dataset.path}: {origin} data; say under which --license it may be shared"
        )
    licence = license_id or "mit"
    if not _LICENCE.fullmatch(licence):
        raise PublishError(
            f"--license: expected an identifier like mit or cc-by-4.0, got {licence!r}"
        )
    return licence


def card_head(dataset: DatasetFolder, licence: str) -> str:
    """Front matter of the card, from which the Hub's viewer and ``load_dataset`` know
    configurations and files."""
    files: dict[str, list[str]] = {split: [] for split in dataset.splits}
    for name, shard in data_shards(dataset).items():
        files[shard.split].append(
            name
        )  # by name, not by pattern: a stray file can never join the data
    configs = card_configs(dataset, dataset.fingerprint, files, preview=True)
    return front_matter(dataset.manifest, configs, licence, ["fpp-ml-bench"])


def stage_dataset(
    dataset: DatasetFolder,
    repo: str,
    licence: str,
    folder: Path,
    texts: Mapping[str, str],
    threads: int = 1,
    row_done: Callable[[int], None] = lambda rows: None,
) -> Publication:
    """Write all that is published of ``dataset``, and ``texts`` by file name, into ``folder``: same
    data, same bytes. Parquet files that are already there are kept (see `staging_folder`). Raises
    `DatasetError` for a damaged dataset, ``OSError`` when a file can't be written."""
    for name, shard in data_shards(dataset).items():
        if (folder / name).is_file():
            row_done(shard.rows)
        else:
            write_shard(dataset, shard, folder / name, row_done, threads)
    for mesh in (
        file for file in dataset.manifest.others if file.path.startswith(f"{MESH_FOLDER}/")
    ):
        if damage := damage_of(dataset.path, mesh):
            raise DatasetError(damage)
        (folder / MESH_FOLDER).mkdir(exist_ok=True)
        shutil.copyfile(dataset.path / mesh.path, folder / mesh.path)
    save_rig(dataset.rig, folder / RIG_FILE)
    write_atomically(folder / PICTURE, overview(dataset))
    features, splits = published_features(dataset), list(dataset.splits)
    metadata = croissant(dataset.manifest, features, splits, licence, repo)
    write_atomically(folder / CROISSANT_FILE, metadata)
    for name, text in texts.items():
        write_atomically(folder / name, text.encode())
    about = {
        "fingerprint": dataset.fingerprint,
        "size": list(dataset.size),
        "configs": list(dataset.configs),
    }
    marked = mark_bytes("dataset", **about, splits=dataset.splits, content=dataset.content)
    write_atomically(folder / MARK, marked)
    return Publication("dataset", repo, folder, f"{NAME} dataset {dataset.fingerprint[:12]}", OWNED)


@dataclass(frozen=True)
class Download:
    """What an import downloads from ``source``: ``sizes`` in bytes by name of file, those matched
    by ``patterns``. ``missing`` are those of them that ``cache`` does not hold, ``raw_scans`` the
    images that are left out."""

    source: Source
    patterns: tuple[str, ...]
    sizes: dict[str, int]
    missing: dict[str, int]
    raw_scans: dict[str, int]
    cache: Path


def plan_download(hub: Hub, repository: str, revision: str | None, raw_scans: bool) -> Download:
    """What an import of ``repository`` at ``revision`` (branch, tag or commit; None: its main
    branch) downloads: the depth variant that it reads, the depth ranges and, with ``raw_scans``,
    the frames of the raw scans. Raises `RemoteError` as `Hub.state`, `LayoutError` for a repository
    without the published layout or raw scans."""
    remote = hub.state("dataset", repository, revision)
    if not remote.exists:
        raise RemoteError(
            f"{repository}: no such folder here, and no such dataset on {hub.endpoint}, or it is "
            f"private; check the "
            "name, or run 'hf auth login' with a token that may read it"
        )

    def matching(*patterns: str) -> dict[str, int]:
        names = filter_repo_objects(remote.files, allow_patterns=list(patterns))
        return {name: remote.files[name].size for name in names}

    variant = next(
        (name for name in VARIANT_FOLDERS.values() if matching(f"{TRAINING}/{name}/*")), None
    )
    scans = matching(_SCAN_FRAMES)
    if variant is None:
        hint = f"expected {TRAINING}/ with one of {', '.join(VARIANT_FOLDERS.values())}"
        if MARK in remote.files:
            hint = f'it holds Parquet files, which datasets.load_dataset("{repository}") opens'
        raise LayoutError(f"{repository}: this dataset does not have the published layout; {hint}")
    if raw_scans and not scans:
        raise LayoutError(
            f"{repository}: has no raw scans ({RAW_SCANS}/), only the single-shot images and their "
            f"depth"
        )
    patterns = (
        f"{TRAINING}/{variant}/*",
        f"{TRAINING}/{INFO}/*",
        *([_SCAN_FRAMES] if raw_scans else []),
    )
    sizes, commit = matching(*patterns), remote.commit or ""
    missing = {
        name: size
        for name, size in sizes.items()
        if not isinstance(
            try_to_load_from_cache(repository, name, revision=commit, repo_type="dataset"), str
        )
    }
    source = Source(repository, commit, (variant, *([RAW_SCANS] if raw_scans else [])))
    return Download(
        source, patterns, sizes, missing, {} if raw_scans else scans, Path(constants.HF_HUB_CACHE)
    )


def fetch_tree(hub: Hub, download: Download, out: Path) -> Path:
    """Download what is missing, with the client's own progress bars; returns the folder of the tree
    in the cache. Raises `BuildError` where a disk has no space for the download and the dataset to
    be written to ``out``, `RemoteError` as `Hub.download`."""
    if download.missing:
        # The import is estimated for images of the paper's size.
        frames = len(PAPER_SEQUENCE) if RAW_SCANS in download.source.folders else 1
        samples = sum(f"/{FRINGE}/" in name for name in download.sizes)
        imported, downloaded = (
            samples * FULL_SIZE**2 * (frames + _DEPTH_BYTES),
            sum(download.missing.values()),
        )
        cure = " for the download (HF_HOME) or the dataset (--out)"
        check_space({download.cache: downloaded, out: imported}, "download and import need", cure)
    return hub.download(download.source.repository, download.source.commit, list(download.patterns))
