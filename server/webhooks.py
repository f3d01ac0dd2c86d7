"""Routes about webhooks: where a tenant wants to be told of its jobs' ends, and how the telling went."""

from __future__ import annotations

import base64
import secrets
import time
from typing import Any
from uuid import UUID, uuid4

import httpx
import sqlalchemy as sa
from fastapi import APIRouter, Response

from server.deliveries import SECRET_PREFIX
from server.problems import ApiProblem, invalid, not_found
from server.schema import DeliveryList, DeliveryOut, WebhookIn, WebhookList, WebhookOut, moment
from server.service import Served, Service
from splatcore.errors import Problem
from worker.database import alone
from worker.outbox import deliveries, webhooks

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"])

MOST = 10
_MOST_DELIVERIES = 200


@router.post("", status_code=201)
def add_webhook(body: WebhookIn, service: Served, response: Response) -> WebhookOut:
    """The only answer that holds the secret."""
    _require_usable(body.url)
    row = {
        "id": str(uuid4()),
        "tenant": service.tenant,
        "url": body.url,
        "secret": SECRET_PREFIX + base64.b64encode(secrets.token_bytes(32)).decode(),
        "events": " ".join(sorted(body.events)),
        "created_at": time.time(),
    }
    count = sa.select(sa.func.count()).select_from(webhooks).where(webhooks.c.tenant == service.tenant)
    with service.store.database.writing() as write:
        alone(write, service.tenant)
        if write.execute(count).scalar_one() >= MOST:
            faults = [Problem("webhooks", f"there are {MOST}, the most that a tenant may have", "delete one first")]
            raise ApiProblem(409, "too-many-webhooks", "The tenant has enough webhooks.", faults)
        write.execute(webhooks.insert().values(**row))
    response.headers["Location"] = f"/v1/webhooks/{row['id']}"
    return _out(row, secret=str(row["secret"]))


@router.get("")
def list_webhooks(service: Served) -> WebhookList:
    query = sa.select(webhooks).where(webhooks.c.tenant == service.tenant).order_by(webhooks.c.created_at)
    with service.store.database.reading() as read:
        return WebhookList(webhooks=[_out(dict(row._mapping)) for row in read.execute(query)])


@router.get("/{webhook_id}")
def get_webhook(webhook_id: UUID, service: Served) -> WebhookOut:
    return _out(_webhook(service, webhook_id))


@router.delete("/{webhook_id}", status_code=204)
def delete_webhook(webhook_id: UUID, service: Served) -> None:
    """What it was still to be told goes with it."""
    _webhook(service, webhook_id)
    with service.store.database.writing() as write:
        write.execute(deliveries.delete().where(deliveries.c.webhook_id == str(webhook_id)))
        write.execute(webhooks.delete().where(webhooks.c.id == str(webhook_id)))


@router.get("/{webhook_id}/deliveries")
def list_deliveries(webhook_id: UUID, service: Served) -> DeliveryList:
    """Newest first, 200 at most."""
    _webhook(service, webhook_id)
    query = (
        sa.select(deliveries)
        .where(deliveries.c.webhook_id == str(webhook_id))
        .order_by(deliveries.c.created_at.desc(), deliveries.c.id)
        .limit(_MOST_DELIVERIES)
    )
    with service.store.database.reading() as read:
        return DeliveryList(deliveries=[_delivery(dict(row._mapping)) for row in read.execute(query)])


def _webhook(service: Service, webhook_id: UUID) -> dict[str, Any]:
    mine = sa.and_(webhooks.c.id == str(webhook_id), webhooks.c.tenant == service.tenant)
    with service.store.database.reading() as read:
        row = read.execute(sa.select(webhooks).where(mine)).one_or_none()
    if row is None:
        raise not_found("webhook")
    return dict(row._mapping)


def _require_usable(text: str) -> None:
    """What can be said of a URL without asking anybody; where it leads is looked at when it is used."""
    try:
        url = httpx.URL(text)
        plain = url.scheme in ("http", "https") and url.host and "%" not in url.host and url.port != 0
        usable = plain and not (url.userinfo or url.fragment) and (url.port or 1) < 65536
    except (httpx.InvalidURL, UnicodeError):  # the second from a host that only looks like an encoded one
        usable = False
    if not usable:
        hint = "give an address such as https://lab.example.org/ct-done, without a user's name or a fragment"
        raise invalid("The address cannot be used.", [Problem("url", "is no plain http or https address", hint)])


def _out(row: dict[str, Any], secret: str | None = None) -> WebhookOut:
    return WebhookOut(
        id=row["id"], url=row["url"], events=row["events"].split(), created_at=moment(row["created_at"]), secret=secret
    )


def _delivery(row: dict[str, Any]) -> DeliveryOut:
    state = "delivered" if row["delivered_at"] else "waiting" if row["due_at"] else "given up"
    return DeliveryOut(
        id=row["id"],
        job_id=row["job_id"],
        event=row["event"],
        state=state,
        attempts=row["attempts"],
        status=row["status"],
        error=row["error"],
        created_at=moment(row["created_at"]),
        delivered_at=None if row["delivered_at"] is None else moment(row["delivered_at"]),
        next_at=None if row["due_at"] is None else moment(row["due_at"]),
    )
