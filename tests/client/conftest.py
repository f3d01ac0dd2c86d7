"""A server in memory that speaks docs/http.md, with faults to order: behind httpx's mock transport for
the client's own tests, behind a real socket for the command line."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from splatct_client.client import Client
from splatct_client.retry import Patience

ROOT = Path(__file__).resolve().parents[2]
JOB_ID = "6a1f6f0e-0000-4000-8000-000000000001"
Answer = tuple[int, dict[str, str], bytes]


def problem(status: int, title: str, detail: str = "", errors: list[dict[str, str]] | None = None) -> Answer:
    body: dict[str, Any] = {"type": "urn:splatct:problem:test", "title": title, "status": status, "detail": detail}
    if errors is not None:
        body["errors"] = errors
    return status, {"Content-Type": "application/problem+json"}, json.dumps(body).encode()


def ok(body: object, status: int = 200, **headers: str) -> Answer:
    return status, {"Content-Type": "application/json", **headers}, json.dumps(body).encode()


@dataclass
class FakeApi:
    """Answers by path; `faults` are used up first, one per request that they match."""

    results: dict[str, bytes] = field(default_factory=dict)
    states: list[str] = field(default_factory=lambda: ["queued", "running", "succeeded"])
    error: dict[str, str] | None = None
    takes_ids: bool = True  # PUT /v1/jobs/{uuid}, /v1/uploads/{uuid}
    commit_answer: Answer | None = None
    faults: list[tuple[str, Answer | BaseException]] = field(default_factory=list)
    cut_download_at: list[int] = field(default_factory=list)
    uploads: dict[str, bytes] = field(default_factory=dict)
    announced: dict[str, Any] = field(default_factory=dict)
    submitted: list[dict[str, Any]] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    ranges: list[str | None] = field(default_factory=list)

    def job(self) -> dict[str, Any]:
        state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
        given = self.submitted[-1] if self.submitted else {}
        return {
            "id": JOB_ID, "name": given.get("name", "teapot"), "scan_id": "scan-1", "scan_name": "teapot",
            "state": state, "stage": "level", "message": "fitting at bin 4", "progress": 0.5,
            "eta_s": 90, "queue_position": 2,
            "attempt": 1, "options": given.get("options", {}), "created_at": "2026-11-01T10:00:00Z",
            "started_at": None, "finished_at": None, "error": self.error, "links": {}, "a_newer_field": 1,
        }  # fmt: skip

    def answer(self, method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        call = f"{method} {path}"
        self.calls.append(call)
        for index, (start, fault) in enumerate(self.faults):
            if call.startswith(start):
                del self.faults[index]
                if isinstance(fault, BaseException):
                    raise fault
                return fault
        return self._answer(method, path.removeprefix("/v1"), headers, body)

    def _answer(self, method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        if (method, path) == ("GET", "/options"):
            return ok({"options": [
                {"name": "calibrate", "choices": ["full", "static", "none"], "low": None, "high": None},
                {"name": "splats", "choices": None, "low": 100, "high": 5000000},
            ]})  # fmt: skip
        makes = method == "PUT" and path.startswith("/uploads/") and path.count("/") == 2
        if makes and not self.takes_ids:
            return problem(405, "Method not allowed")
        if makes or (method, path) == ("POST", "/uploads"):
            self.announced = json.loads(body)
            return ok({"id": "up-1", "name": self.announced["name"], "state": "open", "files": []}, 201)
        if method == "PUT" and path.startswith("/uploads/up-1/files/"):
            name = path.removeprefix("/uploads/up-1/files/")
            self.uploads[name] = body
            digest = hashlib.sha256(body).hexdigest()
            return ok({"name": name, "size": len(body), "received": len(body), "complete": True, "sha256": digest})
        if (method, path) == ("GET", "/uploads/up-1") and self.announced:
            return ok({"id": "up-1", "name": self.announced["name"], "state": "open", "files": []})
        if (method, path) == ("POST", "/uploads/up-1/commit"):
            return self.commit_answer or ok({"id": "scan-1", "name": "teapot"}, 201)
        if (method, path) == ("DELETE", "/uploads/up-1"):
            return 204, {}, b""
        if method == "PUT" and path.startswith("/jobs/") and not self.takes_ids:
            return problem(405, "Method not allowed")
        if (method, path) == ("POST", "/jobs") or (method == "PUT" and path.startswith("/jobs/")):
            self.submitted.append(json.loads(body))
            return ok(self.job(), 202)
        if (method, path) == ("GET", "/jobs"):
            return ok({"jobs": [self.job()]})
        if (method, path) == ("POST", f"/jobs/{JOB_ID}/cancel"):
            return ok({**self.job(), "state": "cancelling"}, 202)
        if (method, path) == ("GET", f"/jobs/{JOB_ID}"):
            return ok(self.job(), **{"Retry-After": "0"})
        if (method, path) == ("GET", f"/jobs/{JOB_ID}/results"):
            return ok({"files": [
                {"name": n, "size": len(b), "sha256": hashlib.sha256(b).hexdigest()} for n, b in self.results.items()
            ]})  # fmt: skip
        name = path.removeprefix(f"/jobs/{JOB_ID}/results/")
        if name == "manifest.json":
            return ok({"files": []})
        if method == "GET" and name in self.results:
            return self._bytes(self.results[name], headers.get("range"))
        return problem(404, "Not found", f"there is no {path}")

    def _bytes(self, data: bytes, wanted: str | None) -> Answer:
        self.ranges.append(wanted)
        first = int(wanted.removeprefix("bytes=").removesuffix("-")) if wanted else 0
        status = 206 if wanted else 200
        end = self.cut_download_at.pop(0) if self.cut_download_at else len(data)
        return status, {"Content-Length": str(len(data) - first)}, data[first:end]


class _Body(httpx.SyncByteStream):
    """A body that may end too early, as a cut connection makes it."""

    def __init__(self, data: bytes, announced: int) -> None:
        self.data, self.announced = data, announced

    def __iter__(self) -> Iterator[bytes]:
        yield self.data
        if len(self.data) < self.announced:
            raise httpx.RemoteProtocolError("peer closed connection without sending complete message body")


@pytest.fixture
def api() -> FakeApi:
    return FakeApi()


@pytest.fixture
def sleeps() -> list[float]:
    """What the client slept, in seconds; nobody sleeps in truth."""
    return []


@pytest.fixture
def client(api: FakeApi, sleeps: list[float]) -> Iterator[Client]:
    def handle(request: httpx.Request) -> httpx.Response:
        headers = {name.lower(): value for name, value in request.headers.items()}
        status, answered, body = api.answer(request.method, request.url.path, headers, request.read())
        announced = int(answered.get("Content-Length", len(body)))
        return httpx.Response(status, headers=answered, stream=_Body(body, announced))

    patience = Patience(sleep=sleeps.append, clock=lambda: sum(sleeps))
    with Client("http://ct.example", patience=patience, transport=httpx.MockTransport(handle)) as made:
        yield made


@pytest.fixture
def server(api: FakeApi) -> Iterator[str]:
    """The same behind a real socket; its address."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def _serve(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            path = httpx.URL(self.path).path
            headers = {name.lower(): value for name, value in self.headers.items()}
            status, answered, data = api.answer(self.command, path, headers, body)
            self.send_response(status)
            for name, value in ({"Content-Length": str(len(data))} | answered).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_PUT = do_POST = do_DELETE = _serve

        def log_message(self, *_: object) -> None:
            pass

    httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    httpd.daemon_threads = True
    thread = threading.Thread(target=httpd.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}"
    httpd.shutdown()
    httpd.server_close()
    thread.join()


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    folder = tmp_path / "scan"
    folder.mkdir()
    described = {
        "format": "splatct-scan/1",
        "name": "teapot",
        "projections": {"files": ["projections.tif"], "kind": "counts", "flat": ["flat.tif"], "dark": ["dark.tif"]},
        "bad_pixels": "mask.tif",
        "simulation": {"volume_file": "truth.tif", "attenuation_unit": 0.01},
    }
    (folder / "scan.json").write_text(json.dumps(described), encoding="utf-8")
    for name in ("projections.tif", "flat.tif", "dark.tif", "mask.tif", "truth.tif"):
        (folder / name).write_bytes(name.encode() * 1000)
    return folder


Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def splatct(tmp_path: Path) -> Run:
    """Runs the command as an installed one would run: with the entry points of client/pyproject.toml."""
    project = tomllib.loads((ROOT / "client" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = tmp_path / "site" / "splatct_client-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = "\n".join(f"{name} = {target}" for name, target in project["entry-points"]["splatct.verbs"].items())
    (info / "entry_points.txt").write_text(f"[splatct.verbs]\n{points}\n")

    def run(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join([str(info.parent), str(ROOT / "client")])
        env = {name: value for name, value in os.environ.items() if not name.startswith("SPLATCT_")}
        env |= {"PYTHONPATH": path, "PYTHONIOENCODING": "utf-8", "XDG_STATE_HOME": str(tmp_path / "state")}
        env |= environment
        command = [sys.executable, "-m", "splatct_client", *arguments]
        return subprocess.run(command, env=env, capture_output=True, text=True, encoding="utf-8", timeout=60)

    return run
