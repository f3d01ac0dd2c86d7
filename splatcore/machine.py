"""What this process may use of the machine: threads and memory, cgroup limits included.

Standard library only.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


def threads_allowed(cgroup: Path = _CGROUP) -> int:
    """CPU threads: the affinity mask, cut to the cgroup's quota."""
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, period = [*_words(cgroup / "cpu.max"), "", ""][:2]  # version 2
    if not quota:
        quota = (_words(cgroup / "cpu/cpu.cfs_quota_us") or [""])[0]
        period = (_words(cgroup / "cpu/cpu.cfs_period_us") or [""])[0]
    if quota.isdigit() and period.isdigit() and int(quota) > 0 and int(period) > 0:
        threads = min(threads, max(1, math.ceil(int(quota) / int(period))))
    return threads


def memory_bytes(cgroup: Path = _CGROUP) -> tuple[int, int]:
    """(free, total) bytes this process may use; (0, 0) where unknown."""
    info = {}
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            key, _, value = line.partition(":")
            info[key] = int(value.split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        return 0, 0
    free, total = info.get("MemAvailable", 0), info.get("MemTotal", 0)
    for limit_file, used_file in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        limit, used = _words(cgroup / limit_file), _words(cgroup / used_file)
        if limit and used and limit[0].isdigit() and used[0].isdigit() and int(limit[0]) < total:
            total = int(limit[0])
            free = max(0, min(free, total - int(used[0])))
    return free, total


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split()
    except OSError:
        return []
