"""Is the process alive, and can it do work.

Anybody may ask, as often as they like, so that costs next to nothing: one look, by one thread, serves all who ask
within a second.
"""

from __future__ import annotations

import asyncio
import shutil
import time

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response

from server.dispatch import Dispatcher
from server.schema import Readiness
from server.settings import MIB, Settings
from worker.database import Database
from worker.ledger import jobs

router = APIRouter(tags=["health"])

FRESH_S = 1.0
WRITTEN_S = 15.0  # how long the database's having taken a writer is believed: that keeps others waiting for a moment


class Pulse:
    """What the server needs, looked at when somebody asks. Use it on the event loop."""

    def __init__(self, database: Database, dispatcher: Dispatcher, settings: Settings) -> None:
        self._database, self._dispatcher, self._settings = database, dispatcher, settings
        self._look: asyncio.Task[Readiness] | None = None
        self._looked_at = self._wrote_at = float("-inf")

    async def now(self) -> Readiness:
        look = self._look
        if look is None or (look.done() and time.monotonic() - self._looked_at > FRESH_S):
            look = self._look = asyncio.create_task(asyncio.to_thread(self._readiness))
        return await asyncio.shield(look)  # who leaves ends it for nobody else

    def _readiness(self) -> Readiness:
        try:
            redis = self._dispatcher.reachable()
            workers = self._dispatcher.live_workers() if redis else 0
            database = self._database_answers()
            free = shutil.disk_usage(self._settings.data).free
            disk = free > self._settings.disk_floor_mib * MIB
            ready = database and redis and disk and workers > 0
            return Readiness(ready=ready, database=database, redis=redis, disk=disk, workers=workers)
        finally:
            self._looked_at = time.monotonic()

    def _database_answers(self) -> bool:
        """Whether it can be read, and lately took a writer."""
        try:
            with self._database.reading() as read:
                read.execute(sa.select(jobs.c.id).limit(1)).first()
            if time.monotonic() - self._wrote_at > WRITTEN_S:
                with self._database.writing() as write:
                    write.execute(sa.text("SELECT 1"))
                self._wrote_at = time.monotonic()
        except sa.exc.SQLAlchemyError:
            self._wrote_at = float("-inf")
            return False
        return True


@router.get("/healthz")
async def get_health() -> dict[str, str]:
    """Needs no thread: others may have taken them all."""
    return {"status": "alive"}


@router.get("/readyz", responses={503: {"model": Readiness}})
async def get_readiness(request: Request, response: Response) -> Readiness:
    """As it was a second ago at most."""
    pulse: Pulse = request.app.state.pulse
    readiness = await pulse.now()
    response.status_code = 200 if readiness.ready else 503
    response.headers["Cache-Control"] = "no-store"
    return readiness
