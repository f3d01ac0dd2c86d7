"""Empties the outbox: sends what is due, again and again with growing pauses, until it is taken or given up."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import logging
import time
from dataclasses import dataclass

import httpx
import sqlalchemy as sa

from server.addresses import Forbidden, Network, checked
from worker.database import Database
from worker.outbox import deliveries, webhooks

log = logging.getLogger("splatct.webhooks")

PAUSES = (1, 6, 24, 120, 720, 2160, 4320, 8640)  # between attempts, in units of the first: 5 s to 12 h, 22 h in all
SECRET_PREFIX = "whsec_"
_EVERY_S = 1.0
_TOGETHER = 8
_PATIENCE_S = 15.0  # for all of one attempt, however slowly the other side talks
_LEASE_S = 60.0  # for which a delivery is one server's; after a crash it is due again
_KEPT_S = 30 * 24 * 3600.0
_GONE = 410


@dataclass(frozen=True)
class Due:
    id: str
    url: str
    secret: str
    body: str
    attempts: int


@dataclass(frozen=True)
class Outcome:
    """What came of one attempt: the answer's status, or why there was none."""

    status: int | None
    error: str | None

    @property
    def taken(self) -> bool:
        return self.status is not None and 200 <= self.status < 300


class Outbox:
    """The deliveries in the database."""

    def __init__(self, database: Database, first_pause_s: float) -> None:
        self._database = database
        self._first_pause_s = first_pause_s

    def claim(self, most: int) -> list[Due]:
        """Those that are due, ours for a while: several servers may look at once. Turns go round among tenants, so
        that one whose receivers are slow or dead holds up nobody else's."""
        now = time.time()
        turn = sa.func.row_number().over(partition_by=webhooks.c.tenant, order_by=deliveries.c.due_at)
        query = (
            sa.select(deliveries.c.id, deliveries.c.due_at, deliveries.c.body, deliveries.c.attempts,
                      webhooks.c.url, webhooks.c.secret)
            .join(webhooks, webhooks.c.id == deliveries.c.webhook_id)
            .where(deliveries.c.due_at <= now)
            .order_by(turn, deliveries.c.due_at)
            .limit(most)
        )  # fmt: skip
        with self._database.reading() as read:
            found = read.execute(query).all()
        if not found:
            return []
        ours = []
        with self._database.writing() as write:
            for row in found:
                unclaimed = sa.and_(deliveries.c.id == row.id, deliveries.c.due_at == row.due_at)
                if write.execute(deliveries.update().where(unclaimed).values(due_at=now + _LEASE_S)).rowcount:
                    ours.append(Due(row.id, row.url, row.secret, row.body, row.attempts))
        return ours

    def record(self, due: Due, outcome: Outcome) -> None:
        now, attempts = time.time(), due.attempts + 1
        values: dict[str, object] = {"attempts": attempts, "status": outcome.status, "error": outcome.error}
        if outcome.taken:
            values |= {"due_at": None, "delivered_at": now}
        elif outcome.status == _GONE or attempts > len(PAUSES):
            values["due_at"] = None
        else:
            values["due_at"] = now + PAUSES[attempts - 1] * self._first_pause_s
        with self._database.writing() as write:
            write.execute(deliveries.update().where(deliveries.c.id == due.id).values(**values))


def purge_deliveries(database: Database) -> None:
    """Forget what ended a month ago."""
    old = sa.and_(deliveries.c.due_at.is_(None), deliveries.c.created_at < time.time() - _KEPT_S)
    with database.writing() as write:
        write.execute(deliveries.delete().where(old))


def signature(secret: str, message_id: str, timestamp: int, body: str) -> str:
    """As Standard Webhooks has it: whoever knows the secret can tell that we said this, and when."""
    key = base64.b64decode(secret.removeprefix(SECRET_PREFIX))
    digest = hmac.new(key, f"{message_id}.{timestamp}.{body}".encode(), hashlib.sha256).digest()
    return f"v1,{base64.b64encode(digest).decode()}"


async def send(due: Due, allowed: tuple[Network, ...]) -> Outcome:
    """One attempt. Redirects are not followed, and the answer's body is not read."""
    url, now = httpx.URL(due.url), int(time.time())
    try:
        async with asyncio.timeout(_PATIENCE_S):
            address = await checked(url.host, url.port or (443 if url.scheme == "https" else 80), allowed)
            headers = {
                "Host": url.netloc.decode("ascii"),
                "Content-Type": "application/json",
                "User-Agent": "splatct-webhook/1",
                "webhook-id": due.id,
                "webhook-timestamp": str(now),
                "webhook-signature": signature(due.secret, due.id, now, due.body),
            }
            there = url.copy_with(host=address)  # and TLS still asks for the certificate of the name
            async with (
                httpx.AsyncClient(trust_env=False, follow_redirects=False, timeout=_PATIENCE_S) as http,
                http.stream(
                    "POST", there, content=due.body, headers=headers, extensions={"sni_hostname": url.host}
                ) as answer,
            ):
                error = None if 200 <= answer.status_code < 300 else f"it answered {answer.status_code}"
                return Outcome(answer.status_code, error)
    except Forbidden as refusal:
        return Outcome(None, str(refusal))
    except TimeoutError:
        return Outcome(None, f"it took longer than {_PATIENCE_S:.0f} s")
    except httpx.HTTPError as failure:
        return Outcome(None, f"the connection failed ({type(failure).__name__})")


async def keep_delivering(outbox: Outbox, allowed: tuple[Network, ...]) -> None:
    """For ever. A slow receiver holds up the others of its round at most, and never a job."""

    async def one(due: Due) -> None:
        try:
            outcome = await send(due, allowed)
        except Exception:  # counted as an attempt like any other, or it would come again for ever
            log.exception("delivery %s could not be made", due.id)
            outcome = Outcome(None, "it could not be sent; the server's log says more")
        await asyncio.to_thread(outbox.record, due, outcome)

    while True:
        try:
            claimed = await asyncio.to_thread(outbox.claim, _TOGETHER)
            results = await asyncio.gather(*map(one, claimed), return_exceptions=True)
            for failure in results:
                if isinstance(failure, Exception):
                    log.error("a delivery could not be made; it is tried again", exc_info=failure)
        except Exception:
            log.exception("looking into the outbox failed; trying again")
            claimed = []
        if len(claimed) < _TOGETHER:
            await asyncio.sleep(_EVERY_S)
