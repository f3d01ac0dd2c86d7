"""The job that plain RQ runs in the comparison: it takes its time, writes a result, and keeps a journal of both.

It does what ours does, without what SplatCT adds: no state is kept, and nobody asks whether another attempt lives.
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

_TICK_S = 0.2


def work(folder: str, job_id: str, seconds: float) -> None:
    """Work for so long, then put the result in its place by one rename."""
    journal = Path(folder) / f"{job_id}.jsonl"
    began = time.monotonic()
    _say(journal, seconds=0.0)
    while (done := time.monotonic() - began) < seconds:
        time.sleep(min(_TICK_S, seconds - done))
        _say(journal, seconds=round(time.monotonic() - began, 3))
    part = Path(folder) / f".{job_id}.{os.getpid()}.part"
    part.write_text(f"{job_id} {done}\n")
    part.replace(Path(folder) / f"{job_id}.result")
    _say(journal, published=True)


def _say(journal: Path, **what: float | bool) -> None:
    with journal.open("a") as file:  # one write of one line: two attempts at once do not mix theirs
        file.write(json.dumps({"pid": os.getpid(), **what}) + "\n")
