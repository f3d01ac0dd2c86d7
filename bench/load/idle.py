"""What the service costs while nothing is to be done, and while fifty pages look at a job."""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.synchronize import Semaphore
from pathlib import Path

import httpx

from bench.load.figures import Figure, Measured
from bench.load.memory import FAKES
from bench.load.processes import children, cpu_s, written
from bench.load.senders import ask
from bench.service import Service, in_passing
from tests.http.stack import commit, scan_files

PAGES = 50
_START_S = 60.0
_PAGE_S = 2.0  # between two refreshes, as static/jobs.js and job.js have it where there is no stream


@dataclass(frozen=True)
class _Cost:
    """Per second."""

    server_percent: float
    workers_percent: float
    reads: float
    writes: float
    written: float

    def figures(self, when: str) -> list[Figure]:
        return [
            Figure(f"{when}: server", self.server_percent, "% of a core"),
            Figure(f"{when}: all workers", self.workers_percent, "% of a core"),
            Figure(f"{when}: SQL reads", self.reads, "1/s"),
            Figure(f"{when}: SQL writes", self.writes, "1/s"),
            Figure(f"{when}: server to disk", self.written / 1024, "KiB/s"),
        ]


def idle(seconds: float, finished: int, say: Callable[[str], None]) -> Measured:
    with (
        tempfile.TemporaryDirectory(prefix="splatct-bench-") as folder,
        in_passing(
            2,
            {"engine": "fake_engine", "bench_counts": (counts := Path(folder, "counts.json"))},
            [FAKES],
            server="bench.load.counted",
        ) as service,
    ):
        with httpx.Client(base_url=service.url, trust_env=False, timeout=30) as http:
            quick = commit(http, scan_files(steps=1))
            slow = commit(http, scan_files(steps=100_000, pause=1.0))
        done = [ask(service.url, "POST", "/v1/jobs", {"scan_id": quick})["id"] for _ in range(finished)]
        service.until(lambda: _all_done(service, done), 300, "all jobs are done")
        nobody = _cost(service, counts, seconds)
        say("idle: with nobody")
        job = ask(service.url, "POST", "/v1/jobs", {"scan_id": slow})["id"]
        service.until(lambda: ask(service.url, "GET", f"/v1/jobs/{job}")["state"] == "running", 30, "a job runs")
        running = _cost(service, counts, seconds)
        say("idle: with a job")
        watched = {}
        for kind in ("polling", "streaming"):
            with _pages(service, job, streaming=kind == "streaming"):
                watched[kind] = _cost(service, counts, seconds)
            say(f"idle: with {PAGES} pages {kind}")
    figures = [*nobody.figures("nobody, no job"), *running.figures("nobody, a job at work")]
    for kind, cost in watched.items():
        figures += cost.figures(f"{PAGES} pages {kind}, a job at work")
    how = (
        f"{seconds:.0f} s each; {finished} finished jobs kept, two workers; the job at work has news every second. "
        f"Polling: half of the pages ask for the list, half for the job and its news, every {_PAGE_S:g} s, as the "
        "status page does where it has no stream. Streaming: half follow the list, half the job."
    )
    return Measured("The cost of idling and of being watched", how, figures)


def _all_done(service: Service, jobs: list[str]) -> bool:
    states = {job["id"]: job["state"] for job in (service.jobs() or {}).values()}
    if "failed" in states.values():
        raise RuntimeError(f"a job failed; the log is {service.log}")
    return all(states.get(job) == "succeeded" for job in jobs)


def _cost(service: Service, counts: Path, seconds: float) -> _Cost:
    before, began = _standing(service, counts), time.monotonic()
    time.sleep(seconds)
    after, took = _standing(service, counts), time.monotonic() - began
    return _Cost(*((a - b) / took for a, b in zip(after, before, strict=True)))


def _standing(service: Service, counts: Path) -> tuple[float, float, float, float, float]:
    """Processor seconds in percent, statements, bytes: all since the start."""
    server = service.server.pid or 0
    counts.unlink(missing_ok=True)
    os.kill(server, signal.SIGUSR1)
    service.until(counts.exists, 10, "the server has told its counts")
    told = json.loads(counts.read_text())
    workers = sum(_family_s(worker.pid or 0) for worker in service.workers)
    return 100 * cpu_s(server), 100 * workers, told.get("read", 0), told.get("write", 0), written(server)


def _family_s(pid: int) -> float:
    """A worker's, its forked child's and that one's engine's."""
    return cpu_s(pid) + sum(_family_s(child) for child in children(pid))


@contextlib.contextmanager
def _pages(service: Service, job: str, streaming: bool) -> Iterator[None]:
    """Fifty of them in a process of their own, at odds with each other."""
    spawn = multiprocessing.get_context("spawn")
    there = spawn.Semaphore(0)
    process = spawn.Process(target=_look, args=(service.url, job, streaming, there))
    process.start()
    try:
        for page in range(PAGES):
            if not there.acquire(timeout=_START_S):
                raise RuntimeError(
                    f"{page} of {PAGES} pages had an answer; their process's exit code: {process.exitcode}"
                )
        yield
        if not process.is_alive():
            raise RuntimeError(f"the pages ended with {process.exitcode}")
    finally:
        process.terminate()
        process.join()


def _look(url: str, job: str, streaming: bool, there: Semaphore) -> None:
    asyncio.run(_all_pages(url, job, streaming, there))


async def _all_pages(url: str, job: str, streaming: bool, there: Semaphore) -> None:
    limits = httpx.Limits(max_connections=PAGES, max_keepalive_connections=PAGES)
    async with httpx.AsyncClient(base_url=url, trust_env=False, timeout=60, limits=limits) as http:
        pages = [
            _stream(http, job, number, there) if streaming else _poll(http, job, number, there)
            for number in range(PAGES)
        ]
        await asyncio.gather(*pages)


async def _poll(http: httpx.AsyncClient, job: str, number: int, there: Semaphore) -> None:
    last, first = 0, True
    await asyncio.sleep(_PAGE_S * number / PAGES)
    while True:
        if number % 2:
            (await http.get("/v1/jobs?limit=50")).raise_for_status()
        else:
            (await http.get(f"/v1/jobs/{job}")).raise_for_status()
            last = (await http.get(f"/v1/jobs/{job}/events?after={last}")).raise_for_status().json()["last"]
        if first:
            there.release()
            first = False
        await asyncio.sleep(_PAGE_S)


async def _stream(http: httpx.AsyncClient, job: str, number: int, there: Semaphore) -> None:
    url = "/v1/events" if number % 2 else f"/v1/jobs/{job}/events/stream?job=true"
    async with http.stream("GET", url) as events:
        events.raise_for_status()
        there.release()
        async for _ in events.aiter_lines():
            pass
    raise RuntimeError("the stream ended, and the job had not")
