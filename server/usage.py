"""What the caller's tenant has taken, and how much there is."""

from __future__ import annotations

from fastapi import APIRouter

from server.quotas import active_jobs, used_bytes
from server.schema import Taken, Usage
from server.service import Served

router = APIRouter(prefix="/v1/usage", tags=["usage"])


@router.get("")
def get_usage(service: Served) -> Usage:
    tenant, quotas = service.tenant, service.quotas
    with service.store.database.reading() as read:
        size, active = used_bytes(read, tenant), active_jobs(read, tenant)
    return Usage(
        bytes=Taken(used=size, limit=quotas.bytes or None),
        active_jobs=Taken(used=active, limit=quotas.active_jobs or None),
    )
