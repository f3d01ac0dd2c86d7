"""Routes that take a scan in: announce, send, commit."""

from __future__ import annotations

import threading
from pathlib import Path as FolderPath
from typing import Annotated
from uuid import UUID

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from starlette.requests import ClientDisconnect

from server.adding import file_out
from server.announce import announced, open_upload, require_scan_json
from server.checking import CheckFailed, check_scan
from server.intake import Arrival, Busy, Gone, Mismatch
from server.partial import remove_part
from server.problems import ApiProblem, invalid, not_found
from server.scans import scan_out
from server.schema import FileOut, ScanOut, UploadIn, UploadOut, moment
from server.service import Served, Service
from server.spool import Spool
from server.store import File, Scan, Upload
from splatcore.errors import Problem, ScanError

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

COMMIT_WAIT_S = 30.0
_checks = threading.BoundedSemaphore(2)  # checks are processes; more at once would only wait for the disk

FileName = Annotated[str, Path(max_length=1024)]


@router.post("", status_code=201)
def create_upload(body: UploadIn, service: Served, response: Response) -> UploadOut:
    files = announced(body.files)
    if not body.growing:
        require_scan_json(files)
    upload = open_upload(service, body.name, files)
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    return upload_out(upload)


@router.get("/{upload_id}")
def get_upload(upload_id: UUID, service: Served) -> UploadOut:
    return upload_out(_upload(service, upload_id))


@router.put(
    "/{upload_id}/files/{name}",
    openapi_extra={
        "requestBody": {
            "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
            "required": True,
        }
    },
)
async def put_file(upload_id: UUID, name: FileName, request: Request, service: Served) -> FileOut:
    found = await to_thread.run_sync(service.store.upload_file, str(upload_id), name)
    if found is None:
        raise not_found("file in this upload")
    committed, file = found
    if committed:
        raise ApiProblem(409, "committed", "The upload is committed; its files can no longer change.")
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) != file.size:
        raise invalid(f"{declared} bytes were sent, {file.size} were announced.", [Problem(name, "has another size")])
    try:
        with service.intake.writing(str(upload_id)) as parts:
            sha256 = await _receive(request, service, str(upload_id), file, parts)
    except Busy:
        raise ApiProblem(409, "busy", "The upload is being committed.", retry_after_s=2) from None
    except Gone:
        raise not_found("upload") from None
    except Mismatch as mismatch:
        raise invalid(f"The file was refused: {mismatch}.", [Problem(name, str(mismatch), "send it again")]) from None
    except ClientDisconnect:
        raise ApiProblem(400, "interrupted", "The connection ended before the file did.") from None
    return FileOut(name=name, size=file.size, received=file.size, complete=True, sha256=sha256)


@router.delete("/{upload_id}", status_code=204)
def delete_upload(upload_id: UUID, service: Served) -> None:
    if _upload(service, upload_id).committed:
        raise ApiProblem(409, "committed", "The upload is committed; delete the scan instead.")
    try:
        with service.intake.alone(str(upload_id), wait_s=2.0):
            if service.reserve.deleting(lambda: service.store.drop_upload(str(upload_id))):
                service.intake.remove_upload(str(upload_id))
    except Busy:
        raise ApiProblem(409, "busy", "Files of the upload are still arriving.", retry_after_s=2) from None
    except Gone:
        service.reserve.deleting(lambda: service.store.drop_upload(str(upload_id)))
    service.reserve.fill()


@router.post("/{upload_id}/commit", status_code=201)
def commit_upload(upload_id: UUID, service: Served, response: Response) -> ScanOut:
    upload = _upload(service, upload_id)
    scan = None
    if not upload.committed:
        try:
            with service.intake.alone(upload.id, COMMIT_WAIT_S):
                scan = _commit(service, _upload(service, upload_id))
        except Busy:
            raise ApiProblem(503, "busy", "Files are arriving, or another commit runs.", retry_after_s=2) from None
        except Gone:  # committed by another request just now
            pass
    scan = scan or service.store.scan(upload.id)
    if scan is None:
        raise not_found("upload")
    response.headers["Location"] = f"/v1/scans/{scan.id}"
    return scan_out(scan)


def _commit(service: Service, upload: Upload) -> Scan | None:
    if upload.committed:
        return None
    missing = upload.missing()
    if all(file.name != "scan.json" for file in upload.files):
        missing = ["scan.json", *missing]  # an upload that grew, and was never told of it
    if missing:
        problems = [Problem(name, "is missing", "send it, then commit again") for name in missing[:200]]
        raise ApiProblem(409, "incomplete", f"{len(missing)} files are missing.", problems)
    if not _checks.acquire(timeout=COMMIT_WAIT_S):
        raise ApiProblem(503, "busy", "Other scans are being checked.", retry_after_s=5)
    try:
        facts = check_scan(
            service.intake.open_folder(upload.id), service.settings.check, service.settings.check_memory_mib
        )
    except ScanError as error:
        raise ApiProblem(422, "bad-scan", "The scan cannot be used as it is.", error.problems) from None
    except CheckFailed:
        raise ApiProblem(500, "check-failed", "The scan could not be checked; the server's log says more.") from None
    finally:
        _checks.release()
    service.intake.promote(upload.id)
    scan = service.store.commit(upload, facts)
    service.intake.remove_upload(upload.id)
    return scan


async def _receive(request: Request, service: Service, upload_id: str, file: File, parts: FolderPath) -> str:
    """Stream the body to disk in a thread, hashing on the way; constant memory.

    A newer request for the same file ends this one, as with pieces: many at once would each take the file's size of
    the disk, of which it was given once."""
    async with service.turns.take(upload_id, file.name) as turn:
        arrival = await to_thread.run_sync(Arrival, parts, file.size, file.expected_sha256)
        try:
            async with Spool(arrival.write) as spool:
                with turn.scope:
                    async for piece in request.stream():
                        await spool.give(piece)
                if turn.scope.cancelled_caught:
                    raise ApiProblem(409, "taken-over", "A newer request writes this file now.")
                await spool.empty()
            sha256 = await to_thread.run_sync(arrival.complete)

            def record() -> None:
                service.store.received(upload_id, file.name, sha256)

            await to_thread.run_sync(service.intake.settle, upload_id, file.name, arrival, record)
            await to_thread.run_sync(remove_part, parts, file.name)  # the whole file replaces what came in pieces
            return sha256
        finally:
            await to_thread.run_sync(arrival.discard, abandon_on_cancel=False)


def _upload(service: Service, upload_id: UUID) -> Upload:
    upload = service.store.upload(str(upload_id))
    if upload is None:
        raise not_found("upload")
    return upload


def upload_out(upload: Upload) -> UploadOut:
    base = f"/v1/uploads/{upload.id}"
    links = {"self": base}
    links |= {"scan": f"/v1/scans/{upload.id}"} if upload.committed else {"commit": f"{base}/commit"}
    return UploadOut(
        id=upload.id,
        name=upload.name,
        state="committed" if upload.committed else "open",
        files=[file_out(file) for file in upload.files],
        scan_id=upload.id if upload.committed else None,
        created_at=moment(upload.created_at),
        links=links,
    )
