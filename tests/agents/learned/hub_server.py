"""A hub on this machine: as much of the Hugging Face Hub's interface as sending and fetching two files takes."""

from __future__ import annotations

import base64
import hashlib
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class Hub:
    """What it keeps, and what it was asked."""

    def __init__(self) -> None:
        self.commits: dict[str, dict[str, bytes]] = {}  # by repository@commit
        self.heads: dict[str, str] = {}  # repository → commit
        self.asked: list[str] = []
        self.private: dict[str, bool] = {}
        self.lies: dict[str, Any] = {}  # headers that it gives instead
        self.address = ""

    def add(self, repository: str, files: dict[str, bytes]) -> str:
        """Make a commit, the head of a repository."""
        text = json.dumps([repository, self.heads.get(repository), sorted(files)]).encode()
        commit = hashlib.sha1(text + b"".join(files.values())).hexdigest()
        self.commits[f"{repository}@{commit}"] = files
        self.heads[repository] = commit
        return commit


class _Handler(BaseHTTPRequestHandler):
    hub: Hub

    def log_message(self, *args: Any) -> None:
        pass

    def _answer(self, body: Any = b"", status: int = 200, **headers: str) -> None:
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        self.send_response(status)
        for name, value in {"Content-Length": str(len(data)), **headers}.items():
            self.send_header(name.replace("_", "-"), str(value))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def do_GET(self) -> None:
        self.hub.asked.append(f"{self.command} {self.path}")
        repository, _, rest = self.path.lstrip("/").partition("/resolve/")
        revision, _, name = rest.partition("/")
        commit = self.hub.heads.get(repository, "") if revision == "main" else revision
        files = self.hub.commits.get(f"{repository}@{commit}")
        if files is None or name not in files:
            code = "RepoNotFound" if repository not in self.hub.heads else "EntryNotFound"
            self._answer(status=404, X_Error_Code=code)
            return
        data = files[name]
        tag = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
        self._answer(data, **{"ETag": f'"{tag}"', "X_Repo_Commit": commit, **self.hub.lies})

    do_HEAD = do_GET

    def do_POST(self) -> None:
        self.hub.asked.append(f"{self.command} {self.path}")
        chunked = self.headers.get("Transfer-Encoding") == "chunked"
        data = b"".join(self._chunks()) if chunked else self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Authorization") != "Bearer hf_secret":
            self._answer({"error": "Invalid username or password."}, 401)
        elif self.path == "/api/repos/create":
            asked = json.loads(data)
            name = f"{asked['organization']}/{asked['name']}" if asked.get("organization") else asked["name"]
            self.hub.private[name] = asked.get("private") or asked.get("visibility") == "private"
            self._answer({"url": f"{self.hub.address}/{name}", "id": name})
        elif "/preupload/" in self.path:
            files = [
                {"path": f["path"], "uploadMode": "regular", "shouldIgnore": False}
                for f in json.loads(data)["files"]
            ]
            self._answer({"files": files})
        elif "/commit/" in self.path:
            lines = [json.loads(line) for line in data.splitlines()]
            files = {
                line["value"]["path"]: base64.b64decode(line["value"]["content"]) for line in lines
                if line["key"] == "file"
            }  # fmt: skip
            repository = self.path.removeprefix("/api/models/").partition("/commit/")[0]
            commit = self.hub.add(repository, files)
            self._answer({"commitUrl": f"{self.hub.address}/{repository}/commit/{commit}", "commitOid": commit})
        else:
            self._answer(status=404)

    def _chunks(self) -> Iterator[bytes]:
        while size := int(self.rfile.readline(), 16):
            yield self.rfile.read(size)
            self.rfile.readline()
        self.rfile.readline()


@contextmanager
def running() -> Iterator[Hub]:
    """Give a hub that answers."""
    hub = Hub()
    server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"hub": hub}))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        hub.address = f"http://127.0.0.1:{server.server_port}"
        yield hub
    finally:
        server.shutdown()
        server.server_close()
