"""Puts jobs on the queue and asks it who is there. The only file of the server that knows RQ and Redis."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import cast

from redis import Redis
from redis.backoff import NoBackoff
from redis.exceptions import RedisError
from redis.retry import Retry
from rq import Queue, Worker
from rq.job import Job as QueuedJob
from rq.serializers import JSONSerializer
from rq.utils import utcparse

from worker.contract import QUEUE, TASK, queue_id
from worker.ledger import Job

__all__ = ["Dispatcher", "RedisError"]

MOST_WAITING = 200  # on the queue: each is a sign that wakes a worker, which asks the database whose turn it is
PICK_UP_S = 6.0  # how long a job may be off the queue without its row saying that it runs
WORKER_SILENCE_S = 40.0  # an idle worker shows itself every 15 s, a busy one every 5 s
RESULT_TTL_S = 60
FAILURE_TTL_S = 3600


class Dispatcher:
    def __init__(self, redis_url: str) -> None:
        self._redis = Redis.from_url(
            redis_url, socket_timeout=5.0, socket_connect_timeout=2.0, retry=Retry(NoBackoff(), 1)
        )
        self._queue = Queue(QUEUE, connection=self._redis, serializer=JSONSerializer)
        self._off_since: dict[str, float] = {}

    def ensure_queued(self, jobs: Sequence[Job]) -> None:
        """Put every job on the queue that is not there, oldest first, up to as many as are of use.

        A job just taken by a worker is for a moment neither on the queue nor running; it is left
        alone for that moment. Putting one there twice is harmless: only one claim succeeds.
        """
        waiting = set(self._queue.get_job_ids())
        now = time.monotonic()
        off: dict[str, float] = {}
        for job in jobs[:MOST_WAITING]:
            name = queue_id(job.id, job.attempt)
            if name in waiting:
                continue
            since = self._off_since.get(name, now)
            known = QueuedJob.exists(name, connection=self._redis)
            if known and now - since < PICK_UP_S:
                off[name] = since
                continue
            self._queue.enqueue_call(
                TASK,
                args=(job.id, job.attempt),
                job_id=name,
                timeout=-1,  # the supervisor keeps the time, by a clock that a busy C call cannot stop
                result_ttl=RESULT_TTL_S,
                failure_ttl=FAILURE_TTL_S,
                description=name,
            )
        self._off_since = off

    def reachable(self) -> bool:
        try:
            return bool(self._redis.ping())
        except RedisError:
            return False

    def live_workers(self) -> int:
        """Workers seen lately; 0 when Redis cannot tell.

        Counted by their heartbeats: RQ's list of workers is not restored when Redis was wiped.
        """
        now, live = datetime.now(UTC), 0
        try:
            for key in self._redis.scan_iter(f"{Worker.redis_worker_namespace_prefix}*", count=1000, _type="hash"):
                fields = self._redis.hmget(key, "queues", "last_heartbeat", "death")
                queues, seen, death = cast(list[bytes | None], fields)
                ours = queues is None or QUEUE in queues.decode().split(",")
                if not ours or seen is None or death is not None:
                    continue
                live += (now - utcparse(seen.decode())).total_seconds() < WORKER_SILENCE_S
        except (RedisError, ValueError):
            return 0
        return live

    def close(self) -> None:
        self._redis.close()
