"""What this process may use of the machine: threads and memory, cgroup limits included.

Standard library only.
"""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path

_CGROUP = Path("/sys/fs/cgroup")


def own_cgroup(root: Path = _CGROUP, membership: Path = Path("/proc/self/cgroup")) -> Path:
    """The folder of this process's cgroup (version 2), or the root where it cannot be seen, as in a container."""
    own = next((line[3:] for line in _lines(membership) if line.startswith("0::")), "/")
    folder = root / own.lstrip("/")
    return folder if folder.is_dir() else root


def threads_allowed(cgroup: Path | None = None) -> int:
    """CPU threads: the affinity mask, cut to the quotas of the cgroup (this process's own) and those above it."""
    threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for folder in _upwards(cgroup):
        quota, period = [*_words(folder / "cpu.max"), "", ""][:2]  # version 2
        if not quota:
            quota = (_words(folder / "cpu/cpu.cfs_quota_us") or [""])[0]
            period = (_words(folder / "cpu/cpu.cfs_period_us") or [""])[0]
        if quota.isdigit() and period.isdigit() and int(quota) > 0 and int(period) > 0:
            threads = min(threads, max(1, math.ceil(int(quota) / int(period))))
    return threads


def memory_bytes(cgroup: Path | None = None) -> tuple[int, int]:
    """(free, total) bytes this process may use, by the cgroup (its own) and those above it; (0, 0) where unknown."""
    info = {}
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            key, _, value = line.partition(":")
            info[key] = int(value.split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        return 0, 0
    free, total = info.get("MemAvailable", 0), info.get("MemTotal", 0)
    files = (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    )
    for folder, (limit_file, used_file) in itertools.product(_upwards(cgroup), files):
        limit, used = _words(folder / limit_file), _words(folder / used_file)
        if limit and used and limit[0].isdigit() and used[0].isdigit() and int(limit[0]) < total:
            total = int(limit[0])
            free = max(0, min(free, total - int(used[0])))
    return free, total


def _upwards(cgroup: Path | None) -> list[Path]:
    """A cgroup and all above it, up to the root of those that can be seen."""
    if cgroup is not None:
        return [cgroup]
    own = own_cgroup()
    return [folder for folder in (own, *own.parents) if folder.is_relative_to(_CGROUP)]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").splitlines()
    except OSError:
        return []


def _words(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split()
    except OSError:
        return []
