"""The API's calls, one method each: docs/http.md is the contract."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote, urlsplit
from uuid import uuid4

import httpx

from splatct_client.credentials import checked
from splatct_client.download import fetch_file
from splatct_client.errors import (
    ClientError,
    InputError,
    IntegrityError,
    KeyNeeded,
    Problem,
    ServerProblem,
    ServerUnreachable,
    UnexpectedAnswer,
)
from splatct_client.models import FileSpec, Job, ResultFile, Scan, Upload, UploadedFile
from splatct_client.resume import CHUNK as RESUMED_FROM
from splatct_client.resume import send_in_chunks
from splatct_client.retry import NEVER_DONE_STATUS, RETRIED_STATUS, Patience, retry_after_s

CHUNK = 1 << 20
LOOPBACK = frozenset({"127.0.0.1", "localhost", "::1"})
LONGEST_WAIT_S = 30.0  # of one long poll; proxies give up on a silent request after 60 s
SHORTEST_PAUSE_S = 0.5
OnBytes = Callable[[int], None]


class Client:
    """A connection to one server. Use it as a context manager, from one thread.

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

    # Uploads

    def create_upload(self, name: str, files: Sequence[FileSpec]) -> Upload:
        body = {"name": name, "files": [file.to_json() for file in files]}
        return Upload.from_json(self._json("POST", "/v1/uploads", json=body, repeatable=False))

    def upload(self, upload_id: str) -> Upload:
        return Upload.from_json(self._json("GET", f"/v1/uploads/{_id(upload_id)}"))

    def put_file(
        self, upload_id: str, name: str, source: Path | bytes, on_bytes: OnBytes | None = None
    ) -> UploadedFile:
        """Send one file, streamed and hashed on the way. `on_bytes` is told the bytes of this file sent so far.

        A large one goes in chunks, and after a failure on from where the server stands.

        Raises IntegrityError if the server's sha256 differs from what was read here.
        """
        size = len(source) if isinstance(source, bytes) else source.stat().st_size
        url = f"/v1/uploads/{_id(upload_id)}/files/{_name(name)}"
        if isinstance(source, Path) and size > RESUMED_FROM:
            return UploadedFile(name, size, size, True, send_in_chunks(self, url, source, on_bytes))
        digest = hashlib.sha256()

        def body() -> Iterator[bytes]:
            nonlocal digest
            digest, sent = hashlib.sha256(), 0
            for chunk in _chunks(source):
                digest.update(chunk)
                yield chunk
                sent += len(chunk)
                if on_bytes:
                    on_bytes(sent)

        try:
            stored = UploadedFile.from_json(self._json("PUT", url, content=body, size=size))
        except httpx.LocalProtocolError as error:
            raise IntegrityError(f"{name}: changed its size while it was sent ({error})") from error
        if stored.sha256 is not None and stored.sha256 != digest.hexdigest():
            raise IntegrityError(
                f"{name}: the server stored sha256 {stored.sha256}, the file here has {digest.hexdigest()}; "
                "does something still write to it?"
            )
        return stored

    def commit(self, upload_id: str, *, timeout_s: float = 1800.0) -> Scan:
        """Have the server check every file. Takes as long as reading the scan takes."""
        return Scan.from_json(self._json("POST", f"/v1/uploads/{_id(upload_id)}/commit", timeout=timeout_s))

    def abandon(self, upload_id: str) -> None:
        self._request("DELETE", f"/v1/uploads/{_id(upload_id)}")

    # Jobs

    def options(self) -> list[dict[str, Any]]:
        """Every reconstruction option the server knows: name, default, choices, range, help."""
        return _items(self._json("GET", "/v1/options"), "options")

    def submit(
        self,
        scan_id: str,
        options: dict[str, Any] | None = None,
        name: str | None = None,
        priority: str | None = None,
    ) -> Job:
        """priority: low, normal or high among one's own jobs."""
        body: dict[str, Any] = {"scan_id": scan_id, "options": options or {}}
        if name is not None:
            body["name"] = name
        if priority is not None:
            body["priority"] = priority
        try:  # under an id of our own it can be repeated until there is an answer, and there is one job
            return Job.from_json(self._json("PUT", f"/v1/jobs/{uuid4()}", json=body))
        except ServerProblem as problem:
            if problem.status != 405:
                raise
        return Job.from_json(self._json("POST", "/v1/jobs", json=body, repeatable=False))  # an older server

    def job(self, job_id: str) -> Job:
        return Job.from_json(self._json("GET", f"/v1/jobs/{_id(job_id)}"))

    def jobs(self, *, state: str | None = None, limit: int | None = None, before: str | None = None) -> list[Job]:
        """Jobs, newest first."""
        given = {"state": state, "limit": limit, "before": before}
        query = {name: value for name, value in given.items() if value is not None}
        return [Job.from_json(job) for job in _items(self._json("GET", "/v1/jobs", params=query), "jobs")]

    def cancel(self, job_id: str) -> Job:
        return Job.from_json(self._json("POST", f"/v1/jobs/{_id(job_id)}/cancel"))

    def wait(self, job_id: str, on_progress: Callable[[Job], None] | None = None) -> Job:
        """Until the job has finished, however it ends. The server is asked to answer when there is news; one too
        old to know how answers at once, and is asked again after a pause."""
        url, pause = f"/v1/jobs/{_id(job_id)}", SHORTEST_PAUSE_S
        etag: str | None = None
        seen: object = None
        while True:
            asked = self.patience.clock()
            query: dict[str, Any] = (
                {} if etag is None else {"params": {"wait": self._wait_s}, "headers": {"If-None-Match": etag}}
            )
            answer = self._request("GET", url, **query)
            news = answer.status_code != 304
            if news:
                job = Job.from_json(_parsed(answer))
                if on_progress:
                    on_progress(job)
                if job.finished:
                    return job
                state = (job.state, job.progress, job.message)
                news, seen = state != seen, state
                etag = answer.headers.get("ETag")
            if etag is not None and (news or self.patience.clock() - asked >= SHORTEST_PAUSE_S):
                continue
            pause = SHORTEST_PAUSE_S if news else min(pause * 1.5, 5.0)
            later = retry_after_s(answer.headers.get("Retry-After"))
            self.patience.sleep(min(later, 30.0) if later is not None else pause)

    # Results

    # `kind` is "results", or "partial": what a job had when it was cancelled or its time was up.

    def results(self, job_id: str, kind: str = "results") -> list[ResultFile]:
        """The files a finished job left, with size and sha256."""
        manifest = self._json("GET", f"/v1/jobs/{_id(job_id)}/{kind}")
        return [ResultFile.from_json(file) for file in _items(manifest, "files")]

    def manifest(self, job_id: str, kind: str = "results") -> bytes:
        """manifest.json itself, which cannot list its own sha256."""
        return self._request("GET", f"/v1/jobs/{_id(job_id)}/{kind}/manifest.json").content

    def download(
        self, job_id: str, file: ResultFile, folder: Path, on_bytes: OnBytes | None = None, kind: str = "results"
    ) -> Path:
        """Fetch one result file into `folder`: resumed, checked, and there under its name only when whole."""
        return fetch_file(self, f"/v1/jobs/{_id(job_id)}/{kind}/{_name(file.name)}", file, folder, on_bytes)

    # The wire

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
        return _parsed(self._request(method, url, **kwargs))

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


def _id(text: str) -> str:
    return quote(text, safe="")


def _name(text: str) -> str:
    return quote(text, safe="/")  # a file may lie in a subfolder


def _chunks(source: Path | bytes) -> Iterator[bytes]:
    if isinstance(source, bytes):
        yield source
        return
    with source.open("rb") as stream:
        while chunk := stream.read(CHUNK):
            yield chunk


def _parsed(response: httpx.Response) -> Any:
    try:
        return response.json()
    except ValueError:
        kind = response.headers.get("Content-Type", "no type")
        raise UnexpectedAnswer(
            f"{response.request.url} answered with {kind}, not JSON: is it a SplatCT server?"
        ) from None


def _items(data: Any, key: str) -> list[Any]:
    items = data.get(key) if isinstance(data, dict) else None
    if not isinstance(items, list):
        raise UnexpectedAnswer(f"the server's answer has no list {key!r}")
    return items


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
