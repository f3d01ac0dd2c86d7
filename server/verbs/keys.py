"""`splatct keys`: who may use the server, and how much of it. Works on the database directly; a running server sees it
at once.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from server.audit import AuditLog
    from server.keys import Key
    from server.settings import Settings
    from worker.database import Database

HELP = "add, list and revoke the keys that open a server; what a tenant may take"
SCOPES = ("read", "submit", "delete", "admin")
DEFAULT_SCOPES = "read,submit,delete"


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    add = actions.add_parser("add", help="make a key; it is printed this once")
    add.add_argument("--tenant", default="local", help="whose key it is (default: %(default)s)")
    add.add_argument("--name", default="", help="what it is for, such as the scanner's name")
    add.add_argument(
        "--scopes", default=DEFAULT_SCOPES, help=f"of {', '.join(SCOPES)}, comma between (default: %(default)s)"
    )
    add.add_argument("--expires", metavar="WHEN", help="a date (2027-01-31) or a time from now (90d, 12h)")
    shown = actions.add_parser("list", help="show all keys, without their secrets")
    shown.add_argument("--tenant", help="only this tenant's")
    revoke = actions.add_parser("revoke", help="make a key useless, at once and for good")
    revoke.add_argument("id", metavar="ID", help="as `splatct keys list` shows it")
    tenant = actions.add_parser("tenant", help="show or set what one tenant may take, in place of the settings")
    tenant.add_argument("tenant", metavar="TENANT")
    told = "a number, none (no limit) or default (as the server's settings have it)"
    tenant.add_argument("--max-bytes", metavar="SIZE", help=f"of uploads, scans and results: as 500M, 20G, 2T; {told}")
    tenant.add_argument("--max-jobs", metavar="N", help=f"that wait and run together: {told}")
    tenant.add_argument("--max-uploads", metavar="N", help=f"that are open together: {told}")
    for action in (add, shown, revoke, tenant):
        add_data_option(action)


def add_data_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", type=Path, help="the server's data folder (SPLATCT_DATA, default ./splatct-data)")
    help = "print one JSON object on stdout, errors too"
    parser.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help=help)


def run(args: argparse.Namespace) -> int:
    import os

    from server.audit import COMMAND_LINE, AuditLog, Deed
    from server.keys import KeyRing, Scope
    from server.opening import opened
    from server.settings import Settings, SettingsError
    from server.times import expiry

    os.umask(0o077)
    settings = Settings.read({"data": args.data})
    if args.action != "add":
        settings.require_database()
    with opened(settings) as database:
        ring, audit = KeyRing(database), AuditLog(database)
        if args.action == "add":
            scopes = _scopes(args.scopes)
            key, text = ring.add(_tenant(args.tenant), args.name, map(Scope, scopes), expiry(args.expires))
            audit.note(Deed(key.tenant, None, COMMAND_LINE, "add-key", key.id, " ".join(sorted(key.scopes))))
            _print(args, {"key": text, **described(key)}, text)
            if not args.json:
                _advise(key)
        elif args.action == "list":
            keys = [key for key in ring.all() if args.tenant in (None, key.tenant)]
            _print(args, {"keys": [described(key) for key in keys]}, _table(keys))
        elif args.action == "tenant":
            _quotas(args, settings, database, audit)
        else:
            revoked = ring.revoke(args.id)
            if revoked is None:
                raise SettingsError(f"keys revoke: got {args.id!r}, expected the id of a key; see `splatct keys list`")
            audit.note(Deed(revoked.tenant, None, COMMAND_LINE, "revoke-key", revoked.id))
            _print(args, described(revoked), f"key {revoked.id} of {revoked.tenant} is revoked")
    return 0


def _quotas(args: argparse.Namespace, settings: Settings, database: Database, audit: AuditLog) -> None:
    """Change what is asked for, then say what holds."""
    from server.audit import COMMAND_LINE, Deed
    from server.quotas import Quotas, set_own

    tenant, asked = _tenant(args.tenant, "keys tenant"), {
        "bytes": ("--max-bytes", args.max_bytes),
        "active_jobs": ("--max-jobs", args.max_jobs),
        "open_uploads": ("--max-uploads", args.max_uploads),
    }  # fmt: skip
    wanted = {name: _amount(*given) for name, given in asked.items() if given[1] is not None}
    if wanted:
        set_own(database, tenant, wanted)
        said = " ".join(f"{asked[name][0]} {asked[name][1]}" for name in wanted)
        audit.note(Deed(tenant, None, COMMAND_LINE, "set-quota", tenant, said))
    with database.reading() as read:
        holds = Quotas.from_settings(settings).of(read, tenant)
    shown = {name: getattr(holds, name) or None for name in asked}
    text = ", ".join(f"{name.replace('_', ' ')}: {value or 'no limit'}" for name, value in shown.items())
    _print(args, {"tenant": tenant, **shown}, f"{tenant}: {text}")


def _amount(option: str, text: str) -> int | None:
    """0: no limit; None: as the settings have it."""
    import re

    from server.settings import SettingsError

    if text in ("none", "default"):
        return 0 if text == "none" else None
    given = re.fullmatch(r"([0-9]{1,15})([MGT]?)", text)
    value = 0 if given is None else int(given[1]) << {"": 0, "M": 20, "G": 30, "T": 40}[given[2]]
    most = 1 << (60 if option == "--max-bytes" else 30)
    if given is None or not 0 < value < most or (given[2] and option != "--max-bytes"):
        kind = "a size such as 500M, 20G or 2T" if option == "--max-bytes" else "a number from 1 up"
        raise SettingsError(f"{option}: got {text!r}, expected {kind}, none or default")
    return value


def described(key: Key) -> dict[str, Any]:
    import time

    from server.times import text

    return {
        "id": key.id,
        "tenant": key.tenant,
        "name": key.name,
        "scopes": sorted(key.scopes),
        "state": key.state(time.time()),
        "created_at": text(key.created_at),
        "expires_at": text(key.expires_at),
        "last_used_at": text(key.last_used_at),
    }


def _print(args: argparse.Namespace, value: dict[str, Any], text: str) -> None:
    import json

    print(json.dumps(value, ensure_ascii=False) if args.json else text)


def _advise(key: Key) -> None:
    import sys

    advice = f"key {key.id} of {key.tenant}, shown this once: keep it in a file that only you can read (--key-file)"
    print(advice, file=sys.stderr)


def _scopes(text: str) -> list[str]:
    from server.settings import SettingsError

    given = [name.strip() for name in text.split(",") if name.strip()]
    if not given or set(given) - set(SCOPES):
        raise SettingsError(f"--scopes: got {text!r}, expected some of {', '.join(SCOPES)}, comma between")
    return given


def _tenant(text: str, option: str = "--tenant") -> str:
    import re

    from server.settings import SettingsError

    if not re.fullmatch(r"[a-z0-9][a-z0-9._-]{0,63}", text):
        raise SettingsError(
            f"{option}: got {text!r}, expected 1 to 64 of small letters, digits and ._-, a letter or digit first"
        )
    return text


def _table(keys: list[Key]) -> str:
    rows = [("ID", "TENANT", "STATE", "SCOPES", "EXPIRES", "LAST USED", "NAME")]
    for key in keys:
        shown = described(key)
        times = [(shown[name] or "never")[:16] for name in ("expires_at", "last_used_at")]
        rows.append((key.id, key.tenant, shown["state"], ",".join(shown["scopes"]), *times, key.name))
    widths = [max(len(row[column]) for row in rows) for column in range(6)]
    lines = ["  ".join([*(c.ljust(w) for c, w in zip(row, widths, strict=False)), row[6]]).rstrip() for row in rows]
    return "\n".join(lines) if keys else "no keys; `splatct keys add` makes one"
