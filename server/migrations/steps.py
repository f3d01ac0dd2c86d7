"""Every version of the schema, in order: the n-th step leads from version n-1 to version n."""

from __future__ import annotations

from collections.abc import Callable

import sqlalchemy as sa

from server.migrations import (
    v0001_first,
    v0002_tenants,
    v0003_sessions,
    v0004_audit,
    v0005_webhooks,
    v0006_durable_jobs,
    v0007_retention,
    v0008_contents,
    v0009_accounts,
)

STEPS: tuple[Callable[[sa.Connection], None], ...] = (
    v0001_first.upgrade,
    v0002_tenants.upgrade,
    v0003_sessions.upgrade,
    v0004_audit.upgrade,
    v0005_webhooks.upgrade,
    v0006_durable_jobs.upgrade,
    v0007_retention.upgrade,
    v0008_contents.upgrade,
    v0009_accounts.upgrade,
)
