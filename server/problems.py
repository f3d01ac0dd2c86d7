"""Errors on the wire: RFC 9457 `application/problem+json`, whatever went wrong.

Nothing of the request is echoed and no traceback leaves the process.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import DBAPIError
from starlette.exceptions import HTTPException

from server.headers import add_to
from server.logs import request_id
from splatcore.errors import Problem
from worker.fulldisk import is_full

log = logging.getLogger("splatct.server")


class ApiProblem(Exception):
    """Raised by a route to answer with a problem."""

    def __init__(
        self,
        status: int,
        name: str,
        detail: str,
        errors: Sequence[Problem] = (),
        retry_after_s: int | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status = status
        self.name = name
        self.detail = detail
        self.errors = tuple(errors)
        self.headers = dict(headers or {})
        if retry_after_s is not None:
            self.headers["Retry-After"] = str(retry_after_s)


def not_found(what: str) -> ApiProblem:
    return ApiProblem(404, "not-found", f"There is no such {what}.")


def invalid(detail: str, errors: Sequence[Problem] = ()) -> ApiProblem:
    return ApiProblem(422, "invalid", detail, errors)


def disk_is_full(headers: Mapping[str, str] | None = None) -> ApiProblem:
    fault = Problem("disk", "is full", "nothing was lost: delete jobs or scans, which goes on working, then try again")
    return ApiProblem(507, "no-room", "The server's disk is full.", [fault], headers=headers)


def response(
    status: int, name: str, detail: str, errors: Sequence[Problem] = (), headers: dict[str, str] | None = None
) -> JSONResponse:
    body: dict[str, Any] = {
        "type": f"urn:splatct:problem:{name}",
        "title": name.replace("-", " ").capitalize(),
        "status": status,
        "detail": detail,
    }
    if errors:
        body["errors"] = [error.to_json() for error in errors]
    return JSONResponse(body, status, headers, media_type="application/problem+json")


def answer(problem: ApiProblem) -> JSONResponse:
    return response(problem.status, problem.name, problem.detail, problem.errors, problem.headers)


async def _on_problem(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, ApiProblem)
    return answer(error)


async def _on_http(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    phrase = HTTPStatus(error.status_code).phrase
    headers = dict(error.headers) if error.headers else None
    return response(error.status_code, phrase.lower().replace(" ", "-"), f"{phrase}.", headers=headers)


async def _on_invalid(_request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    errors = [Problem(_pointer(one["loc"]), str(one["msg"])) for one in error.errors()]
    return response(422, "invalid", "The request is not what this call expects.", errors)


async def _on_full(request: Request, error: Exception) -> JSONResponse:
    """A disk that is full is nobody's bug, and passes; anything else of these kinds is."""
    if not is_full(error):
        raise error
    log.error("%s %s: the disk is full", request.method, request.url.path)
    return answer(disk_is_full())


async def _on_bug(request: Request, error: Exception) -> JSONResponse:
    log.error("%s %s failed", request.method, request.url.path, exc_info=error)
    current = request_id.get()  # this answer is made outside of the middleware that names all others
    headers = None if current is None else {"X-Request-Id": current}
    failure = response(500, "internal-server-error", "The server failed; its log says more.", headers=headers)
    add_to(failure.headers, request.url.scheme, request.url.path)
    return failure


def _pointer(where: Sequence[str | int]) -> str:
    """("body", "files", 0, "size") as body/files/0/size. Unknown field names are the caller's own words,
    so only short plain ones are repeated."""
    parts = [str(part) for part in where]
    return "/".join(part if len(part) <= 64 and part.isprintable() else "…" for part in parts)


def install(app: FastAPI) -> None:
    app.add_exception_handler(ApiProblem, _on_problem)
    app.add_exception_handler(HTTPException, _on_http)
    app.add_exception_handler(RequestValidationError, _on_invalid)
    app.add_exception_handler(OSError, _on_full)
    app.add_exception_handler(DBAPIError, _on_full)
    app.add_exception_handler(Exception, _on_bug)
