"""The ledger on PostgreSQL: the same tests as on SQLite, and submissions that race."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy.exc import IntegrityError

from server.migrations import prepare
from server.problems import ApiProblem
from server.quotas import Quotas
from server.store import File, NewJob, Store
from server.submissions import Claim, Kind
from worker.contract import State
from worker.database import Database
from worker.ledger import Ledger

from ..postgres import emptied, running_postgres
from .test_ledger import (  # noqa: F401  collected here once more, on the database below
    test_a_scan_is_needed_until_its_job_ends,
    test_a_stale_attempt_is_fenced_off,
    test_cancel_is_immediate_when_queued_and_a_request_when_running,
    test_crashes_are_counted_and_end,
    test_many_and_the_queue,
    test_of_many_claims_one_succeeds,
    test_only_finished_jobs_can_be_forgotten,
    test_pages_and_positions,
)

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    with running_postgres() as address:
        yield address


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    opened = Database(emptied(url))
    prepare(opened)
    yield opened
    opened.close()


@pytest.fixture
def ledger(database: Database) -> Ledger:
    return Ledger(database)


@pytest.mark.parametrize("kind", list(Kind))
def test_of_submissions_at_once_one_makes_the_job(database: Database, kind: Kind) -> None:
    """SQLite has one writer at a time; here the transactions truly overlap."""
    store = Store(database)
    scan = store.commit(store.add_upload("scan", [File("scan.json", 1, None, None)]), {})
    for turn in range(20):
        claim, together, placed = Claim(kind, f"name-{turn}", "digest"), threading.Barrier(6), list[str]()

        def submit(
            number: int, claim: Claim = claim, together: threading.Barrier = together, placed: list[str] = placed
        ) -> bool:
            job_id = claim.name if kind is Kind.ID else f"{claim.name}-{number}"
            together.wait()
            try:
                return store.add_job(NewJob(job_id, "job", {}, claim), scan, lambda: placed.append(job_id))
            except IntegrityError:
                earlier = store.submissions.find(claim)
                assert earlier is not None and store.jobs.get(earlier.job_id) is not None
                return False

        with ThreadPoolExecutor(6) as pool:
            assert sum(pool.map(submit, range(6))) == 1
        assert len(placed) == 1 and len(store.jobs.in_states(State)) == turn + 1
    store.submissions.purge()


def test_of_uploads_at_once_no_more_than_fit_the_quota_are_taken(database: Database) -> None:
    quotas, together = Quotas(35, 2, 0), threading.Barrier(6)
    stores = {tenant: Store(database, tenant) for tenant in ("a", "b")}

    def announce(number: int) -> bool:
        tenant = "ab"[number % 2]
        together.wait()
        try:
            stores[tenant].add_upload("scan", [File("scan.json", 10, None, None)], quotas.upload(tenant, 10))
        except ApiProblem:
            return False
        return True

    with ThreadPoolExecutor(6) as pool:
        taken = [number % 2 for _ in range(4) for number, done in enumerate(pool.map(announce, range(6))) if done]
    assert (taken.count(0), taken.count(1)) == (3, 3)


def test_of_jobs_at_once_no_more_than_the_quota_are_queued(database: Database) -> None:
    quotas, together, store = Quotas(0, 2), threading.Barrier(6), Store(database, "a")
    scan = store.commit(store.add_upload("scan", [File("scan.json", 1, None, None)]), {})

    def submit(number: int) -> bool:
        together.wait()
        try:
            return store.add_job(NewJob(str(number), "job", {}), scan, lambda: None, quotas.job("a", 0))
        except ApiProblem:
            return False

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(submit, range(6))) == 2
