"""A connection to one server: sends requests, repeats them while that helps, turns refusals into exceptions."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Self
from urllib.parse import urlsplit

import httpx

from splatct_client.credentials import checked
from splatct_client.errors import (
    ClientError,
    InputError,
    KeyNeeded,
    Problem,
    ServerProblem,
    ServerUnreachable,
    UnexpectedAnswer,
)
from splatct_client.retry import NEVER_DONE_STATUS, RETRIED_STATUS, Patience, retry_after_s

LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
LONGEST_WAIT_S = 30.0  # of one long poll; proxies give up on a silent request after 60 s


class Connection:
    """Use it as a context manager, from one thread.

    Calls are repeated for `patience` while the server is away or overloaded; what must not
    happen twice (a new upload) only if the server cannot have done it. A server that
    never answered at all is reported at once.
    """

    def __init__(
        self,
        base_url: str,
        *,
        key: str | None = None,
        patience: Patience | None = None,
        timeout_s: float = 60.0,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        address = urlsplit(base_url)
        if address.scheme not in ("http", "https") or not address.hostname:
            raise InputError(f"server: got {base_url!r}, expected an address such as http://127.0.0.1:8080")
        if "@" in address.netloc:  # not repeated: addresses end up in logs and in what is printed
            raise InputError("server: the address holds a user's name or a secret; a key goes into --key-file")
        self.base_url = base_url.rstrip("/")
        self.patience = patience or Patience()
        self._reached = False
        self._wait_s = min(LONGEST_WAIT_S, timeout_s / 2)
        headers = {"User-Agent": "splatct-client/1", "Accept": "application/json"}
        if key is not None:
            headers["Authorization"] = f"Bearer {checked(key, 'key')}"
        self._has_key = key is not None
        self._http = httpx.Client(
            base_url=self.base_url,
            follow_redirects=False,  # the key is for this address alone
            timeout=httpx.Timeout(timeout_s, connect=min(10.0, timeout_s)),
            transport=transport,
            trust_env=address.hostname not in LOOPBACK,  # no proxy to oneself
            headers=headers,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def offset(self, url: str) -> httpx.Response:
        """HEAD of a file of an upload: `Upload-Offset` is where to go on."""
        return self._request("HEAD", url)

    def send_chunk(
        self, url: str, headers: dict[str, str], body: Callable[[], Iterator[bytes]], size: int
    ) -> httpx.Response:
        """One PATCH. Repeated only if the server cannot have taken any of it: see `resume`."""
        return self._request("PATCH", url, repeatable=False, content=body, size=size, headers=headers)

    def stream(self, url: str, headers: dict[str, str]) -> httpx.Response:
        """A GET whose body has not been read yet; the caller closes it. Not repeated: see `download`."""
        response = self._http.send(
            self._http.build_request("GET", url, headers={"Accept-Encoding": "identity", **headers}), stream=True
        )
        if (response.is_error and response.status_code != 416) or response.has_redirect_location:
            response.read()
            response.close()
            raise self._refusal(response)
        return response

    def _json(self, method: str, url: str, **kwargs: Any) -> Any:
        return parsed(self._request(method, url, **kwargs))

    def _request(
        self,
        method: str,
        url: str,
        *,
        repeatable: bool = True,
        content: Callable[[], Iterator[bytes]] | None = None,
        size: int = 0,
        timeout: float | None = None,
        **kwargs: Any,
    ) -> httpx.Response:
        if timeout is not None:
            kwargs["timeout"] = timeout
        attempts = self.patience.start()
        if content is not None:
            kwargs["headers"] = {**kwargs.get("headers", {}), "Content-Length": str(size)}
        while True:
            if content is not None:
                kwargs["content"] = content()
            try:
                response = self._http.request(method, url, **kwargs)
            except httpx.LocalProtocolError:
                raise
            except httpx.TransportError as error:
                never_sent = isinstance(error, (httpx.ConnectError, httpx.ConnectTimeout))
                if not self._reached or not (repeatable or never_sent) or not attempts.pause():
                    raise ServerUnreachable(self.base_url, error) from error
                continue
            self._reached = True
            if not response.is_error and not response.has_redirect_location:
                return response
            again = response.status_code in (RETRIED_STATUS if repeatable else NEVER_DONE_STATUS)
            if not again or not attempts.pause(retry_after_s(response.headers.get("Retry-After"))):
                raise self._refusal(response)

    def _refusal(self, response: httpx.Response) -> ClientError:
        if response.has_redirect_location:
            return UnexpectedAnswer(
                f"{self.base_url} sends on to another address, which is not followed: the key is for this one alone; "
                "give the server's final address with --server URL or SPLATCT_SERVER"
            )
        if response.status_code == 401 and not self._has_key:
            return KeyNeeded(self.base_url)
        return _problem(response)


def parsed(response: httpx.Response) -> Any:
    try:
        return response.json()
    except ValueError:
        kind = response.headers.get("Content-Type", "no type")
        raise UnexpectedAnswer(
            f"{response.request.url} answered with {kind}, not JSON: is it a SplatCT server?"
        ) from None


def _problem(response: httpx.Response) -> ServerProblem:
    """The exception for an error answer, problem+json or not."""
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        body = {}
    listed = [error for error in body.get("errors") or [] if isinstance(error, dict)]
    return ServerProblem(
        response.status_code,
        str(body.get("title") or response.reason_phrase or "the server refused"),
        str(body.get("detail") or ""),
        str(body.get("type") or "about:blank"),
        [Problem(str(e.get("where", "")), str(e.get("what", "")), str(e.get("hint") or "")) for e in listed],
    )
