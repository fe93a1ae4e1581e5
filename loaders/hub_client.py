"""The Hugging Face Hub through its own client: reading a repository's state, and sending what changed.

Every error of the client (no token, no network, 401, 403, 404, 5xx) becomes a `PublishError` that says what to do.
The client reads ``HF_ENDPOINT``, ``HF_TOKEN`` and ``HF_HUB_OFFLINE`` itself.
"""

import json
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fpp_ml_bench import __version__
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.hub import MARK, Change, Kind, Publication, Remote, RemoteFile

if TYPE_CHECKING:
    from huggingface_hub import CommitOperationAdd

_BATCH_BYTES, _BATCH_FILES = 1 << 26, 64
"""Files are sent before the commit in batches of about this size; a file that arrived is never sent again."""
_REPO = re.compile(r"(?!.*(--|\.\.))\w[\w.-]{0,95}/\w[\w.-]{0,95}(?<![.-])", re.ASCII)
_URL_PREFIX: dict[Kind, str] = {"dataset": "datasets/", "space": "spaces/", "model": ""}


def check_repo_name(repo: str) -> str:
    """``repo`` itself when it is an OWNER/NAME that the Hub can have, else `PublishError`."""
    if not _REPO.fullmatch(repo) or repo.endswith(".git"):
        raise PublishError(
            f"expected a repository as OWNER/NAME (letters, digits, '-', '_', '.'), got {printable(repo, 80)!r}"
        )
    return repo


class Hub:
    """A connection to the Hub. Its constructor uses no network."""

    def __init__(self) -> None:
        from huggingface_hub import HfApi
        from huggingface_hub.utils import disable_progress_bars

        disable_progress_bars()  # ours shows all files together
        self._api = HfApi(library_name="fpp-ml-bench", library_version=__version__)
        self.endpoint: str = self._api.endpoint
        if not self.endpoint.startswith(("https://", "http://")):
            raise PublishError(f"HF_ENDPOINT: expected a URL like https://huggingface.co, got {self.endpoint!r}")

    def url(self, kind: Kind, repo: str) -> str:
        return f"{self.endpoint}/{_URL_PREFIX[kind]}{repo}"

    def check_token(self) -> set[str]:
        """Names that the token may publish under: its user and their organisations. `PublishError` without a token."""
        from huggingface_hub import get_token

        if not get_token():
            raise PublishError(
                "no token for the Hub: run 'hf auth login' once or set HF_TOKEN, with a token that may write; "
                "--dry-run needs none for what is public"
            )
        with self._explained("asking who the token belongs to"):
            me = self._api.whoami()
        return {str(me.get("name"))} | {str(org.get("name")) for org in me.get("orgs") or ()}

    def check_may_create(self, repo: str, names: set[str]) -> None:
        """`PublishError` where the token may not make repositories for the owner of ``repo``."""
        owner = repo.split("/")[0]
        if owner.lower() not in {name.lower() for name in names}:
            owners = ", ".join(printable(name, 60) for name in sorted(names))
            raise PublishError(f"{repo}: does not exist, and this token may make repositories of {owners} only")

    def state(self, kind: Kind, repo: str) -> Remote:
        """A repository's commit, visibility and files; a `Remote` without a commit where no repository is visible."""
        from huggingface_hub import get_token
        from huggingface_hub.errors import RepositoryNotFoundError
        from huggingface_hub.hf_api import RepoFile

        with self._explained(f"reading {kind} {repo}"):
            try:
                info = self._api.repo_info(repo, repo_type=kind)
            except RepositoryNotFoundError as error:
                # Without a token the Hub answers 401, not 404, for a repository that is private or missing.
                if error.response.status_code == 401 and get_token():
                    raise
                return Remote(None)
            tree = self._api.list_repo_tree(repo, repo_type=kind, recursive=True, revision=info.sha)
            files = {
                entry.path: RemoteFile(
                    entry.path, entry.size, entry.blob_id, entry.lfs.sha256 if entry.lfs is not None else None
                )
                for entry in tree if isinstance(entry, RepoFile)
            }  # fmt: skip
        return Remote(info.sha or "", bool(info.private), files)

    def mark(self, kind: Kind, repo: str, remote: Remote) -> dict[str, Any]:
        """Content of `MARK` in a repository; `PublishError` where the file is missing or damaged."""
        if not remote.exists:
            raise PublishError(
                f"{repo}: no such {kind} on {self.endpoint}, or this token may not see it; check the name, or publish "
                f"it first: fpp-bench publish {kind} ... --repo {repo}"
            )
        if MARK not in remote.files or remote.files[MARK].bytes > 1 << 20:
            raise PublishError(f"{repo}: this {kind} was not published by fpp-bench (no {MARK} there)")
        with tempfile.TemporaryDirectory() as cache, self._explained(f"reading {MARK} of {kind} {repo}"):
            path = self._api.hf_hub_download(repo, MARK, repo_type=kind, revision=remote.commit, cache_dir=cache)
            content = Path(path).read_bytes()
        try:
            about = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise PublishError(f"{repo}: its {MARK} is damaged; publish the {kind} again") from error
        return about if isinstance(about, dict) else {}

    def send(
        self, publication: Publication, changes: list[Change], remote: Remote, private: bool,
        sent: Callable[[int], None] = lambda count: None,
    ) -> str:  # fmt: skip
        """Make the repository where there is none, send new and changed files, and commit; returns the commit's URL.

        All files become visible together, with the commit. An interrupted run, started again, sends only what is
        missing. ``sent`` is called with the bytes of each batch. Raises `PublishError`, also after a commit by someone
        else meanwhile.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        repo, kind = publication.repo, publication.kind
        if not remote.exists:
            with self._explained(f"making {kind} {repo}"):
                sdk = "static" if kind == "space" else None
                self._api.create_repo(repo, repo_type=kind, private=private or None, space_sdk=sdk)
        with self._explained(f"sending to {kind} {repo}"):
            additions = [
                CommitOperationAdd(change.path, publication.folder / change.path)
                for change in changes if change.status in ("new", "changed")
            ]  # fmt: skip
            for batch in _batches(additions):
                self._api.preupload_lfs_files(repo, batch, repo_type=kind, free_memory=False)
                sent(sum(addition.upload_info.size for addition in batch))
            deletions = [CommitOperationDelete(c.path, is_folder=False) for c in changes if c.status == "deleted"]
            done = self._api.create_commit(
                repo, [*additions, *deletions], commit_message=publication.message, repo_type=kind,
                parent_commit=remote.commit or None,
            )  # fmt: skip
        return str(done.commit_url)

    @contextmanager
    def _explained(self, doing: str) -> Iterator[None]:
        from huggingface_hub.errors import HfHubHTTPError, HTTPError, LocalTokenNotFoundError, OfflineModeIsEnabled

        try:
            yield
        except OfflineModeIsEnabled as error:
            raise PublishError(f"{doing}: HF_HUB_OFFLINE is set, so nothing may be sent; unset it") from error
        except LocalTokenNotFoundError as error:
            raise PublishError(f"{doing}: no token; run 'hf auth login' or set HF_TOKEN") from error
        except HfHubHTTPError as error:
            raise PublishError(
                f"{doing}: {_status_words(error.response.status_code)}{_server_message(error)}"
            ) from error
        except HTTPError as error:
            raise PublishError(
                f"{doing}: {self.endpoint} can't be reached ({printable(str(error)) or type(error).__name__}); check "
                "the network and HF_ENDPOINT, then run the same command again: it sends only what is missing"
            ) from error
        except (ValueError, RuntimeError, OSError) as error:
            # The client's refusals of an answer or a card (ValueError), and its transfer library (RuntimeError).
            lines = " ".join(printable(line) for line in str(error).splitlines())
            raise PublishError(f"{doing}: {lines or type(error).__name__}; run the same command again") from error


def _status_words(status: int) -> str:
    answers = {
        401: "the Hub does not accept the token (401); run 'hf auth login' again or set another HF_TOKEN",
        403: "the token may not do that (403); it needs write access to this owner and repository",
        404: "no such repository, or this token may not see it (404); check the name",
        409: "somebody else is changing it (409); run the same command again",
        412: "somebody else committed meanwhile (412); run the same command again",
        413: "too large for the Hub (413)",
        429: "too many requests (429); wait some minutes, then run the same command again",
    }
    if status >= 500:
        return f"the Hub has a fault ({status}); run the same command again later, it sends only what is missing"
    return answers.get(status, f"the Hub refused ({status})")


def _server_message(error: Any) -> str:
    return f". The Hub says: {printable(' '.join(error.server_message.split()))}" if error.server_message else ""


def _batches(additions: "list[CommitOperationAdd]") -> "Iterator[list[CommitOperationAdd]]":
    batch: list[CommitOperationAdd] = []
    for addition in additions:
        batch.append(addition)
        if len(batch) == _BATCH_FILES or sum(queued.upload_info.size for queued in batch) >= _BATCH_BYTES:
            yield batch
            batch = []
    if batch:
        yield batch
