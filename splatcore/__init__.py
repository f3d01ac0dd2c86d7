"""SplatCT's engine: joint Gaussian-splat reconstruction and pose calibration of X-ray CT.

A library first: `splatcore` needs no server. Importing it loads neither torch nor numpy;
each name loads its module on first use (PEP 562).
"""

from __future__ import annotations

import importlib
import os
from typing import Any

# How long an OpenMP thread of the core spins at a barrier before it sleeps. GNU's default, about a millisecond,
# makes two threads on a busy machine slower than one, since they spin while others hold the processor.
# Read when libgomp is loaded, so it is set before anything can load it.
os.environ.setdefault("GOMP_SPINCOUNT", "5000")

__version__ = "0.1.0"

# Functions named like their module (reconstruct, simulate, evaluate) are imported from it: a package
# attribute of that name is the module itself as soon as anybody has imported it.
_HOME = {
    "Options": "options",
    "Progress": "progress",
    "Scan": "scan",
    "check_scan": "scan",
    "read_scan": "scan",
    "write_results": "results",
}

__all__ = [*_HOME, "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'splatcore' has no attribute {name!r}")
    return getattr(importlib.import_module(f"splatcore.{_HOME[name]}"), name)
