"""Version 6: jobs have a priority, may be made from earlier ones, and may end with a partial result."""

from __future__ import annotations

import sqlalchemy as sa


def upgrade(write: sa.Connection) -> None:
    no = sa.false().compile(dialect=write.dialect)
    for column in ("priority INTEGER DEFAULT 0 NOT NULL", f"partial BOOLEAN DEFAULT {no} NOT NULL",
                   "restart_of VARCHAR(36)"):  # fmt: skip
        write.execute(sa.text(f"ALTER TABLE jobs ADD COLUMN {column}"))
    write.execute(sa.text("CREATE INDEX ix_jobs_tenant_started_at ON jobs (tenant, started_at)"))
