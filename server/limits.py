"""How large a request may be, by what it is for."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.types import Message, Receive

KIB = 1 << 10
MIB = 1 << 20

HEAD_BYTES = 32 * KIB  # request line and headers together
_SESSION = 8 * KIB
_JOB = 256 * KIB
_ANNOUNCEMENT = 16 * MIB  # 50,000 file names
_OTHER = 16 * KIB  # calls that have no body to speak of


def body_limit(method: str, path: str) -> int | None:
    """Bytes that a body may have. None for files, which are streamed and have the size they announced as limit."""
    if path.startswith("/v1/uploads/") and "/files/" in path and method in ("PUT", "PATCH"):
        return None
    if path == "/v1/uploads" or (path.startswith("/v1/uploads/") and (path.endswith("/files") or method == "PUT")):
        return _ANNOUNCEMENT
    if path == "/v1/session":
        return _SESSION
    return _JOB if path == "/v1/jobs" or path.startswith("/v1/jobs/") else _OTHER


def head_bytes(raw_path: bytes, query: bytes, headers: list[tuple[bytes, bytes]]) -> int:
    return len(raw_path) + len(query) + sum(len(name) + len(value) + 4 for name, value in headers)


def limited(receive: Receive, limit: int) -> Receive:
    """For bodies that do not say how long they are."""
    seen = 0

    async def counted() -> Message:
        nonlocal seen
        message = await receive()
        seen += len(message.get("body", b""))
        if seen > limit:
            raise HTTPException(413)
        return message

    return counted
