"""Finds out which version of the schema a database has, and takes the steps that are missing.

All missing steps are one transaction, so that a failure or a kill leaves the old version whole. Of
servers that start together one takes the steps; the others wait for it and find nothing to do.
"""

from __future__ import annotations

import contextlib
import glob
import logging
import os
import sqlite3
import time
from datetime import UTC, datetime
from pathlib import Path

import sqlalchemy as sa

from server.migrations.steps import STEPS
from splatcore.errors import SplatCTError
from worker.database import Database

log = logging.getLogger("splatct.server")

_ADVISORY_LOCK = 0x53504C4154  # any number that no other program on the same PostgreSQL takes

_versions = sa.Table(
    "schema_versions",
    sa.MetaData(),
    sa.Column("version", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("applied_at", sa.Float, nullable=False),  # seconds since 1970, UTC
)


class SchemaError(SplatCTError):
    """The database is of a version that this program cannot use."""


def prepare(database: Database) -> None:
    """Make the tables, or bring older ones up to date. Raises SchemaError if they are newer than this program.

    A SQLite file is copied beside itself first. A process that is killed meanwhile leaves the old version.
    """
    with database.writing() as write:
        if write.dialect.name == "postgresql":
            write.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK)))
        found, newest = _version(write), len(STEPS)
        if found > newest:
            raise SchemaError(
                f"database: its schema has version {found}, this program knows versions up to {newest}. "
                "A newer SplatCT has used it: start that one, or restore the copy that it made when it upgraded."
            )
        if found == newest and sa.inspect(write).has_table(_versions.name):
            return
        if 0 < found < newest:
            log.warning("upgrading the database from version %d to %d", found, newest)
            copy = _backed_up(database, found)
            if copy is not None:
                log.warning("the database as it was is kept in %s", copy)
        _versions.create(write, checkfirst=True)
        for step in STEPS[found:]:
            step(write)
        for number in range(_recorded(write) + 1, newest + 1):
            write.execute(_versions.insert().values(version=number, applied_at=time.time()))


def _version(read: sa.Connection) -> int:
    """0 for an empty database."""
    tables = sa.inspect(read)
    if tables.has_table(_versions.name):
        return _recorded(read)
    return 1 if tables.has_table("jobs") else 0  # version 1 did not say so


def _recorded(read: sa.Connection) -> int:
    return int(read.execute(sa.select(sa.func.coalesce(sa.func.max(_versions.c.version), 0))).scalar_one())


def _backed_up(database: Database, version: int) -> Path | None:
    """A copy of a SQLite file, made while the caller's transaction keeps all writers out; None elsewhere."""
    name = database.engine.url.database
    if database.engine.dialect.name != "sqlite" or not name or name == ":memory:":
        return None
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%SZ")
    copy = Path(f"{name}.v{version}-{stamp}.bak")
    for left in copy.parent.glob(f"{glob.escape(Path(name).name)}.v*.part*"):  # by an upgrade that was killed
        left.unlink()
    part = copy.with_suffix(".part")
    os.close(os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    with contextlib.closing(sqlite3.connect(name)) as source, contextlib.closing(sqlite3.connect(part)) as target:
        source.backup(target)
    with part.open("rb") as written:
        os.fsync(written.fileno())
    return part.rename(copy)
