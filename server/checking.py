"""Judges an uploaded scan in a process of its own, under limits, so that a hostile TIFF is never
decoded in the server.

As a module (`python -m server.checking`) it is that process: it puts the limits on itself and then
becomes the check. As an import it is the server's side.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatcore.errors import Problem, ScanError
from worker.lifeline import die_with_parent
from worker.process import clean_environment

log = logging.getLogger("splatct.server")

MOST_PROBLEMS = 200
_BYTES_PER_S = 20e6  # slower than this is not a check but an attack
_BROKEN = Problem(
    "scan",
    "could not be checked within the limits on memory and time",
    "a file may be damaged, or claim a size it does not have",
)


class CheckFailed(Exception):
    """The check itself is broken: nothing is known about the scan."""


def check_scan(folder: Path, module: str, memory_mib: int) -> dict[str, Any]:
    """The facts about a scan. Raises ScanError with all that is wrong with it."""
    command = [sys.executable, "-P", "-m", "server.checking", str(os.getpid()), str(memory_mib), module, str(folder)]
    single = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL")}
    environment = {**clean_environment(), **single, "PYTHONDONTWRITEBYTECODE": "1"}
    patience = 60.0 + sum(file.stat().st_size for file in folder.iterdir()) / _BYTES_PER_S
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, timeout=patience, check=False
        )
    except subprocess.TimeoutExpired:
        raise ScanError([_BROKEN]) from None
    if done.returncode in (0, 2):
        return _verdict(done.returncode, done.stdout)
    if done.returncode < 0 or b"MemoryError" in done.stderr:
        raise ScanError([_BROKEN])
    log.error("the check ended with %d: %s", done.returncode, done.stderr.decode(errors="replace")[-2000:])
    raise CheckFailed


def _verdict(code: int, output: bytes) -> dict[str, Any]:
    try:
        answer = json.loads(output)
        if code == 0:
            facts: dict[str, Any] = answer["facts"]
            return facts
        problems = [Problem(str(p["where"]), str(p["what"]), str(p.get("hint", ""))) for p in answer["problems"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        log.error("the check answered with code %d and no verdict", code)
        raise CheckFailed from None
    raise ScanError(problems[:MOST_PROBLEMS])


def _become_check(arguments: Sequence[str]) -> None:
    import resource
    import runpy

    parent, memory_mib, module, folder = arguments
    die_with_parent(int(parent))
    memory = int(memory_mib) << 20
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))  # it has nothing to write
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.argv = [module, folder]
    runpy.run_module(module, run_name="__main__")


if __name__ == "__main__":
    _become_check(sys.argv[1:])
