"""What an upload announces: which names may be, whether there is room, and what need not be sent.

A file whose SHA-256 the tenant already has in a scan is complete at once: it gets another name of the same file. The
look goes no further than the tenant's own scans, so nobody learns what others have.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence

from sqlalchemy.exc import IntegrityError

from server import names
from server.contents import find
from server.problems import ApiProblem, invalid, not_found
from server.schema import FileIn
from server.service import Service
from server.settings import MIB
from server.store import File, Upload
from splatcore.errors import Problem

MOST_FILES = 50_000
_TOLD = 200  # problems of one answer


def announced(given: Sequence[FileIn]) -> list[File]:
    """Raises a 422 that lists every name that cannot be."""
    problems = _name_problems([file.name for file in given])
    if problems:
        raise invalid("The announced files cannot be accepted.", problems[:_TOLD])
    return [File(file.name, file.size, file.sha256.lower() if file.sha256 else None, None) for file in given]


def require_scan_json(files: Sequence[File]) -> None:
    if all(file.name != "scan.json" for file in files):
        hint = "it describes the scan, see docs/http.md; where it comes last, announce the upload as growing"
        raise invalid(
            "The announced files cannot be accepted.", [Problem("files", "scan.json is not among them", hint)]
        )


def open_once(service: Service, upload_id: str, name: str, files: list[File]) -> tuple[Upload, bool]:
    """The upload of an id that the client chose, and whether an earlier request made it."""
    earlier = service.store.upload(upload_id)
    if earlier is None:
        try:
            return open_upload(service, name, files, upload_id), False
        except IntegrityError:  # another request made it just now, or another tenant has one of this id
            earlier = service.store.upload(upload_id)
            if earlier is None:
                raise not_found("upload") from None
    told = [(file.name, file.size, file.expected_sha256) for file in earlier.files[: len(files)]]
    if (earlier.name, told) != (name, [(file.name, file.size, file.expected_sha256) for file in files]):
        hint = "repeat a request unchanged, and give a new one a new UUID"
        fault = Problem("path/upload_id", "was used for other files, or another name", hint)
        raise ApiProblem(409, "upload-exists", "There is an upload of this id, and another request made it.", [fault])
    if not earlier.committed:
        service.intake.create(upload_id)  # the server may have died before it came to that
    return earlier, True


def open_upload(service: Service, name: str, files: list[File], upload_id: str | None = None) -> Upload:
    """A new upload of these files, some of them perhaps complete."""
    known = find(service.store, files)
    _require_room(service, [file for file in files if file.name not in known])
    size = sum(file.size for file in files)
    upload = service.store.add_upload(name, files, service.quotas.upload(service.tenant, size), upload_id)
    try:
        service.intake.create(upload.id)
        _adopt(service, upload.id, files, known)
    except OSError:  # a full disk: what is not there must reserve nothing
        service.reserve.deleting(lambda: service.store.drop_upload(upload.id))
        service.intake.remove_upload(upload.id)
        raise
    return service.store.upload(upload.id) or upload


def add_files(service: Service, upload_id: str, files: list[File]) -> list[File]:
    """Announce more files of an open upload, while nobody commits it. What was announced before, and just so, may be
    announced again: a client that did not hear the answer repeats its request."""
    known = find(service.store, files)
    _require_room(service, [file for file in files if file.name not in known])

    def judge(there: Sequence[File]) -> list[File]:
        before = {names.key(file.name): file for file in there}
        new, problems = [], []
        for position, file in enumerate(files):
            earlier = before.get(names.key(file.name))
            if earlier is None:
                new.append(file)
            elif (earlier.name, earlier.size, earlier.expected_sha256) != (file.name, file.size, file.expected_sha256):
                what = f"was announced before, with {earlier.size} bytes, or differs from that name in capitals alone"
                problems.append(Problem(f"files/{position}", what, "announce it unchanged, or under another name"))
        if problems:
            raise ApiProblem(409, "announced", "Other files of these names are announced.", problems[:_TOLD])
        if len(there) + len(new) > MOST_FILES:
            what = f"there are {len(there)}, {len(new)} are added, {MOST_FILES} may be"
            raise invalid("The upload has too many files.", [Problem("files", what, "put several views in one TIFF")])
        return new

    new = service.store.add_files(upload_id, judge, lambda size: service.quotas.files(service.tenant, size))
    if new is None:
        raise ApiProblem(409, "committed", "The upload is committed; its files can no longer change.")
    _adopt(service, upload_id, new, known)
    wanted = {file.name for file in files}
    upload = service.store.upload(upload_id)
    return [file for file in (upload.files if upload else ()) if file.name in wanted]


def _adopt(service: Service, upload_id: str, files: Sequence[File], known: dict[str, tuple[str, str]]) -> None:
    """Give the upload what the tenant has; a source that was deleted just now has to be sent after all."""
    done: dict[str, str] = {}
    for file in files:
        if file.name in known and file.expected_sha256 is not None:
            try:
                service.intake.adopt(upload_id, file.name, *known[file.name])
            except FileNotFoundError:
                continue
            done[file.name] = file.expected_sha256
    if done:
        service.intake.sync(upload_id)
        service.store.received_all(upload_id, done)


def _require_room(service: Service, files: Sequence[File]) -> None:
    """Refuse what will not fit, counting what open uploads still have to send."""
    size = sum(file.size for file in files)
    free = shutil.disk_usage(service.settings.data).free
    spoken_for = service.store.outstanding_bytes() + service.settings.disk_floor_mib * MIB
    if size > free - spoken_for:
        what = f"has {free} bytes free; {spoken_for} are spoken for or kept free, {size} are asked for"
        fault = Problem("disk", what, "delete jobs, scans or open uploads first, which goes on working")
        raise ApiProblem(507, "no-room", f"The disk has no room for {size} more bytes.", [fault])


def _name_problems(given: Sequence[str]) -> list[Problem]:
    problems, seen = [], set()
    for position, name in enumerate(given):
        where = f"files/{position}/name"
        fault = names.fault(name)
        if fault is not None:
            problems.append(Problem(where, f"the name {fault}", "use plain names without folders"))
        elif names.key(name) in seen:
            problems.append(Problem(where, "the name is taken by another file of this upload"))
        seen.add(names.key(name))
    return problems
