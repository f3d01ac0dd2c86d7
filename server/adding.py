"""The route for a scan that is sent while the scanner still turns: its views are announced as they come."""

from __future__ import annotations

from uuid import UUID

from fastapi import APIRouter

from server.announce import add_files, announced
from server.intake import Busy, Gone
from server.problems import ApiProblem, not_found
from server.schema import FileList, FileOut, FilesIn
from server.service import Served
from server.store import File

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])


@router.post("/{upload_id}/files", status_code=201)
def announce_files(upload_id: UUID, body: FilesIn, service: Served) -> FileList:
    """More files for an open upload; the answer speaks of these alone. May be repeated."""
    upload = service.store.upload(str(upload_id))
    if upload is None:
        raise not_found("upload")
    if upload.committed:
        raise ApiProblem(409, "committed", "The upload is committed; its files can no longer change.")
    files = announced(body.files)
    try:
        with service.intake.writing(upload.id):
            return FileList(files=[file_out(file) for file in add_files(service, upload.id, files)])
    except Busy:
        raise ApiProblem(409, "busy", "The upload is being committed.", retry_after_s=2) from None
    except Gone:
        raise not_found("upload") from None


def file_out(file: File) -> FileOut:
    return FileOut(
        name=file.name, size=file.size, received=file.received, complete=bool(file.sha256), sha256=file.sha256
    )
