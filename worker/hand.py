"""The RQ worker: stock, save that SIGTERM hands the running job back instead of waiting for its end."""

from __future__ import annotations

import logging
import os
import signal
import time
from types import FrameType

from redis import Redis
from redis.backoff import ExponentialBackoff
from redis.exceptions import ConnectionError as RedisConnectionError
from redis.exceptions import RedisError
from redis.exceptions import TimeoutError as RedisTimeoutError
from redis.retry import Retry
from rq import Queue, Worker
from rq.serializers import JSONSerializer

from worker.contract import QUEUE

log = logging.getLogger("splatct.worker")

WORKER_TTL_S = 30  # also bounds how long RQ sleeps in one wait for a job (TTL - 15)
MONITORING_S = 5


class Hand(Worker):
    """Forwards the first SIGTERM to the child, whose supervisor then queues the job again."""

    asked_to_stop = False

    def request_stop(self, signum: int, frame: FrameType | None) -> None:
        self.asked_to_stop = True
        if self.horse_pid:
            os.kill(self.horse_pid, signal.SIGTERM)
        super().request_stop(signum, frame)  # type: ignore[no-untyped-call]


class WorkLoop:
    """Works until SIGTERM or SIGINT, across outages of Redis.

    RQ's worker gives up when Redis goes away while a job runs. The job itself needs no Redis, so
    the loop waits for it to end and then starts over with a fresh worker.
    """

    def __init__(self, redis_url: str) -> None:
        self._url = redis_url
        self._stopping = False
        self._hand: Hand | None = None

    def run(self) -> None:
        os.environ["SPLATCT_WORKER_PID"] = str(os.getpid())  # the forked child ties its life to this
        while not self._stopping:
            self._listen()
            try:
                self._hand = self._make()
                self._hand.work(logging_level="WARNING")
            except RedisError as error:
                log.warning("Redis is away (%s); trying again", type(error).__name__)
            self._listen()
            if self._hand is not None:
                self._stopping = self._stopping or self._hand.asked_to_stop
                if self._hand.horse_pid:
                    self._hand.wait_for_horse()
                self._hand = None
            if not self._stopping:
                time.sleep(1.0)

    def _make(self) -> Hand:
        retry = Retry(ExponentialBackoff(cap=2.0, base=0.1), 4)
        errors: list[type[Exception]] = [RedisConnectionError, RedisTimeoutError]
        redis = Redis.from_url(self._url, retry=retry, retry_on_error=errors, health_check_interval=15)
        return Hand(
            [Queue(QUEUE, connection=redis, serializer=JSONSerializer)],
            connection=redis,
            serializer=JSONSerializer,
            worker_ttl=WORKER_TTL_S,
            job_monitoring_interval=MONITORING_S,
            log_job_description=False,
        )

    def _listen(self) -> None:
        """Take the signals while RQ does not have them."""
        for which in (signal.SIGTERM, signal.SIGINT):
            signal.signal(which, self._stop)

    def _stop(self, _signal: int, _frame: FrameType | None) -> None:
        self._stopping = True
        if self._hand is not None and self._hand.horse_pid:
            os.kill(self._hand.horse_pid, signal.SIGTERM)
