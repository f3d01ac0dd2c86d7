"""Builds the application. No global app, no settings at import: `create_app(settings)`."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Response
from fastapi.staticfiles import StaticFiles

from server import (
    adding,
    follow,
    health,
    imports,
    jobs,
    metrics,
    pages,
    pins,
    problems,
    results,
    resume,
    scans,
    signin,
    uploads,
    usage,
    webhooks,
)
from server.access import Access
from server.audit import AuditLog
from server.census import Census, Outcomes
from server.deliveries import Outbox, keep_delivering
from server.dispatch import Dispatcher
from server.guard import Guard
from server.health import Pulse
from server.heap import keep_giving_back
from server.importing import roots
from server.intake import Intake
from server.janitor import Janitor, keep_clean
from server.keys import KeyRing
from server.metrics import JobNumbers, Metrics
from server.migrations import prepare
from server.observe import Observer
from server.quotas import Quotas
from server.rates import Buckets, Rates
from server.reconcile import Reconciler, keep_reconciling
from server.rehearsal import DropUploads
from server.reserve import Reserve
from server.retention import Rules
from server.service import Service
from server.sessions import Sessions
from server.settings import MIB, Settings
from server.store import Store
from server.watch import Watch
from server.witness import Witness
from worker.database import Database

log = logging.getLogger("splatct.server")


class _Static(StaticFiles):
    """The page's files, asked for anew each time: after an upgrade no browser mixes old code with new."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "no-cache"
        return response


def create_app(settings: Settings) -> FastAPI:
    """The service for one data folder. Its background tasks run while the app's lifespan does."""
    settings = settings.model_copy(update={"data": settings.data.absolute()})

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        (settings.data / "jobs").mkdir(parents=True, exist_ok=True)
        database = Database(settings.database)
        prepare(database)
        store, intake = Store(database), Intake(settings.data)
        dispatcher = Dispatcher(settings.redis_url)
        watch = Watch(store.jobs, settings.data)
        reconciler = Reconciler(store.jobs, dispatcher, settings.data)
        outcomes, outbox = Outcomes(database), Outbox(database, settings.webhook_retry_s)
        quotas = Quotas.from_settings(settings)
        reserve = Reserve(settings.data, settings.disk_reserve_mib * MIB)
        reserve.fill()
        import_roots = roots(settings.import_from, settings.data)
        loop, wake = asyncio.get_running_loop(), asyncio.Event()

        def wake_up() -> None:
            loop.call_soon_threadsafe(wake.set)

        app.state.service = Service(settings, store, intake, watch, outcomes, quotas, reserve, wake_up, import_roots)
        app.state.metrics = Metrics(JobNumbers(Census(database), outcomes, reconciler, settings.data))
        app.state.pulse = Pulse(database, dispatcher, settings)
        app.state.audit = AuditLog(database)
        app.state.rates = Rates(
            Buckets(settings.rate_per_s, settings.rate_burst),
            Buckets(settings.failures_per_min / 60, max(1, round(settings.failures_per_min))),
        )
        app.state.keys = KeyRing(database)
        app.state.sessions = Sessions(
            database, app.state.keys, round(settings.session_hours * 3600), settings.key_sessions
        )
        tasks = [
            asyncio.create_task(keep_reconciling(reconciler, settings.reconcile_s, wake)),
            asyncio.create_task(watch.keep_looking()),
            asyncio.create_task(keep_clean(Janitor(store, intake, settings.data, Rules.of(settings), reserve))),
            asyncio.create_task(keep_giving_back()),
            asyncio.create_task(keep_delivering(outbox, settings.webhook_networks)),
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            dispatcher.close()
            database.close()

    app = FastAPI(
        title="SplatCT",
        version="1",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        separate_input_output_schemas=False,
    )
    problems.install(app)
    if settings.test_mode:
        log.warning("test mode is on: jobs and uploads may fail on purpose")
        app.add_middleware(DropUploads, share=settings.test_drop_uploads)
    app.add_middleware(Witness)
    app.add_middleware(Access, open_without_keys=settings.may_be_open)
    app.add_middleware(Guard, allowed_hosts=settings.host_names)
    app.add_middleware(Observer)
    for part in (
        signin,
        uploads,
        resume,
        scans,
        jobs,
        follow,
        results,
        health,
        metrics,
        usage,
        webhooks,
        pins,
        adding,
        imports,
    ):
        app.include_router(part.router)
    app.include_router(pages.router)
    app.mount("/static", _Static(directory=Path(__file__).parent / "static"), name="static")
    return app
