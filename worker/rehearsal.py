"""Test mode: an engine that misbehaves as told, so that clients can be tested against failure.

It acts between two steps of whatever runs, the real engine included. Standard library beside the keeper.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from typing import Any

from splatcore.errors import Problem, ReconstructionError, ScanError
from splatcore.keeper import State
from worker.jobfolder import JobFolder
from worker.requests import Requests


class Rehearsal(Requests):
    """Slow from the first step on; at step `at_step` of each of the first `attempts` attempts it ends as told."""

    def __init__(self, folder: JobFolder, every_s: float, attempt: int, plan: dict[str, Any]) -> None:
        super().__init__(folder, every_s)
        self._step_s, self._at_step, self._steps = float(plan["step_s"]), int(plan["at_step"]), 0
        attempts = int(plan["attempts"])
        self._end = str(plan["end"]) if not attempts or attempt <= attempts else ""

    def pause(self, state: Callable[[], State], stage_ends: bool = False) -> None:
        super().pause(state, stage_ends)
        self._steps += 1
        if self._step_s:
            time.sleep(self._step_s)
        if self._end and self._steps == self._at_step:
            _ENDS[self._end]()


def _bad_input() -> None:
    raise ScanError([Problem("projections.tif", "is refused by test mode")])


def _cannot_reconstruct() -> None:
    raise ReconstructionError("Test mode ends this reconstruction.")


def _out_of_memory() -> None:
    bytearray(1 << 60)  # more than any machine has


def _disk_full() -> None:
    raise OSError(28, "No space left on device")


def _bug() -> None:
    raise RuntimeError("test mode")


def _crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def _hang() -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(1e9)


_ENDS: dict[str, Callable[[], None]] = {
    "bad_input": _bad_input,
    "cannot_reconstruct": _cannot_reconstruct,
    "out_of_memory": _out_of_memory,
    "disk_full": _disk_full,
    "bug": _bug,
    "crash": _crash,
    "hang": _hang,
}
