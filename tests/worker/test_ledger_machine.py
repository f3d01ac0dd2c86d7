"""The ledger under any sequence of what workers, users and the reconcile loop may do, against a model of a page.

Several jobs, each with the attempts that were ever claimed: late ones go on acting, as a worker does that was thought
dead. Whatever happens, a job ends once, and only its newest attempt decides how.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, rule

from worker.contract import FINISHED, MAX_CRASHES, ErrorKind, State
from worker.database import Database, metadata
from worker.ledger import Job, Ledger

ENDS = ["succeed", "fail", "end cancel", "hand back", "crash", "crash further on"]


@dataclass
class Model:
    state: State = State.QUEUED
    attempt: int = 1
    crashes: int = 0
    ends: list[State] = field(default_factory=list)


class LedgerMachine(RuleBasedStateMachine):
    claims = Bundle("claims")  # (job id, attempt, the row as its worker saw it)

    @initialize()
    def open(self) -> None:
        self.database = Database("sqlite://")
        metadata.create_all(self.database.engine)
        self.ledger = Ledger(self.database)
        self.models: dict[str, Model] = {}

    def teardown(self) -> None:
        if hasattr(self, "database"):
            self.database.close()

    def _mine(self, claim: Job) -> bool:
        return self.models[claim.id].attempt == claim.attempt

    def _move(self, job_id: str, state: State) -> None:
        model = self.models[job_id]
        model.state = state
        if state in FINISHED:
            model.ends.append(state)

    @rule()
    def submit(self) -> None:
        job_id = f"job-{len(self.models)}"
        with self.database.writing() as write:
            self.ledger.add(write, job_id, "a job", ("scan", "scan"), {})
        self.models[job_id] = Model()

    @rule(target=claims)
    def claim_next(self) -> Job | None:
        line = self.ledger.line(5)
        waiting = [job_id for job_id, model in self.models.items() if model.state is State.QUEUED]
        assert {job.id for job in line} <= set(waiting) and bool(line) == bool(waiting)
        if not line:
            return None
        claimed = self.ledger.claim(line[0].id, line[0].attempt, "here")
        assert claimed is not None
        self._move(claimed.id, State.RUNNING)
        return claimed

    @rule(claim=claims)
    def beat(self, claim: Job | None) -> None:
        if claim is None:
            return
        state = self.ledger.beat(claim.id, claim.attempt, {"progress": 0.5})
        model = self.models[claim.id]
        alive = self._mine(claim) and model.state in (State.RUNNING, State.CANCELLING)
        assert state == (model.state if alive else None)

    @rule(
        claim=claims, how=st.sampled_from(["succeed", "fail", "end cancel", "hand back", "crash", "crash further on"])
    )
    def worker_ends(self, claim: Job | None, how: str) -> None:
        if claim is None:
            return
        model, ledger = self.models[claim.id], self.ledger
        running = self._mine(claim) and model.state is State.RUNNING
        cancelling = self._mine(claim) and model.state is State.CANCELLING
        if how == "succeed":
            assert ledger.succeed(claim.id, claim.attempt) == running
            if running:
                self._move(claim.id, State.SUCCEEDED)
        elif how == "fail":
            assert ledger.fail(claim.id, claim.attempt, ErrorKind.TIMEOUT, "too long") == running
            if running:
                self._move(claim.id, State.FAILED)
        elif how == "end cancel":
            assert ledger.end_cancel(claim.id, claim.attempt) == cancelling
            if cancelling:
                self._move(claim.id, State.CANCELLED)
        elif how == "hand back":
            assert ledger.hand_back(claim.id, claim.attempt) == running
            if running:
                self._move(claim.id, State.QUEUED)
                model.attempt += 1
        else:
            further = how == "crash further on"
            end = ledger.crashed(claim, "it died", advanced=further)
            assert (end is not None) == running
            if running:
                model.crashes = 1 if further else model.crashes + 1
                given_up = model.crashes >= MAX_CRASHES
                assert end is (State.FAILED if given_up else State.QUEUED)
                self._move(claim.id, end)
                model.attempt += not given_up

    @rule(number=st.integers(0, 5))
    def cancel(self, number: int) -> None:
        job_id = f"job-{number}"
        job = self.ledger.ask_cancel(job_id)
        if job_id not in self.models:
            assert job is None
            return
        model = self.models[job_id]
        goal = {State.QUEUED: State.CANCELLED, State.RUNNING: State.CANCELLING}.get(model.state)
        if goal is not None:
            self._move(job_id, goal)
        assert job is not None and job.state is model.state

    @invariant()
    def the_table_is_as_the_page_says(self) -> None:
        for job_id, model in getattr(self, "models", {}).items():
            job = self.ledger.get(job_id)
            assert job is not None and job.state is model.state and len(model.ends) <= 1
            assert job.attempt == model.attempt or job.state in FINISHED
            assert (job.finished_at is not None) == (job.state in FINISHED)


TestLedger = LedgerMachine.TestCase
TestLedger.settings = settings(max_examples=60, stateful_step_count=30, deadline=None)
