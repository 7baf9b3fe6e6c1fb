"""A server with the Hugging Face hub's protocol, which fails on request."""

from __future__ import annotations

import contextlib
import hashlib
import http.server
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

REPOSITORY = "someone/tiny"


class Hub(http.server.ThreadingHTTPServer):
    """Serves a folder as a repository.

    cut: file -> bytes after which its connections are cut.  down: answer 503 to further downloads after a cut.
    spoilt: files of which another content is sent than the listing's hash says.  ranges: honor Range, or send whole
    files.  gated: answer 403 to downloads.  requested: (file, Range) so far.
    """

    def __init__(self, folder: Path, repository: str):
        super().__init__(("127.0.0.1", 0), Handler)
        self.folder, self.repository = folder, repository
        self.cut: dict[str, int] = {}
        self.down = False
        self.spoilt: set[str] = set()
        self.ranges = True
        self.gated = False
        self.requested: list[tuple[str, str | None]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Handler(http.server.BaseHTTPRequestHandler):
    server: Hub

    def do_GET(self) -> None:
        path = self.path.split("?")[0]
        if path == f"/api/models/{self.server.repository}/revision/main":
            self._answer(json.dumps(self._listing()).encode())
            return
        found = re.fullmatch(rf"/{self.server.repository}/resolve/main/(.+)", path)
        if found is None or not (self.server.folder / found[1]).is_file():
            self.send_error(404)
            return
        self._file(found[1])

    def _file(self, name: str) -> None:
        wanted = self.headers.get("Range")
        self.server.requested.append((name, wanted))
        if self.server.down or self.server.gated:
            self.send_error(403 if self.server.gated else 503)
            return
        content = (self.server.folder / name).read_bytes()
        if name in self.server.spoilt:
            content = bytes(reversed(content))
        wanted = wanted if self.server.ranges else None
        start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1]) if wanted else 0
        self.send_response(206 if wanted else 200)
        self.send_header("Content-Length", str(len(content) - start))
        if wanted:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        self.end_headers()
        if name in self.server.cut:
            self.wfile.write(content[start : self.server.cut[name]])
            self.wfile.flush()
            self.server.down = True
            self.close_connection = True
            return
        self.wfile.write(content[start:])

    def _listing(self) -> dict[str, Any]:
        siblings = []
        for path in sorted(p for p in self.server.folder.rglob("*") if p.is_file()):
            content = path.read_bytes()
            blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
            own = {"rfilename": path.relative_to(self.server.folder).as_posix(), "size": len(content), "blobId": blob}
            if path.suffix in (".onnx", ".safetensors"):
                digest = hashlib.sha256(content).hexdigest()
                own["lfs"] = {"sha256": digest, "size": len(content), "pointerSize": 130}
            siblings.append(own)
        return {
            "id": self.server.repository,
            "sha": "0" * 40,
            "siblings": siblings,
            "private": False,
            "tags": [],
            "downloads": 0,
        }

    def _answer(self, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        pass


@contextlib.contextmanager
def serve(folder: Path, repository: str = REPOSITORY) -> Iterator[Hub]:
    """Runs a hub with the repository in a folder."""
    running = Hub(folder, repository)
    thread = threading.Thread(target=running.serve_forever, daemon=True)
    thread.start()
    try:
        yield running
    finally:
        running.shutdown()
        running.server_close()
        thread.join()
