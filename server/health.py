"""Is the process alive, and can it do work."""

from __future__ import annotations

import shutil

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response

from server.dispatch import Dispatcher
from server.schema import Readiness
from server.service import Service
from server.settings import MIB

router = APIRouter(tags=["health"])


@router.get("/healthz")
async def get_health() -> dict[str, str]:
    """Needs no thread: others may have taken them all."""
    return {"status": "alive"}


@router.get("/readyz", responses={503: {"model": Readiness}})
def get_readiness(request: Request, response: Response) -> Readiness:
    dispatcher: Dispatcher = request.app.state.dispatcher
    service: Service = request.app.state.service  # whoever asks: no key is needed to learn that we are ready
    redis = dispatcher.reachable()
    workers = dispatcher.live_workers() if redis else 0
    database = _database_answers(service)
    disk = shutil.disk_usage(service.settings.data).free > service.settings.disk_floor_mib * MIB
    ready = database and redis and disk and workers > 0
    response.status_code = 200 if ready else 503
    response.headers["Cache-Control"] = "no-store"
    return Readiness(ready=ready, database=database, redis=redis, disk=disk, workers=workers)


def _database_answers(service: Service) -> bool:
    try:
        with service.store.database.writing() as write:
            write.execute(sa.text("SELECT 1"))
    except sa.exc.SQLAlchemyError:
        return False
    return True
