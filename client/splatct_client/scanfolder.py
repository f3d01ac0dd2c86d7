"""What of a scan folder goes to the server: scan.json without its truth, and the files it names."""

from __future__ import annotations

import hashlib
import json
import unicodedata
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from splatct_client.errors import InputError, Problem
from splatct_client.models import FileSpec

CALIBRATION = ("flat", "dark", "bad_pixels")


@dataclass(frozen=True)
class ScanFolder:
    """A scan, ready to be sent. Only its names are checked here; the server judges the contents."""

    name: str
    scan_json: bytes  # without `simulation`: the truth is for `splatct evaluate`, not for the server
    files: dict[str, Path]  # every other file, by the name in the scan.json above

    @property
    def specs(self) -> list[FileSpec]:
        """With digests, for which all of the scan is read: what the server has already need not be sent."""
        return [self.json_spec(), *(spec_of(name, path) for name, path in self.files.items())]

    def json_spec(self) -> FileSpec:
        return FileSpec("scan.json", len(self.scan_json), hashlib.sha256(self.scan_json).hexdigest())

    @property
    def size(self) -> int:
        return len(self.scan_json) + sum(path.stat().st_size for path in self.files.values())

    @property
    def sources(self) -> dict[str, Path | bytes]:
        return {"scan.json": self.scan_json, **self.files}


def read_scan_folder(folder: Path) -> ScanFolder:
    """Find what the scan needs. Raises InputError naming everything that is missing."""
    path = folder / "scan.json"
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; expected a scan folder with scan.json and its TIFF files")
    if not path.is_file():
        raise InputError(f"{folder} has no scan.json; expected a scan folder with scan.json and its TIFF files")
    try:
        scan = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not valid JSON: {error}") from None
    if not isinstance(scan, dict):
        raise InputError(f"{path}: expected a JSON object, got {type(scan).__name__}")

    problems: list[Problem] = []
    named = list(_named(scan, problems))
    for pointer, name in named:
        problem = _wrong_with(folder, name)
        if problem:
            problems.append(Problem(f"scan.json{pointer}", *problem))
    sent_as = plain_names(name for _, name in named)
    if problems:
        raise InputError(f"{folder} cannot be submitted:", problems)
    scan.pop("simulation", None)
    for _, owner, key in _slots(scan):
        given = owner[key]
        owner[key] = [sent_as[name] for name in given] if isinstance(given, list) else sent_as[given]
    title = scan.get("name")
    return ScanFolder(
        name=title if isinstance(title, str) and title else folder.resolve().name,
        scan_json=json.dumps(scan, ensure_ascii=False, indent=1).encode(),
        files={sent: folder / name for name, sent in sent_as.items()},
    )


def spec_of(name: str, path: Path) -> FileSpec:
    with path.open("rb") as stream:
        sha256 = hashlib.file_digest(stream, "sha256").hexdigest()
        return FileSpec(name, stream.tell(), sha256)


def plain_names(names: Iterable[str]) -> dict[str, str]:
    """The name under which each file is sent. The server takes no folders, only Unicode form C, and no
    two names that differ in nothing but their capitals."""
    sent: dict[str, str] = {}
    taken = {"scan.json"}
    for name in names:
        if name in sent:
            continue
        plain = wanted = unicodedata.normalize("NFC", "_".join(PurePosixPath(name).parts))
        count = 1
        while plain.casefold() in taken:
            count += 1
            plain = f"{PurePosixPath(wanted).stem}-{count}{PurePosixPath(wanted).suffix}"
        taken.add(plain.casefold())
        sent[name] = plain
    return sent


def _slots(scan: dict[str, Any]) -> list[tuple[str, dict[str, Any], str]]:
    """The places in scan.json that name files: pointer, object and key. `flat`, `dark` and `bad_pixels`
    may stand in `projections` or beside it."""
    projections = scan["projections"]
    places = [("/projections", projections, key) for key in ("files", *CALIBRATION)]
    places += [("", scan, key) for key in CALIBRATION]
    return [(f"{pointer}/{key}", owner, key) for pointer, owner, key in places if owner.get(key) is not None]


def _named(scan: dict[str, Any], problems: list[Problem]) -> Iterator[tuple[str, str]]:
    """Each file name in scan.json with its JSON pointer; what is no name becomes a problem."""
    projections = scan.get("projections")
    if not isinstance(projections, dict):
        problems.append(Problem("scan.json", "has no object `projections`"))
        return
    if not projections.get("files"):
        problems.append(Problem("scan.json/projections/files", "names no file"))
    for pointer, owner, key in _slots(scan):
        for name in owner[key] if isinstance(owner[key], list) else [owner[key]]:
            if isinstance(name, str) and name:
                yield pointer, name
            else:
                problems.append(Problem(f"scan.json{pointer}", f"got {name!r}, expected a file name"))


def _wrong_with(folder: Path, name: str) -> tuple[str, str] | None:
    """What is wrong with a named file, and a hint; None if it can be sent."""
    parts = PurePosixPath(name).parts
    if name.startswith("/") or PureWindowsPath(name).drive or ".." in parts or "\\" in name:
        return f"{name!r} points out of the scan folder", "give names relative to the folder, with / between parts"
    if name == "scan.json":
        return "names scan.json itself", ""
    path = folder / name
    if not path.is_file():
        return f"{name} does not exist", "is the name spelled as on disk, capitals included?"
    if path.stat().st_size == 0:
        return f"{name} is empty", ""
    return None
