"""What the caller's tenant has taken, and how much there is."""

from __future__ import annotations

from fastapi import APIRouter

from server.quotas import active_jobs, open_uploads, used_bytes
from server.schema import Taken, Usage
from server.service import Served

router = APIRouter(prefix="/v1/usage", tags=["usage"])


@router.get("")
def get_usage(service: Served) -> Usage:
    tenant = service.tenant
    with service.store.database.reading() as read:
        limits = service.quotas.of(read, tenant)
        return Usage(
            bytes=Taken(used=used_bytes(read, tenant), limit=limits.bytes or None),
            active_jobs=Taken(used=active_jobs(read, tenant), limit=limits.active_jobs or None),
            open_uploads=Taken(used=open_uploads(read, tenant), limit=limits.open_uploads or None),
        )
