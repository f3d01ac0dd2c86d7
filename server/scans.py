"""Routes about committed scans."""

from __future__ import annotations

from uuid import UUID

from fastapi import APIRouter

from server.problems import ApiProblem, not_found
from server.schema import ScanList, ScanOut, moment
from server.service import Served
from server.store import Scan

router = APIRouter(prefix="/v1/scans", tags=["scans"])


@router.get("")
def list_scans(service: Served) -> ScanList:
    return ScanList(scans=[scan_out(scan) for scan in service.store.scans()])


@router.get("/{scan_id}")
def get_scan(scan_id: UUID, service: Served) -> ScanOut:
    scan = service.store.scan(str(scan_id))
    if scan is None:
        raise not_found("scan")
    return scan_out(scan)


@router.delete("/{scan_id}", status_code=204)
def delete_scan(scan_id: UUID, service: Served) -> None:
    if service.store.scan(str(scan_id)) is None:
        raise not_found("scan")
    if not service.reserve.deleting(lambda: service.store.drop_scan(str(scan_id))):
        if service.store.scan(str(scan_id)) is None:  # deleted by another request just now
            raise not_found("scan")
        raise ApiProblem(409, "in-use", "A job that has not finished needs this scan.")
    service.intake.remove_scan(str(scan_id))
    service.reserve.fill()


def scan_out(scan: Scan) -> ScanOut:
    return ScanOut(
        id=scan.id,
        name=scan.name,
        bytes=scan.bytes,
        facts=scan.facts,
        pinned=scan.pinned,
        created_at=moment(scan.created_at),
        links={"self": f"/v1/scans/{scan.id}"},
    )
