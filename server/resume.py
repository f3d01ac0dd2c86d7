"""Routes that take one file in pieces: where it stands, and the next piece. tus 1.0 clients understand them."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path as FolderPath
from typing import Annotated
from uuid import UUID

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from sqlalchemy.exc import DBAPIError

from server.digests import TUS_ALGORITHMS, BadDigest, Claim, claims, content_digest
from server.intake import Mismatch
from server.partial import Part, part_path, take_back
from server.problems import ApiProblem, disk_is_full, invalid
from server.receiving import End, finish, look, only_writer, receive
from server.service import Served, Service
from server.settings import MIB
from server.store import File
from server.turns import Turn
from splatcore.errors import Problem
from worker.fulldisk import is_full

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

TUS = {"Tus-Resumable": "1.0.0"}
MEDIA_TYPE = "application/offset+octet-stream"
BYTES = {"type": "string", "format": "binary"}
ACKNOWLEDGE_EVERY = 16 * MIB  # a crash costs at most this much of a chunk, however long the chunk is

FileName = Annotated[str, Path(max_length=1024)]


@router.options("", status_code=204)
async def options() -> Response:
    return _offered()


@router.options("/{upload_id}/files/{name}", status_code=204)
async def options_of_file(upload_id: UUID, name: FileName) -> Response:
    """The same of every file, whether it is there or not."""
    return _offered()


def _offered() -> Response:
    offered = {
        "Tus-Version": "1.0.0",
        "Tus-Extension": "checksum",
        "Tus-Checksum-Algorithm": ",".join(TUS_ALGORITHMS),
    }
    return Response(status_code=204, headers=TUS | offered)


@router.head("/{upload_id}/files/{name}")
async def head_file(upload_id: UUID, name: FileName, request: Request, service: Served) -> Response:
    """Where to go on. Ends a PATCH of the same file that is still under way: its client has come back."""
    _require_version(request)
    async with _opened(service, str(upload_id), name) as (_turn, file, part):
        if part is None:
            return Response(headers=_standing(file, file.size, file.sha256))
        sha256 = await _finished(service, str(upload_id), file, part)
        return Response(headers=_standing(file, part.offset, sha256))


@router.patch(
    "/{upload_id}/files/{name}",
    status_code=204,
    openapi_extra={"requestBody": {"content": {MEDIA_TYPE: {"schema": BYTES}}, "required": True}},
)
async def patch_file(upload_id: UUID, name: FileName, request: Request, service: Served) -> Response:
    _require_version(request)
    start, digests = _start(request), _claims(request)
    async with _opened(service, str(upload_id), name) as (turn, file, part):
        at = file.size if part is None else part.offset
        if part is None and await to_thread.run_sync(_is_committed, service, str(upload_id)):
            raise ApiProblem(409, "committed", "The upload is committed; its files can no longer change.", headers=TUS)
        if start != at:
            raise ApiProblem(
                409,
                "offset-mismatch",
                f"The file stands at offset {at}, the chunk starts at {start}.",
                [Problem("Upload-Offset", f"is {start}, not {at}", f"go on from offset {at}, or ask HEAD")],
                headers=TUS | {"Upload-Offset": str(at)},
            )
        declared = request.headers.get("content-length", "")
        if declared.isdecimal() and at + int(declared) > file.size:
            raise _refused(name, at, f"more than the announced {file.size} bytes would arrive")
        if part is None:
            return Response(status_code=204, headers=_standing(file, file.size, file.sha256))
        await _receive(request, turn, name, part, digests)
        sha256 = await _finished(service, str(upload_id), file, part)
        return Response(status_code=204, headers=_standing(file, part.offset, sha256))


@contextlib.asynccontextmanager
async def _opened(service: Service, upload_id: str, name: str) -> AsyncIterator[tuple[Turn, File, Part | None]]:
    """This request as the file's only writer; no part if the file is complete."""
    await look(service, upload_id, name)
    async with only_writer(service, upload_id, name, TUS) as (turn, file, parts):
        if parts is None or file.sha256 is not None:
            yield turn, file, None
            return

        def open_part(parts: FolderPath) -> Part:
            if file.acknowledged == file.size:  # perhaps it got its name just before a crash
                take_back(parts, name, service.intake.settled(upload_id, name))
            record = partial(service.store.acknowledge, upload_id, name)
            return Part(part_path(parts, name), file.size, file.acknowledged, record, service.running)

        part = await to_thread.run_sync(open_part, parts)
        try:
            yield turn, file, part
        finally:
            part.close()


async def _receive(request: Request, turn: Turn, name: str, part: Part, digests: list[Claim]) -> None:
    """Stream a chunk to disk. What counts at the end is acknowledged; a problem is raised if that is not all."""
    start = part.acknowledged

    def save(block: bytes) -> None:
        for claim in digests:
            claim.update(block)
        part.write(block)
        if not digests and part.offset - part.acknowledged >= ACKNOWLEDGE_EVERY:
            part.acknowledge()

    try:
        end = await receive(request, turn, save)
        broken = next((claim for claim in digests if not claim.holds()), None)
        if digests and (broken or end is not End.WHOLE):
            await to_thread.run_sync(part.drop_chunk)
        else:
            await to_thread.run_sync(part.acknowledge)
    except Mismatch as mismatch:
        await to_thread.run_sync(part.drop_chunk)
        raise _refused(name, part.offset, str(mismatch)) from None
    except (OSError, DBAPIError) as error:  # some file systems find room for what was written only when it is synced
        if not is_full(error):
            raise
        await to_thread.run_sync(part.drop_chunk)
        raise disk_is_full(headers=TUS | {"Upload-Offset": str(part.offset)}) from None
    if end is End.TAKEN_OVER:
        raise _problem(409, "taken-over", "A newer request writes this file now.", part)
    if end is End.CUT:
        raise _problem(400, "interrupted", "The connection ended before the chunk did.", part)
    if broken:
        errors = [Problem(broken.header, "is not the digest of the bytes that arrived", f"send again from {start}")]
        raise _problem(broken.status, "digest-mismatch", "The chunk was damaged and is dropped.", part, errors)


async def _finished(service: Service, upload_id: str, file: File, part: Part) -> str | None:
    """The sha256 of a file whose last byte has come, checked and in its place; None while bytes are missing."""
    if part.offset != file.size:
        return None
    try:
        return await to_thread.run_sync(finish, service, upload_id, file, part)
    except Mismatch as mismatch:
        await to_thread.run_sync(part.clear)
        raise _refused(file.name, 0, str(mismatch)) from None


def _is_committed(service: Service, upload_id: str) -> bool:
    upload = service.store.upload(upload_id)
    return upload is not None and upload.committed


def _require_version(request: Request) -> None:
    if request.headers.get("tus-resumable", TUS["Tus-Resumable"]) != TUS["Tus-Resumable"]:
        errors = [Problem("Tus-Resumable", "names another version", "this server speaks tus 1.0.0")]
        raise ApiProblem(
            412, "tus-version", "The tus version is not known here.", errors, headers={"Tus-Version": "1.0.0"}
        )


def _start(request: Request) -> int:
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != MEDIA_TYPE:
        errors = [Problem("Content-Type", "is another", f"send {MEDIA_TYPE}")]
        raise ApiProblem(415, "media-type", f"A chunk is sent as {MEDIA_TYPE}.", errors, headers=TUS)
    given = request.headers.get("upload-offset", "")
    if not (given.isascii() and given.isdecimal() and len(given) < 20):
        errors = [Problem("Upload-Offset", "is no number", "HEAD tells the offset to go on from")]
        raise ApiProblem(400, "offset-missing", "A chunk needs the offset at which it starts.", errors, headers=TUS)
    return int(given)


def _claims(request: Request) -> list[Claim]:
    try:
        return claims(request.headers.get("content-digest"), request.headers.get("upload-checksum"))
    except BadDigest as bad:
        hint = "give the digest as in docs/http.md, or none"
        errors = [Problem("Content-Digest or Upload-Checksum", str(bad), hint)]
        raise ApiProblem(400, "bad-digest", "The digest of the chunk cannot be read.", errors, headers=TUS) from None


def _standing(file: File, offset: int, sha256: str | None) -> dict[str, str]:
    headers = {"Upload-Offset": str(offset), "Upload-Length": str(file.size), "Cache-Control": "no-store"}
    return TUS | headers | ({"Repr-Digest": content_digest(sha256)} if sha256 else {})


def _refused(name: str, offset: int, what: str) -> ApiProblem:
    refusal = invalid(f"The file was refused: {what}.", [Problem(name, what, f"send again from offset {offset}")])
    refusal.headers |= TUS | {"Upload-Offset": str(offset)}
    return refusal


def _problem(status: int, name: str, detail: str, part: Part, errors: list[Problem] | None = None) -> ApiProblem:
    hint = [Problem("Upload-Offset", f"is {part.offset} now", "ask HEAD, then go on from there")]
    headers = TUS | {"Upload-Offset": str(part.offset)}
    return ApiProblem(status, name, detail, errors or hint, headers=headers)
