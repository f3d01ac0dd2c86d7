"""Version 7: jobs and scans may be pinned, and scans know when a job of theirs last came or went."""

from __future__ import annotations

import sqlalchemy as sa


def upgrade(write: sa.Connection) -> None:
    no = sa.false().compile(dialect=write.dialect)
    for table in ("jobs", "scans"):
        write.execute(sa.text(f"ALTER TABLE {table} ADD COLUMN pinned BOOLEAN DEFAULT {no} NOT NULL"))
    kind = sa.Float().compile(dialect=write.dialect)
    write.execute(sa.text(f"ALTER TABLE scans ADD COLUMN used_at {kind}"))
