"""Sessions of the page: a key is shown once, and a cookie stands for it from then on.

Kept in the database, by the SHA-256 of a random token, so that they survive a restart, end when they are told to,
and end with their key: it is asked for with every request.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from dataclasses import dataclass

import sqlalchemy as sa

from server.keys import Key, KeyRing
from worker.database import Database, alone, metadata

CSRF_HEADER = "X-CSRF-Token"

sessions = sa.Table(
    "sessions",
    metadata,
    sa.Column("digest", sa.String(64), primary_key=True),  # SHA-256 of the cookie's value
    sa.Column("key_id", sa.String(16), nullable=False, index=True),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("expires_at", sa.Float, nullable=False, index=True),
)


@dataclass(frozen=True)
class Session:
    key: Key
    expires_at: float


class TooMany(Exception):
    """The key has as many sessions as it may have."""

    def __init__(self, most: int, wait_s: float) -> None:
        super().__init__(f"{most} sessions were begun with this key and have not ended; no more may be")
        self.wait_s = wait_s  # until the first of them ends by itself


class Sessions:
    def __init__(self, database: Database, ring: KeyRing, last_s: int, most: int = 0) -> None:
        """most: sessions of one key at a time; 0: no limit."""
        self._database = database
        self._ring = ring
        self._most = most
        self.last_s = last_s

    def begin(self, key: Key) -> tuple[Session, str]:
        """A session, and the token for its cookie. It ends with the key at the latest. Raises TooMany."""
        token, now = secrets.token_urlsafe(32), time.time()
        ends = min(now + self.last_s, key.expires_at or float("inf"))
        row = {"digest": _digest(token), "key_id": key.id, "created_at": now, "expires_at": ends}
        with self._database.writing() as write:
            write.execute(sessions.delete().where(sessions.c.expires_at <= now))
            alone(write, key.id)
            query = sa.select(sa.func.count(), sa.func.min(sessions.c.expires_at)).where(sessions.c.key_id == key.id)
            count, first_end = write.execute(query).one()
            if self._most and count >= self._most:
                raise TooMany(self._most, first_end - now)
            write.execute(sessions.insert().values(**row))
        return Session(key, ends), token

    def find(self, token: str) -> Session | None:
        query = sa.select(sessions.c.key_id, sessions.c.expires_at).where(
            sessions.c.digest == _digest(token), sessions.c.expires_at > time.time()
        )
        with self._database.reading() as read:
            row = read.execute(query).one_or_none()
        key = None if row is None else self._ring.still_valid(row.key_id)
        return None if row is None or key is None else Session(key, row.expires_at)

    def end(self, token: str) -> None:
        with self._database.writing() as write:
            write.execute(sessions.delete().where(sessions.c.digest == _digest(token)))


def cookie_name(scheme: str) -> str:
    """Over https a name that browsers let nobody else set: not plain http, and no other host of the same domain."""
    return "__Host-splatct_session" if scheme == "https" else "splatct_session"


def csrf_token(token: str) -> str:
    """What a page that may read our answers can send along, and another site's page cannot know."""
    return hashlib.sha256(b"csrf " + token.encode()).hexdigest()


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode()).hexdigest()
