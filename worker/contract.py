"""What server and worker agree on: job states, their legal transitions, names on the queue.

Standard library only. The table below is the whole state machine; `worker.ledger` refuses
every change it does not list.
"""

from __future__ import annotations

from enum import IntEnum, StrEnum

QUEUE = "splatct"
TASK = "worker.supervise.run_job"
LOCAL_TENANT = "local"  # whose everything is as long as there are no keys

# Attempts that may die without getting further before the job is given up; hand-backs do not count. More than a
# few, since going on from a checkpoint costs little, and the next death may be the machine's fault again.
MAX_CRASHES = 5
# The same where the last was killed by another hand: a SIGKILL that was neither ours nor the kernel's for want of
# memory, or the death of the worker, says little of the job. Still not for ever: a job may take its machine along.
MAX_KILLS = 20
HEARTBEAT_S = 2.0  # how often a supervisor marks its row
DEAD_S = 8.0  # a heartbeat older than this, on another host, is a dead worker
STUCK_S = 60.0  # on this host, where the lock still proves life, wait this long instead


class State(StrEnum):
    QUEUED = "queued"
    RUNNING = "running"
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"


TRANSITIONS: dict[State, frozenset[State]] = {
    State.QUEUED: frozenset({State.RUNNING, State.CANCELLED, State.FAILED}),
    State.RUNNING: frozenset({State.QUEUED, State.CANCELLING, State.SUCCEEDED, State.FAILED}),
    # A cancellation that was accepted always ends as one, even if the engine finished meanwhile.
    State.CANCELLING: frozenset({State.CANCELLED}),
    State.SUCCEEDED: frozenset(),
    State.FAILED: frozenset(),
    State.CANCELLED: frozenset(),
}

FINISHED = frozenset(state for state, onward in TRANSITIONS.items() if not onward)
ACTIVE = frozenset(State) - FINISHED


class Priority(IntEnum):
    """Of a tenant's jobs, those of a higher one are run first."""

    LOW = -1
    NORMAL = 0
    HIGH = 1


class ErrorKind(StrEnum):
    """Why a job failed: stable words for programs; the message is for people."""

    BAD_INPUT = "bad_input"
    CANNOT_RECONSTRUCT = "cannot_reconstruct"
    OUT_OF_MEMORY = "out_of_memory"
    DISK_FULL = "disk_full"
    TIMEOUT = "timeout"
    CRASHED = "crashed"


class Exit(IntEnum):
    """Exit codes of `python -m worker.engine`. Any other code, or a signal, is a crash."""

    OK = 0
    BUG = 1  # an exception nobody foresaw: the same input would raise it again
    BAD_INPUT = 10
    CANNOT_RECONSTRUCT = 11
    OUT_OF_MEMORY = 12
    DISK_FULL = 13
    CANCELLED = 14  # as asked; a result of what there was is in the attempt's folder, if there was any
    STOPPED = 15  # as asked; the state is kept, if it could be


def queue_id(job_id: str, attempt: int) -> str:
    """The id of one attempt on the queue; a stale attempt can never be mistaken for a newer one."""
    return f"{job_id}-{attempt}"
