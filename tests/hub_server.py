"""A Hugging Face Hub on the loopback interface, standard library only: enough of it for the real
client.

Repositories live in memory. Whose name they carry decides what goes wrong: ``forbidden/...`` may
not be written (403), ``broken/...`` fails with 500, ``cut/...`` fails once, at its first commit, to
``raced/...`` somebody else commits while files are sent, and files of ``gated/...`` may not be read
(403). The only tokens are `TOKENS`.
"""

import base64
import hashlib
import json
import re
import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote, urlsplit

TOKENS = {"hf_good": "alice"}
ORGANISATIONS = ("forbidden", "broken", "cut", "raced")
LARGE_SUFFIXES = (".parquet", ".ply", ".png")
_API = re.compile(
    r"/api/(datasets|spaces|models)/([^/]+/[^/]+)(?:/(preupload|commit|revision|tree)/([^/]+)(/.*)?)?"
)
_RESOLVE = re.compile(r"/(?:(datasets|spaces)/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)")
_LFS = re.compile(r"/(?:(datasets|spaces)/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch")


def git_sha1(content: bytes) -> str:
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


@dataclass
class Repo:
    private: bool = False
    sdk: str | None = None
    files: dict[str, bytes] = field(
        default_factory=lambda: {".gitattributes": b"*.parquet filter=lfs\n"}
    )
    commits: list[str] = field(default_factory=lambda: [hashlib.sha1(b"initial").hexdigest()])
    tags: dict[str, tuple[str, dict[str, bytes]]] = field(default_factory=dict)
    """Commit and files of each tag; ``files`` are those of the main branch."""

    def at(self, revision: str) -> tuple[str, dict[str, bytes]] | None:
        """Commit and files of a branch, tag or commit."""
        known = {commit: (commit, files) for commit, files in self.tags.values()} | self.tags
        now = self.commits[-1], self.files
        return known.get(revision, now if revision in ("main", self.commits[-1]) else None)


class HubServer(ThreadingHTTPServer):
    """``repos[kind, name]`` is what is stored, ``requests`` what was asked: (method, path)."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repos: dict[tuple[str, str], Repo] = {}
        self.large: dict[str, bytes] = {}
        self.requests: list[tuple[str, str]] = []
        self.cut: set[str] = set()
        self.faults: set[str] = set()
        """Files of which the next download fails, with 500."""
        self.halves: set[str] = set()
        """Files of which the next download ends in the middle."""
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def writes(self) -> list[tuple[str, str]]:
        """Requests that change something, and forget them all."""
        requests, self.requests = self.requests, []
        return [
            (m, p)
            for m, p in requests
            if m == "PUT" or p.endswith("/repos/create") or "/commit/" in p
        ]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: HubServer

    def log_message(self, *args: Any) -> None:
        pass

    def _answer(self, status: int, content: Any = None, **headers: str) -> None:
        body = content if isinstance(content, bytes) else json.dumps(content or {}).encode()
        self.send_response(status)
        length = {} if "Content_Length" in headers else {"Content_Length": str(len(body))}
        for name, value in {**length, **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def _refuse(self, status: int, message: str, code: str = "") -> None:
        self._answer(
            status,
            {"error": message},
            X_Error_Message=message,
            **({"X_Error_Code": code} if code else {}),
        )

    def _handle(self) -> None:
        path = unquote(urlsplit(self.path).path)
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.headers.get("Transfer-Encoding") == "chunked":
            body = b""
            while size := int(self.rfile.readline(), 16):
                body += self.rfile.read(size)
                self.rfile.readline()
            self.rfile.readline()
        self.server.requests.append((self.command, path))
        token = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if path.startswith("/large/"):
            self.server.large[path.removeprefix("/large/")] = body
            return self._answer(200)
        if token and token not in TOKENS:
            return self._refuse(401, "Invalid credentials in Authorization header")
        if path == "/api/whoami-v2":
            orgs = [{"name": name} for name in ORGANISATIONS]
            return self._answer(200, {"type": "user", "name": TOKENS[token], "orgs": orgs})
        if path == "/api/validate-yaml":
            return self._answer(200, {"warnings": [], "errors": []})
        if path == "/api/repos/create":
            return self._create(json.loads(body), token)
        if match := _LFS.fullmatch(path):
            return self._batch(json.loads(body))
        if match := _API.fullmatch(path):
            repo = self._repo(match[1], match[2], token)
            return self._api(repo, match, body) if repo else None
        if match := _RESOLVE.fullmatch(path):
            repo = self._repo(match[1] or "models", match[2], token)
            return self._resolve(repo, match[2], match[3], match[4]) if repo else None
        return self._refuse(404, f"no such address: {path}")

    do_GET = do_HEAD = do_POST = do_PUT = _handle

    def _repo(self, kind: str, name: str, token: str) -> Repo | None:
        repo = self.server.repos.get((kind, name))
        if name.startswith("broken/"):
            self._refuse(500, "Internal Error")
        elif repo is None or (repo.private and not token):
            self._refuse(404 if token else 401, "Repository not found", "RepoNotFound")
        else:
            return repo
        return None

    def _create(self, request: dict[str, Any], token: str) -> None:
        name = f"{request.get('organization') or TOKENS[token]}/{request['name']}"
        key = f"{request.get('type', 'model')}s", name
        if name.startswith("forbidden/"):
            return self._refuse(403, "You don't have the rights to create a repository here")
        if key in self.server.repos:
            return self._refuse(409, "You already created this repository")
        private = request.get("visibility") == "private" or bool(request.get("private"))
        self.server.repos[key] = Repo(private, request.get("sdk"))
        return self._answer(200, {"url": f"{self.server.endpoint}/{key[0]}/{name}"})

    def _batch(self, request: dict[str, Any]) -> None:
        objects = []
        for large_file in request["objects"]:
            upload = {"upload": {"href": f"{self.server.endpoint}/large/{large_file['oid']}"}}
            stored = large_file["oid"] in self.server.large
            objects.append({**large_file, **({} if stored else {"actions": upload})})
        self._answer(200, {"transfer": "basic", "objects": objects})

    def _api(self, repo: Repo, match: re.Match[str], body: bytes) -> None:
        kind, name, action, revision, _ = match.groups()
        if action == "preupload":
            if name.startswith("raced/"):
                repo.commits.append(hashlib.sha1(b"somebody else").hexdigest())
            files = [
                {
                    "path": f["path"],
                    "uploadMode": "lfs" if f["path"].endswith(LARGE_SUFFIXES) else "regular",
                    "shouldIgnore": False,
                    "oid": None,
                }
                for f in json.loads(body)["files"]
            ]
            return self._answer(200, {"files": files})
        if action == "commit":
            return self._commit(repo, kind, name, body)
        if (there := repo.at(revision or "main")) is None:
            return self._refuse(404, f"Invalid rev id: {revision}", "RevisionNotFound")
        commit, files = there
        if action == "tree":
            return self._answer(200, [self._entry(path, files[path]) for path in sorted(files)])
        siblings = [{"rfilename": path} for path in sorted(files)]
        about = {
            "id": name,
            "sha": commit,
            "private": repo.private,
            "siblings": siblings,
            "tags": [],
        }
        return self._answer(200, about)

    def _entry(self, path: str, content: bytes) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "type": "file",
            "path": path,
            "size": len(content),
            "oid": git_sha1(content),
        }
        if path.endswith(LARGE_SUFFIXES):
            entry["lfs"] = {
                "oid": hashlib.sha256(content).hexdigest(),
                "size": len(content),
                "pointerSize": 130,
            }
            entry["oid"] = git_sha1(b"pointer")
        return entry

    def _commit(self, repo: Repo, kind: str, name: str, body: bytes) -> None:
        if name.startswith("forbidden/"):
            return self._refuse(403, "You don't have the rights to write here")
        if name.startswith("cut/") and name not in self.server.cut:
            self.server.cut.add(name)
            return self._refuse(500, "Internal Error")
        lines = [json.loads(line) for line in body.splitlines()]
        if lines[0]["value"].get("parentCommit", repo.commits[-1]) != repo.commits[-1]:
            return self._refuse(412, "A commit has happened since")
        for line in lines[1:]:
            value = line["value"]
            if line["key"] == "file":
                repo.files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                repo.files[value["path"]] = self.server.large[value["oid"]]
            else:
                del repo.files[value["path"]]
        repo.commits.append(hashlib.sha1(body).hexdigest())
        url = f"{self.server.endpoint}/{kind}/{name}/commit/{repo.commits[-1]}"
        return self._answer(
            200,
            {"success": True, "commitOid": repo.commits[-1], "commitUrl": url, "hookOutput": ""},
        )

    def _resolve(self, repo: Repo, name: str, revision: str, path: str) -> None:
        if name.startswith("gated/"):
            return self._refuse(403, "Access to this dataset is restricted", "GatedRepo")
        commit, files = repo.at(revision) or ("", {})
        if path not in files:
            return self._refuse(404, f"{path} does not exist", "EntryNotFound")
        content = files[path]
        if self.command == "GET" and path in self.server.faults:
            self.server.faults.remove(path)
            return self._refuse(500, "Internal Error")
        etag = self._entry(path, content).get("lfs", {}).get("oid") or git_sha1(content)
        about = {"ETag": f'"{etag}"', "X_Repo_Commit": commit, "Accept_Ranges": "bytes"}
        if byte_range := re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or ""):
            first, last = (
                int(byte_range[1]),
                min(int(byte_range[2] or len(content)), len(content) - 1),
            )
            about["Content_Range"] = f"bytes {first}-{last}/{len(content)}"
            return self._answer(206, content[first : last + 1], **about)
        if self.command == "GET" and path in self.server.halves:
            self.server.halves.remove(path)
            self.close_connection = True
            return self._answer(
                200, content[: len(content) // 2], **about, Content_Length=str(len(content))
            )
        return self._answer(200, content, **about)
