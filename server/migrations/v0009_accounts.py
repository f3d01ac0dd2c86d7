"""Version 9: jobs know what they take of the disk, and a tenant may have quotas of its own."""

from __future__ import annotations

import sqlalchemy as sa


def upgrade(write: sa.Connection) -> None:
    no = sa.false().compile(dialect=write.dialect)
    write.execute(sa.text("ALTER TABLE jobs ADD COLUMN bytes BIGINT DEFAULT 0 NOT NULL"))
    write.execute(sa.text(f"ALTER TABLE jobs ADD COLUMN measured BOOLEAN DEFAULT {no} NOT NULL"))
    write.execute(sa.text("CREATE INDEX ix_jobs_measured ON jobs (measured)"))
    write.execute(
        sa.text(
            "CREATE TABLE tenant_quotas (tenant VARCHAR(64) NOT NULL, bytes BIGINT, active_jobs INTEGER, "
            "open_uploads INTEGER, PRIMARY KEY (tenant))"
        )
    )
