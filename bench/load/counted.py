"""`python -m bench.load.counted`: the server, which also counts its SQL statements.

SIGUSR1 makes it write the counts to the file that SPLATCT_BENCH_COUNTS names.
"""

from __future__ import annotations

import json
import os
import runpy
import signal
from collections import Counter
from pathlib import Path
from typing import Any

import sqlalchemy as sa

_counts: Counter[str] = Counter()


def _count(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
    verb = statement.split(maxsplit=1)[0].upper()
    if verb != "BEGIN":
        _counts["write" if verb in ("INSERT", "UPDATE", "DELETE") else "read"] += 1


def _tell(*_: Any) -> None:
    path = Path(os.environ["SPLATCT_BENCH_COUNTS"])
    part = path.with_suffix(".part")
    part.write_text(json.dumps(_counts))
    part.replace(path)


if __name__ == "__main__":
    sa.event.listen(sa.Engine, "before_cursor_execute", _count)
    signal.signal(signal.SIGUSR1, _tell)
    runpy.run_module("server", run_name="__main__")
