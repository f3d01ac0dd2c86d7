"""Says who a request comes from, before anything reads its body: the one place where identity is established.

Everything is closed but what `_PUBLIC` lists. As long as there never was a key, whoever reaches this
machine's loopback address is the tenant `local` and may do all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from hmac import compare_digest

from fastapi.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Send
from starlette.types import Scope as Connection

from server.keys import Key, KeyRing, Scope
from server.problems import ApiProblem, answer
from server.rates import Drawn, Rates, neighbourhood
from server.sessions import CSRF_HEADER, Sessions, cookie_name, csrf_token
from splatcore.errors import Problem
from worker.contract import LOCAL_TENANT

_PUBLIC = frozenset({"/", "/sign-in", "/healthz", "/readyz", "/openapi.json"})
_PUBLIC_BELOW = ("/static/", "/jobs/")  # files of the page, and its shells: no data in either
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})


@dataclass(frozen=True)
class Caller:
    """Whom a request acts for. `key_id` is None where there are no keys, `session_ends` without a session."""

    tenant: str
    scopes: frozenset[Scope]
    key_id: str | None = None
    session_ends: float | None = None

    @classmethod
    def of(cls, key: Key, session_ends: float | None = None) -> Caller:
        return cls(key.tenant, key.scopes, key.id, session_ends)

    def may(self, scope: Scope | None) -> bool:
        return scope is None or scope in self.scopes or Scope.ADMIN in self.scopes


LOCAL = Caller(LOCAL_TENANT, frozenset(Scope))


class Access:
    """Middleware: `request.state.caller`, or 401 or 403. `open_without_keys`: only loopback can reach us."""

    def __init__(self, app: ASGIApp, open_without_keys: bool) -> None:
        self.app = app
        self._open_without_keys = open_without_keys

    async def __call__(self, scope: Connection, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and not is_public(scope["method"], scope["path"]):
            try:
                caller = await run_in_threadpool(self._identify, HTTPConnection(scope))
                scope.setdefault("state", {})["caller"] = caller
                drawn = _draw(scope["app"].state.rates, caller)
                _require(caller, needed(scope["method"], scope["path"]))
            except ApiProblem as problem:
                await answer(problem)(scope, receive, send)
                return
            if drawn is not None:
                send = _adding(send, drawn.headers())
        await self.app(scope, receive, send)

    def _identify(self, request: HTTPConnection) -> Caller:
        ring: KeyRing = request.app.state.keys
        if self._open_without_keys and not ring.exist():
            return LOCAL
        given, token = request.headers.get("authorization"), request.cookies.get(cookie_name(request.url.scheme))
        if given is None and token is not None:
            return _of_session(request, token)
        scheme, _, text = (given or "").partition(" ")
        if scheme.lower() != "bearer":
            raise unauthorized("A key is needed.", "is missing")
        key = ring.find(text.strip())
        if key is None:
            count_failure(request)
            raise unauthorized("The key is not valid.", "is not known here, has expired or was revoked")
        return Caller.of(key)


def _of_session(request: HTTPConnection, token: str) -> Caller:
    """Who signed in. A browser sends the cookie whoever made it ask, so a call that changes something must also
    send what only a page that reads our answers can know."""
    sessions: Sessions = request.app.state.sessions
    session = sessions.find(token)
    if session is None:
        raise unauthorized("The session has ended; sign in again.", "is missing, and the session has ended")
    sent = request.headers.get(CSRF_HEADER, "")
    if request.scope["method"] not in _SAFE and not compare_digest(sent.encode(), csrf_token(token).encode()):
        hint = "send `csrf` of GET /v1/session along, or a key in place of the cookie"
        faults = [Problem(f"header/{CSRF_HEADER.lower()}", "is missing, or not this session's", hint)]
        raise ApiProblem(403, "csrf", "Another site's page may have made this request.", faults)
    return Caller.of(session.key, session.expires_at)


def count_failure(request: HTTPConnection) -> None:
    """A key that was none, or a 429. Valid keys are not asked: many people may share an address, and one of them
    who goes on trying must not lock the others out."""
    rates: Rates = request.app.state.rates
    drawn = rates.failures.take(neighbourhood(request.client.host if request.client else None))
    if drawn is not None and drawn.wait_s:
        raise _too_many("Too many keys from this address were not valid.", drawn)


def _draw(rates: Rates, caller: Caller) -> Drawn | None:
    """One request of the caller's. None where nothing is counted."""
    drawn = None if caller.key_id is None else rates.keys.take(caller.key_id)
    if drawn is not None and drawn.wait_s:
        raise _too_many("This key asks more often than it may.", drawn)
    return drawn


def _too_many(detail: str, drawn: Drawn) -> ApiProblem:
    wait_s = math.ceil(drawn.wait_s)
    return ApiProblem(429, "too-many-requests", detail, retry_after_s=wait_s, headers=drawn.headers())


def _adding(send: Send, headers: dict[str, str]) -> Send:
    async def adding(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(headers)
        await send(message)

    return adding


def is_public(method: str, path: str) -> bool:
    if (method, path) == ("POST", "/v1/session"):  # signing in
        return True
    return method in _SAFE and (path in _PUBLIC or path.startswith(_PUBLIC_BELOW))


def needed(method: str, path: str) -> Scope | None:
    """The scope that a call asks for; None: any key will do. Sending in a scan is one thing, whatever its calls."""
    if path == "/metrics":
        return Scope.ADMIN
    if path in ("/v1/options", "/v1/session"):
        return None
    if path == "/v1/uploads" or path.startswith("/v1/uploads/"):
        return Scope.SUBMIT
    if method in _SAFE:
        return Scope.READ
    return Scope.DELETE if method == "DELETE" else Scope.SUBMIT


def unauthorized(detail: str, what: str) -> ApiProblem:
    hint = "send `Authorization: Bearer KEY`; `splatct keys add` on the server makes a key"
    faults = [Problem("header/authorization", what, hint)]
    return ApiProblem(401, "unauthorized", detail, faults, headers={"WWW-Authenticate": "Bearer"})


def _require(caller: Caller, scope: Scope | None) -> None:
    if not caller.may(scope):
        has = ", ".join(sorted(caller.scopes))
        faults = [Problem("header/authorization", f"has the scopes {has}; {scope} is needed", "use another key")]
        raise ApiProblem(403, "forbidden", f"The key may not do this: it lacks the scope {scope}.", faults)
