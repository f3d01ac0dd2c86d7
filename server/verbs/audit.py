"""`splatct audit`: who sent in, read or deleted what. Reads the database directly, as `splatct keys` does."""

from __future__ import annotations

import argparse
from typing import Any

from server.verbs.keys import add_data_option

HELP = "show who submitted, read or deleted what, and when"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tenant", help="only this tenant's")
    parser.add_argument("--key", metavar="ID", help="only what was done with this key")
    parser.add_argument("--action", help="only this: submit, read-results, delete-job, sign-in and so on")
    parser.add_argument("--id", help="only what was done to this upload, scan, job or key")
    parser.add_argument("--since", metavar="WHEN", help="from a date (2027-01-31) on, or so long ago (7d, 12h)")
    parser.add_argument("--until", metavar="WHEN", help="before a date, or so long ago")
    parser.add_argument("--lines", action="store_true", help="one JSON object a line, for other programs to keep")
    add_data_option(parser)


def run(args: argparse.Namespace) -> int:
    import json

    from server.audit import AuditLog, Wanted
    from server.opening import opened
    from server.settings import Settings
    from server.times import since

    settings = Settings.read({"data": args.data})
    settings.require_database()
    wanted = Wanted(args.tenant, args.key, args.action, args.id, since(args.since), since(args.until))
    with opened(settings) as database:
        entries = map(told, AuditLog(database).entries(wanted))
        if getattr(args, "json", False):
            print(json.dumps({"entries": list(entries)}, ensure_ascii=False))
            return 0
        for entry in entries:
            print(json.dumps(entry, ensure_ascii=False) if args.lines else _line(entry))
    return 0


def told(row: dict[str, Any]) -> dict[str, Any]:
    from server.times import text

    return {**row, "at": text(row["at"])}


def _line(entry: dict[str, Any]) -> str:
    who = f"{entry['tenant'] or '-'} {entry['key_id'] or '-'} {entry['address'] or '-'}"
    return f"{entry['at']}  {who}  {entry['action']} {entry['thing']} {entry['detail']}".rstrip()
