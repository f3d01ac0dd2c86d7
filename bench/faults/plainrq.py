"""RQ by itself, as it comes, under the same faults: what the same queue does without a database that knows better.

Everything is the default of the installed version: `rq worker` without options, `Queue.enqueue` without options, a
Redis without a configuration file, which writes snapshots after so many changes and no log of them. Beside that, what
the documentation of both has for who wants more: `Retry`, and a Redis that keeps a log (`appendonly`). As with ours,
whatever dies is started again after a second.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import rq
from redis import Redis
from redis.exceptions import RedisError
from rq import Queue, Retry
from rq.exceptions import NoSuchJobError
from rq.job import Job

from bench.faults.plainjob import work
from bench.service import Part, parent_of
from server.redisserver import find_program
from worker.lifeline import before_exec

WORK_S = 20.0  # of one job; RQ's own limit is 180 s
_ENDED_BADLY = ("failed", "stopped", "canceled")


class DefaultRedis:
    """The program with no option but where it listens and where its files go; and a log of all changes, if wanted."""

    def __init__(self, folder: Path, keeps_log: bool) -> None:
        folder.mkdir()
        self._folder, self._socket, self._more = folder, folder / "redis.sock", ["--appendonly", "yes"] * keeps_log
        self.url = f"unix://{self._socket}?db=0"
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = [str(find_program()), "--port", "0", "--unixsocket", str(self._socket), "--dir", str(self._folder)]
        command += self._more
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdout=quiet, stderr=quiet, preexec_fn=before_exec(signal.SIGKILL))
        deadline = time.monotonic() + 15
        while True:
            with contextlib.suppress(RedisError), Redis.from_url(self.url) as redis:
                if redis.ping():
                    return
            if time.monotonic() > deadline:
                raise TimeoutError("a Redis with default settings does not answer")
            time.sleep(0.05)

    def alive(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@dataclass(frozen=True)
class Setup:
    """How it differs from what comes."""

    name: str
    retries: int = 0
    keeps_log: bool = False


SETUPS = (
    Setup("RQ, its defaults"),
    Setup("RQ, Retry(max=5)", retries=5),
    Setup("RQ, Retry(max=5), Redis with appendonly", retries=5, keeps_log=True),
)


class PlainRQ:
    """A `Target` of `bench.faults.campaign`. Use it in `with`."""

    server: Part | None = None  # nothing stands between who enqueues and Redis

    def __init__(self, folder: Path, workers: int, setup: Setup = SETUPS[0], work_s: float = WORK_S) -> None:
        self._folder, self._work_s = folder / "jobs", work_s
        self._folder.mkdir()
        self._retry = {"retry": Retry(max=setup.retries)} if setup.retries else {}
        self.redis = DefaultRedis(folder / "redis", setup.keeps_log)
        environment = dict(os.environ) | {
            "PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH", "")]))
        }
        self._command = [sys.executable, "-P", "-m", "rq.cli", "worker", "--url", self.redis.url]
        self.workers = [Part(self._command, environment, folder / "log.txt") for _ in range(workers)]
        self._connection = Redis.from_url(self.redis.url)
        self._queue = Queue(connection=self._connection)
        self._ids: list[str] = []
        self._told: dict[str, str] = {}  # the last that the queue said of each job

    def __enter__(self) -> Self:
        self.redis.start()
        self.tend()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for part in self.workers:
            part.stop()
        for pid in _running(self._command):  # work-horses that outlived their workers
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._connection.close()
        self.redis.kill()

    def tend(self) -> None:
        if not self.redis.alive():
            self.redis.start()
        for part in self.workers:
            part.tend()

    def settings(self) -> str:
        """What was left as it comes, as the parts themselves tell it."""
        told = self._connection.config_get("save")["save"], self._connection.config_get("appendonly")["appendonly"]
        retry = self._retry["retry"].max if self._retry else "none"
        version = self._connection.info("server")["redis_version"]
        return f"RQ {rq.__version__}, retries {retry}; Redis {version}, save {told[0]!r}, appendonly {told[1]}"

    def submit(self, number: int) -> str:
        job_id = f"{number}-{time.monotonic_ns()}"  # one that was refused is not tried again under its name
        self._queue.enqueue(work, str(self._folder), job_id, self._work_s, job_id=job_id, **self._retry)
        self._ids.append(job_id)
        return job_id

    def jobs(self) -> dict[str, dict[str, Any]] | None:
        """What has a result is done, whatever the queue says; of the rest the queue knows, or nobody."""
        try:
            in_line = set(self._queue.get_job_ids())
            words = {job_id: self._word(job_id) for job_id in self._ids}
        except RedisError:
            return None
        at_work = self.engines()
        found = {}
        for job_id in self._ids:
            word = words[job_id]
            if self._told.get(job_id) != "finished":  # which it forgets after a while, as it should
                self._told[job_id] = word
            attempts = max(len(_attempts(self._journal(job_id))), 1)
            if (self._folder / f"{job_id}.result").exists():
                found[job_id] = {"state": "succeeded", "attempt": attempts, "error": None}
            elif job_id in at_work:
                found[job_id] = {"state": "running", "attempt": attempts, "error": None}
            elif word == "unknown" or word in _ENDED_BADLY:
                error = {"message": f"the queue says: {word}"}
                found[job_id] = {"state": "failed", "attempt": attempts, "error": error}
            else:  # `started` without a process that does it, too, and `queued` without a place in the queue
                state = "out of line" if word == "queued" and job_id not in in_line else word
                found[job_id] = {"state": state, "attempt": attempts, "error": None}
        return found

    def _word(self, job_id: str) -> str:
        """What the queue says of a job. A wipe may leave a record with nothing in it but a heartbeat."""
        try:
            return str(Job.fetch(job_id, self._connection).get_status().value)
        except NoSuchJobError:
            return "unknown"

    def misreported(self) -> list[str]:
        """Jobs whose result is there, and of which the queue never said so."""
        done = [job_id for job_id, job in (self.jobs() or {}).items() if job["state"] == "succeeded"]
        return [f"{job_id}: {self._told[job_id]}" for job_id in done if self._told[job_id] != "finished"]

    def engines(self) -> dict[str, int]:
        """The work-horse of each job: whoever wrote last in its journal, if it lives."""
        running, found = set(_running(self._command)), {}
        for job_id in self._ids:
            lines = self._journal(job_id)
            if lines and "published" not in lines[-1] and lines[-1]["pid"] in running:
                found[job_id] = int(lines[-1]["pid"])
        return found

    def job_of(self, worker: Part) -> str | None:
        for job_id, pid in self.engines().items():
            with contextlib.suppress(OSError):
                if worker.pid == parent_of(pid):
                    return job_id
        return None

    def kept_ago(self, job_id: str) -> float | None:
        return None

    def events(self, job_id: str) -> list[dict[str, Any]]:
        lines = self._journal(job_id)
        numbers = {pid: number for number, pid in enumerate(_attempts(lines), start=1)}
        told = [line for line in lines if "seconds" in line]
        return [{"attempt": numbers[line["pid"]], "message": "", "seconds": line["seconds"]} for line in told]

    def published(self) -> Counter[str]:
        return Counter({i: sum("published" in line for line in self._journal(i)) for i in self._ids})

    def until(self, condition: Callable[[], bool], seconds: float, what: str) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {seconds:.0f} s until {what}")
            self.tend()
            time.sleep(0.5)

    def _journal(self, job_id: str) -> list[dict[str, Any]]:
        try:
            text = (self._folder / f"{job_id}.jsonl").read_text()
        except FileNotFoundError:
            return []
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def _attempts(journal: list[dict[str, Any]]) -> list[int]:
    """The process of each attempt, in the order of their beginnings."""
    return list(dict.fromkeys(int(line["pid"]) for line in journal))


def _running(command: list[str]) -> list[int]:
    """Processes of this command: workers, and the work-horses that they forked."""
    wanted, found = "\0".join(command).encode(), []
    for entry in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if entry.name.isdecimal() and (entry / "cmdline").read_bytes().startswith(wanted):
                found.append(int(entry.name))
    return found
