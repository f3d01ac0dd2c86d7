"""The route that takes a scan from a folder of the server's machine, as if its files had been sent."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from collections.abc import Iterator
from typing import Any
from uuid import uuid4

from fastapi import APIRouter, Response

from server.announce import MOST_FILES, announced, open_upload
from server.importing import NotHere, Refused, Source, opened
from server.intake import Mismatch
from server.partial import Part
from server.problems import ApiProblem, invalid, not_found
from server.receiving import finish
from server.schema import FileIn, ImportIn, UploadOut
from server.service import Served, Service
from server.settings import MIB
from server.store import File
from server.uploads import upload_out
from splatcore.errors import Problem

router = APIRouter(prefix="/v1/imports", tags=["uploads"])

_MOST_JSON = 16 * MIB
_CALIBRATION = ("flat", "dark", "bad_pixels")
_imports = threading.BoundedSemaphore(2)  # each copies as fast as the disk can


@router.post("", status_code=201)
def import_scan(body: ImportIn, service: Served, response: Response) -> UploadOut:
    """Copies scan.json and the files it names; commit the upload then, as any other."""
    if not _imports.acquire(blocking=False):
        raise ApiProblem(503, "busy", "Two other scans are being imported.", retry_after_s=30)
    try:
        with opened(service.imports, service.tenant, body.folder) as source:
            upload_id = _copied(service, source, body.name)
    except NotHere:
        raise not_found("folder to import from, or no scan.json in it") from None
    except Refused as refused:
        raise invalid("The folder cannot be imported.", [Problem("folder", str(refused))]) from None
    finally:
        _imports.release()
    response.headers["Location"] = f"/v1/uploads/{upload_id}"
    upload = service.store.upload(upload_id)
    if upload is None:
        raise not_found("upload")
    return upload_out(upload)


def _copied(service: Service, source: Source, name: str | None) -> str:
    with source.file("scan.json") as descriptor:
        text = os.pread(descriptor, _MOST_JSON + 1, 0)
    scan = _parsed(text)
    files = _announced(source, ["scan.json", *dict.fromkeys(named_files(scan))])
    title = name or (scan["name"] if isinstance(scan.get("name"), str) else "")
    upload = open_upload(service, title[:200] if title.isprintable() and title else "imported scan", files)
    try:
        with service.intake.writing(upload.id) as parts:
            for file in files:
                part = Part(parts / uuid4().hex, file.size)
                try:
                    _settle(service, upload.id, source, file, part)
                finally:
                    part.discard()
    except BaseException:
        service.reserve.deleting(lambda: service.store.drop_upload(upload.id))
        service.intake.remove_upload(upload.id)
        raise
    return upload.id


def _settle(service: Service, upload_id: str, source: Source, file: File, part: Part) -> None:
    with source.file(file.name) as descriptor:
        before = os.fstat(descriptor)
        with contextlib.suppress(Mismatch):  # it grew, as its size will tell
            while before.st_size == file.size and (block := os.read(descriptor, MIB)):
                part.write(block)
        after = os.fstat(descriptor)
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns) or before.st_size != file.size:
        fault = Problem(file.name, "changed while it was read", "import it when the scanner has finished")
        raise ApiProblem(409, "changing", "Something still writes to the folder.", [fault])
    part.acknowledge()
    finish(service, upload_id, file, part)


def _announced(source: Source, wanted: list[str]) -> list[File]:
    """With their sizes; raises a 422 that lists every file that cannot be taken."""
    if len(wanted) > MOST_FILES:
        raise invalid("The scan has too many files.", [Problem("scan.json", f"names {len(wanted)}, not {MOST_FILES}")])
    problems, given = [], []
    for name in wanted:
        try:
            size = source.size(name)
        except NotHere:
            problems.append(Problem(name[:255], "is named in scan.json and is not in the folder"))
        except Refused as refused:
            problems.append(Problem(name[:255], str(refused), "only files directly in the folder are imported"))
        else:
            if size:
                given.append(FileIn(name=name, size=size))
            else:
                problems.append(Problem(name[:255], "is empty"))
    if problems:
        raise invalid("The scan cannot be imported.", problems[:200])
    return announced(given)


def _parsed(text: bytes) -> dict[str, Any]:
    if len(text) > _MOST_JSON:
        raise invalid("The scan cannot be imported.", [Problem("scan.json", f"is larger than {_MOST_JSON} bytes")])
    try:
        scan = json.loads(text)
    except (ValueError, RecursionError):
        raise invalid("The scan cannot be imported.", [Problem("scan.json", "is not valid JSON")]) from None
    if not isinstance(scan, dict):
        raise invalid("The scan cannot be imported.", [Problem("scan.json", "is not a JSON object")])
    return scan


def named_files(scan: dict[str, Any]) -> Iterator[str]:
    """What else belongs to the scan. Whether it makes sense is judged at the commit."""
    projections = scan.get("projections")
    places = [(projections, key) for key in ("files", *_CALIBRATION)] + [(scan, key) for key in _CALIBRATION]
    for owner, key in places:
        given = owner.get(key) if isinstance(owner, dict) else None
        for name in given if isinstance(given, list) else [given]:
            if isinstance(name, str) and name != "scan.json":
                yield name
