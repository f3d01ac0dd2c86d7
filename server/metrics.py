"""`GET /metrics`: the service in Prometheus' text format. Labels have few values; none names a job."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from pathlib import Path

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy.exc import SQLAlchemyError

from server.census import Census, Outcomes
from server.reconcile import Reconciler
from worker.contract import ErrorKind, State

log = logging.getLogger("splatct.server")

router = APIRouter(tags=["health"])

_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0)
_OUTCOMES = [(State.SUCCEEDED, ""), (State.CANCELLED, ""), *((State.FAILED, kind.value) for kind in ErrorKind)]


class Metrics:
    """What is counted as it happens; the rest is looked up when asked for."""

    def __init__(self, jobs: Collector) -> None:
        self.registry = CollectorRegistry()
        self.registry.register(jobs)
        self.requests = Counter(
            "splatct_requests", "Requests answered", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "splatct_request_seconds",
            "From a request's first byte to its answer's last; long polls and streams wait on purpose",
            ["method", "route"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.upload_bytes = Counter("splatct_upload_bytes", "Bytes of files received", registry=self.registry)


class JobNumbers(Collector):
    def __init__(self, census: Census, outcomes: Outcomes, reconciler: Reconciler, data: Path) -> None:
        self._census = census
        self._outcomes = outcomes
        self._reconciler = reconciler
        self._data = data

    def describe(self) -> Iterator[Metric]:
        """Nothing, so that registering asks no database."""
        return iter(())

    def collect(self) -> Iterator[Metric]:
        try:
            yield from self._from_database()
            reachable = 1
        except SQLAlchemyError:
            log.warning("the database did not answer; its metrics are missing", exc_info=True)
            reachable = 0
        yield GaugeMetricFamily("splatct_database_up", "Whether the database answered", value=reachable)
        free = shutil.disk_usage(self._data).free
        yield GaugeMetricFamily("splatct_disk_free_bytes", "Free where the data folder lies", value=free)
        recovered = self._reconciler.recoveries
        yield CounterMetricFamily("splatct_recoveries", "Jobs taken from a worker that had died", value=recovered)

    def _from_database(self) -> list[Metric]:
        self._outcomes.catch_up()
        jobs = GaugeMetricFamily("splatct_jobs", "Jobs in the database", labels=["state"])
        for state, count in self._census.by_state().items():
            jobs.add_metric([state.value], count)
        age = GaugeMetricFamily(
            "splatct_queue_age_seconds",
            "Since the oldest queued job was submitted; 0 when none waits",
            value=self._census.queue_age_s(),
        )
        finished = CounterMetricFamily("splatct_jobs_finished", "Jobs that ended", labels=["outcome", "error"])
        counts = dict.fromkeys(_OUTCOMES, 0) | self._outcomes.counts
        for (state, kind), count in counts.items():
            finished.add_metric([state.value, kind], count)
        return [jobs, age, finished]


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
def get_metrics(request: Request) -> Response:
    metrics: Metrics = request.app.state.metrics
    headers = {"Content-Type": CONTENT_TYPE_LATEST, "Cache-Control": "no-store"}
    return Response(generate_latest(metrics.registry), headers=headers)
