"""Tells that a disk, or a disk quota, is full, whoever met it: the file system, SQLite or PostgreSQL."""

from __future__ import annotations

import errno
import sqlite3

from sqlalchemy.exc import DBAPIError

_FULL = (errno.ENOSPC, errno.EDQUOT)
# SQLite says "full" where it writes, and "I/O error" where it cannot make its shared index larger.
_SQLITE = (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_SHMSIZE)
_POSTGRESQL = "53100"


def is_full(error: BaseException | None) -> bool:
    """Whether `error` says so, itself or what it was raised from."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _FULL:
            return True
        if isinstance(error, DBAPIError) and _database_is_full(error.orig):
            return True
        error = error.__cause__
    return False


def _database_is_full(error: BaseException | None) -> bool:
    if isinstance(error, sqlite3.Error):
        return getattr(error, "sqlite_errorcode", None) in _SQLITE
    return getattr(error, "sqlstate", None) == _POSTGRESQL
