"""`splatct janitor`: remove at once what the server would within the hour, or only say what that is."""

from __future__ import annotations

import argparse

from server.verbs.keys import add_data_option

HELP = "remove what need not be kept any longer, or list it with its bytes (--dry-run)"
WORDS = {
    "results": "job with results", "failed": "failed or cancelled job", "scan": "scan without a job",
    "upload": "stale upload", "orphan": "folder without a row",
}  # fmt: skip


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dry-run", action="store_true", help="remove nothing")
    add_data_option(parser)


def run(args: argparse.Namespace) -> int:
    import json
    import os
    import time
    from typing import Any

    from server.intake import Intake
    from server.janitor import Janitor
    from server.opening import opened
    from server.reserve import Reserve
    from server.retention import Doomed, Rules, freed
    from server.settings import MIB, Settings
    from server.store import Store
    from server.times import text

    os.umask(0o077)
    settings = Settings.read({"data": args.data})
    settings.require_database()
    data = settings.data.absolute()

    def told(one: Doomed) -> dict[str, Any]:
        named = {"kind": one.kind, "id": one.id, "tenant": one.tenant, "name": one.name, "since": text(one.since)}
        return {**named, "bytes": freed([one.folder])}

    with opened(settings) as database:
        (data / "jobs").mkdir(exist_ok=True)
        reserve = Reserve(data, settings.disk_reserve_mib * MIB)
        janitor, now = Janitor(Store(database), Intake(data), data, Rules.of(settings), reserve), time.time()
        listed = {one.id: told(one) for one in janitor.plan(now)}
        total = freed(one.folder for one in janitor.plan(now))
        if not args.dry_run:
            gone = {one.id for one in janitor.sweep(now)}
            listed = {name: one for name, one in listed.items() if name in gone}
    if getattr(args, "json", False):
        print(json.dumps({"dry_run": args.dry_run, "bytes": total, "items": list(listed.values())}, ensure_ascii=False))
        return 0
    for one in listed.values():
        since, size = (one["since"] or "")[:16], one["bytes"]
        print(f"{since}  {size:>14,}  {one['tenant']:<12}  {WORDS[one['kind']]} {one['id']}  {one['name']}")
    print(f"{len(listed)} {'would go' if args.dry_run else 'gone'}, {total:,} bytes")
    return 0
