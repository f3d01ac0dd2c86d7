"""The service under test: Valkey, the server and workers as processes in a folder of their own, started again a second
after they died, as `splatct up` does."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
import numpy as np
from splatct_client.client import Client
from splatct_client.scanfolder import read_scan_folder
from splatct_client.sending import send

from server.redisserver import OwnRedis
from splatcore.simulate import Simulation, simulate
from worker.lifeline import before_exec

_AGAIN_S = 1.0  # after a death


class Part:
    """One process of the service, started again when it died. It dies with this process."""

    def __init__(self, command: Sequence[str], environment: dict[str, str], log: Path) -> None:
        self._command, self._environment, self._log = command, environment, log
        self._process: subprocess.Popen[bytes] | None = None
        self._died_at = 0.0

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    def has_died(self) -> bool:
        """And was not started again yet."""
        return self._process is None or self._process.poll() is not None

    def tend(self) -> None:
        if self._process is not None and self._process.poll() is not None:
            self._process, self._died_at = None, time.monotonic()
        if self._process is None and time.monotonic() - self._died_at >= _AGAIN_S:
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    self._command, env=self._environment, stdout=log, stderr=log, preexec_fn=before_exec(signal.SIGKILL)
                )

    def signal(self, which: signal.Signals) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, which)

    def stop(self) -> None:
        self.signal(signal.SIGKILL)
        if self._process is not None:
            self._process.wait()


class Service:
    """Use it in `with`; call `tend` often."""

    def __init__(
        self,
        folder: Path,
        workers: int,
        settings: Mapping[str, object] | None = None,
        imports: Sequence[Path] = (),
        server: str = "server",
    ) -> None:
        """`settings` are SPLATCT_* variables by the rest of their names; `imports` are added to PYTHONPATH, `server` is
        the module that serves."""
        self.data, self.log = folder / "data", folder / "log.txt"
        self.data.mkdir(parents=True)
        self.redis = OwnRedis(folder / "redis")
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        paths = [str(Path.cwd()), *map(str, imports), os.environ.get("PYTHONPATH", "")]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("SPLATCT_")} | {
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "SPLATCT_DATA": str(self.data),
            "SPLATCT_REDIS_URL": self.redis.url,
            "SPLATCT_PORT": str(self.port),
            **{f"SPLATCT_{name.upper()}": str(value) for name, value in (settings or {}).items()},
        }
        python = [sys.executable, "-P", "-m"]
        self.server = Part([*python, server], environment, self.log)
        self.workers = [Part([*python, "worker"], environment, self.log) for _ in range(workers)]
        self.url = f"http://127.0.0.1:{self.port}"
        self.client = Client(self.url)

    def __enter__(self) -> Self:
        self.redis.start()
        self.tend()
        self.until(lambda: self.jobs() is not None, 60, "the server answers")
        return self

    def send_body(self, edge: int, what: Simulation) -> str:
        """The id of a small scan: a body with an insert, `edge` voxels a side, simulated and committed."""
        folder = self.data.parent / "scan"
        z, y, x = np.mgrid[-1 : 1 : edge * 1j, -1 : 1 : edge * 1j, -1 : 1 : edge * 1j]
        body = 0.5 * (x**2 + (y / 0.7) ** 2 + (z / 0.8) ** 2 < 0.6) + 0.4 * (abs(x + 0.3) + abs(y) + abs(z) < 0.25)
        simulate(body.astype(np.float32), folder, what, threads=1, name="body")
        return self.send(folder)

    def send(self, folder: Path) -> str:
        return send(self.client, read_scan_folder(folder))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for part in (*self.workers, self.server):
            part.stop()
        self.redis.stop()
        self.client.__exit__(None, None, None)

    def tend(self) -> None:
        """Start again what has died."""
        if not self.redis.alive():
            self.redis.start()
        for part in (self.server, *self.workers):
            part.tend()

    def jobs(self) -> dict[str, dict[str, Any]] | None:
        """All jobs as the server tells them; None while it does not answer."""
        try:
            answer = httpx.get(f"{self.url}/v1/jobs?limit=500", timeout=5, trust_env=False)
            return {job["id"]: job for job in answer.raise_for_status().json()["jobs"]}
        except httpx.HTTPError:
            return None

    def events(self, job_id: str) -> list[dict[str, Any]]:
        path = f"{self.url}/v1/jobs/{job_id}/events"
        return list(httpx.get(path, timeout=10, trust_env=False).raise_for_status().json()["events"])

    def engines(self) -> dict[str, int]:
        """The engine process of each job at work, from the kernel's own list."""
        found = {}
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                line = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdecimal() else []
                if b"worker.engine" in line:
                    job = next((Path(word.decode()) for word in line if str(self.data).encode() in word), None)
                    if job is not None:
                        found[job.name] = int(entry.name)
        return found

    def job_of(self, worker: Part) -> str | None:
        """What a worker is at: its engine is its grandchild."""
        for job_id, pid in self.engines().items():
            with contextlib.suppress(OSError):
                if worker.pid in (parent := parent_of(pid), parent_of(parent)):
                    return job_id
        return None

    def until(self, condition: Any, seconds: float, what: str) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {seconds:.0f} s until {what}; the service's log is {self.log}")
            self.tend()
            time.sleep(0.1)


@contextlib.contextmanager
def in_passing(
    workers: int, settings: Mapping[str, object] | None = None, imports: Sequence[Path] = (), server: str = "server"
) -> Iterator[Service]:
    """A service in a temporary folder."""
    with (
        tempfile.TemporaryDirectory(prefix="splatct-bench-", ignore_cleanup_errors=True) as folder,
        Service(Path(folder), workers, settings, imports, server) as service,
    ):
        yield service


def parent_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])
