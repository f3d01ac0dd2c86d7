"""Version 5: webhooks, and the outbox of what they are still to be told."""

from __future__ import annotations

import sqlalchemy as sa

_tables = sa.MetaData()

sa.Table(
    "webhooks",
    _tables,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("tenant", sa.String(64), nullable=False, index=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("secret", sa.String(64), nullable=False),
    sa.Column("events", sa.String(128), nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
)

sa.Table(
    "webhook_deliveries",
    _tables,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("webhook_id", sa.String(36), nullable=False),
    sa.Column("job_id", sa.String(36), nullable=False),
    sa.Column("event", sa.String(32), nullable=False),
    sa.Column("body", sa.Text, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("due_at", sa.Float, index=True),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("delivered_at", sa.Float),
    sa.Column("status", sa.Integer),
    sa.Column("error", sa.Text),
    sa.Index("ix_webhook_deliveries_of", "webhook_id", "created_at"),
)


def upgrade(write: sa.Connection) -> None:
    _tables.create_all(write)
