"""The state machine, as docs/http.md words it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from worker.contract import ACTIVE, FINISHED, MAX_CRASHES, TRANSITIONS, ErrorKind, State
from worker.database import Database
from worker.ledger import Job, Ledger, jobs


def test_every_state_is_in_the_table() -> None:
    assert set(TRANSITIONS) == set(State)


def test_finished_states_are_final_and_the_documented_ones() -> None:
    assert FINISHED == {State.SUCCEEDED, State.FAILED, State.CANCELLED}
    assert all(not TRANSITIONS[state] for state in FINISHED)
    assert ACTIVE | FINISHED == set(State)


def test_cancelling_leads_to_cancelled_alone() -> None:
    assert TRANSITIONS[State.CANCELLING] == {State.CANCELLED}


def test_only_a_running_job_succeeds_or_returns_to_the_queue() -> None:
    for goal in (State.SUCCEEDED, State.QUEUED):
        assert {state for state, onward in TRANSITIONS.items() if goal in onward} == {State.RUNNING}


def test_every_state_can_be_reached_and_left() -> None:
    reached, frontier = {State.QUEUED}, [State.QUEUED]
    while frontier:
        new = TRANSITIONS[frontier.pop()] - reached
        reached |= new
        frontier += new
    assert reached == set(State)
    for state in ACTIVE:
        assert TRANSITIONS[state], state


# Everything that may change a job, by what it says it may start from.
CHANGES: dict[str, tuple[Callable[[Ledger, Job], Any], dict[State, State]]] = {
    "claim": (lambda ledger, job: ledger.claim(job.id, job.attempt, "here"), {State.QUEUED: State.RUNNING}),
    "succeed": (lambda ledger, job: ledger.succeed(job.id, job.attempt), {State.RUNNING: State.SUCCEEDED}),
    "fail": (
        lambda ledger, job: ledger.fail(job.id, job.attempt, ErrorKind.TIMEOUT, "too long"),
        {State.RUNNING: State.FAILED},
    ),
    "fail waiting": (
        lambda ledger, job: ledger.fail(job.id, job.attempt, ErrorKind.CRASHED, "gone", was=State.QUEUED),
        {State.QUEUED: State.FAILED},
    ),
    "end cancel": (lambda ledger, job: ledger.end_cancel(job.id, job.attempt), {State.CANCELLING: State.CANCELLED}),
    "hand back": (lambda ledger, job: ledger.hand_back(job.id, job.attempt), {State.RUNNING: State.QUEUED}),
    "crash": (lambda ledger, job: ledger.crashed(job, "it died"), {State.RUNNING: State.QUEUED}),
    "last crash": (
        lambda ledger, job: ledger.crashed(replace(job, crashes=MAX_CRASHES), "it died"),
        {State.RUNNING: State.FAILED},
    ),
    "cancel": (
        lambda ledger, job: ledger.ask_cancel(job.id),
        {State.QUEUED: State.CANCELLED, State.RUNNING: State.CANCELLING},
    ),
    "beat": (lambda ledger, job: ledger.beat(job.id, job.attempt, {}), {}),
}


@pytest.mark.parametrize(("state", "change"), list(itertools.product(State, CHANGES)))
def test_every_change_from_every_state_is_in_the_table_or_does_nothing(
    state: State, change: str, ledger: Ledger, database: Database, new_job: Callable[..., Job]
) -> None:
    job_id = new_job().id
    with database.writing() as write:
        write.execute(jobs.update().where(jobs.c.id == job_id).values(state=state))
    before = ledger.get(job_id)
    assert before is not None
    act, expected = CHANGES[change]
    act(ledger, before)
    after = ledger.get(job_id)
    assert after is not None and after.state is expected.get(state, state)
    assert after.state is state or after.state in TRANSITIONS[state]
    assert (after.attempt > before.attempt) == (state is State.RUNNING and after.state is State.QUEUED)
    assert (after.finished_at is not None) == (after.state in FINISHED and after.state is not state)


@pytest.mark.parametrize(("state", "change"), [(s, c) for s in sorted(ACTIVE) for c in CHANGES if c != "cancel"])
def test_an_attempt_that_is_over_changes_nothing(
    state: State, change: str, ledger: Ledger, database: Database, new_job: Callable[..., Job]
) -> None:
    job_id = new_job().id
    stale = ledger.get(job_id)
    assert stale is not None
    with database.writing() as write:
        write.execute(jobs.update().where(jobs.c.id == job_id).values(state=state, attempt=2))
    before = ledger.get(job_id)
    CHANGES[change][0](ledger, stale)
    assert ledger.get(job_id) == before


def test_every_transition_of_the_table_is_made_by_something() -> None:
    made = {(old, new) for _, moves in CHANGES.values() for old, new in moves.items()}
    assert made == {(old, new) for old, onward in TRANSITIONS.items() for new in onward}
