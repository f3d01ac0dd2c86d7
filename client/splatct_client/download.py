"""One result file, from the server to its place: resumed after a cut, checked, renamed last."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING

import httpx

from splatct_client.errors import IntegrityError, ServerProblem, ServerUnreachable, UnexpectedAnswer
from splatct_client.models import ResultFile
from splatct_client.retry import RETRIED_STATUS

if TYPE_CHECKING:
    from splatct_client.client import Client


def place(folder: Path, name: str) -> Path:
    """Where a file of that name goes. Raises UnexpectedAnswer for a name that leaves the folder."""
    parts = PurePosixPath(name).parts
    odd = not parts or ".." in parts or name.startswith("/") or "\\" in name or "\0" in name
    if odd or PureWindowsPath(name).drive:
        raise UnexpectedAnswer(f"the server names a result file {name!r}, which is not a plain relative name")
    return folder.joinpath(*parts)


def fetch_file(
    client: Client, url: str, file: ResultFile, folder: Path, on_bytes: Callable[[int], None] | None = None
) -> Path:
    target = place(folder, file.name)
    if target.is_file() and target.stat().st_size == file.size and sha256_of(target) == file.sha256:
        if on_bytes:
            on_bytes(file.size)
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    resumed = part.is_file() and part.stat().st_size > 0
    _receive(client, url, file, part, on_bytes)
    if sha256_of(part) != file.sha256 and resumed:  # the old piece was of another file
        part.unlink()
        _receive(client, url, file, part, on_bytes)
    if sha256_of(part) != file.sha256:
        part.unlink()
        raise IntegrityError(f"{file.name}: what arrived differs from the manifest's sha256; fetch it again")
    part.replace(target)
    return target


def sha256_of(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _receive(client: Client, url: str, file: ResultFile, part: Path, on_bytes: Callable[[int], None] | None) -> None:
    """Append to `part` until it has the announced size; a cut is resumed where it happened."""
    attempts = client.patience.start()
    while True:
        have = part.stat().st_size if part.is_file() else 0
        if have > file.size:
            part.unlink()
            have = 0
        if have == file.size and part.is_file():
            return
        try:
            _receive_once(client, url, part, have, on_bytes)
            cut: Exception = IntegrityError(f"{file.name}: the server sends fewer bytes than the manifest says")
        except httpx.TransportError as error:
            cut = ServerUnreachable(client.base_url, error)
        except ServerProblem as error:
            if error.status not in RETRIED_STATUS:
                raise
            cut = error
        now = part.stat().st_size if part.is_file() else 0
        if now == file.size and part.is_file():
            return
        if now > have:
            attempts = client.patience.start()  # it moves on: patience starts afresh
        if not attempts.pause():
            raise cut


def _receive_once(client: Client, url: str, part: Path, have: int, on_bytes: Callable[[int], None] | None) -> None:
    response = client.stream(url, {"Range": f"bytes={have}-"} if have else {})
    try:
        if response.status_code == 416:
            part.unlink(missing_ok=True)
            return
        if response.status_code != 206:
            have = 0
        with part.open("r+b" if have else "wb") as stream:
            stream.seek(have)
            for chunk in response.iter_bytes():
                stream.write(chunk)
                have += len(chunk)
                if on_bytes:
                    on_bytes(have)
    finally:
        response.close()
