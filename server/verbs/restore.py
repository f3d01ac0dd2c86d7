"""`splatct restore`: a data folder from what `splatct backup` made."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from server.verbs.keys import add_data_option

HELP = "make a server's data folder from a backup"


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("source", metavar="SRC", type=Path, help="the folder that `splatct backup` made")
    parser.add_argument("--verify", action="store_true", help="restore nothing: check every digest of the backup")
    add_data_option(parser)


def run(args: argparse.Namespace) -> int:
    import os

    from server.audit import COMMAND_LINE, AuditLog, Deed
    from server.opening import opened
    from server.restore import restore
    from server.settings import Settings

    if args.verify:
        return check(args, args.source)
    os.umask(0o077)
    settings = Settings.read({"data": args.data})
    made = restore(settings, args.source)
    with opened(settings) as database:
        AuditLog(database).note(Deed("", None, COMMAND_LINE, "restore", args.source.name[:64]))
    if getattr(args, "json", False):
        print(json.dumps({"data": str(settings.data), **vars(made)}))
        return 0
    print(f"{settings.data}: {made.scans} scans, {made.jobs} jobs, {made.queued} of them to run")
    for name in made.dropped:
        print(f"not in the backup, dropped from the database: {name}")
    print("open uploads are not kept in backups: who was sending one begins again")
    return 0


def check(args: argparse.Namespace, folder: Path) -> int:
    """Read all of a backup; exit code 1 where it is not as it was written."""
    from server.archive import Manifest

    manifest = Manifest.read(folder)
    faults = list(manifest.verify(folder))
    if getattr(args, "json", False):
        print(json.dumps({"backup": str(folder), "made_at": manifest.made_at, "ok": not faults, "faults": faults}))
    else:
        whole = f"{folder}: {len(manifest.files)} files are as they were written at {manifest.made_at}"
        print("\n".join(faults) if faults else whole)
    return 1 if faults else 0
