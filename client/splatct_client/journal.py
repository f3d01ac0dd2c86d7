"""What a run leaves for the next, should it be cut off: which upload it was at, and under which id it submitted.

Kept in the user's own state folder, one small file for each server and scan folder: scans lie where nobody may write,
too.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class Journal:
    def __init__(self, server: str, folder: Path, environment: Mapping[str, str] = os.environ) -> None:
        named = f"{server.rstrip('/')}\n{folder.resolve()}"
        name = hashlib.sha256(named.encode(errors="surrogateescape")).hexdigest()[:32]
        self._file = state_folder(environment) / "uploads" / f"{name}.json"
        self._facts: dict[str, Any] = {"server": server, "folder": str(folder.resolve())}  # for who looks into it
        with contextlib.suppress(OSError, ValueError):  # none, or torn by a crash of this machine: begin anew
            facts = json.loads(self._file.read_bytes())
            self._facts |= facts if isinstance(facts, dict) else {}

    def get(self, name: str) -> Any:
        return self._facts.get(name)

    def note(self, **facts: Any) -> None:
        """Where it cannot be kept the run goes on: what is lost is that the next one may."""
        self._facts |= facts
        part = self._file.with_name(f"{self._file.name}.{os.getpid()}.part")
        try:
            self._file.parent.mkdir(parents=True, exist_ok=True)
            part.write_text(json.dumps(self._facts))
            part.replace(self._file)
        except OSError as error:
            print(f"{self._file} cannot be written ({error.strerror}): another run would start anew", file=sys.stderr)

    def forget(self) -> None:
        """There is nothing left to go on with."""
        with contextlib.suppress(OSError):
            self._file.unlink()


def state_folder(environment: Mapping[str, str]) -> Path:
    """Of this program, on Windows and elsewhere."""
    if sys.platform == "win32":
        return Path(environment.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "splatct"
    return Path(environment.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "splatct"
