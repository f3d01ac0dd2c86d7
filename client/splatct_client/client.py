"""The API's calls, one method each: docs/http.md is the contract."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote
from uuid import uuid4

import httpx

from splatct_client.connection import Connection, parsed
from splatct_client.download import fetch_file
from splatct_client.errors import IntegrityError, ServerProblem, UnexpectedAnswer
from splatct_client.models import Delivery, FileSpec, Job, ResultFile, Scan, Upload, UploadedFile, Webhook
from splatct_client.resume import CHUNK as RESUMED_FROM
from splatct_client.resume import send_in_chunks
from splatct_client.retry import retry_after_s

CHUNK = 1 << 20
SHORTEST_PAUSE_S = 0.5
_PINNING = {True: "POST", False: "DELETE"}
OnBytes = Callable[[int], None]


class Client(Connection):
    """What one server can do."""

    # Uploads

    def create_upload(
        self, name: str, files: Sequence[FileSpec], growing: bool = False, upload_id: str | None = None
    ) -> Upload:
        """growing: more files are announced later, scan.json among them perhaps. upload_id: a UUID of one's own, under
        which the same may be asked for again, in a later run too, and is one upload."""
        body: dict[str, Any] = {"name": name, "files": [file.to_json() for file in files]}
        body |= {"growing": True} if growing else {}
        try:  # as in `submit`
            return Upload.from_json(self._json("PUT", f"/v1/uploads/{_id(upload_id or str(uuid4()))}", json=body))
        except ServerProblem as problem:
            if problem.status != 405:
                raise
        return Upload.from_json(self._json("POST", "/v1/uploads", json=body, repeatable=False))

    def announce(self, upload_id: str, files: Sequence[FileSpec]) -> list[UploadedFile]:
        """More files of an open upload; repeated unchanged it does no harm."""
        body = {"files": [file.to_json() for file in files]}
        answer = self._json("POST", f"/v1/uploads/{_id(upload_id)}/files", json=body)
        return [UploadedFile.from_json(file) for file in _items(answer, "files")]

    def import_scan(self, folder: str, name: str | None = None) -> Upload:
        """A folder of the server's own disks as an upload whose files are complete; commit it then."""
        body = {"folder": folder} | ({} if name is None else {"name": name})
        answer = self._json("POST", "/v1/imports", json=body, repeatable=False, timeout=1800.0)
        return Upload.from_json(answer)

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

    def scans(self) -> list[Scan]:
        """Committed scans, newest first."""
        return [Scan.from_json(scan) for scan in _items(self._json("GET", "/v1/scans"), "scans")]

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
        job_id: str | None = None,
    ) -> Job:
        """priority: low, normal or high among one's own jobs. job_id: a UUID of one's own, under which the same may be
        submitted again, in a later run too, and is one job."""
        body: dict[str, Any] = {"scan_id": scan_id, "options": options or {}}
        if name is not None:
            body["name"] = name
        if priority is not None:
            body["priority"] = priority
        try:  # under an id of our own it can be repeated until there is an answer, and there is one job
            return Job.from_json(self._json("PUT", f"/v1/jobs/{_id(job_id or str(uuid4()))}", json=body))
        except ServerProblem as problem:
            if problem.status != 405:
                raise
        return Job.from_json(self._json("POST", "/v1/jobs", json=body, repeatable=False))  # an older server

    def validate(self, scan_id: str, options: dict[str, Any] | None = None) -> dict[str, Any]:
        """What a job would cost: `memory_bytes`, `seconds`, `disk_bytes`, `warnings` and more. Nothing is run."""
        estimate = self._json("POST", "/v1/jobs/validate", json={"scan_id": scan_id, "options": options or {}})
        if not isinstance(estimate, dict):
            raise UnexpectedAnswer("the server's estimate is no JSON object")
        return estimate

    def restart(
        self,
        job_id: str,
        options: dict[str, Any] | None = None,
        name: str | None = None,
        priority: str | None = None,
    ) -> Job:
        """A new job of a finished one's scan; what is given changes."""
        given = {"options": options or None, "name": name, "priority": priority}
        body = {key: value for key, value in given.items() if value is not None}
        once = {"Idempotency-Key": str(uuid4())}  # so that it may be repeated until there is an answer
        return Job.from_json(self._json("POST", f"/v1/jobs/{_id(job_id)}/restart", json=body, headers=once))

    def prioritise(self, job_id: str, priority: str) -> Job:
        return Job.from_json(self._json("PATCH", f"/v1/jobs/{_id(job_id)}", json={"priority": priority}))

    def pin(self, job_id: str, pinned: bool = True) -> Job:
        """Keep a job's results, however old they grow; or no longer."""
        return Job.from_json(self._json(_PINNING[pinned], f"/v1/jobs/{_id(job_id)}/pin"))

    def pin_scan(self, scan_id: str, pinned: bool = True) -> Scan:
        return Scan.from_json(self._json(_PINNING[pinned], f"/v1/scans/{_id(scan_id)}/pin"))

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
                job = Job.from_json(parsed(answer))
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

    # Webhooks

    def add_webhook(self, url: str, events: Sequence[str] | None = None) -> Webhook:
        """The only answer that has the secret. events: all where left out."""
        body: dict[str, Any] = {"url": url} | ({"events": list(events)} if events else {})
        return Webhook.from_json(self._json("POST", "/v1/webhooks", json=body, repeatable=False))

    def webhooks(self) -> list[Webhook]:
        return [Webhook.from_json(one) for one in _items(self._json("GET", "/v1/webhooks"), "webhooks")]

    def remove_webhook(self, webhook_id: str) -> None:
        self._request("DELETE", f"/v1/webhooks/{_id(webhook_id)}")

    def deliveries(self, webhook_id: str) -> list[Delivery]:
        """Newest first, 200 at most."""
        answer = self._json("GET", f"/v1/webhooks/{_id(webhook_id)}/deliveries")
        return [Delivery.from_json(one) for one in _items(answer, "deliveries")]

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


def _items(data: Any, key: str) -> list[Any]:
    items = data.get(key) if isinstance(data, dict) else None
    if not isinstance(items, list):
        raise UnexpectedAnswer(f"the server's answer has no list {key!r}")
    return items
