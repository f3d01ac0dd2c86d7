"""What the engine process may use of the machine; it puts the limits on itself before it reads the scan.

Address space is limited by the memory that this process may use (its cgroup's, or the machine's) and some more, for
libraries and thread stacks that are mapped but hardly touched: so a reconstruction that grows too large gets a
MemoryError, which can be told from a crash, before the kernel kills it. Of the processors it takes what others leave:
whoever asks the server for a job's state must not wait for a reconstruction on the same machine.
"""

from __future__ import annotations

import contextlib
import os
import resource
from pathlib import Path

from splatcore.machine import memory_bytes

MIB = 1 << 20
_MAPPED = 2048 * MIB


def limit_self(memory_mib: int, file_mib: int, nice: int) -> None:
    """memory_mib: 0: what the machine gives; file_mib: of the largest file that may be written; nice: by how much its
    priority is lowered. No core files."""
    os.nice(nice)
    memory = memory_mib * MIB or memory_bytes()[1]
    if memory:
        _lower(resource.RLIMIT_AS, memory + _MAPPED)
    _lower(resource.RLIMIT_FSIZE, file_mib * MIB)
    _lower(resource.RLIMIT_CORE, 0)
    with contextlib.suppress(OSError):  # where memory runs short all the same, this process goes and not its worker
        Path("/proc/self/oom_score_adj").write_text("500", encoding="ascii")


def _lower(which: int, value: int) -> None:
    hard = resource.getrlimit(which)[1]
    value = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(which, (value, value))
