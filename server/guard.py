"""Stands before every route: limits of size, host and origin checks, security headers.

Where there are no keys, the one thing between a web page on the internet and this API is the browser; where
there are, a browser may hold a session. So names that are not ours are refused (DNS rebinding), and so are
writes that a browser marks as coming from another site.
"""

from __future__ import annotations

import ipaddress

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from server.headers import add_to
from server.limits import HEAD_BYTES, body_limit, head_bytes, limited
from server.problems import response


class Guard:
    def __init__(self, app: ASGIApp, allowed_hosts: frozenset[str]) -> None:
        self.app = app
        self._allowed_hosts = allowed_hosts

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                add_to(MutableHeaders(scope=message), scope["scheme"], scope["path"])
            await send(message)

        head = head_bytes(scope.get("raw_path") or b"", scope["query_string"], scope["headers"])
        if head > HEAD_BYTES:
            detail = f"The request's head has {head} bytes; it may have at most {HEAD_BYTES}."
            refusal = response(431, "head-too-large", detail)
        elif not self._is_ours(headers.get("host", "")):
            refusal = response(
                421, "misdirected-request", "This server does not go by that name; SPLATCT_ALLOWED_HOSTS lists its own."
            )
        elif scope["method"] not in ("GET", "HEAD", "OPTIONS") and headers.get("sec-fetch-site") in (
            "cross-site",
            "same-site",
        ):
            refusal = response(403, "cross-site", "Requests from other web sites are refused.")
        elif (limit := body_limit(scope["method"], scope["path"])) is not None and _declared(headers) > limit:
            refusal = response(413, "content-too-large", f"The body may have at most {limit} bytes.")
        else:
            await self.app(scope, receive if limit is None else limited(receive, limit), send_guarded)
            return
        await refusal(scope, receive, send_guarded)

    def _is_ours(self, host: str) -> bool:
        """Whether a Host header names this machine: by a loopback name, or one that the settings allow."""
        name, colon, port = host.rpartition(":")
        name = (name if colon and port.isdecimal() else host).strip("[]").lower()
        if name in self._allowed_hosts:
            return True
        try:
            return name == "localhost" or ipaddress.ip_address(name).is_loopback
        except ValueError:
            return False


def _declared(headers: Headers) -> int:
    length = headers.get("content-length", "0")
    return int(length) if length.isdecimal() else 0
