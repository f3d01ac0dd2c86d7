"""A scan on its way to the server: what is missing is sent, then all of it is committed.

A run that was cut off, however hard, is gone on with by the next: the journal says which upload it was, the server what
it has of it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

from splatct_client.bar import Bar, size_text
from splatct_client.client import Client
from splatct_client.errors import ClientError, ServerProblem
from splatct_client.journal import Journal
from splatct_client.models import FileSpec, Job, Upload
from splatct_client.scanfolder import ScanFolder


def send(client: Client, scan: ScanFolder, journal: Journal | None = None) -> str:
    """Upload and commit; returns the scan's id."""
    specs = scan.specs
    upload = _opened(client, scan.name, specs, journal)
    with given_up_if_refused(client, upload.id, journal):
        if upload.state != "committed":
            there = {file.name for file in upload.files if file.complete}
            if there:
                print(f"the server has {len(there)} of {len(specs)} files already", file=sys.stderr)
            send_files(client, upload.id, {name: source for name, source in scan.sources.items() if name not in there})
        return commit(client, upload.id)


def earlier(client: Client, journal: Journal) -> Upload | None:
    """The upload that an earlier run was at, if the server still has it."""
    upload_id = journal.get("upload")
    if not isinstance(upload_id, str):
        return None
    try:
        return client.upload(upload_id)
    except ServerProblem as problem:
        if problem.status not in (404, 422):
            raise
        return None


@contextlib.contextmanager
def given_up_if_refused(client: Client, upload_id: str, journal: Journal | None) -> Iterator[None]:
    """What the server will never take holds a share of its disk no longer; all else waits for another run."""
    try:
        yield
    except ServerProblem as problem:
        if problem.status == 422 or journal is None:
            abandon(client, upload_id)
            if journal is not None:
                journal.forget()
        raise
    except KeyboardInterrupt:
        if journal is None:
            abandon(client, upload_id)
        else:
            print("the same command goes on from here", file=sys.stderr)
        raise


def send_files(client: Client, upload_id: str, missing: Mapping[str, Path | bytes]) -> None:
    done, total = 0, sum(map(_size, missing.values()))
    with Bar("upload") as bar:
        for name, source in missing.items():

            def show(sent: int, name: str = name, before: int = done) -> None:
                at = before + sent
                bar.show(at / max(total, 1), f"{size_text(at)} of {size_text(total)}  {name}")

            done += client.put_file(upload_id, name, source, show).size


def commit(client: Client, upload_id: str) -> str:
    print("the server checks the files", file=sys.stderr)
    return client.commit(upload_id).id


def submit_once(
    client: Client,
    journal: Journal,
    scan_id: str,
    options: dict[str, object],
    name: str | None,
    priority: str | None,
) -> Job:
    """One job, though an earlier run may have got this far and never heard the answer."""
    asked = [scan_id, options, name, priority]
    known = journal.get("job") if journal.get("asked") == asked else None
    job_id = known if isinstance(known, str) else str(uuid4())
    journal.note(job=job_id, asked=asked)
    try:
        job = client.submit(scan_id, options, name, priority, job_id)
    except ServerProblem as problem:
        if known is None or problem.status != 410:
            raise
        job = client.submit(scan_id, options, name, priority)  # the earlier one has been deleted since
    journal.forget()
    return job


def _opened(client: Client, name: str, specs: Sequence[FileSpec], journal: Journal | None) -> Upload:
    """The upload of an earlier run of the very same files, or a new one."""
    told = json.dumps([spec.to_json() for spec in specs], sort_keys=True)
    files = hashlib.sha256(told.encode()).hexdigest()
    found = None if journal is None else earlier(client, journal)
    if journal is not None and found is not None:
        if journal.get("files") == files:
            return found
        if found.state != "committed":
            abandon(client, found.id)  # of other files: the scan was changed since
    return create(client, journal, name, specs, files=files)


def create(
    client: Client, journal: Journal | None, name: str, specs: Sequence[FileSpec], growing: bool = False, **facts: Any
) -> Upload:
    """A new upload. Its id is in the journal before the server is asked: whenever this run is killed, the next one
    finds it."""
    upload_id = str(uuid4())
    if journal is not None:
        journal.note(upload=upload_id, growing=growing, **facts)
    upload = client.create_upload(name, specs, growing, upload_id)
    if journal is not None and upload.id != upload_id:  # of a server too old to take ours
        journal.note(upload=upload.id)
    return upload


def abandon(client: Client, upload_id: str) -> None:
    with contextlib.suppress(ClientError):
        client.abandon(upload_id)  # or it would hold its share of the server's disk until it expires


def _size(source: Path | bytes) -> int:
    return len(source) if isinstance(source, bytes) else source.stat().st_size
