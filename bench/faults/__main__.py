"""Kill everything, again and again, and count what was lost.

    python -m bench.faults            100 SIGKILLs of worker or engine, 20 of server and Redis, 10 wipes, 10 drains;
                                      the same of plain RQ; a full disk; and 1,000 uploads cut at random
    python -m bench.faults --quick    a tenth of it

Real parts on loopback, in a temporary folder. Writes faults.md and faults.json; exits 1 if a job was lost, published
twice or stuck, if an upload was committed as something else than what was sent, or sent again by a chunk or more, or
if a full disk did more than make others wait. What becomes of plain RQ's jobs is told, not judged.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from bench.faults.campaign import END_S, Campaign, Counts
from bench.faults.disk import NoMount, fill_the_disk
from bench.faults.plainrq import SETUPS, PlainRQ, Setup
from bench.faults.service import Struck
from bench.faults.table import Column, side_by_side
from bench.faults.uploads import run_uploads
from bench.service import in_passing

_FULL = Counts(kills=100, server=20, redis=20, wipes=10, drains=10)
_QUICK = Counts(kills=10, server=2, redis=2, wipes=1, drains=1)
_QUICK_END_S = 120.0  # nothing of plain RQ that is not over by then is over within ten minutes
_RQ_WATCH_S = 3.0  # RQ takes up again what it does within a second, or after minutes
_PARTS = ("jobs", "rq", "disk", "uploads")


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m bench.faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of it")
    parser.add_argument("--only", choices=_PARTS, help="one part of it")
    parser.add_argument("--uploads", type=int, help="how many are cut (default 1000, or 100)")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("bench-results"), help="folder for faults.md and faults.json")
    args = parser.parse_args(argv)
    parts = (args.only,) if args.only else _PARTS
    found: dict[str, object] = {"seed": args.seed}
    page, good, columns = "", True, []
    args.out.mkdir(parents=True, exist_ok=True)
    if "uploads" in parts:
        with _timed() as minutes, in_passing(workers=0) as service:
            count = args.uploads or (100 if args.quick else 1000)
            cut = run_uploads(service, count, args.seed, print)
        found["uploads"] = {**cut.to_json(), "minutes": minutes()}
        page += (
            f"Uploads cut at random, seed {args.seed}, {minutes():.0f} minutes.\n\n| | |\n|---|---:|\n{cut.table()}\n"
        )
        good = good and cut.good()
    if "disk" in parts:
        try:
            with _folder() as folder:
                filled = fill_the_disk(folder, 2 if args.quick else 10, args.seed, print)
        except NoMount as reason:
            page += f"Full disk: not run, {reason}\n\n"
        else:
            found["disk"] = filled.to_json()
            page += filled.table()
            good = good and filled.good()
    counts = _QUICK if args.quick else _FULL
    if "jobs" in parts:
        with _timed() as minutes, _folder() as folder, Struck(folder, args.workers) as service:
            outcome = Campaign(service, counts, args.seed, print).run()
        found |= {**outcome.to_json(), "workers": args.workers, "minutes": minutes()}
        columns.append(Column("SplatCT", outcome, minutes()))
        good = good and outcome.good()
    if "rq" in parts:
        beside = _plain_rq(args.workers, counts, args.seed, _QUICK_END_S if args.quick else END_S)
        found["rq"] = {c.name: {**c.outcome.to_json(), "minutes": c.minutes, "settings": c.settings} for c in beside}
        columns += beside
    page += side_by_side(columns, args.seed, args.workers)
    (args.out / "faults.json").write_text(json.dumps(found, indent=1) + "\n")
    (args.out / "faults.md").write_text(page)
    print(page)
    return 0 if good else 1


def _plain_rq(workers: int, counts: Counts, seed: int, end_s: float) -> list[Column]:
    """Every setup at the same time, each in a process of its own: their jobs sleep."""
    with ProcessPoolExecutor(len(SETUPS)) as pool:
        tasks = [pool.submit(_one_plain_rq, setup, workers, counts, seed, end_s) for setup in SETUPS]
        return [task.result() for task in tasks]


def _one_plain_rq(setup: Setup, workers: int, counts: Counts, seed: int, end_s: float) -> Column:
    with _timed() as minutes, _folder() as folder, PlainRQ(folder, workers, setup) as plain:
        settings = plain.settings()
        outcome = Campaign(plain, counts, seed, lambda text: print(f"{setup.name}: {text}"), _RQ_WATCH_S, end_s).run()
        outcome.misreported = plain.misreported()
    return Column(setup.name, outcome, minutes(), settings)


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="splatct-faults-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@contextlib.contextmanager
def _timed() -> Iterator[Callable[[], float]]:
    """Yields a function that tells, afterwards, how many minutes it took."""
    began, took = time.monotonic(), 0.0
    yield lambda: round(took / 60, 1)
    took = time.monotonic() - began


if __name__ == "__main__":
    raise SystemExit(main())
