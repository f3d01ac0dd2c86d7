"""Sees every request from outside all else: gives it an id, writes its log line, counts and times it."""

from __future__ import annotations

import logging
import re
import time
from typing import Any
from uuid import UUID, uuid4

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.logs import request_id
from server.metrics import Metrics

log = logging.getLogger("splatct.request")

HEADER = "X-Request-Id"
_GIVEN = re.compile(r"[A-Za-z0-9._:-]{1,128}")
_METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
_NO_ROUTE = "none"
_CANCELLED = 499  # the caller left before there was an answer


class Observer:
    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        seen = _Request(scope)
        request_id.set(seen.id)  # a request has a context of its own: nothing to put back
        try:
            await self.app(scope, seen.receiving(receive), seen.sending(send))
        except Exception:
            seen.status = seen.status or 500  # answered by the handler outside of us
            raise
        finally:
            seen.tell(scope["app"].state.metrics)


class _Request:
    def __init__(self, scope: Scope) -> None:
        given = Headers(scope=scope).get(HEADER, "")
        self.id = given if _GIVEN.fullmatch(given) else uuid4().hex
        self.status = 0
        self._scope = scope
        self._began = time.monotonic()
        self._received = 0
        self._location = ""

    def receiving(self, receive: Receive) -> Receive:
        async def counted() -> Message:
            message = await receive()
            self._received += len(message.get("body", b""))
            return message

        return counted

    def sending(self, send: Send) -> Send:
        async def marked(message: Message) -> None:
            if message["type"] == "http.response.start":
                self.status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[HEADER] = self.id
                self._location = headers.get("Location", "")
            await send(message)

        return marked

    def tell(self, metrics: Metrics) -> None:
        seconds, route, status = time.monotonic() - self._began, _template(self._scope), self.status or _CANCELLED
        method = self._scope["method"] if self._scope["method"] in _METHODS else "other"
        metrics.requests.labels(method, route, str(status)).inc()
        metrics.seconds.labels(method, _kind(self._scope, route)).observe(seconds)
        if method in ("PUT", "PATCH") and route.startswith("/v1/uploads/{upload_id}/files/"):
            metrics.upload_bytes.inc(self._received)
        fields: dict[str, Any] = {
            "request_id": self.id,
            "method": method,
            "route": route,
            "status": status,
            "ms": round(seconds * 1000, 1),
        }
        caller = self._scope.get("state", {}).get("caller")
        if caller is not None and caller.key_id is not None:
            fields |= {"tenant": caller.tenant, "key_id": caller.key_id}
        job_id = _job_id(self._scope, self._location)
        if job_id is not None:
            fields["job_id"] = job_id
        log.log(logging.WARNING if status >= 500 else logging.INFO, "request", extra={"fields": fields})


def _template(scope: Scope) -> str:
    """The route's path with its placeholders: ids and invented paths would be labels without end."""
    path = getattr(scope.get("route"), "path", None)
    if path is None and scope["path"].startswith("/static/"):
        return "/static"
    return path or _NO_ROUTE


def _kind(scope: Scope, route: str) -> str:
    """A long poll is a route of its own, so that its waiting does not hide how fast the others are."""
    return f"{route}?wait" if b"wait=" in scope["query_string"] and route == "/v1/jobs/{job_id}" else route


def _job_id(scope: Scope, location: str) -> str | None:
    """The job that the request named, or made."""
    named = scope.get("path_params", {}).get("job_id") or location.removeprefix("/v1/jobs/")
    try:
        return str(UUID(str(named)))
    except ValueError:
        return None
