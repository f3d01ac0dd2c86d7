"""Version 3: sessions of the page, each opened by a key."""

from __future__ import annotations

import sqlalchemy as sa

_tables = sa.MetaData()

sa.Table(
    "sessions",
    _tables,
    sa.Column("digest", sa.String(64), primary_key=True),
    sa.Column("key_id", sa.String(16), nullable=False, index=True),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("expires_at", sa.Float, nullable=False, index=True),
)


def upgrade(write: sa.Connection) -> None:
    _tables.create_all(write)
