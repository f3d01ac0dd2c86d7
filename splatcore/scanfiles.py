"""The files a scan names: found inside its folder and nowhere else, each once."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

from splatcore.document import Document, nearest, shown
from splatcore.tiff import MAX_PAGES

_LONGEST_NAME = 1024  # characters, folders included
_LOOKED_AT = 200  # files of a folder, for one whose name is near


@dataclass(frozen=True)
class NamedFile:
    """A file of the scan: as scan.json names it, where it lies, and the JSON pointer that names it."""

    name: str
    path: Path
    pointer: str


def find_file(folder: Path, name: object, pointer: str, doc: Document) -> NamedFile | None:
    """The regular file of that name inside the folder, whatever links lead there."""
    if not isinstance(name, str) or not name:
        doc.note(pointer, f"got {shown(name)}, expected a file name")
        return None
    if len(name) > _LONGEST_NAME:
        doc.note(pointer, f"{shown(name)} has {len(name)} characters, more than the {_LONGEST_NAME} allowed")
        return None
    path = PurePosixPath(name)
    if not name.isprintable() or "\\" in name or ":" in name or path.is_absolute() or ".." in path.parts:
        hint = "name a file inside the scan folder, with '/' between folders and no '..'"
        doc.note(pointer, f"{shown(name)} is not a plain relative path", hint)
        return None
    root = folder.resolve()
    try:
        target = (root / path).resolve()
        inside, exists, regular = target.is_relative_to(root), target.exists(), target.is_file()
    except (OSError, RuntimeError) as error:  # a loop of links, a name too long
        doc.note(
            pointer,
            f"{shown(name)} cannot be followed: {getattr(error, 'strerror', None) or 'its links run in a circle'}",
        )
        return None
    if not inside:
        doc.note(pointer, f"{shown(name)} leads out of the scan folder", "links may only point inside it")
    elif not exists:
        try:
            entries = islice((root / path).parent.iterdir(), _LOOKED_AT)
            present = sorted(entry.name for entry in entries if entry.is_file())
        except OSError:
            present = []
        hint = nearest(path.name, [entry for entry in present if entry != "scan.json"])
        doc.note(pointer, f"{shown(name)} does not exist in the scan folder", hint)
    elif not regular:
        doc.note(pointer, f"{shown(name)} is not a regular file")
    else:
        return NamedFile(name, target, pointer)
    return None


def find_files(given: Any, pointer: str, folder: Path, taken: dict[Path, str], doc: Document) -> tuple[NamedFile, ...]:
    names = doc.array(given, pointer)
    if names is None:
        return ()
    if not names:
        doc.note(pointer, "is empty", "name at least one TIFF file")
    if len(names) > MAX_PAGES:
        doc.note(pointer, f"names {len(names)} files, more than the {MAX_PAGES} allowed")
        return ()
    found = []
    for i, name in enumerate(names):
        if doc.full:  # following one name more may cost as much as its author likes
            doc.pass_over()
            break
        file = find_file(folder, name, f"{pointer}/{i}", doc)
        if file is None:
            continue
        if file.path in taken:
            doc.note(file.pointer, f"{shown(name)} is the same file as {taken[file.path]}", "name each file once")
        taken.setdefault(file.path, file.pointer)
        found.append(file)
    return tuple(found)
