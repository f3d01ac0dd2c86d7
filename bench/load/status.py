"""How long who asks waits, while scans come in and one is reconstructed."""

from __future__ import annotations

import http.client
import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.synchronize import Event
from pathlib import Path

from bench.load.figures import Figure, Measured, quantile
from bench.load.senders import MIB, announce, ask, give_up, put
from bench.service import Service, in_passing
from splatcore.machine import threads_allowed

MOST_MS = 50.0
HEAD = Path("examples/head")
_SENDERS = 4
_JOBS = 50  # in the list, as many as a page shows
_PAUSE_S = 0.01  # between two questions


def status(seconds: float, file_mib: int, say: Callable[[str], None]) -> Measured:
    with in_passing(workers=1) as service:
        running = _fill(service)
        quiet = _ask(service, running, seconds / 3)
        say("status: asked while only a reconstruction runs")
        with_uploads, sent = _ask_during_uploads(service, running, seconds, file_mib * MIB)
        state = ask(service.url, "GET", f"/v1/jobs/{running}")["state"]
        if state not in ("running", "succeeded"):
            raise RuntimeError(f"the reconstruction that was to run beside the uploads is {state}")
    figures = [Figure("uploads meanwhile", sent / seconds / MIB, "MiB/s")]
    for when, took in (("only the reconstruction", quiet), ("uploads and reconstruction", with_uploads)):
        for route, ms in took.items():
            most = MOST_MS if took is with_uploads else None
            figures.append(Figure(f"{when}: {route}, median", quantile(ms, 0.5), "ms"))
            figures.append(Figure(f"{when}: {route}, p99 of {len(ms)}", quantile(ms, 0.99), "ms", at_most=most))
    how = (
        f"One caller, each question after the answer to the one before, on one connection. Four senders PUT files of "
        f"{file_mib} MiB without a pause; one worker reconstructs examples/head with {threads_allowed()} threads, "
        f"niced by 5 as by default; {_JOBS} jobs in the list."
    )
    raw = {"only the reconstruction": quiet, "uploads and reconstruction": with_uploads}
    return Measured("Status calls under load", how, figures, raw)


def _fill(service: Service) -> str:
    """One job at work, others done for or waiting behind it."""
    scan = service.send(HEAD)
    jobs = [service.client.submit(scan, {"seed": seed}).id for seed in range(_JOBS)]
    for job in jobs[1 : _JOBS // 2]:
        ask(service.url, "POST", f"/v1/jobs/{job}/cancel")
    service.until(lambda: _works(service, jobs[0]), 60, "the reconstruction is at work")
    return jobs[0]


def _works(service: Service, job: str) -> bool:
    """Whether it has begun to fit, and is no longer only reading."""
    told = ask(service.url, "GET", f"/v1/jobs/{job}")
    return bool(told["state"] == "running" and told["stage"] == "level")


def _ask(service: Service, job: str, seconds: float) -> dict[str, list[float]]:
    """Milliseconds of every question."""
    connection = http.client.HTTPConnection("127.0.0.1", service.port, timeout=60)
    routes = {"GET /healthz": "/healthz", "GET /v1/jobs/{id}": f"/v1/jobs/{job}", "GET /v1/jobs": "/v1/jobs?limit=50"}
    took: dict[str, list[float]] = {route: [] for route in routes}
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for route, path in routes.items():
            began = time.perf_counter()
            connection.request("GET", path)
            answer = connection.getresponse()
            answer.read()
            took[route].append(1000 * (time.perf_counter() - began))
            if answer.status != 200:
                raise RuntimeError(f"{route} was answered with {answer.status}")
            time.sleep(_PAUSE_S)
    connection.close()
    return took


def _ask_during_uploads(service: Service, job: str, seconds: float, size: int) -> tuple[dict[str, list[float]], int]:
    """And the bytes that came in meanwhile. The senders are processes, so that they take no turn of ours."""
    spawn = multiprocessing.get_context("spawn")
    stop, sent = spawn.Event(), spawn.Value("q", 0)
    senders = [spawn.Process(target=_keep_sending, args=(service.url, size, stop, sent)) for _ in range(_SENDERS)]
    for sender in senders:
        sender.start()
    try:
        service.until(lambda: sent.value >= _SENDERS * size, 120, "all senders are at it")
        before = sent.value
        took = _ask(service, job, seconds)
        return took, sent.value - before
    finally:
        stop.set()
        for sender in senders:
            sender.join(60)


def _keep_sending(url: str, size: int, stop: Event, sent: multiprocessing.Value) -> None:  # type: ignore[valid-type]
    while not stop.is_set():
        upload = announce(url, size)
        put(f"{upload}/files/projections.tif", size)
        give_up(upload)
        with sent.get_lock():  # type: ignore[attr-defined]
            sent.value += size  # type: ignore[attr-defined]
