"""How the bytes of one file come in, whole by PUT or in pieces by PATCH: from one request at a time, a block at a time,
and under the file's name once all of it is durable and checked."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable, Mapping
from enum import Enum, auto
from pathlib import Path

from anyio import to_thread
from fastapi import Request
from starlette.requests import ClientDisconnect

from server.intake import Busy, Gone, Mismatch
from server.partial import Part
from server.problems import ApiProblem, not_found
from server.service import Service
from server.spool import Spool
from server.store import File
from server.turns import Turn


class End(Enum):
    """How a body ended."""

    WHOLE = auto()
    CUT = auto()
    TAKEN_OVER = auto()  # by a newer request for the same file


async def look(service: Service, upload_id: str, name: str) -> tuple[bool, File]:
    """Whether the upload is committed, and the file; or a 404."""
    found = await to_thread.run_sync(service.store.upload_file, upload_id, name)
    if found is None:
        raise not_found("file in this upload")
    return found


@contextlib.asynccontextmanager
async def only_writer(
    service: Service, upload_id: str, name: str, headers: Mapping[str, str] | None = None
) -> AsyncIterator[tuple[Turn, File, Path | None]]:
    """This request as the file's only writer, and the folder for parts; no folder if the upload is committed.

    `look` first: this ends the request that is at it, which may be another tenant's. `headers` are a refusal's."""
    async with service.turns.take(upload_id, name) as turn:
        committed, file = await look(service, upload_id, name)
        if committed:
            yield turn, file, None
            return
        try:
            with service.intake.writing(upload_id) as parts:
                yield turn, file, parts
        except Busy:
            refusal = "The upload is being committed."
            raise ApiProblem(409, "busy", refusal, retry_after_s=2, headers=dict(headers or {})) from None
        except Gone:
            raise not_found("upload") from None


async def receive(request: Request, turn: Turn, save: Callable[[bytes], None]) -> End:
    """Stream the body to `save` in threads; constant memory. All that came is saved, however it ends."""
    cut = False
    async with Spool(save) as spool:
        with turn.scope:
            try:
                async for piece in request.stream():
                    await spool.give(piece)
            except ClientDisconnect:
                cut = True
        await spool.empty()
    return End.TAKEN_OVER if turn.scope.cancelled_caught else End.CUT if cut else End.WHOLE


def finish(service: Service, upload_id: str, file: File, part: Part) -> str:
    """Give a file that is all here and durable its name; returns its sha256. Raises Mismatch if it is another's."""
    sha256 = part.sha256()
    if file.expected_sha256 not in (None, sha256):
        raise Mismatch("the sha256 of the bytes that arrived is not the announced one")

    def record() -> None:
        service.store.received(upload_id, file.name, sha256)

    service.intake.settle(upload_id, file.name, part.move_to, record)
    return sha256
