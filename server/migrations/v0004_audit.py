"""Version 4: the audit log. The database itself refuses to change or delete what is in it."""

from __future__ import annotations

import sqlalchemy as sa

_tables = sa.MetaData()

sa.Table(
    "audit",
    _tables,
    sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("at", sa.Float, nullable=False, index=True),
    sa.Column("tenant", sa.String(64), nullable=False),
    sa.Column("key_id", sa.String(16)),
    sa.Column("address", sa.String(64), nullable=False),
    sa.Column("action", sa.String(32), nullable=False),
    sa.Column("thing", sa.String(64), nullable=False, index=True),
    sa.Column("detail", sa.Text, nullable=False),
    sa.Column("request_id", sa.String(128)),
    sa.Index("ix_audit_tenant_at", "tenant", "at"),
)

_REFUSAL = "the audit log is append-only"


def upgrade(write: sa.Connection) -> None:
    _tables.create_all(write)
    if write.dialect.name == "postgresql":
        write.exec_driver_sql(
            f"CREATE FUNCTION audit_is_kept() RETURNS trigger LANGUAGE plpgsql "
            f"AS $$ BEGIN RAISE EXCEPTION '{_REFUSAL}'; END $$"
        )
        write.exec_driver_sql(
            "CREATE TRIGGER audit_is_kept BEFORE UPDATE OR DELETE OR TRUNCATE ON audit "
            "FOR EACH STATEMENT EXECUTE FUNCTION audit_is_kept()"
        )
        return
    for event in ("UPDATE", "DELETE"):
        write.exec_driver_sql(
            f"CREATE TRIGGER audit_no_{event.lower()} BEFORE {event} ON audit "
            f"BEGIN SELECT RAISE(ABORT, '{_REFUSAL}'); END"
        )
