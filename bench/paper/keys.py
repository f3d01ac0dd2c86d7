"""Short names for parameter sets, and for the engine that computed with them: what the cache goes by."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import splatcore


def key_of(parameters: dict[str, Any]) -> str:
    """The same twelve hexadecimal digits for the same parameters, in any order."""
    return hashlib.sha256(json.dumps(parameters, sort_keys=True).encode()).hexdigest()[:12]


@cache
def engine_digest() -> str:
    """Changes with every source file of the engine and with its native core: no result outlives the code it is of."""
    from splatcore import _native

    total = hashlib.sha256()
    for path in (*sorted(Path(splatcore.__file__).parent.glob("*.py")), Path(_native.__file__)):
        total.update(path.name.encode())
        total.update(path.read_bytes())
    return total.hexdigest()[:12]
