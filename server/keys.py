"""API keys: who may come in, for which tenant, to do what.

A key reads `splatct_ID_SECRET`. Only its SHA-256 is kept. A slow hash would protect passwords, which can be
guessed; nobody guesses 256 random bits, and a slow one would cost every request. The id is public: it finds
the row, and names the key in lists and logs.
"""

from __future__ import annotations

import hashlib
import logging
import secrets
import time
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from worker.database import Database, metadata

log = logging.getLogger("splatct.server")

PREFIX = "splatct"
_ID_LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # none that is taken for another when read aloud
_USED_EVERY_S = 60.0  # how finely the last use is known


class Scope(StrEnum):
    """What a key is good for. `admin` includes the others, and what concerns the whole server."""

    READ = "read"
    SUBMIT = "submit"
    DELETE = "delete"
    ADMIN = "admin"


keys = sa.Table(
    "api_keys",
    metadata,
    sa.Column("id", sa.String(16), primary_key=True),
    sa.Column("tenant", sa.String(64), nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),  # SHA-256 of the whole key
    sa.Column("scopes", sa.String(64), nullable=False),  # their names, a space between
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("expires_at", sa.Float),
    sa.Column("revoked_at", sa.Float),
    sa.Column("last_used_at", sa.Float),
)


@dataclass(frozen=True)
class Key:
    id: str
    tenant: str
    name: str
    scopes: frozenset[Scope]
    created_at: float
    expires_at: float | None
    revoked_at: float | None
    last_used_at: float | None

    def state(self, now: float) -> str:
        if self.revoked_at is not None:
            return "revoked"
        return "expired" if self.expires_at is not None and self.expires_at <= now else "valid"


class KeyRing:
    """The keys in the database."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._exist = False

    def add(self, tenant: str, name: str, scopes: Iterable[Scope], expires_at: float | None) -> tuple[Key, str]:
        """A new key, and the text of it, which nobody can tell later."""
        key_id = "".join(secrets.choice(_ID_LETTERS) for _ in range(10))
        text = f"{PREFIX}_{key_id}_{secrets.token_urlsafe(32)}"
        key = Key(key_id, tenant, name, frozenset(scopes), time.time(), expires_at, None, None)
        row = vars(key) | {"digest": _digest(text), "scopes": " ".join(sorted(key.scopes))}
        with self._database.writing() as write:
            write.execute(keys.insert().values(**row))
        return key, text

    def all(self) -> list[Key]:
        """Oldest first, revoked ones too."""
        with self._database.reading() as read:
            return [_key(row) for row in read.execute(sa.select(keys).order_by(keys.c.created_at, keys.c.id))]

    def revoke(self, key_id: str) -> Key | None:
        """For good; None if there is no such key. Its row stays, so that the log's words keep their meaning."""
        mine = keys.c.id == key_id
        with self._database.writing() as write:
            write.execute(keys.update().where(mine, keys.c.revoked_at.is_(None)).values(revoked_at=time.time()))
            row = write.execute(sa.select(keys).where(mine)).one_or_none()
        return None if row is None else _key(row)

    def exist(self) -> bool:
        """Whether there ever was a key. A server whose last key was revoked stays closed."""
        if not self._exist:
            with self._database.reading() as read:
                self._exist = read.execute(sa.select(keys.c.id).limit(1)).first() is not None
        return self._exist

    def find(self, text: str) -> Key | None:
        """The valid key that reads so."""
        prefix, _, rest = text.partition("_")
        if prefix != PREFIX or not (text.isascii() and text.isprintable()):  # PostgreSQL fails on a NUL
            return None
        row = self._row(rest.partition("_")[0])
        known = "" if row is None else row.digest
        if not secrets.compare_digest(_digest(text), known):
            return None
        assert row is not None
        return self._valid(row)

    def still_valid(self, key_id: str) -> Key | None:
        """The key of that id, for who has shown it before."""
        row = self._row(key_id)
        return None if row is None else self._valid(row)

    def _row(self, key_id: str) -> sa.Row[tuple[object, ...]] | None:
        with self._database.reading() as read:
            return read.execute(sa.select(keys).where(keys.c.id == key_id)).one_or_none()

    def _valid(self, row: sa.Row[tuple[object, ...]]) -> Key | None:
        key, now = _key(row), time.time()
        if key.state(now) != "valid":
            return None
        if key.last_used_at is None or now - key.last_used_at > _USED_EVERY_S:
            try:
                with self._database.writing() as write:
                    write.execute(keys.update().where(keys.c.id == key.id).values(last_used_at=now))
            except SQLAlchemyError:  # a full disk must not keep people from deleting things
                log.warning("could not note that key %s was used", key.id, exc_info=True)
        return key


def _key(row: sa.Row[tuple[object, ...]]) -> Key:
    fields = dict(row._mapping)
    del fields["digest"]
    return Key(**fields | {"scopes": frozenset(Scope(name) for name in str(fields["scopes"]).split())})


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
