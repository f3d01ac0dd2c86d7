"""Sends a scan while the scanner still writes it: each view as soon as it has come to rest, scan.json at the end."""

from __future__ import annotations

import sys
import time
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from splatct_client.client import Client
from splatct_client.errors import InputError, ServerProblem
from splatct_client.journal import Journal
from splatct_client.models import FileSpec, Upload
from splatct_client.scanfolder import ScanFolder, read_scan_folder, spec_of
from splatct_client.sending import abandon, commit, create, earlier, given_up_if_refused, send_files

POLL_S = 0.5
TIFF = (".tif", ".tiff")
ANNOUNCED = "urn:splatct:problem:announced"  # with another size or digest


@dataclass
class Rest:
    """Tells files that nobody writes to any more: size and time of change have stood still for a while."""

    settle_s: float
    clock: Callable[[], float] = time.monotonic
    _seen: dict[Path, tuple[tuple[int, int], float]] = field(default_factory=dict)

    def has(self, path: Path) -> bool:
        try:
            status = path.stat()
        except FileNotFoundError:
            self._seen.pop(path, None)
            return False
        state, now = (status.st_size, status.st_mtime_ns), self.clock()
        before, since = self._seen.get(path, (None, now))
        if before != state:
            since = now
        self._seen[path] = (state, since)
        return status.st_size > 0 and now - since >= self.settle_s


class GrowingScan:
    """A folder that fills."""

    def __init__(self, folder: Path, settle_s: float, say: Callable[[str], None]) -> None:
        if not folder.is_dir():
            raise InputError(f"{folder} is not a folder; expected the one that the scanner writes to")
        self._folder, self._rest, self._say = folder, Rest(settle_s), say
        self._waits_for = ""

    def whole(self) -> ScanFolder | None:
        """The scan, once scan.json and every file that it names have come to rest."""
        if not self._rest.has(self._folder / "scan.json"):
            return None
        try:
            scan = read_scan_folder(self._folder)
        except InputError as error:  # files that it names are still to come, or it is not yet what it will be
            if str(error) != self._waits_for:
                self._waits_for = str(error)
                self._say(f"not yet whole: {str(error).splitlines()[0]}")
            return None
        at_rest = [self._rest.has(path) for path in scan.files.values()]
        return scan if all(at_rest) else None

    def views(self) -> dict[str, Path]:
        """TIFF files at rest, by the name under which `scanfolder.plain_names` will want them."""
        found: dict[str, Path] = {}
        for path in sorted(self._folder.rglob("*")):
            inside = path.relative_to(self._folder)
            hidden = any(part.startswith(".") for part in inside.parts)
            if not hidden and path.suffix.lower() in TIFF and path.is_file() and self._rest.has(path):
                found.setdefault(unicodedata.normalize("NFC", "_".join(inside.parts)), path)
        return found


def send_growing(client: Client, scan: GrowingScan, name: str, journal: Journal, idle_s: float | None) -> str:
    """Until the scan is whole; then commits it and returns its id. Raises InputError when nothing has come for
    `idle_s`: another run goes on; and for a file that changed after it was sent: another run begins anew."""
    upload = _opened(client, name, journal)
    sent = {file.name: file.size for file in upload.files if file.complete}
    if sent:
        print(f"the server has {len(sent)} files already", file=sys.stderr)
    came = client.patience.clock()
    with given_up_if_refused(client, upload.id, journal):
        while upload.state != "committed":
            whole = scan.whole()
            if whole is not None:
                _send_rest(client, upload.id, whole, journal)
                break
            for file, path in scan.views().items():
                if sent.get(file) != path.stat().st_size:
                    sent[file] = _send(client, upload.id, spec_of(file, path), path, journal)
                    came = client.patience.clock()
            if idle_s is not None and client.patience.clock() - came > idle_s:
                raise InputError(
                    f"nothing has come for {idle_s:g} s and the scan is not whole; {len(sent)} files are at the "
                    "server. The same command goes on, when there is more"
                )
            client.patience.sleep(POLL_S)
        return commit(client, upload.id)


def _send_rest(client: Client, upload_id: str, scan: ScanFolder, journal: Journal) -> None:
    """What of the whole scan is not at the server, scan.json last. All is read once more: a view that was written again
    after it was sent is told by its digest, and refused."""
    there = {file.name: file.sha256 for file in client.upload(upload_id).files}
    for spec in (*scan.specs[1:], scan.json_spec()):
        if there.get(spec.name) != spec.sha256:
            _send(client, upload_id, spec, scan.sources[spec.name], journal)


def _send(client: Client, upload_id: str, spec: FileSpec, source: Path | bytes, journal: Journal) -> int:
    try:
        (told,) = client.announce(upload_id, [spec])
    except ServerProblem as problem:
        if problem.kind != ANNOUNCED:
            raise
        abandon(client, upload_id)  # what is announced cannot be changed: this upload will never be whole
        journal.forget()
        raise InputError(
            f"{spec.name} was written again after it was sent, so what was sent is given up. Start again, with a "
            "longer --settle if the scanner pauses while it writes a file"
        ) from None
    if not told.complete:  # the server may have the same bytes from another scan
        send_files(client, upload_id, {spec.name: source})
    return spec.size


def _opened(client: Client, name: str, journal: Journal) -> Upload:
    found = earlier(client, journal) if journal.get("growing") else None
    return found or create(client, journal, name, [], growing=True)
