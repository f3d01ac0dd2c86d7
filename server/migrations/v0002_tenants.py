"""Version 2: every upload, scan, job and claim belongs to a tenant, and keys open a tenant's door.

What was there before there were keys is the tenant `local`'s.
"""

from __future__ import annotations

import sqlalchemy as sa

_tables = sa.MetaData()

_submissions = sa.Table(
    "submissions",
    _tables,
    sa.Column("tenant", sa.String(64), primary_key=True),
    sa.Column("kind", sa.String(8), primary_key=True),
    sa.Column("name", sa.String(255), primary_key=True),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("job_id", sa.String(36), nullable=False),
    sa.Column("created_at", sa.Float, nullable=False, index=True),
)

_keys = sa.Table(
    "api_keys",
    _tables,
    sa.Column("id", sa.String(16), primary_key=True),
    sa.Column("tenant", sa.String(64), nullable=False),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),
    sa.Column("scopes", sa.String(64), nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("expires_at", sa.Float),
    sa.Column("revoked_at", sa.Float),
    sa.Column("last_used_at", sa.Float),
)


def upgrade(write: sa.Connection) -> None:
    for table in ("uploads", "scans", "jobs"):
        write.execute(sa.text(f"ALTER TABLE {table} ADD COLUMN tenant VARCHAR(64) DEFAULT 'local' NOT NULL"))
        write.execute(sa.text(f"CREATE INDEX ix_{table}_tenant_created_at ON {table} (tenant, created_at)"))
    # Its key changes, which SQLite cannot do in place. A day's worth of rows at most.
    rows = write.execute(sa.text("SELECT kind, name, digest, job_id, created_at FROM submissions")).mappings().all()
    write.execute(sa.text("DROP TABLE submissions"))
    _tables.create_all(write)
    if rows:
        write.execute(_submissions.insert(), [{"tenant": "local", **row} for row in rows])
