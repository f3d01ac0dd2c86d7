"""Routes of the page's session: begin one with a key, see whose it is, end it."""

from __future__ import annotations

import math

from fastapi import APIRouter, Request, Response

from server.access import Caller
from server.keys import KeyRing
from server.problems import ApiProblem
from server.rates import Rates, neighbourhood
from server.schema import SessionIn, SessionOut, moment
from server.service import Served
from server.sessions import Sessions, TooMany, cookie_name, csrf_token
from splatcore.errors import Problem

router = APIRouter(prefix="/v1/session", tags=["session"])


@router.post("", status_code=201)
def sign_in(body: SessionIn, request: Request, response: Response) -> SessionOut:
    """A cookie in place of the key, which the page then need not keep."""
    ring: KeyRing = request.app.state.keys
    sessions: Sessions = request.app.state.sessions
    if not ring.exist():
        raise ApiProblem(409, "no-keys", "This server has no keys yet: there is nothing to sign in to.")
    rates: Rates = request.app.state.rates
    address = neighbourhood(request.client.host if request.client else None)
    wait_s = math.ceil(rates.failures.wait_s(address))
    if wait_s:  # before looking, so that trying on learns nothing
        detail = "Too many keys from this address were not valid."
        raise ApiProblem(429, "too-many-requests", detail, retry_after_s=wait_s)
    key = ring.find(body.key.strip())
    if key is None:
        rates.failures.take(address)
        raise ApiProblem(401, "unauthorized", "This key is not known here, has expired or was revoked.")
    try:
        session, token = sessions.begin(key)
    except TooMany as many:
        fault = Problem("sessions", str(many), "sign out where it is no longer needed, or use another key")
        detail = "Too many browsers are signed in with this key."
        raise ApiProblem(429, "too-many-sessions", detail, [fault], math.ceil(many.wait_s)) from None
    request.state.caller = caller = Caller.of(key, session.expires_at)
    response.set_cookie(
        cookie_name(request.url.scheme),
        token,
        max_age=sessions.last_s,
        path="/",
        secure=request.url.scheme == "https",
        httponly=True,
        samesite="strict",
    )
    return _out(caller, csrf_token(token))


@router.get("")
def get_session(request: Request, service: Served) -> SessionOut:
    """Who the caller is, and what to send along as `X-CSRF-Token`."""
    assert service.caller is not None
    token = request.cookies.get(cookie_name(request.url.scheme)) if service.caller.session_ends is not None else None
    return _out(service.caller, None if token is None else csrf_token(token))


@router.delete("", status_code=204)
def sign_out(request: Request, service: Served, response: Response) -> None:
    sessions: Sessions = request.app.state.sessions
    token = request.cookies.get(cookie_name(request.url.scheme))
    if token is not None:
        sessions.end(token)
        name, secure = cookie_name(request.url.scheme), request.url.scheme == "https"
        response.delete_cookie(name, path="/", secure=secure, httponly=True, samesite="strict")


def _out(caller: Caller, csrf: str | None) -> SessionOut:
    return SessionOut(
        tenant=caller.tenant,
        key_id=caller.key_id,
        scopes=sorted(caller.scopes),
        expires_at=None if caller.session_ends is None else moment(caller.session_ends),
        csrf=csrf,
    )
