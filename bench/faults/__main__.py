"""Kill everything, again and again, and count what was lost.

    python -m bench.faults            100 SIGKILLs of worker or engine, 20 of server and Redis, 10 wipes, 10 drains
                                      and 1,000 uploads cut at random
    python -m bench.faults --quick    a tenth of it

Real parts on loopback, in a temporary folder. Writes faults.md and faults.json; exits 1 if a job was lost, published
twice or stuck, or if an upload was committed as something else than what was sent, or sent again by a chunk or more.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from bench.faults.campaign import CHECKPOINT_S, SETTINGS, Campaign, Counts, Outcome
from bench.faults.uploads import run_uploads
from bench.service import in_passing

_FULL = Counts(kills=100, server=20, redis=20, wipes=10, drains=10)
_QUICK = Counts(kills=10, server=2, redis=2, wipes=1, drains=1)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        "python -m bench.faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a tenth of it")
    parser.add_argument("--only", choices=("jobs", "uploads"), help="half of it")
    parser.add_argument("--uploads", type=int, help="how many are cut (default 1000, or 100)")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("bench-results"), help="folder for faults.md and faults.json")
    args = parser.parse_args(argv)
    uploads = args.uploads or (100 if args.quick else 1000)
    found: dict[str, object] = {"seed": args.seed}
    page, good = "", True
    args.out.mkdir(parents=True, exist_ok=True)
    if args.only != "jobs":
        began = time.monotonic()
        with in_passing(workers=0) as service:
            cut = run_uploads(service, uploads, args.seed, print)
        minutes = (time.monotonic() - began) / 60
        found["uploads"] = {**cut.to_json(), "minutes": round(minutes, 1)}
        page += f"Uploads cut at random, seed {args.seed}, {minutes:.0f} minutes.\n\n| | |\n|---|---:|\n{cut.table()}\n"
        good = good and cut.good()
    if args.only != "uploads":
        began = time.monotonic()
        with in_passing(args.workers, SETTINGS) as service:
            outcome = Campaign(service, _QUICK if args.quick else _FULL, args.seed, print).run()
        took = time.monotonic() - began
        found |= {**outcome.to_json(), "workers": args.workers, "minutes": round(took / 60, 1)}
        page += report(outcome, args.seed, args.workers, took)
        good = good and outcome.good()
    (args.out / "faults.json").write_text(json.dumps(found, indent=1) + "\n")
    (args.out / "faults.md").write_text(page)
    print(page)
    return 0 if good else 1


def report(out: Outcome, seed: int, workers: int, seconds: float) -> str:
    def told(values: list[float]) -> str:
        if not values:
            return "-"
        ordered = sorted(values)
        return f"{ordered[len(ordered) // 2]:.1f} / {ordered[int(0.95 * (len(ordered) - 1))]:.1f} / {ordered[-1]:.1f}"

    kinds = {"worker": "SIGKILL of a worker", "engine": "SIGKILL of an engine", "server": "SIGKILL of the server",
             "redis": "SIGKILL of Redis", "wipe": "FLUSHALL of Redis", "drain": "SIGTERM of a worker"}  # fmt: skip
    rows = [(text, str(out.faults[kind])) for kind, text in kinds.items()]
    rows += [
        ("jobs", str(out.jobs)),
        ("attempts, of these gone on from a checkpoint", f"{out.attempts}, {out.resumed}"),
        ("**lost**", str(len(out.lost))),
        ("**published twice**", str(len(out.published_twice))),
        ("**stuck**", str(len(out.stuck))),
        ("worker killed → next attempt runs (s; median / 95 % / most)", told(out.recovery_s)),
        ("engine killed → next attempt runs (s)", told(out.engine_recovery_s)),
        (f"work done again (s), with a checkpoint every {CHECKPOINT_S:g} s", told(out.lost_s)),
    ]
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    bad = "".join(f"\n- {line}" for line in (*out.lost, *out.published_twice, *out.stuck))
    head = (
        f"Faults at random moments, seed {seed}, {workers} workers, {seconds / 60:.0f} minutes.\n\n| | |\n|---|---:|\n"
    )
    return f"{head}{table}\n{bad}\n"


if __name__ == "__main__":
    raise SystemExit(main())
