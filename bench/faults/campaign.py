"""Faults at random moments, and what became of the jobs."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import statistics
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from redis import Redis
from redis.exceptions import RedisError
from splatct_client.errors import ClientError

from bench.service import Service
from splatcore.simulate import Simulation

_FINISHED = ("succeeded", "failed", "cancelled")
_PAUSE_S = (0.5, 3.0)  # between two faults
_WAITING = 3  # jobs that are kept waiting or at work, for each worker
_OPTIONS = {"quality": "preview", "calibrate": "full", "splats": 1500, "threads": 1}
_SCAN = Simulation(views=16, det=48, sigma_rot=0.02, sigma_trans=1.0, seed=1)
CHECKPOINT_S = 1.0
SETTINGS = {"checkpoint_s": CHECKPOINT_S, "test_mode": 1, "test_step_s": 0.004}  # the real engine, slowed
_END_S = 600.0  # after the last fault: a job that has not ended by then is stuck


@dataclass(frozen=True)
class Counts:
    """How many faults of each kind."""

    kills: int  # SIGKILL of a worker or of an engine, half and half
    server: int
    redis: int
    wipes: int
    drains: int


@dataclass
class Outcome:
    """What was found."""

    jobs: int = 0
    lost: list[str] = field(default_factory=list)  # did not end as succeeded: why
    published_twice: list[str] = field(default_factory=list)
    stuck: list[str] = field(default_factory=list)
    resumed: int = 0  # attempts that went on from a checkpoint
    attempts: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    recovery_s: list[float] = field(default_factory=list)  # from the death of a worker to the job's next attempt
    engine_recovery_s: list[float] = field(default_factory=list)
    lost_s: list[float] = field(default_factory=list)  # work done again, of every attempt after the first

    def good(self) -> bool:
        return not (self.lost or self.published_twice or self.stuck)

    def to_json(self) -> dict[str, Any]:
        return {
            **vars(self), "faults": dict(self.faults), "recovery_median_s": _median(self.recovery_s),
            "engine_recovery_median_s": _median(self.engine_recovery_s), "lost_median_s": _median(self.lost_s),
        }  # fmt: skip


def _median(values: list[float]) -> float | None:
    return round(statistics.median(values), 2) if values else None


class Campaign:
    """One run of all faults against one service."""

    def __init__(self, service: Service, counts: Counts, seed: int, say: Callable[[str], None]) -> None:
        self._service, self._rng, self._say = service, random.Random(seed), say
        plan = ["worker"] * (counts.kills // 2) + ["engine"] * (counts.kills - counts.kills // 2)
        plan += ["server"] * counts.server + ["redis"] * counts.redis
        plan += ["wipe"] * counts.wipes + ["drain"] * counts.drains
        self._rng.shuffle(plan)
        self._plan = plan
        self._scan = service.send_body(24, _SCAN)
        self._ids: list[str] = []
        self._victims: list[tuple[str, str, int, float]] = []  # kind, job, its attempt, when
        self._outcome = Outcome()

    def run(self) -> Outcome:
        for number, kind in enumerate(self._plan, start=1):
            self._live(self._rng.uniform(*_PAUSE_S))
            self._strike(kind)
            self._outcome.faults[kind] += 1
            if number % 10 == 0:
                self._say(f"{number} of {len(self._plan)} faults, {len(self._ids)} jobs")
        self._say("waiting for the last jobs")
        with contextlib.suppress(TimeoutError):
            self._service.until(self._all_ended, _END_S, "all jobs have ended")
        self._judge()
        return self._outcome

    def _live(self, seconds: float) -> None:
        """Keep everything running and jobs coming, and watch who was taken up again."""
        until = time.monotonic() + seconds
        while time.monotonic() < until or (self._victims and time.monotonic() < until + 15):
            self._service.tend()
            jobs = self._service.jobs()
            if jobs is not None:
                self._watch(jobs)
                under_way = sum(job["state"] not in _FINISHED for job in jobs.values())
                if under_way < _WAITING * len(self._service.workers):
                    with contextlib.suppress(ClientError):  # the server may just have been killed
                        self._ids.append(
                            self._service.client.submit(self._scan, {**_OPTIONS, "seed": len(self._ids)}).id
                        )
            time.sleep(0.05)

    def _watch(self, jobs: dict[str, dict[str, Any]]) -> None:
        for victim in list(self._victims):
            kind, job_id, attempt, at = victim
            job = jobs.get(job_id)
            if job is None or job["state"] in _FINISHED:
                self._victims.remove(victim)  # it was done before it could be hit
            elif job["attempt"] > attempt and job["state"] == "running":
                took = time.monotonic() - at
                (self._outcome.recovery_s if kind == "worker" else self._outcome.engine_recovery_s).append(took)
                self._victims.remove(victim)

    def _strike(self, kind: str) -> None:
        service = self._service
        if kind in ("worker", "engine"):
            self._kill_at_work(kind)
        elif kind == "drain":
            self._rng.choice(service.workers).signal(signal.SIGTERM)
        elif kind == "server":
            service.server.signal(signal.SIGKILL)
        elif kind == "redis":
            service.redis.kill()
        else:
            with contextlib.suppress(RedisError), Redis.from_url(service.redis.url) as redis:
                redis.flushall()

    def _kill_at_work(self, kind: str) -> None:
        """A worker that has a job, or an engine; whichever there is first."""
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            self._live(0.05)
            jobs, engines = self._service.jobs() or {}, self._service.engines()
            workers = [w for w in self._service.workers if self._service.job_of(w) in jobs]
            if not engines or not workers:
                continue
            if kind == "worker":
                worker = self._rng.choice(workers)
                job_id = self._service.job_of(worker)
                worker.signal(signal.SIGKILL)
            else:
                job_id = self._rng.choice(sorted(engines))
                with contextlib.suppress(ProcessLookupError):
                    os.kill(engines[job_id], signal.SIGKILL)
            if job_id in jobs:
                self._victims.append((kind, job_id, jobs[job_id]["attempt"], time.monotonic()))
            return

    def _all_ended(self) -> bool:
        jobs = self._service.jobs()
        return jobs is not None and all(i in jobs and jobs[i]["state"] in _FINISHED for i in self._ids)

    def _judge(self) -> None:
        out, jobs = self._outcome, self._service.jobs() or {}
        log = self._service.log.read_text(errors="replace").splitlines()
        published = Counter(i for line in log if "published its results" in line for i in self._ids if i in line)
        for job_id in self._ids:
            job = jobs.get(job_id)
            out.jobs += 1
            if job is None:
                out.lost.append(f"{job_id}: unknown")
            elif job["state"] not in _FINISHED:
                out.stuck.append(f"{job_id}: {job['state']}")
            elif job["state"] != "succeeded":
                out.lost.append(f"{job_id}: {job['state']}, {(job['error'] or {}).get('message', '')[:200]}")
            if published[job_id] > 1:
                out.published_twice.append(job_id)
            if job is not None:
                self._count_work(job_id, job["attempt"])

    def _count_work(self, job_id: str, attempts: int) -> None:
        """What each attempt did again, by the run's own clock, which goes on from the checkpoint's."""
        out, events = self._outcome, self._service.events(job_id)
        out.attempts += attempts
        out.resumed += sum("Going on from the checkpoint" in event["message"] for event in events)
        seconds: dict[int, list[float]] = {}
        for event in events:
            if "attempt" in event and "seconds" in event:
                seconds.setdefault(event["attempt"], []).append(event["seconds"])
        for attempt, told in seconds.items():
            before = [s for earlier, s in seconds.items() if earlier < attempt]
            if before:
                out.lost_s.append(max(0.0, round(before[-1][-1] - told[0], 2)))
