"""A stand-in for the Hugging Face Hub: a real HTTP server that speaks the calls of ``huggingface_hub``."""

import base64
import hashlib
import json
import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qs, unquote, urlsplit

import pytest

from flowlab.cli import main

TOKEN = "hf_standin"
Files = dict[str, bytes]


@dataclass
class Repo:
    """A repository: its commits, the newest last."""

    commits: dict[str, Files] = field(default_factory=dict)
    private: bool = False
    gated: bool = False
    listed: dict[str, int] = field(default_factory=dict)
    """Sizes that are told otherwise than they are."""

    def commit(self, files: Files) -> str:
        told = json.dumps([len(self.commits), *sorted((n, hashlib.sha1(c).hexdigest()) for n, c in files.items())])
        sha = hashlib.sha1(told.encode()).hexdigest()
        self.commits[sha] = dict(files)
        return sha

    @property
    def newest(self) -> str:
        return [*self.commits][-1]


class HubServer(ThreadingHTTPServer):
    """Repositories in memory, by ``datasets/user/name`` or ``models/user/name``."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.repos: dict[str, Repo] = {}
        self.calls: list[str] = []
        self.fails: Callable[[str, str], int | None] = lambda method, path: None
        """What status a call gets, if it is to fail."""
        self.cuts: Callable[[str], bool] = lambda path: False
        """Whether a download breaks in the middle."""
        self.uses_lfs = False
        self.stored: Files = {}
        """What came through LFS, by SHA-256."""
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def files(self, repo: str) -> Files:
        """The newest content."""
        return self.repos[repo].commits[self.repos[repo].newest]

    def put(self, repo: str, files: Files, **about: Any) -> str:
        """Have a repository with this content; the commit."""
        held = self.repos.setdefault(repo, Repo())
        for name, value in about.items():
            setattr(held, name, value)
        return held.commit(files)


class _Handler(BaseHTTPRequestHandler):
    server: HubServer
    protocol_version = "HTTP/1.1"

    def log_message(self, *_: Any) -> None:
        """Silence."""

    def do_HEAD(self) -> None:
        self._serve()

    def do_GET(self) -> None:
        self._serve()

    def do_POST(self) -> None:
        self._serve()

    def do_PUT(self) -> None:
        self._serve()

    def _serve(self) -> None:
        url = urlsplit(self.path)
        path, self.query = unquote(url.path), parse_qs(url.query)
        self.body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.server.calls.append(f"{self.command} {path}")
        if (status := self.server.fails(self.command, path)) is not None:
            self._json({"error": "it fails"}, status)
            return
        for pattern, answer in _ROUTES:
            if match := re.fullmatch(pattern, path):
                answer(self, *match.groups())
                return
        self._json({"error": f"no route {path}"}, 404)

    def _json(self, values: Any, status: int = 200, **headers: str) -> None:
        self._send(json.dumps(values).encode(), status, {"Content-Type": "application/json", **headers})

    def _send(self, content: bytes, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in (headers or {}).items():
            self.send_header(name.replace("_", "-"), value)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    @property
    def _may(self) -> bool:
        return self.headers.get("Authorization") == f"Bearer {TOKEN}"

    def _repo(self, key: str) -> Repo | None:
        """The repository, or an answer that says why not."""
        repo = self.server.repos.get(key)
        if repo is None or (repo.private and not self._may):
            self._json({"error": "Repository not found"}, 401 if not self._may else 404, X_Error_Code="RepoNotFound")
            return None
        if repo.gated:
            self._json({"error": "Access is restricted"}, 403, X_Error_Code="GatedRepo")
            return None
        return repo

    def _commit(self, repo: Repo, revision: str) -> str | None:
        found = repo.newest if revision == "main" and repo.commits else revision
        if found not in repo.commits:
            self._json({"error": "Invalid rev id"}, 404, X_Error_Code="RevisionNotFound")
            return None
        return found

    def info(self, key: str, revision: str | None) -> None:
        if (repo := self._repo(key)) and (commit := self._commit(repo, revision or "main")):
            siblings = [{"rfilename": name} for name in repo.commits[commit]]
            name = key.partition("/")[2]
            self._json(
                {"_id": "1", "id": name, "modelId": name, "sha": commit, "private": repo.private, "siblings": siblings,
                 "tags": [], "downloads": 0, "likes": 0, "gated": False, "disabled": False}
            )  # fmt: skip

    def tree(self, key: str, revision: str) -> None:
        if (repo := self._repo(key)) and (commit := self._commit(repo, revision)):
            rows = [
                {"type": "file", "path": name, "oid": _blob(content), "size": repo.listed.get(name, len(content))}
                for name, content in repo.commits[commit].items()
            ]
            self._json([{"type": "directory", "path": "shards", "oid": "0" * 40}, *rows])

    def resolve(self, key: str, revision: str, name: str) -> None:
        repo = self._repo(key if key.startswith("datasets/") else f"models/{key}")
        if repo is None or (commit := self._commit(repo, revision)) is None:
            return
        if name not in repo.commits[commit]:
            self._json({"error": "Entry not found"}, 404, X_Error_Code="EntryNotFound")
            return
        content = repo.commits[commit][name]
        headers = {"ETag": f'"{_blob(content)}"', "X-Repo-Commit": commit, "Accept-Ranges": "bytes"}
        begin = int(re.findall(r"bytes=(\d+)-", self.headers.get("Range", "bytes=0-"))[0])
        if self.command == "GET" and self.server.cuts(name):
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content[: len(content) // 2])
            self.close_connection = True
            return
        if begin:
            headers["Content-Range"] = f"bytes {begin}-{len(content) - 1}/{len(content)}"
        self._send(content[begin:], 206 if begin else 200, headers)

    def create(self) -> None:
        about = json.loads(self.body)
        if not self._may:
            self._json({"error": "Invalid username or password."}, 401)
            return
        if about.get("organization") == "others":
            self._json({"error": "You don't have the rights to create one under this namespace"}, 403)
            return
        key = f"{about.get('type', 'model')}s/{about.get('organization', 'anna')}/{about['name']}"
        url = f"{self.server.endpoint}/{key.removeprefix('models/')}"
        if key in self.server.repos:
            self._json({"error": "You already created this repo", "url": url}, 409)
            return
        self.server.repos[key] = Repo(
            private="private" in (about.get("visibility"), about.get("private") and "private")
        )
        self.server.repos[key].commit({".gitattributes": b"*.zip filter=lfs\n"})
        self._json({"url": url, "name": about["name"], "id": "1"})

    def preupload(self, key: str, revision: str) -> None:
        if (repo := self._repo(key)) is None:
            return
        there, told = repo.commits[repo.newest], []
        for file in json.loads(self.body)["files"]:
            mode = "lfs" if self.server.uses_lfs and file["path"].endswith(".zip") else "regular"
            oid = _blob(there[file["path"]]) if file["path"] in there else None
            told.append({"path": file["path"], "uploadMode": mode, "shouldIgnore": False, "oid": oid})
        self._json({"files": told})

    def commit(self, key: str, revision: str) -> None:
        if not self._may:
            self._json({"error": "Invalid username or password."}, 401)
            return
        if (repo := self._repo(key)) is None:
            return
        files = dict(repo.commits[repo.newest])
        for line in map(json.loads, self.body.decode().splitlines()):
            value = line["value"]
            if line["key"] == "file":
                files[value["path"]] = base64.b64decode(value["content"])
            elif line["key"] == "lfsFile":
                files[value["path"]] = self.server.stored[value["oid"]]
            elif line["key"] == "deletedFile":
                del files[value["path"]]
        sha = repo.commit(files)
        self._json({"success": True, "commitOid": sha, "commitUrl": f"{self.server.endpoint}/{key}/commit/{sha}"})

    def lfs_batch(self, key: str) -> None:
        told = [
            {**o, "actions": {"upload": {"href": f"{self.server.endpoint}/lfs/{o['oid']}"}}}
            for o in json.loads(self.body)["objects"]
        ]
        self._json({"transfer": "basic", "objects": told})

    def lfs_put(self, oid: str) -> None:
        assert hashlib.sha256(self.body).hexdigest() == oid
        self.server.stored[oid] = self.body
        self._json({})

    def check_yaml(self) -> None:
        assert json.loads(self.body)["content"].startswith("---\n")
        self._json({"errors": [], "warnings": []})


def _blob(content: bytes) -> str:
    """What git calls it."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


_KEY = r"((?:datasets|models)/[\w.-]+/[\w.-]+)"
_ROUTES: list[tuple[str, Callable[..., None]]] = [
    (r"/api/repos/create", _Handler.create),
    (r"/api/validate-yaml", _Handler.check_yaml),
    (rf"/api/{_KEY}(?:/revision/(.+))?", _Handler.info),
    (rf"/api/{_KEY}/tree/([^/]+)", _Handler.tree),
    (rf"/api/{_KEY}/preupload/(.+)", _Handler.preupload),
    (rf"/api/{_KEY}/commit/(.+)", _Handler.commit),
    (r"/((?:datasets/)?[\w.-]+/[\w.-]+)/resolve/([^/]+)/(.+)", _Handler.resolve),
    (r"/((?:datasets/)?[\w.-]+/[\w.-]+)\.git/info/lfs/objects/batch", _Handler.lfs_batch),
    (r"/lfs/(\w+)", _Handler.lfs_put),
]


@contextmanager
def standing_in(patch: pytest.MonkeyPatch, home: Path) -> Iterator[HubServer]:
    """A Hub that flowlab takes for the real one, and a login for it."""
    server = HubServer()
    patch.setenv("HF_ENDPOINT", server.endpoint)
    patch.setenv("HF_TOKEN", TOKEN)
    patch.setenv("FLOWLAB_CACHE", str(home / "cache"))
    patch.setattr("huggingface_hub.constants.HF_TOKEN_PATH", str(home / "no-token"))
    clock = SimpleNamespace(**{**vars(time), "sleep": lambda seconds: None})  # it tries again after a while
    for module in ("utils._http", "file_download"):
        patch.setattr(f"huggingface_hub.{module}.time", clock)
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()


def uploaded(patch: pytest.MonkeyPatch, path: Path, home: Path, *options: str) -> Files:
    """What a push of something uploads."""
    with standing_in(patch, home) as server, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main("hub", "push", str(path), "anna/it", "--yes", *options)
        return server.files(next(iter(server.repos)))
