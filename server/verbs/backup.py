"""`splatct backup`: everything a server keeps, copied while it runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from server.verbs.keys import add_data_option

HELP = "copy all that a server keeps, while it runs; or check such a copy"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dest", metavar="DEST", type=Path, help="the folder to make; on another disk, best")
    parser.add_argument("--verify", action="store_true", help="make nothing: check the backup that is there")
    parser.add_argument(
        "--files-only",
        action="store_true",
        help="without the database, where that is PostgreSQL's: run pg_dump first",
    )
    add_data_option(parser)


def run(args: argparse.Namespace) -> int:
    import os

    from server.audit import COMMAND_LINE, AuditLog, Deed
    from server.backup import back_up
    from server.opening import opened
    from server.settings import Settings
    from server.verbs.restore import check

    if args.verify:
        return check(args, args.dest)
    os.umask(0o077)
    settings = Settings.read({"data": args.data})
    settings.require_database()
    with opened(settings) as database:  # an older one is brought up to date first, as by every command
        manifest = back_up(settings, args.dest, args.files_only)
        AuditLog(database).note(Deed("", None, COMMAND_LINE, "backup", args.dest.name[:64]))
    size = sum(entry.size for entry in manifest.files)
    told = {"backup": str(args.dest), "scans": len(manifest.scans), "jobs": len(manifest.jobs), "bytes": size}
    if getattr(args, "json", False):
        import json

        print(json.dumps({**told, "damaged": manifest.damaged}))
    else:
        print(f"{args.dest}: {told['scans']} scans, {told['jobs']} jobs, {size} bytes")
        for fault in manifest.damaged:
            print(f"damaged in the data folder: {fault}")
    return 1 if manifest.damaged else 0
