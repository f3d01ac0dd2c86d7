"""Did the kernel kill a process for want of memory? A SIGKILL does not say who sent it; the kernel's counters do."""

from __future__ import annotations

from pathlib import Path

from splatcore.machine import own_cgroup

_FILES = ("memory.events", "memory/memory.oom_control")  # of the cgroup, version 2 and 1


class OomWatch:
    """Looks at the counters when it is made, and again when asked."""

    def __init__(self, cgroup: Path | None = None, vmstat: Path = Path("/proc/vmstat")) -> None:
        self._files = [(own_cgroup() if cgroup is None else cgroup) / name for name in _FILES] + [vmstat]
        self._before = self._counts()

    def killed(self) -> bool:
        """Whether any of them has grown: the kernel has killed something here since."""
        return any(now > before for now, before in zip(self._counts(), self._before, strict=True))

    def _counts(self) -> list[int]:
        return [_counter(file) for file in self._files]


def _counter(file: Path) -> int:
    try:
        words = [line.split() for line in file.read_text(encoding="ascii").splitlines()]
    except OSError:
        return 0
    return next((int(word[1]) for word in words if len(word) == 2 and word[0] == "oom_kill"), 0)
