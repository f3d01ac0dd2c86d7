"""One pair of eyes for all who wait: looks at the watched jobs and lists twice a second, in one thread for a moment,
and wakes those whose job or list has changed. Hundreds who wait cost one query, and no thread of the pool.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Generic, TypeVar

from server.problems import ApiProblem
from server.schema import JobOut
from server.tail import Tail
from worker.jobfolder import JobFolder
from worker.journal import Line
from worker.ledger import Job, Ledger

log = logging.getLogger("splatct.server")

EVERY_S = 0.5
LEAST_S = 0.05  # between two looks, however many newcomers ask for one
MOST_OF_ONE = 250  # of one tenant, so that others find a place
MOST_EYES = 500  # each is an open connection, of which a process commonly may have 1,024
LISTED = 50  # newest jobs of a tenant that its list shows


@dataclass(frozen=True)
class Sight:
    """A job as it was last seen; None once it is deleted."""

    job: Job | None
    queue_position: int | None = None


@dataclass(frozen=True)
class Listing:
    """A tenant's newest jobs, newest first, by id. One object for all who look at it."""

    jobs: dict[str, JobOut]
    more: bool  # there are older ones


Seen = TypeVar("Seen", Sight, Listing)


class Eye(Generic[Seen]):
    """One who waits for news of one job, or of a tenant's list."""

    def __init__(self, watched: _Watched[Seen], tenant: str) -> None:
        self.tenant = tenant
        self._watched: _Watched[Seen] = watched
        self._bell = asyncio.Event()
        if watched.sight is not None:
            self._bell.set()

    async def news(self, within_s: float | None = None) -> Seen | None:
        """What there is after the next change (the first time: as soon as it has been seen); None if there was none,
        or if the server stops."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                await self._bell.wait()
            self._bell.clear()
            return self._watched.sight
        return None

    @property
    def tail(self) -> Tail:
        assert self._watched.tail is not None
        return self._watched.tail

    def ring(self) -> None:
        self._bell.set()


@dataclass
class _Watched(Generic[Seen]):
    sight: Seen | None = None
    tail: Tail | None = None
    eyes: set[Eye[Seen]] = field(default_factory=set)

    def ring(self) -> None:
        for eye in self.eyes:
            eye.ring()


class Watch:
    """Make and use it on the event loop."""

    def __init__(self, ledger: Ledger, data: Path) -> None:
        self._ledger = ledger
        self._data = data
        self._loop = asyncio.get_running_loop()
        self._jobs: dict[str, _Watched[Sight]] = {}
        self._lists: dict[str, _Watched[Listing]] = {}  # by tenant
        self._newcomer = asyncio.Event()
        self._blind = False
        self.closed = False

    @contextlib.contextmanager
    def on(self, job_id: str, tenant: str, events: bool = False) -> Iterator[Eye[Sight]]:
        """Watch a job, with its events if asked. 503 when too many do already, of all or of this tenant's."""
        self._require_place(tenant)
        watched = self._jobs.setdefault(job_id, _Watched())
        if events and watched.tail is None:
            watched.tail = Tail(JobFolder(self._data, job_id).events)
            watched.sight = None  # what was seen so far says nothing of the events: look at both together
        with self._eye(self._jobs, job_id, tenant) as eye:
            yield eye

    @contextlib.contextmanager
    def on_list(self, tenant: str) -> Iterator[Eye[Listing]]:
        """Watch a tenant's newest jobs; the same 503."""
        self._require_place(tenant)
        self._lists.setdefault(tenant, _Watched())
        with self._eye(self._lists, tenant, tenant) as eye:
            yield eye

    @contextlib.contextmanager
    def _eye(self, among: dict[str, _Watched[Seen]], name: str, tenant: str) -> Iterator[Eye[Seen]]:
        watched = among[name]
        eye = Eye(watched, tenant)
        watched.eyes.add(eye)
        if watched.sight is None:
            self._newcomer.set()
        if self.closed:
            eye.ring()
        try:
            yield eye
        finally:
            watched.eyes.discard(eye)
            if not watched.eyes:
                among.pop(name, None)

    def _require_place(self, tenant: str) -> None:
        open_eyes = [eye.tenant for watched in self._all() for eye in watched.eyes]
        for count, most, whose in (
            (len(open_eyes), MOST_EYES, ""),
            (open_eyes.count(tenant), MOST_OF_ONE, " of this tenant"),
        ):
            if count >= most:
                raise ApiProblem(503, "busy", f"{most} requests{whose} wait for news already.", retry_after_s=15)

    def _all(self) -> list[_Watched[Sight] | _Watched[Listing]]:
        return [*self._jobs.values(), *self._lists.values()]

    def close(self) -> None:
        """Wake all, so that a stopping server has nobody to wait for. May be called from a signal handler."""
        self._loop.call_soon_threadsafe(self._close)

    def _close(self) -> None:
        self.closed = True
        for watched in self._all():
            watched.sight = None
            watched.ring()

    async def keep_looking(self) -> None:
        """For ever; asleep while nobody watches."""
        while not self.closed:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(EVERY_S if self._jobs or self._lists else None):
                    await self._newcomer.wait()
            self._newcomer.clear()
            tails = {job_id: watched.tail for job_id, watched in self._jobs.items()}
            try:
                seen = await asyncio.to_thread(self._look, tails)
                listed = await asyncio.to_thread(self._look_at_lists, list(self._lists))
                self._blind = False
            except Exception:
                if not self._blind:
                    log.exception("looking at the watched jobs failed; trying again")
                self._blind = True
            else:
                self._tell(seen, tails)
                self._tell_lists(listed)
            await asyncio.sleep(LEAST_S)

    def _look(self, tails: dict[str, Tail | None]) -> dict[str, tuple[Sight, list[Line]]]:
        """The rows before the journals: when a row says that the job has finished, all its events are there."""
        jobs = {job.id: job for job in self._ledger.many(list(tails))} if tails else {}
        queue = self._ledger.positions(jobs.values())
        return {
            job_id: (Sight(jobs.get(job_id), queue.get(job_id)), [] if tail is None else tail.fetch())
            for job_id, tail in tails.items()
        }

    def _look_at_lists(self, tenants: list[str]) -> dict[str, Listing]:
        found = {}
        for tenant in tenants:
            ledger = self._ledger.of(tenant)
            jobs = ledger.page(None, LISTED + 1, None)
            queue = ledger.positions(jobs)
            shown = {job.id: JobOut.of(job, queue.get(job.id)) for job in jobs[:LISTED]}
            found[tenant] = Listing(shown, len(jobs) > LISTED)
        return found

    def _tell(self, seen: dict[str, tuple[Sight, list[Line]]], tails: dict[str, Tail | None]) -> None:
        for job_id, (sight, lines) in seen.items():
            watched, tail = self._jobs.get(job_id), tails[job_id]
            if tail is not None:
                tail.keep(lines)
            if watched is None or self.closed or watched.tail is not tail:
                continue  # all left meanwhile, or one came who needs the events too: the next look is theirs
            changed = watched.sight is None or _shown(watched.sight) != _shown(sight)
            watched.sight = sight
            if changed or lines:
                watched.ring()

    def _tell_lists(self, seen: dict[str, Listing]) -> None:
        for tenant, listing in seen.items():
            watched = self._lists.get(tenant)
            if watched is not None and not self.closed and _order(watched.sight) != _order(listing):
                watched.sight = listing
                watched.ring()


def _shown(sight: Sight) -> object:
    """What a change of counts as news; the heartbeat alone does not."""
    job = sight.job
    if job is None:
        return None
    told = (job.state, job.attempt, job.stage, job.message, job.progress, job.eta_s, job.pinned, job.priority)
    return *told, sight.queue_position


def _order(listing: Listing | None) -> object:
    """What tells one list from another: two with the same jobs in another order differ, too."""
    return None if listing is None else (list(listing.jobs.items()), listing.more)
