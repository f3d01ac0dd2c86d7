"""A real file system of a few MiB, to be filled to the last byte."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

MIB = 1 << 20


class NoMount(Exception):
    """A file system cannot be mounted here: why."""


class TinyDisk:
    def __init__(self, path: Path) -> None:
        self.path = path
        self._filler = path / "filler"

    @property
    def free(self) -> int:
        return shutil.disk_usage(self.path).free

    def fill(self, leave: int = 0) -> None:
        """Take what is free, but for `leave` bytes. Written, not reserved: the kernel's ENOSPC is real."""
        with self._filler.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while (rest := self.free - leave) > 0:
                file.write(bytes(min(rest, MIB)))

    def empty(self) -> None:
        self._filler.unlink(missing_ok=True)


@contextlib.contextmanager
def tiny_disk(path: Path, mib: int) -> Iterator[TinyDisk]:
    """A tmpfs at `path`. Mounting asks for root, or what a container calls CAP_SYS_ADMIN; raises NoMount without."""
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={mib}m,mode=700", "tmpfs", str(path)]
    done = subprocess.run(mount, capture_output=True, text=True, check=False)
    if done.returncode:
        raise NoMount(f"a file system of {mib} MiB cannot be mounted as uid {os.getuid()}: {done.stderr.strip()}")
    try:
        yield TinyDisk(path)
    finally:
        subprocess.run(["umount", "--lazy", str(path)], check=True)
