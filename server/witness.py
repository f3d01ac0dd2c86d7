"""Middleware that puts into the audit log what requests did: the one place that decides what is worth an entry.

The entry is written before the first byte of the answer goes out, so whoever has an answer is on record.
Reads of one thing by one caller within a minute are one entry: a download in many ranges is one reading.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.exc import SQLAlchemyError
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.access import Caller
from server.audit import AuditLog, Deed
from server.logs import request_id

log = logging.getLogger("splatct.audit")

ACTIONS = {
    ("POST", "/v1/uploads"): "upload",
    ("PUT", "/v1/uploads/{upload_id}"): "upload",
    ("POST", "/v1/uploads/{upload_id}/files"): "upload",
    ("POST", "/v1/imports"): "import",
    ("POST", "/v1/uploads/{upload_id}/commit"): "commit",
    ("DELETE", "/v1/uploads/{upload_id}"): "delete-upload",
    ("DELETE", "/v1/scans/{scan_id}"): "delete-scan",
    ("POST", "/v1/scans/{scan_id}/pin"): "pin",
    ("DELETE", "/v1/scans/{scan_id}/pin"): "unpin",
    ("POST", "/v1/jobs/{job_id}/pin"): "pin",
    ("DELETE", "/v1/jobs/{job_id}/pin"): "unpin",
    ("POST", "/v1/jobs"): "submit",
    ("PUT", "/v1/jobs/{job_id}"): "submit",
    ("POST", "/v1/jobs/{job_id}/restart"): "submit",
    ("POST", "/v1/jobs/{job_id}/cancel"): "cancel",
    ("PATCH", "/v1/jobs/{job_id}"): "prioritise",
    ("DELETE", "/v1/jobs/{job_id}"): "delete-job",
    ("GET", "/v1/jobs/{job_id}/results"): "read-results",
    ("GET", "/v1/jobs/{job_id}/results/{file}"): "read-results",
    ("GET", "/v1/jobs/{job_id}/partial"): "read-results",
    ("GET", "/v1/jobs/{job_id}/partial/{file}"): "read-results",
    ("GET", "/v1/jobs/{job_id}/report"): "read-results",
    ("GET", "/v1/jobs/{job_id}/slices/{axis}/{index}.png"): "read-results",
    ("GET", "/v1/jobs/{job_id}/log"): "read-log",
    ("POST", "/v1/webhooks"): "add-webhook",
    ("DELETE", "/v1/webhooks/{webhook_id}"): "delete-webhook",
    ("POST", "/v1/session"): "sign-in",
    ("DELETE", "/v1/session"): "sign-out",
}
_READ_AGAIN_S = 60.0
_ADDRESS = 64  # characters that are kept: a proxy may have passed on what its caller called himself
_MOST_READS = 10_000


class Witness:
    def __init__(self, app: ASGIApp) -> None:
        self.app = app
        self._reads = Recent(_READ_AGAIN_S, _MOST_READS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def noting(message: Message) -> None:
            if message["type"] == "http.response.start":
                deed = _deed(scope, message["status"], Headers(raw=message["headers"]))
                if deed is not None and not (deed.action.startswith("read-") and self._reads.again(deed)):
                    await run_in_threadpool(_note, scope["app"].state.audit, deed)
            await send(message)

        await self.app(scope, receive, noting)


class Recent:
    """Remembers deeds for so many seconds, `most` at a time, and nothing for longer. By a digest of each: a deed takes
    half a kilobyte, and a busy server notes hundreds a minute."""

    def __init__(self, seconds: float, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._seconds, self._most, self._clock = seconds, most, clock
        self._noted: dict[bytes, float] = {}  # when, oldest first

    def __len__(self) -> int:
        return len(self._noted)

    def again(self, deed: Deed) -> bool:
        """Whether it is one of them; if not, it is from now on."""
        now, noted = self._clock(), hashlib.blake2b(repr(deed).encode(), digest_size=16).digest()
        while self._noted and now - self._noted[first := next(iter(self._noted))] >= self._seconds:
            del self._noted[first]
        if noted in self._noted:
            return True
        if len(self._noted) >= self._most:
            del self._noted[next(iter(self._noted))]
        self._noted[noted] = now
        return False


def _note(audit: AuditLog, deed: Deed) -> None:
    try:
        audit.note(deed)
    except SQLAlchemyError:  # a full disk must not keep people from deleting: then the log keeps the entry
        log.exception("the audit log could not be written", extra={"fields": vars(deed)})


def _deed(scope: Scope, status: int, headers: Headers) -> Deed | None:
    """What there is to note of an answer. Nothing where nothing was done, or done before."""
    path = getattr(scope.get("route"), "path", "")
    action = ACTIONS.get((scope["method"], path))
    refused = action == "sign-in" and status == 401
    if action is None or (status >= 400 and not refused) or "Idempotency-Replayed" in headers:
        return None
    caller: Caller | None = scope.get("state", {}).get("caller")
    given = scope.get("path_params", {})
    made = headers.get("Location", "").rpartition("/")[2]
    thing = next((str(given[name]) for name in ("job_id", "scan_id", "upload_id", "webhook_id") if name in given), made)
    reading = action.startswith("read-")
    return Deed(
        tenant="" if caller is None else caller.tenant,
        key_id=None if caller is None else caller.key_id,
        address=scope["client"][0][:_ADDRESS] if scope.get("client") else "",
        action="sign-in-refused" if refused else action,
        thing=thing,
        detail=_part(path, str(given.get("file", ""))) if reading else "",
        request_id=None if reading else request_id.get(),  # several requests may be one reading
    )


def _part(path: str, file: str) -> str:
    """Which part of the results; all slices are one."""
    return file or path.removeprefix("/v1/jobs/{job_id}/").partition("/")[0]
