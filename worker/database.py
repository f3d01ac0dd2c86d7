"""Opens the SQL database: SQLite in WAL mode, or whatever a SQLAlchemy URL names.

SQLite needs three things said aloud: WAL, so that readers never wait for a writer; FULL
synchronisation, so that an accepted job survives a power cut; and BEGIN IMMEDIATE for writers,
because a transaction that reads first and writes later fails at once when another wrote between.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import sqlalchemy as sa

metadata = sa.MetaData()

_ADVISORY_LOCK = 0x5155  # the first half of a pair whose second is a name


class Database:
    """Connections to one database. Open it after a fork, never before."""

    def __init__(self, url: str) -> None:
        self.engine = sa.create_engine(url, pool_pre_ping=not url.startswith("sqlite"))
        if self.engine.dialect.name == "sqlite":
            sa.event.listen(self.engine, "connect", _prepare_sqlite)
            sa.event.listen(self.engine, "begin", _begin_sqlite)

    @contextmanager
    def reading(self) -> Iterator[sa.Connection]:
        with self.engine.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def writing(self) -> Iterator[sa.Connection]:
        """One transaction that will write; commits at the end, rolls back on an exception."""
        with self.engine.connect() as plain:
            connection = plain.execution_options(splatct_writes=True)
            with connection.begin():
                yield connection

    def close(self) -> None:
        self.engine.dispose()


def alone(write: sa.Connection, name: str) -> None:
    """For the rest of the transaction no other that asks for it has this name, be it a tenant's or a key's. SQLite has
    one writer as it is."""
    if write.dialect.name == "postgresql":
        write.execute(sa.select(sa.func.pg_advisory_xact_lock(_ADVISORY_LOCK, sa.func.hashtext(name))))


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the driver's own BEGIN comes too late; see _begin_sqlite
    for pragma in ("busy_timeout=20000", "journal_mode=WAL", "synchronous=FULL"):
        connection.execute(f"PRAGMA {pragma}").close()


def _begin_sqlite(connection: sa.Connection) -> None:
    writes = connection.get_execution_options().get("splatct_writes", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
