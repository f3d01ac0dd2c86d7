"""Faults at random moments, and what became of the jobs: of ours, or of whatever else has the parts of a `Target`."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import statistics
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from redis import Redis
from redis.exceptions import RedisError
from splatct_client.errors import ClientError

from bench.service import Part

FINISHED = ("succeeded", "failed", "cancelled")
_UNDER_WAY = ("queued", "running", "cancelling")
_PAUSE_S = (0.5, 3.0)  # between two faults
_WAITING = 3  # jobs that are kept waiting or at work, for each worker
_WATCH_S = 15.0  # a victim of a kill is waited for so long before the next fault; its recovery counts later, too
_IDLE_S = 180.0  # of all workers, which is no fault to count but a campaign that strikes at nothing
END_S = 600.0  # after the last fault: a job that has not ended by then is stuck


@dataclass(frozen=True)
class Counts:
    """How many faults of each kind."""

    kills: int  # SIGKILL of a worker or of an engine, half and half
    server: int
    redis: int
    wipes: int
    drains: int


class RedisPart(Protocol):
    @property
    def url(self) -> str: ...

    def kill(self) -> None:
        """SIGKILL, and wait for its death."""


class Target(Protocol):
    """What a campaign strikes and asks."""

    @property
    def redis(self) -> RedisPart: ...

    @property
    def workers(self) -> Sequence[Part]: ...

    @property
    def server(self) -> Part | None: ...

    def tend(self) -> None:
        """Start again what has died."""

    def jobs(self) -> dict[str, dict[str, Any]] | None:
        """`state`, `attempt` and `error` of all jobs; None while nobody can tell."""

    def submit(self, number: int) -> str: ...

    def engines(self) -> dict[str, int]:
        """The process that does the work of each job."""

    def job_of(self, worker: Part) -> str | None: ...

    def kept_ago(self, job_id: str) -> float | None:
        """Seconds since the state of the job was kept; None if it is not."""

    def events(self, job_id: str) -> list[dict[str, Any]]:
        """Of each attempt, with `attempt`, `message` and `seconds` of work done."""

    def published(self) -> Counter[str]:
        """How often the result of each job was put in its place."""

    def until(self, condition: Callable[[], bool], seconds: float, what: str) -> None: ...


@dataclass
class Outcome:
    """What was found."""

    jobs: int = 0
    end_s: float = END_S
    work_s: list[float] = field(default_factory=list)  # of each job, without what was done again
    lost: list[str] = field(default_factory=list)  # did not end as succeeded: why
    published_twice: list[str] = field(default_factory=list)
    stuck: list[str] = field(default_factory=list)
    resumed: int = 0  # attempts that went on from a checkpoint
    attempts: int = 0
    misreported: list[str] = field(default_factory=list)  # done, and never told so
    faults: Counter[str] = field(default_factory=Counter)
    struck: Counter[str] = field(default_factory=Counter)  # kills that met a job at work, of each kind
    recovery_s: list[float] = field(default_factory=list)  # from the death of a worker to the job's next attempt
    engine_recovery_s: list[float] = field(default_factory=list)
    lost_s: list[float] = field(default_factory=list)  # work done again, of every attempt after the first
    beyond_s: list[float] = field(default_factory=list)  # the part of it that was done before the state was kept

    def good(self) -> bool:
        return not (self.lost or self.published_twice or self.stuck)

    def to_json(self) -> dict[str, Any]:
        return {
            **vars(self), "faults": dict(self.faults), "struck": dict(self.struck),
            "recovery_median_s": _median(self.recovery_s), "lost_median_s": _median(self.lost_s),
            "engine_recovery_median_s": _median(self.engine_recovery_s), "work_median_s": _median(self.work_s),
        }  # fmt: skip


def _median(values: list[float]) -> float | None:
    return round(statistics.median(values), 2) if values else None


class Campaign:
    """One run of all faults against one service. What it has no part for, a server, is left alone."""

    def __init__(
        self, service: Target, counts: Counts, seed: int, say: Callable[[str], None], watch_s: float = _WATCH_S,
        end_s: float = END_S,
    ) -> None:  # fmt: skip
        self._service, self._rng, self._say = service, random.Random(seed), say
        self._watch_s = watch_s
        plan = ["worker"] * (counts.kills // 2) + ["engine"] * (counts.kills - counts.kills // 2)
        plan += ["server"] * counts.server + ["redis"] * counts.redis
        plan += ["wipe"] * counts.wipes + ["drain"] * counts.drains
        self._rng.shuffle(plan)
        self._plan = plan
        self._ids: list[str] = []
        self._victims: list[tuple[str, str, int, float]] = []  # kind, job, its attempt, when
        self._kept_ago: dict[tuple[str, int], float] = {}  # by job and the attempt that was killed
        self._outcome = Outcome(end_s=end_s)

    def run(self) -> Outcome:
        for number, kind in enumerate(self._plan, start=1):
            self._live(self._rng.uniform(*_PAUSE_S))
            if kind != "server" or self._service.server is not None:
                self._strike(kind)
                self._outcome.faults[kind] += 1
            if number % 10 == 0:
                self._say(f"{number} of {len(self._plan)} faults, {len(self._ids)} jobs")
        self._say("waiting for the last jobs")
        with contextlib.suppress(TimeoutError):
            self._service.until(self._all_ended, self._outcome.end_s, "all jobs have ended")
        self._judge()
        return self._outcome

    def _live(self, seconds: float) -> None:
        """Keep everything running and jobs coming, and watch who was taken up again."""
        until = time.monotonic() + seconds
        while time.monotonic() < until or self._is_waiting():
            self._service.tend()
            jobs = self._service.jobs()
            if jobs is not None:
                self._watch(jobs)
                under_way = sum(job["state"] in _UNDER_WAY for job in jobs.values())
                if under_way < _WAITING * len(self._service.workers):
                    with contextlib.suppress(ClientError, RedisError):  # what takes jobs may just have been killed
                        self._ids.append(self._service.submit(len(self._ids)))
            time.sleep(0.05)

    def _is_waiting(self) -> bool:
        """For a victim to be taken up again."""
        return any(time.monotonic() - at < self._watch_s for *_, at in self._victims)

    def _watch(self, jobs: dict[str, dict[str, Any]]) -> None:
        for victim in list(self._victims):
            kind, job_id, attempt, at = victim
            job = jobs.get(job_id)
            if job is None or job["state"] in FINISHED:
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
            assert service.server is not None
            service.server.signal(signal.SIGKILL)
        elif kind == "redis":
            service.redis.kill()
        else:
            with contextlib.suppress(RedisError), Redis.from_url(service.redis.url) as redis:
                redis.flushall()

    def _kill_at_work(self, kind: str) -> None:
        """A worker that has a job, or an engine; whichever there is first."""
        deadline = time.monotonic() + _IDLE_S
        while time.monotonic() < deadline:
            self._live(0.05)
            jobs, engines = self._service.jobs() or {}, self._service.engines()
            workers = [w for w in self._service.workers if self._service.job_of(w) in jobs]
            if not engines or not workers:
                continue
            worker = self._rng.choice(workers)
            job_id = self._service.job_of(worker) if kind == "worker" else self._rng.choice(sorted(engines))
            if job_id is None or job_id not in jobs:
                continue
            attempt, kept_ago = jobs[job_id]["attempt"], self._service.kept_ago(job_id)
            if kind == "worker":
                worker.signal(signal.SIGKILL)
            else:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(engines[job_id], signal.SIGKILL)
            self._outcome.struck[kind] += 1
            self._victims.append((kind, job_id, attempt, time.monotonic()))
            if kept_ago is not None:
                self._kept_ago[job_id, attempt] = kept_ago
            return
        raise TimeoutError(f"no worker had a job for {_IDLE_S:.0f} s: there is nothing to kill")

    def _all_ended(self) -> bool:
        jobs = self._service.jobs()
        return jobs is not None and all(i in jobs and jobs[i]["state"] in FINISHED for i in self._ids)

    def _judge(self) -> None:
        out, jobs = self._outcome, self._service.jobs() or {}
        published = self._service.published()
        for job_id in self._ids:
            job = jobs.get(job_id)
            out.jobs += 1
            if job is None:
                out.lost.append(f"{job_id}: unknown")
            elif job["state"] not in FINISHED:
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
            # What is told before a run begins, or goes on, has no part of its time.
            if "attempt" in event and "seconds" in event and event.get("stage") != "read":
                seconds.setdefault(event["attempt"], []).append(event["seconds"])
        if seconds:
            out.work_s.append(max(told[-1] for told in seconds.values()))
        for attempt, told in seconds.items():
            before = max((earlier for earlier in seconds if earlier < attempt), default=None)
            if before is None:
                continue
            again = max(0.0, round(seconds[before][-1] - told[0], 2))
            out.lost_s.append(again)
            if (job_id, before) in self._kept_ago:
                out.beyond_s.append(max(0.0, round(again - self._kept_ago[job_id, before], 2)))
