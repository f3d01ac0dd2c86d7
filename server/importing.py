"""Opens a folder that the server may import from, and the files in it, without ever leaving it.

Every step of the way is opened by its name within the folder before it, links refused: what a path means cannot change
between the look and the reading, and no path leads anywhere else.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from server.settings import SettingsError

EVERYBODY = "*"
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # or a FIFO would keep us waiting


class NotHere(Exception):
    """There is no such thing, as far as this tenant goes."""


class Refused(Exception):
    """There is something, and it is not read; the text says why."""


@dataclass(frozen=True)
class Root:
    """A folder that scans may be imported from, known to its tenant by its last name."""

    tenant: str
    path: Path


def roots(text: str, data: Path) -> tuple[Root, ...]:
    """Of the setting: TENANT=FOLDER, comma between. Raises SettingsError."""
    found: list[Root] = []
    for entry in filter(None, map(str.strip, text.split(","))):
        tenant, equals, folder = entry.partition("=")
        path = Path(folder.strip())
        if not equals or not tenant.strip() or not path.is_absolute() or not path.name:
            raise _wrong(f"got {entry!r}, expected TENANT=FOLDER with an absolute path, as lab-1=/mnt/scanner3")
        resolved, ours = path.resolve(), data.resolve()
        if resolved.is_relative_to(ours) or ours.is_relative_to(resolved):
            raise _wrong(f"{path} and the data folder {data} lie in each other; tenants would read what is others'")
        if any(_alike(root, tenant.strip(), path) for root in found):
            raise _wrong(f"two folders are named {path.name!r}; give one another name, or let it be another tenant's")
        found.append(Root(tenant.strip(), path))
    return tuple(found)


def _alike(root: Root, tenant: str, path: Path) -> bool:
    """Whether some tenant would know both by one name."""
    return root.path.name == path.name and (root.tenant == tenant or EVERYBODY in (root.tenant, tenant))


def _wrong(what: str) -> SettingsError:
    return SettingsError(f"import_from (SPLATCT_IMPORT_FROM): {what}")


class Source:
    """One folder, open."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def size(self, name: str) -> int:
        with self.file(name) as descriptor:
            return os.fstat(descriptor).st_size

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[int]:
        """A regular file directly in the folder; yields its descriptor. Raises NotHere or Refused."""
        if not _plain(name):
            raise Refused("is no plain name")
        try:
            descriptor = os.open(name, _FILE, dir_fd=self._descriptor)
        except OSError as error:
            raise _refusal(error, name, self._descriptor) from None
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise Refused("is not a regular file")
            yield descriptor
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def opened(allowed: tuple[Root, ...], tenant: str, folder: str) -> Iterator[Source]:
    """The folder that `folder`, as NAME/SUB/SUB, means to this tenant. Raises NotHere or Refused."""
    name, *below = folder.split("/")
    root = next((r for r in allowed if r.path.name == name and r.tenant in (tenant, EVERYBODY)), None)
    if root is None:
        raise NotHere
    if not all(map(_plain, below)):
        raise Refused("has a part that is empty, . or .., or holds a backslash or a control character")
    try:
        descriptor = os.open(root.path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)  # itself it may be a link
    except OSError:
        raise NotHere from None
    try:
        for part in below:
            try:
                inner = os.open(part, _FOLDER, dir_fd=descriptor)
            except OSError as error:
                raise _refusal(error, part, descriptor) from None
            os.close(descriptor)
            descriptor = inner
        yield Source(descriptor)
    finally:
        os.close(descriptor)


def _plain(name: str) -> bool:
    return name not in ("", ".", "..") and "/" not in name and "\\" not in name and name.isprintable()


def _refusal(error: OSError, name: str, folder: int) -> Exception:
    try:
        status = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except (OSError, ValueError):
        return NotHere()
    if stat.S_ISLNK(status.st_mode):
        return Refused("is a symbolic link; links are not followed")
    if isinstance(error, PermissionError):
        return Refused("may not be read by the server")
    return Refused("cannot be opened, or is of another kind than expected")
