"""Ties the life of a process to its parent's, and tells hosts apart.

A worker killed with SIGKILL cannot clean up. Without this its engine would live on as an
orphan beside the next attempt. Linux sends the signal set here the moment the parent dies.
"""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path

_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True) if sys.platform == "linux" else None


def die_with_parent(parent: int, how: signal.Signals = signal.SIGKILL) -> None:
    """Ask the kernel to kill this process when `parent` dies; exit now if it already has."""
    _set_death_signal(how)
    if os.getppid() != parent:  # it died before the request was in place
        os._exit(1)


def before_exec(how: signal.Signals) -> Callable[[], None]:
    """A `preexec_fn` doing the same for a program that is not ours. For single-threaded parents."""
    parent = os.getpid()

    def tie() -> None:
        die_with_parent(parent, how)

    return tie


def host_id() -> str:
    """One running kernel. Two processes that agree on it see each other's file locks."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    return boot.read_text().strip() if boot.exists() else socket.gethostname()


def _set_death_signal(how: signal.Signals) -> None:
    if _libc is not None and _libc.prctl(_PR_SET_PDEATHSIG, int(how), 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG) failed")
