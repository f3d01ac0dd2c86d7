"""The outbox: what webhooks are to be told, written in the transaction that makes it true.

So no end of a job goes untold because somebody died in between, and none is told that did not happen. The server
delivers it (`server.deliveries`).
"""

from __future__ import annotations

import json
import time
from datetime import UTC, datetime
from typing import Any
from uuid import uuid4

import sqlalchemy as sa

from worker.database import metadata

webhooks = sa.Table(
    "webhooks",
    metadata,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("tenant", sa.String(64), nullable=False, index=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("secret", sa.String(64), nullable=False),  # as it is: a signature cannot be made from a hash
    sa.Column("events", sa.String(128), nullable=False),  # their names, a space between
    sa.Column("created_at", sa.Float, nullable=False),
)

deliveries = sa.Table(
    "webhook_deliveries",
    metadata,
    sa.Column("id", sa.String(36), primary_key=True),
    sa.Column("webhook_id", sa.String(36), nullable=False),
    sa.Column("job_id", sa.String(36), nullable=False),
    sa.Column("event", sa.String(32), nullable=False),
    sa.Column("body", sa.Text, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("due_at", sa.Float, index=True),  # null: delivered, or given up
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("delivered_at", sa.Float),
    sa.Column("status", sa.Integer),  # of the last answer
    sa.Column("error", sa.Text),  # of the last attempt
    sa.Index("ix_webhook_deliveries_of", "webhook_id", "created_at"),
)


def announce(write: sa.Connection, tenant: str, event: str, data: dict[str, Any]) -> None:
    """Put `event` into the outbox of every webhook of the tenant that asked for it. `data` has the job's id."""
    listening = write.execute(sa.select(webhooks.c.id, webhooks.c.events).where(webhooks.c.tenant == tenant)).all()
    now = time.time()
    body = json.dumps({"type": event, "timestamp": datetime.fromtimestamp(now, UTC).isoformat(), "data": data})
    rows = [
        {"id": str(uuid4()), "webhook_id": hook.id, "job_id": data["id"], "event": event, "body": body,
         "created_at": now, "due_at": now, "attempts": 0}
        for hook in listening
        if event in hook.events.split()
    ]  # fmt: skip
    if rows:
        write.execute(deliveries.insert(), rows)
