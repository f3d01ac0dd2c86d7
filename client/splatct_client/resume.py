"""Sends one large file in chunks; after a failure it asks where the file stands and goes on from there."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import httpx

from splatct_client.errors import IntegrityError, ServerProblem, ServerUnreachable, UnexpectedAnswer
from splatct_client.retry import Patience

CHUNK = 32 << 20
PIECE = 1 << 20
# A chunk that these answer to is sent again, from where the server then stands.
AGAIN = frozenset({"urn:splatct:problem:" + kind for kind in ("offset-mismatch", "taken-over", "interrupted")})
DAMAGED = "urn:splatct:problem:digest-mismatch"


class Wire(Protocol):
    """What of the client is needed here."""

    patience: Patience

    def offset(self, url: str) -> httpx.Response: ...
    def send_chunk(
        self, url: str, headers: dict[str, str], body: Callable[[], Iterator[bytes]], size: int
    ) -> httpx.Response: ...


def send_in_chunks(
    wire: Wire, url: str, path: Path, on_bytes: Callable[[int], None] | None = None, chunk_bytes: int = CHUNK
) -> str:
    """Returns the sha256 of the file as the server stored it, equal to the one here."""
    size = path.stat().st_size
    stood = _offset(wire.offset(url))
    attempts = wire.patience.start()
    while stood < size:
        try:
            now = _offset(_send(wire, url, path, stood, min(chunk_bytes, size - stood), on_bytes))
        except (ServerUnreachable, ServerProblem) as error:
            again = not isinstance(error, ServerProblem) or error.status >= 500 or error.kind in (*AGAIN, DAMAGED)
            if not again or not attempts.pause():
                raise
            now = _offset(wire.offset(url))
        if now > stood:
            attempts = wire.patience.start()
        stood = now
    stored = _sha256(wire.offset(url))
    with path.open("rb") as stream:
        here = hashlib.file_digest(stream, "sha256").hexdigest()
    if stored != here:
        raise IntegrityError(
            f"{path.name}: the server stored sha256 {stored}, the file here has {here}; "
            "does something still write to it?"
        )
    return here


def _send(
    wire: Wire, url: str, path: Path, start: int, length: int, on_bytes: Callable[[int], None] | None
) -> httpx.Response:
    digest = hashlib.sha256()
    for piece in _pieces(path, start, length):
        digest.update(piece)
    headers = {
        "Content-Type": "application/offset+octet-stream",
        "Tus-Resumable": "1.0.0",
        "Upload-Offset": str(start),
        "Content-Digest": f"sha-256=:{base64.b64encode(digest.digest()).decode()}:",
    }

    def body() -> Iterator[bytes]:
        sent = start
        for piece in _pieces(path, start, length):
            yield piece
            sent += len(piece)
            if on_bytes:
                on_bytes(sent)

    return wire.send_chunk(url, headers, body, length)


def _pieces(path: Path, start: int, length: int) -> Iterator[bytes]:
    with path.open("rb") as stream:
        stream.seek(start)
        while length and (piece := stream.read(min(PIECE, length))):
            yield piece
            length -= len(piece)


def _offset(answer: httpx.Response) -> int:
    given = answer.headers.get("Upload-Offset", "")
    if not given.isdecimal():
        raise UnexpectedAnswer(f"{answer.request.url} answered without Upload-Offset: is it a SplatCT server?")
    return int(given)


def _sha256(answer: httpx.Response) -> str | None:
    given = answer.headers.get("Repr-Digest", "")
    if not (given.startswith("sha-256=:") and given.endswith(":")):
        return None
    return base64.b64decode(given[len("sha-256=:") : -1]).hex()
