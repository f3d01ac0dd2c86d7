"""The state machine, as docs/http.md words it."""

from __future__ import annotations

from worker.contract import ACTIVE, FINISHED, TRANSITIONS, State


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
