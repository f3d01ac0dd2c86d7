"""Keeps a few child processes running: starts them again when they die, stops them when told."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence

from worker.process import import_path

log = logging.getLogger("splatct.up")

_FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 30.0
_HEALTHY_S = 60.0  # alive this long, a child has earned a fresh start of its pauses


class Child:
    """`python -m MODULE`, restarted with growing pauses. It ends when this process ends."""

    def __init__(self, name: str, module: str, arguments: Sequence[str], environment: dict[str, str]) -> None:
        self.name = name
        self._command = [sys.executable, "-P", "-m", module, *arguments, "--tie-to", str(os.getpid())]
        self._environment = {**os.environ, "PYTHONPATH": import_path(), **environment}
        self._process: subprocess.Popen[bytes] | None = None
        self._pause = _FIRST_PAUSE_S
        self._started = 0.0
        self._restart_at = 0.0

    @property
    def pid(self) -> int | None:
        return None if self._process is None else self._process.pid

    def tend(self) -> None:
        """Start it if it does not run and its pause is over."""
        now = time.monotonic()
        if self._process is not None:
            code = self._process.poll()
            if code is None:
                return
            if now - self._started > _HEALTHY_S:
                self._pause = _FIRST_PAUSE_S
            log.warning("%s ended with %d; starting it again in %.0f s", self.name, code, self._pause)
            self._restart_at = now + self._pause
            self._pause = min(2 * self._pause, _LONGEST_PAUSE_S)
            self._process = None
        if now >= self._restart_at:
            self._started = now
            self._process = subprocess.Popen(
                self._command, env=self._environment, stdin=subprocess.DEVNULL, process_group=0
            )


def stop_all(children: Sequence[Child], patience_s: float) -> None:
    """SIGTERM to all at once, SIGKILL to those that stay."""
    running = [child._process for child in children if child._process is not None]
    for process in running:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + patience_s
    for process in running:
        try:
            process.wait(max(0.1, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
