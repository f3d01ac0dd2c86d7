"""Whether the server and its workers grow with the jobs that they have seen."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bench.load.figures import Figure, Measured
from bench.load.processes import resident
from bench.load.senders import ask, fetch
from bench.service import Service, in_passing
from splatcore.simulate import Simulation

MOST_PER_JOB = 1024.0  # bytes: a million jobs are a gigabyte then
FAKES = Path("tests/worker/fakes")  # an engine that does nothing, and a check that measures itself
_WARM = 0.3  # of the jobs: caches fill, threads and connections are made
_CALLERS = 4
_WORKERS = 2


def memory(jobs: int, say: Callable[[str], None]) -> Measured:
    """So many jobs from submission to results, each asked for as a client and a page do."""
    with in_passing(_WORKERS, {"engine": "fake_engine"}, [FAKES]) as service:
        scan = service.send_body(24, Simulation(views=16, det=48, seed=1))
        samples = _Run(service, scan, jobs, say).run()
    count, *held = np.array(samples, float).T
    figures = []
    for name, one, most in (("server", held[0], MOST_PER_JOB), ("workers, mean", np.mean(held[1:], axis=0), None)):
        slope, error = growth(count, one)
        figures += [
            Figure(f"{name}: after {_WARM:.0%} of the jobs", _after(count, one, _WARM * jobs) / 1e6, "MB"),
            Figure(f"{name}: after all", one[-1] / 1e6, "MB"),
            Figure(f"{name}: growth after that", slope, "bytes/job", at_most=most),
            Figure(f"{name}: growth, standard error", error, "bytes/job"),
        ]
    how = (
        f"{jobs} jobs with the tests' engine, {_WORKERS} workers, {_CALLERS} callers; each job is submitted, waited "
        "for by long poll, and its events, manifest, volume and a slice are fetched, the list of jobs too. Resident "
        f"memory at every tenth; growth is the slope of a line through what came after the first {_WARM:.0%}."
    )
    return Measured("Memory over many jobs", how, figures, {"jobs, server, workers (bytes)": samples})


class _Run:
    """Callers who share a number of jobs."""

    def __init__(self, service: Service, scan: str, jobs: int, say: Callable[[str], None]) -> None:
        self._service, self._scan, self._left, self._done, self._say = service, scan, jobs, 0, say
        self._jobs = jobs
        self._samples: list[list[int]] = []
        self._guard = threading.Lock()
        self._failure: Exception | None = None

    def run(self) -> list[list[int]]:
        """[jobs done, bytes of the server, of each worker] at every tenth job."""
        callers = [threading.Thread(target=self._call) for _ in range(_CALLERS)]
        for caller in callers:
            caller.start()
        for caller in callers:
            caller.join()
        if self._failure is not None:
            raise self._failure
        return self._samples

    def _call(self) -> None:
        while self._takes_one():
            try:
                self._see_through()
            except Exception as failure:  # of a thread: raised again by `run`
                self._failure = failure
                return
            self._count()

    def _takes_one(self) -> bool:
        with self._guard:
            self._left -= 1
            return self._left >= 0 and self._failure is None

    def _see_through(self) -> None:
        url = self._service.url
        job = ask(url, "POST", "/v1/jobs", {"scan_id": self._scan})["id"]
        deadline = time.monotonic() + 300
        while (told := ask(url, "GET", f"/v1/jobs/{job}?wait=30"))["state"] not in ("succeeded", "failed"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"job {job} is {told['state']} after 300 s; the log is {self._service.log}")
        if told["state"] != "succeeded":
            raise RuntimeError(f"job {job} failed: {json.dumps(told['error'])}")
        for path in ("events", "results", "results/volume.tif", "slices/z/2.png"):
            fetch(url, f"/v1/jobs/{job}/{path}")
        fetch(url, "/v1/jobs?limit=50")

    def _count(self) -> None:
        with self._guard:
            self._done += 1
            if self._done % 10 == 0:
                parts = (self._service.server, *self._service.workers)
                self._samples.append([self._done, *(resident(part.pid or 0) for part in parts)])
            if self._done % max(1, self._jobs // 5) == 0:
                self._say(f"memory: {self._done} of {self._jobs} jobs")


def growth(count: np.ndarray, held: np.ndarray) -> tuple[float, float]:
    """Bytes per job after the warm-up, and the standard error of that."""
    late = count > _WARM * count[-1]
    x, y = count[late] - count[late].mean(), held[late] - held[late].mean()
    slope = float(x @ y / (x @ x))
    residual = y - slope * x
    return slope, float(np.sqrt(residual @ residual / max(1, len(x) - 2) / (x @ x)))


def _after(count: np.ndarray, held: np.ndarray, jobs: float) -> float:
    return float(held[np.searchsorted(count, jobs)])
