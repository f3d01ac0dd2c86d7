"""The real service for tests: Valkey, uvicorn and workers, each a process that a test may kill."""

from __future__ import annotations

import contextlib
import copy
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import httpx
import numpy as np
import tifffile

from server.keys import Key, KeyRing, Scope
from server.redisserver import OwnRedis, embedded_program
from worker.database import Database

ROOT = Path(__file__).resolve().parents[2]
PYTHONPATH = os.pathsep.join([str(ROOT), str(ROOT / "client"), str(ROOT / "tests" / "worker" / "fakes")])

SCAN: dict[str, Any] = {
    "format": "splatct-scan/1",
    "name": "small",
    "projections": {"files": ["projections.tif"], "kind": "line_integrals", "scale": 1.0},
    "geometry": {
        "beam": "cone",
        "dso_mm": 500.0,
        "dsd_mm": 700.0,
        "detector": {"rows": 16, "cols": 16, "pixel_mm": [2.0, 2.0], "offset_mm": [0.0, 0.0]},
        "angles_deg": [30.0 * view for view in range(12)],
    },
    "volume": {"shape": [8, 8, 8], "voxel_mm": [2.0, 2.0, 2.0]},
}


def scan_files(
    change: Callable[[dict[str, Any]], Any] | None = None, pixels: Any = None, **plan: Any
) -> dict[str, bytes]:
    """The files of a small scan; `plan` tells the fake engine how to behave."""
    import io

    scan = copy.deepcopy(SCAN)
    if plan:
        scan["name"] = "fake " + json.dumps(plan)
    if change is not None:
        change(scan)
    if pixels is None:
        r, c = np.mgrid[:16, :16] - 7.5
        pixels = np.repeat(np.maximum(0, 1 - (r**2 + c**2) / 30)[None], 12, axis=0).astype("float32")
    tiff = io.BytesIO()
    tifffile.imwrite(tiff, pixels, photometric="minisblack")
    return {"scan.json": json.dumps(scan).encode(), "projections.tif": tiff.getvalue()}


def announce(http: httpx.Client, files: dict[str, bytes], name: str = "small") -> dict[str, Any]:
    listed = [{"name": file, "size": len(data)} for file, data in files.items()]
    answer = http.post("/v1/uploads", json={"name": name, "files": listed})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def send(http: httpx.Client, files: dict[str, bytes]) -> str:
    upload_id: str = announce(http, files)["id"]
    for file, data in files.items():
        answer = http.put(f"/v1/uploads/{upload_id}/files/{file}", content=data)
        assert answer.status_code == 200, answer.text
    return upload_id


def commit(http: httpx.Client, files: dict[str, bytes]) -> str:
    answer = http.post(f"/v1/uploads/{send(http, files)}/commit")
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def submit(http: httpx.Client, scan_id: str, **options: Any) -> str:
    answer = http.post("/v1/jobs", json={"scan_id": scan_id, "options": options})
    assert answer.status_code == 202, answer.text
    return str(answer.json()["id"])


class Stack:
    """Redis and server run on entry; workers are started by the test."""

    def __init__(self, folder: Path) -> None:
        self.data = folder / "data"
        self.data.mkdir(parents=True)
        self.redis = OwnRedis(folder / "redis", embedded_program())
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")} | {
            "PYTHONPATH": PYTHONPATH,
            "SPLATCT_DATA": str(self.data),
            "SPLATCT_REDIS_URL": self.redis.url,
            "SPLATCT_PORT": str(self.port),
            "SPLATCT_ENGINE": "fake_engine",
            "SPLATCT_RECONCILE_S": "0.5",
            "SPLATCT_CANCEL_GRACE_S": "1",
            "SPLATCT_CHECKPOINT_S": "0.2",
        }
        self._log = (folder / "log.txt").open("ab")
        self._processes: list[subprocess.Popen[bytes]] = []
        self._hooks = {"response": [self._tells_no_path]}
        base_url = f"http://127.0.0.1:{self.port}"
        self.http = httpx.Client(base_url=base_url, trust_env=False, timeout=30, event_hooks=self._hooks)

    def _tells_no_path(self, response: httpx.Response) -> None:
        """Whatever a test asks for: no answer says where things lie on the server."""
        kind = response.headers.get("content-type", "").partition(";")[0]
        if kind in ("application/json", "application/problem+json", "text/plain"):
            response.read()
            for place in (self.data, ROOT, Path(sys.prefix)):
                assert str(place) not in response.text, (response.request.url, response.text)

    def new_key(self, tenant: str, *scopes: str, expires_at: float | None = None) -> tuple[Key, str]:
        """As `splatct keys add` makes one, while the server runs."""
        database = Database(f"sqlite:///{self.data / 'splatct.db'}")
        try:
            return KeyRing(database).add(tenant, "for a test", map(Scope, scopes), expires_at)
        finally:
            database.close()

    def revoke(self, key_id: str) -> None:
        database = Database(f"sqlite:///{self.data / 'splatct.db'}")
        assert KeyRing(database).revoke(key_id) is not None
        database.close()

    def client(self, key: str | None = None) -> httpx.Client:
        """Closed by whoever asked for it."""
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        base_url = str(self.http.base_url)
        return httpx.Client(base_url=base_url, headers=headers, trust_env=False, timeout=30, event_hooks=self._hooks)

    def __enter__(self) -> Self:
        self.redis.start()
        self.server = self.start_server()
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()
        for process in self._processes:
            process.kill()
            process.wait()
        self.redis.stop()
        self._log.close()

    def start_server(self) -> subprocess.Popen[bytes]:
        process = self._start("server")
        self.until(self._answers, what="the server answers")
        return process

    def start_worker(self) -> subprocess.Popen[bytes]:
        return self._start("worker")

    def _start(self, module: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-P", "-m", module, "--tie-to", str(os.getpid())]
        process = subprocess.Popen(command, env=self.environment, stdout=self._log, stderr=self._log)
        self._processes.append(process)
        return process

    def _answers(self) -> bool:
        with contextlib.suppress(httpx.TransportError):
            return self.http.get("/healthz").status_code == 200
        return False

    def job(self, job_id: str) -> dict[str, Any]:
        return dict(self.http.get(f"/v1/jobs/{job_id}").raise_for_status().json())

    def wait(self, job_id: str, *states: str, seconds: float = 30) -> dict[str, Any]:
        """Until the job is in one of `states`."""
        self.until(lambda: self.job(job_id)["state"] in states, seconds, f"{job_id} in {states}")
        return self.job(job_id)

    def engine_pids(self) -> list[int]:
        """Engine processes of this stack, from the kernel's own list."""
        pids = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if entry.name.isdecimal() and str(self.data).encode() in (line := (entry / "cmdline").read_bytes()):
                    if b"worker.engine" in line:
                        pids.append(int(entry.name))
        return pids

    @staticmethod
    def until(condition: Callable[[], bool], seconds: float = 30, what: str = "the condition") -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"waited {seconds} s for: {what}"
            time.sleep(0.05)


def kill(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGKILL)
    process.wait()
