"""What the kernel says of a process."""

from __future__ import annotations

import os
import re
from pathlib import Path

_TICKS = os.sysconf("SC_CLK_TCK")


def resident(pid: int) -> int:
    """Bytes of memory that the process holds."""
    return _status(pid, "VmRSS")


def children(pid: int) -> list[int]:
    return [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]


def cpu_s(pid: int) -> float:
    """Processor seconds of the process and of its children that have ended."""
    return sum(map(int, _stat(pid)[11:15])) / _TICKS


def started_at(pid: int) -> float:
    """By the clock that counts from the machine's start, CLOCK_BOOTTIME; exact to 10 ms."""
    return int(_stat(pid)[19]) / _TICKS


def written(pid: int) -> int:
    """Bytes that the process had written to a disk."""
    return int(re.findall(r"^write_bytes: (\d+)", Path(f"/proc/{pid}/io").read_text(), re.MULTILINE)[0])


def _stat(pid: int) -> list[str]:
    """From the third field on, the state."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def _status(pid: int, name: str) -> int:
    found = re.search(rf"^{name}:\s*(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    assert found is not None, f"/proc/{pid}/status has no {name}"
    return int(found[1]) * 1024
