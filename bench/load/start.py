"""From a submission on an idle queue to the engine's process, and to the first that is heard of it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

from bench.load.figures import Figure, Measured, quantile
from bench.load.processes import started_at
from bench.load.senders import ask
from bench.load.status import HEAD
from bench.service import Service, in_passing

MOST_START_S, MOST_FIRST_S = 2.0, 7.0
_SOON_OVER = {"quality": "preview", "calibrate": "none", "rotation": "given"}  # changes nothing before the first event
_FINISHED = ("succeeded", "failed", "cancelled")


def start(submissions: int, say: Callable[[str], None]) -> Measured:
    engine, first = [], []
    with in_passing(workers=2) as service:
        scan = service.send(HEAD)
        service.until(lambda: ask(service.url, "GET", "/readyz")["workers"] == 2, 60, "both workers are there")
        for number in range(submissions):
            started, heard = _submit(service, scan, number)
            engine.append(started)
            first.append(heard)
            if (number + 1) % 5 == 0:
                say(f"start: {number + 1} of {submissions} submissions")
    figures = [
        Figure("to the engine's process, median", quantile(engine, 0.5), "s"),
        Figure("to the engine's process, p95", quantile(engine, 0.95), "s", at_most=MOST_START_S),
        Figure("to the first progress event, median", quantile(first, 0.5), "s"),
        Figure("to the first progress event, longest", max(first), "s", at_most=MOST_FIRST_S),
    ]
    how = (
        f"{submissions} submissions of examples/head, one at a time, when nothing else waits or runs; two workers. "
        "From before the request to the kernel's start time of the process (10 ms), or to the event's own time."
    )
    return Measured("Submission to engine", how, figures, {"engine_s": engine, "first_event_s": first})


def _submit(service: Service, scan: str, seed: int) -> tuple[float, float]:
    """(seconds to the engine's process, seconds to its first event)."""
    time.sleep(0.5 + 0.1 * (seed % 10))  # not always at the same moment of the loops that look every so often
    boot, now = time.clock_gettime(time.CLOCK_BOOTTIME), time.time()
    job = service.client.submit(scan, {**_SOON_OVER, "seed": seed}).id
    found: list[int] = []

    def runs() -> bool:
        found.extend(pid for job_id, pid in service.engines().items() if job_id == job)
        return bool(found)

    service.until(runs, 60, "the engine runs")
    process = started_at(found[0])
    journal = service.data / "jobs" / job / "events.jsonl"
    service.until(lambda: journal.exists() and b"\n" in journal.read_bytes(), 60, "the first event is there")
    heard = json.loads(journal.read_bytes().split(b"\n")[0])["at"]
    ask(service.url, "POST", f"/v1/jobs/{job}/cancel")
    service.until(lambda: ask(service.url, "GET", f"/v1/jobs/{job}")["state"] in _FINISHED, 120, "it has ended")
    return process - boot, float(heard) - now
