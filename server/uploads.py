"""Routes that take a scan in: announce, send, commit."""

from __future__ import annotations

import threading
from typing import Annotated
from uuid import UUID, uuid4

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response

from server.adding import file_out
from server.announce import announced, open_once, open_upload, require_scan_json
from server.checking import CheckFailed, check_scan
from server.intake import Busy, Gone, Mismatch
from server.partial import Part, remove_part
from server.problems import ApiProblem, invalid, not_found
from server.receiving import End, finish, look, only_writer, receive
from server.scans import scan_out
from server.schema import FileOut, ScanOut, UploadIn, UploadOut, moment
from server.service import Served, Service
from server.store import File, Scan, Upload
from splatcore.errors import Problem, ScanError

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

COMMIT_WAIT_S = 30.0
_checks = threading.BoundedSemaphore(2)  # checks are processes; more at once would only wait for the disk

FileName = Annotated[str, Path(max_length=1024)]


@router.post("", status_code=201)
def create_upload(body: UploadIn, service: Served, response: Response) -> UploadOut:
    upload = open_upload(service, body.name, _files(body))
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    return upload_out(upload)


@router.put("/{upload_id}", status_code=201)
def put_upload(upload_id: UUID, body: UploadIn, service: Served, response: Response) -> UploadOut:
    """The same under an id of the client's own. Repeated with the same body: the upload; with another: 409."""
    upload, replayed = open_once(service, str(upload_id), body.name, _files(body))
    response.headers["Location"] = f"/v1/uploads/{upload.id}"
    if replayed:
        response.headers["Idempotency-Replayed"] = "true"
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
    """One whole file, in place of what there is of it. What was cut leaves nothing behind."""
    committed, file = await look(service, str(upload_id), name)
    if committed:
        raise _committed()
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) != file.size:
        raise invalid(f"{declared} bytes were sent, {file.size} were announced.", [Problem(name, "has another size")])
    async with only_writer(service, str(upload_id), name) as (turn, file, parts):
        if parts is None:
            raise _committed()
        part = await to_thread.run_sync(Part, parts / uuid4().hex, file.size)
        try:
            end = await receive(request, turn, part.write)
            if end is End.TAKEN_OVER:
                raise ApiProblem(409, "taken-over", "A newer request writes this file now.")
            if end is End.CUT:
                raise ApiProblem(400, "interrupted", "The connection ended before the file did.")
            sha256 = await to_thread.run_sync(_settled, service, str(upload_id), file, part)
            await to_thread.run_sync(remove_part, parts, name)  # what came in pieces
        except Mismatch as fault:
            problems = [Problem(name, str(fault), "send it again")]
            raise invalid(f"The file was refused: {fault}.", problems) from None
        finally:
            await to_thread.run_sync(part.discard, abandon_on_cancel=False)
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


def _settled(service: Service, upload_id: str, file: File, part: Part) -> str:
    if part.offset != file.size:
        raise Mismatch(f"{part.offset} bytes arrived, {file.size} were announced")
    part.acknowledge()
    return finish(service, upload_id, file, part)


def _committed() -> ApiProblem:
    return ApiProblem(409, "committed", "The upload is committed; its files can no longer change.")


def _files(body: UploadIn) -> list[File]:
    files = announced(body.files)
    if not body.growing:
        require_scan_json(files)
    return files


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
