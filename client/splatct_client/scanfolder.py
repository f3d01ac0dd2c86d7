"""What of a scan folder goes to the server: scan.json without its truth, and the files it names."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from splatct_client.errors import InputError, Problem
from splatct_client.models import FileSpec


@dataclass(frozen=True)
class ScanFolder:
    """A scan, ready to be sent. Only its names are checked here; the server judges the contents."""

    name: str
    scan_json: bytes  # without `simulation`: the truth is for `splatct evaluate`, not for the server
    files: dict[str, Path]  # every other file, by the name that scan.json gives it

    @property
    def specs(self) -> list[FileSpec]:
        sizes = {"scan.json": len(self.scan_json)} | {name: path.stat().st_size for name, path in self.files.items()}
        return [FileSpec(name, size) for name, size in sizes.items()]

    @property
    def size(self) -> int:
        return sum(spec.size for spec in self.specs)

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

    files: dict[str, Path] = {}
    problems: list[Problem] = []
    for pointer, name in _named(scan, problems):
        problem = _wrong_with(folder, name)
        if problem:
            problems.append(Problem(f"scan.json{pointer}", *problem))
        else:
            files[name] = folder / name
    if problems:
        raise InputError(f"{folder} cannot be submitted:", problems)
    scan.pop("simulation", None)
    title = scan.get("name")
    return ScanFolder(
        name=title if isinstance(title, str) and title else folder.resolve().name,
        scan_json=json.dumps(scan, ensure_ascii=False, indent=1).encode(),
        files=files,
    )


def _named(scan: dict[str, Any], problems: list[Problem]) -> Iterator[tuple[str, str]]:
    """Each file name in scan.json with its JSON pointer; what is no name becomes a problem."""
    projections = scan.get("projections")
    if not isinstance(projections, dict):
        problems.append(Problem("scan.json", "has no object `projections`"))
        return
    if not projections.get("files"):
        problems.append(Problem("scan.json/projections/files", "names no file"))
    for key in ("files", "flat", "dark", "bad_pixels"):
        # The calibration files may stand beside `projections` too.
        for pointer, owner in (("/projections", projections), ("", scan)):
            if key == "files" and owner is scan:
                continue
            given = owner.get(key)
            if given is None:
                continue
            for name in given if isinstance(given, list) else [given]:
                if isinstance(name, str) and name:
                    yield f"{pointer}/{key}", name
                else:
                    problems.append(Problem(f"scan.json{pointer}/{key}", f"got {name!r}, expected a file name"))


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
