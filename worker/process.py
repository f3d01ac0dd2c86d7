"""The engine as a child process: starts it, reads its lines, ends it."""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from splatcore.machine import threads_allowed
from worker.jobfolder import JobFolder

# What the engine may know of its surroundings. Never a database or Redis URL.
_INHERITED = ("PATH", "HOME", "LANG", "TZ", "LD_LIBRARY_PATH", "PYTHONSAFEPATH", "PYTHONDONTWRITEBYTECODE")
_INHERITED_PREFIXES = ("LC_", "OMP_", "MKL_", "OPENBLAS_", "CUDA_", "NVIDIA_", "TORCH_", "SPLATCORE_")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")  # they know no cgroup quota

_LONGEST_LINE = 1 << 20


def import_path() -> str:
    """PYTHONPATH for a child started with -P: where these packages lie, and what we were given, absolute."""
    given = [entry for entry in os.environ.get("PYTHONPATH", "").split(os.pathsep) if entry]
    home = str(Path(__file__).resolve().parents[1])
    paths = [] if "site-packages" in home else [home]
    return os.pathsep.join(dict.fromkeys([*paths, *(str(Path(entry).resolve()) for entry in given)]))


def clean_environment(scratch: Path | None = None) -> dict[str, str]:
    """An environment for a process that handles user data: scrubbed, with absolute import paths."""
    kept = {k: v for k, v in os.environ.items() if k in _INHERITED or k.startswith(_INHERITED_PREFIXES)}
    threads = {name: str(threads_allowed()) for name in _THREADS if name not in kept}
    return {**kept, **threads, "PYTHONPATH": import_path(), **({} if scratch is None else {"TMPDIR": str(scratch)})}


class EngineProcess:
    """One run of `python -m worker.engine`, in a process group of its own.

    It inherits the descriptor of the job's lock, so the lock stays held until supervisor *and*
    engine are gone: no second attempt can start while a first engine still breathes.
    """

    def __init__(self, folder: JobFolder, attempt: int, engine: str, lock: int) -> None:
        command = [sys.executable, "-P", "-m", "worker.engine", str(folder.path)]
        command += ["--attempt", str(attempt), "--parent", str(os.getpid()), "--engine", engine]
        with folder.log.open("ab") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=clean_environment(folder.scratch),
                pass_fds=(lock,),
                process_group=0,
            )
        assert self._process.stdout is not None
        self._stdout = self._process.stdout
        os.set_blocking(self._stdout.fileno(), False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._stdout, selectors.EVENT_READ)
        self._pending = b""
        self._open = True

    def read(self, wait_s: float) -> list[dict[str, Any]]:
        """The lines that arrived, waiting up to `wait_s` for the first."""
        if self._open and self._selector.select(wait_s):
            chunk = os.read(self._stdout.fileno(), 1 << 16)
            self._open = bool(chunk)
            self._pending += chunk
        *lines, self._pending = self._pending.split(b"\n")
        self._pending = self._pending[-_LONGEST_LINE:]
        return [event for event in map(_parse, lines) if event is not None]

    def ended(self) -> bool:
        """Whether the process is gone and everything it said has been read."""
        if self._open:
            return False
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        return self._process.returncode is not None

    @property
    def code(self) -> int:
        """Exit code; negative the signal that ended it."""
        return self._process.wait()

    def signal(self, which: signal.Signals) -> None:
        """Send a signal to the engine and all it started."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, which)

    def close(self) -> None:
        """End the process if it is still there, and let go of its pipe."""
        self.signal(signal.SIGKILL)
        self._process.wait()
        self._selector.close()
        self._stdout.close()


def _parse(line: bytes) -> dict[str, Any] | None:
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) else None
