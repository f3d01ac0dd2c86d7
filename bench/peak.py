"""The largest memory this program has had."""

from pathlib import Path


def peak_mib() -> float:
    """Resident, of this program alone: `ru_maxrss` would start with the peak of the process that forked it. MiB"""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(status.split("VmHWM:")[1].split()[0]) / 1024
