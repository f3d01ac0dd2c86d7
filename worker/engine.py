"""The engine process: `python -m worker.engine JOBDIR --attempt N --parent PID`.

It knows one folder and nothing else: no database, no Redis, no server. It reads JOBDIR/job.json
and JOBDIR/scan, says each progress event as one JSON line on stdout, writes the results to
JOBDIR/attempt-N, and ends with one of `worker.contract.Exit`. An error is its last line.

It keeps its state in JOBDIR/run.checkpoint and goes on from what an earlier attempt left there. SIGTERM asks it to
keep its state and go; the file JOBDIR/cancel, to make a result of what there is.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import json
import os
import sys
import traceback
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, TextIO

from splatcore.errors import OptionsError, ReconstructionError, ScanError
from splatcore.keeper import Stopped, Wish
from splatcore.options import Options
from splatcore.progress import Progress
from worker.contract import Exit
from worker.jobfolder import JobFolder
from worker.lifeline import die_with_parent
from worker.limits import limit_self
from worker.requests import Requests

Say = Callable[[dict[str, Any]], None]

_ASKED = {Wish.CONCLUDE: Exit.CANCELLED, Wish.STOP: Exit.STOPPED}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m worker.engine")
    parser.add_argument("job", type=Path)
    parser.add_argument("--attempt", type=int, required=True)
    parser.add_argument("--parent", type=int, required=True)
    parser.add_argument("--engine", default="splatcore")
    given = parser.parse_args(arguments)
    die_with_parent(given.parent)
    with _private_stdout() as out:

        def say(line: dict[str, Any]) -> None:
            out.write(json.dumps(line) + "\n")
            out.flush()

        try:
            return _work(JobFolder(given.job.parent.parent, given.job.name), given.attempt, given.engine, say)
        except Stopped:
            return Exit.STOPPED
        except Exception as error:
            code, message = _classify(error)
            say({"error": message})
            _log(error)
            return code


def _work(folder: JobFolder, attempt: int, engine: str, say: Say) -> int:
    spec = json.loads(folder.spec.read_bytes())
    limit_self(spec.get("memory_mib", 0), spec.get("file_mib", 1 << 20), spec.get("nice", 0))
    options = Options.from_dict(spec["options"])
    requests = _requests(folder, attempt, spec)
    say(Progress("read", 0.0, "Reading the scan").to_json())  # takes a while, as do the imports that it needs
    scan = _part(engine, "scan", "read_scan")(folder.scan)
    if requests.look() in _ASKED:  # before there was anything to keep
        return _ASKED[requests.wish]
    events = _part(engine, "reconstruct", "reconstruct")(scan, options, requests)
    reconstruction = _drive(events, say)
    _part(engine, "results", "write_results")(reconstruction, folder.attempt(attempt))
    return Exit.CANCELLED if requests.concluded else Exit.OK


def _requests(folder: JobFolder, attempt: int, spec: dict[str, Any]) -> Requests:
    every_s, plan = spec.get("checkpoint_s", 0.0), spec.get("test")
    if plan is None:
        return Requests(folder, every_s)
    from worker.rehearsal import Rehearsal

    return Rehearsal(folder, every_s, attempt, plan)


def _drive(events: Generator[Progress, None, Any], say: Say) -> Any:
    """Run the generator to its end and return its value."""
    while True:
        try:
            event = next(events)
        except StopIteration as end:
            return end.value
        say(event.to_json())


def _part(engine: str, module: str, name: str) -> Callable[..., Any]:
    part: Callable[..., Any] = getattr(importlib.import_module(f"{engine}.{module}"), name)
    return part


def _log(error: Exception) -> None:
    """On a full disk there is no room for it: the error has been said, and must not become another."""
    try:
        traceback.print_exception(error)
        sys.stderr.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # or what is left in its buffer fails again at exit


def _classify(error: Exception) -> tuple[Exit, str]:
    """The exit code for an error, and the sentence about it that a user may read."""
    text = str(error)
    if isinstance(error, ScanError | OptionsError):
        return Exit.BAD_INPUT, text
    if isinstance(error, ReconstructionError):
        return Exit.CANNOT_RECONSTRUCT, text
    # torch has its own class on the GPU and a plain RuntimeError on the CPU; neither is imported here
    if isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or "allocate memory" in text:
        return Exit.OUT_OF_MEMORY, "There is not enough memory for this scan. Try quality preview, or a smaller volume."
    if _is_full(error):
        return Exit.DISK_FULL, (
            "The disk filled up while the results were written. Make room and restart the job; it goes on from its "
            "last state."
        )
    return Exit.BUG, f"The engine failed unexpectedly ({type(error).__name__}). The log holds the details."


def _is_full(error: BaseException | None) -> bool:
    """As worker.fulldisk has it, without the database that this process does not know."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__  # the result writer wraps what it meets
    return False


def _private_stdout() -> TextIO:
    """Keep stdout for events; whatever else prints there goes to stderr, which is the log."""
    kept = os.dup(1)
    os.dup2(2, 1)
    return os.fdopen(kept, "w", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
