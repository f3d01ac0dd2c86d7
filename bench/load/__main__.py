"""What the service does under load, beside what it is to do.

    python -m bench.load             about ten minutes on two idle cores
    python -m bench.load --quick     a tenth of it

Real parts on loopback, in temporary folders. Writes load.md and load.json. Figures of time mean something on an idle
machine alone: what others used of it stands beside them. Exits 1 if a target was missed.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.load.figures import Busy, Measured, watching
from bench.load.hostile import hostile
from bench.load.idle import idle
from bench.load.memory import memory
from bench.load.start import start
from bench.load.status import status
from bench.load.uploads import uploads
from splatcore.machine import threads_allowed

Say = Callable[[str], None]

_FULL: dict[str, Callable[[Say], Measured]] = {
    "uploads": lambda say: uploads(3, 512, 192, say),
    "status": lambda say: status(30, 64, say),
    "start": lambda say: start(20, say),
    "memory": lambda say: memory(1000, say),
    "hostile": lambda say: hostile(1, say),
    "idle": lambda say: idle(15, 50, say),
}
_QUICK: dict[str, Callable[[Say], Measured]] = {
    "uploads": lambda say: uploads(1, 64, 32, say),
    "status": lambda say: status(6, 16, say),
    "start": lambda say: start(2, say),
    "memory": lambda say: memory(100, say),
    "hostile": lambda say: hostile(10, say),
    "idle": lambda say: idle(3, 10, say),
}


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m bench.load", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of it")
    parser.add_argument("--only", type=_names, default=tuple(_FULL), metavar="NAMES", help=f"of {','.join(_FULL)}")
    parser.add_argument("--out", type=Path, default=Path("bench-results"), help="folder for load.md and load.json")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    page, found, good = [_head()], {}, True
    for name in args.only:
        began = time.monotonic()
        with watching() as busy:
            measured = (_QUICK if args.quick else _FULL)[name](print)
        seconds = time.monotonic() - began
        page.append(_section(measured, busy, seconds))
        found[name] = _json(measured, busy, seconds)
        good = good and all(figure.met is not False for figure in measured.figures)
        print(page[-1])
        (args.out / "load.json").write_text(json.dumps(found, indent=1) + "\n")
        (args.out / "load.md").write_text("\n".join(page))
    return 0 if good else 1


def _names(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    unknown = [name for name in names if name not in _FULL]
    if unknown:
        raise argparse.ArgumentTypeError(f"got {', '.join(unknown)}; expected some of {','.join(_FULL)}")
    return names


def _head() -> str:
    return f"# The service under load\n\n{os.cpu_count()} processors, {threads_allowed()} allowed.\n"


def _section(measured: Measured, busy: Busy, seconds: float) -> str:
    rows = "\n".join(figure.row() for figure in measured.figures)
    around = f"Load average before: {busy.load_before:.1f}; others used {busy.others_cores:.2f} processors meanwhile"
    table = f"| | measured | target | |\n|---|---:|---:|---|\n{rows}\n"
    return f"## {measured.title}\n\n{measured.how} {around}; {seconds:.0f} s.\n\n{table}"


def _json(measured: Measured, busy: Busy, seconds: float) -> dict[str, Any]:
    figures = [figure.to_json() for figure in measured.figures]
    return {**vars(busy), "seconds": seconds, "how": measured.how, "figures": figures, "raw": measured.raw}


if __name__ == "__main__":
    raise SystemExit(main())
