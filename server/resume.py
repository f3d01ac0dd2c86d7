"""Routes that take one file in pieces: where it stands, and the next piece. tus 1.0 clients understand them."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from typing import Annotated
from uuid import UUID

from anyio import to_thread
from fastapi import APIRouter, Path, Request, Response
from sqlalchemy.exc import DBAPIError
from starlette.requests import ClientDisconnect

from server.digests import TUS_ALGORITHMS, BadDigest, Claim, claims, content_digest
from server.intake import Busy, Gone, Mismatch
from server.partial import Partial, take_back
from server.problems import ApiProblem, disk_is_full, invalid, not_found
from server.service import Served, Service
from server.settings import MIB
from server.spool import Spool
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
    async with _opened(service, str(upload_id), name) as (_turn, file, partial):
        if partial is None:
            return Response(headers=_standing(file, file.size, file.sha256))
        sha256 = await _finished(service, str(upload_id), file, partial)
        return Response(headers=_standing(file, partial.offset, sha256))


@router.patch(
    "/{upload_id}/files/{name}",
    status_code=204,
    openapi_extra={"requestBody": {"content": {MEDIA_TYPE: {"schema": BYTES}}, "required": True}},
)
async def patch_file(upload_id: UUID, name: FileName, request: Request, service: Served) -> Response:
    _require_version(request)
    start, digests = _start(request), _claims(request)
    async with _opened(service, str(upload_id), name) as (turn, file, partial):
        at = file.size if partial is None else partial.offset
        if partial is None and await to_thread.run_sync(_is_committed, service, str(upload_id)):
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
        if partial is None:
            return Response(status_code=204, headers=_standing(file, file.size, file.sha256))
        await _receive(request, turn, name, partial, digests)
        sha256 = await _finished(service, str(upload_id), file, partial)
        return Response(status_code=204, headers=_standing(file, partial.offset, sha256))


@contextlib.asynccontextmanager
async def _opened(service: Service, upload_id: str, name: str) -> AsyncIterator[tuple[Turn, File, Partial | None]]:
    """This request as the file's only writer; no part if the file is complete."""
    if await to_thread.run_sync(service.store.upload_file, upload_id, name) is None:
        raise not_found("file in this upload")  # before the turn, which would end another tenant's request
    async with service.turns.take(upload_id, name) as turn:
        found = await to_thread.run_sync(service.store.upload_file, upload_id, name)
        if found is None:
            raise not_found("file in this upload")
        committed, file = found
        if committed:
            yield turn, file, None
            return
        try:
            with service.intake.writing(upload_id) as parts:
                if file.sha256 is not None:
                    yield turn, file, None
                    return

                def record(offset: int) -> None:
                    service.store.acknowledge(upload_id, name, offset)

                def open_part() -> Partial:
                    if file.acknowledged == file.size:  # perhaps it got its name just before a crash
                        take_back(parts, name, service.intake.settled(upload_id, name))
                    return Partial(parts, name, file.size, file.acknowledged, record)

                partial = await to_thread.run_sync(open_part)
                try:
                    yield turn, file, partial
                finally:
                    partial.close()
        except Busy:
            raise ApiProblem(409, "busy", "The upload is being committed.", retry_after_s=2, headers=TUS) from None
        except Gone:
            raise not_found("upload") from None


async def _receive(request: Request, turn: Turn, name: str, partial: Partial, digests: list[Claim]) -> None:
    """Stream a chunk to disk. What counts at the end is acknowledged; a problem is raised if that is not all."""
    start, cut = partial.acknowledged, False

    def save(block: bytes) -> None:
        for claim in digests:
            claim.update(block)
        partial.write(block)
        if not digests and partial.offset - partial.acknowledged >= ACKNOWLEDGE_EVERY:
            partial.acknowledge()

    try:
        async with Spool(save) as spool:
            with turn.scope:
                try:
                    async for piece in request.stream():
                        await spool.give(piece)
                except ClientDisconnect:
                    cut = True
            taken_over = turn.scope.cancelled_caught
            if not (digests and (cut or taken_over)):
                await spool.empty()
    except Mismatch as mismatch:
        await to_thread.run_sync(partial.drop_chunk)
        raise _refused(name, partial.offset, str(mismatch)) from None
    except (OSError, DBAPIError) as error:
        if not is_full(error):
            raise
        await to_thread.run_sync(partial.drop_chunk)
        raise _full(partial) from None
    broken = next((claim for claim in digests if not claim.holds()), None)
    if digests and (cut or taken_over or broken):
        await to_thread.run_sync(partial.drop_chunk)
    else:
        await _acknowledged(partial)
    if taken_over:
        raise _problem(409, "taken-over", "A newer request writes this file now.", partial)
    if cut:
        raise _problem(400, "interrupted", "The connection ended before the chunk did.", partial)
    if broken:
        errors = [Problem(broken.header, "is not the digest of the bytes that arrived", f"send again from {start}")]
        raise _problem(broken.status, "digest-mismatch", "The chunk was damaged and is dropped.", partial, errors)


async def _acknowledged(partial: Partial) -> None:
    try:
        await to_thread.run_sync(partial.acknowledge)
    except (OSError, DBAPIError) as error:  # some file systems find room for what was written only now
        if not is_full(error):
            raise
        await to_thread.run_sync(partial.drop_chunk)
        raise _full(partial) from None


async def _finished(service: Service, upload_id: str, file: File, partial: Partial) -> str | None:
    """The sha256 of a file whose last byte has come, checked and in its place; None while bytes are missing."""
    if partial.offset != file.size:
        return None

    def finish() -> str:
        sha256 = partial.sha256()
        if file.expected_sha256 not in (None, sha256):
            partial.clear()
            raise _refused(file.name, 0, "the sha256 of the bytes that arrived is not the announced one")
        service.intake.settle(
            upload_id, file.name, partial, lambda: service.store.received(upload_id, file.name, sha256)
        )
        return sha256

    return await to_thread.run_sync(finish)


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


def _full(partial: Partial) -> ApiProblem:
    return disk_is_full(headers=TUS | {"Upload-Offset": str(partial.offset)})


def _refused(name: str, offset: int, what: str) -> ApiProblem:
    refusal = invalid(f"The file was refused: {what}.", [Problem(name, what, f"send again from offset {offset}")])
    refusal.headers |= TUS | {"Upload-Offset": str(offset)}
    return refusal


def _problem(status: int, name: str, detail: str, partial: Partial, errors: list[Problem] | None = None) -> ApiProblem:
    hint = [Problem("Upload-Offset", f"is {partial.offset} now", "ask HEAD, then go on from there")]
    headers = TUS | {"Upload-Offset": str(partial.offset)}
    return ApiProblem(status, name, detail, errors or hint, headers=headers)
