"""What the routes share: settings, database, folders. One instance per app, made at start-up."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated
from uuid import UUID

from fastapi import Depends, Request

from server.access import Caller
from server.census import Outcomes
from server.importing import Root
from server.intake import Intake
from server.partial import Running
from server.problems import not_found
from server.quotas import Quotas
from server.reserve import Reserve
from server.settings import Settings
from server.store import Store
from server.turns import Turns
from server.watch import Watch
from worker.jobfolder import JobFolder
from worker.ledger import Job


@dataclass
class Service:
    settings: Settings
    store: Store
    intake: Intake
    watch: Watch
    outcomes: Outcomes
    quotas: Quotas
    reserve: Reserve
    wake: Callable[[], None]  # have the reconcile loop look at once
    imports: tuple[Root, ...] = ()  # folders that scans may be imported from
    turns: Turns = field(default_factory=Turns)
    running: Running = field(default_factory=Running)  # digests of files that arrive in pieces
    caller: Caller | None = None  # None: the server itself

    def serving(self, caller: Caller) -> Service:
        """The same for one caller: its store finds nothing that is another tenant's."""
        return replace(self, store=self.store.of(caller.tenant), caller=caller)

    @property
    def tenant(self) -> str:
        assert self.caller is not None, "the server itself has no quota"
        return self.caller.tenant

    def folder(self, job_id: str) -> JobFolder:
        return JobFolder(self.settings.data, job_id)

    def job(self, job_id: UUID) -> Job:
        """The job, or a 404."""
        job = self.store.jobs.get(str(job_id))
        if job is None:
            raise not_found("job")
        return job


async def _serving(request: Request) -> Service:  # async: FastAPI would take a thread for it
    service: Service = request.app.state.service
    return service.serving(request.state.caller)


Served = Annotated[Service, Depends(_serving)]
