"""Routes that keep a job or a scan from the janitor, however old it grows. Who deletes it by hand still may."""

from __future__ import annotations

from uuid import UUID

from fastapi import APIRouter

from server.answers import job_out
from server.problems import not_found
from server.scans import scan_out
from server.schema import JobOut, ScanOut
from server.service import Served, Service

router = APIRouter(prefix="/v1", tags=["pins"])


@router.post("/jobs/{job_id}/pin")
def pin_job(job_id: UUID, service: Served) -> JobOut:
    return _job(service, job_id, True)


@router.delete("/jobs/{job_id}/pin")
def unpin_job(job_id: UUID, service: Served) -> JobOut:
    return _job(service, job_id, False)


@router.post("/scans/{scan_id}/pin")
def pin_scan(scan_id: UUID, service: Served) -> ScanOut:
    return _scan(service, scan_id, True)


@router.delete("/scans/{scan_id}/pin")
def unpin_scan(scan_id: UUID, service: Served) -> ScanOut:
    return _scan(service, scan_id, False)


def _job(service: Service, job_id: UUID, pinned: bool) -> JobOut:
    if not service.store.jobs.pin(str(job_id), pinned):
        raise not_found("job")
    return job_out(service, service.job(job_id))


def _scan(service: Service, scan_id: UUID, pinned: bool) -> ScanOut:
    if not service.store.pin_scan(str(scan_id), pinned):
        raise not_found("scan")
    scan = service.store.scan(str(scan_id))
    if scan is None:  # deleted just now
        raise not_found("scan")
    return scan_out(scan)
