"""What became of the jobs, as a table: one column a service."""

from __future__ import annotations

from dataclasses import dataclass

from bench.faults.campaign import Outcome
from bench.faults.service import CHECKPOINT_S

_KINDS = {
    "worker": "SIGKILL of a worker", "engine": "SIGKILL of an engine (RQ: a work-horse)",
    "server": "SIGKILL of the server", "redis": "SIGKILL of Redis", "wipe": "FLUSHALL of Redis",
    "drain": "SIGTERM of a worker",
}  # fmt: skip
_MOST_TOLD = 20


@dataclass(frozen=True)
class Column:
    name: str
    outcome: Outcome
    minutes: float
    settings: str = ""


def side_by_side(columns: list[Column], seed: int, workers: int) -> str:
    """Empty where there is no column."""
    if not columns:
        return ""
    rows = [[text, *(str(c.outcome.faults[kind] or "-") for c in columns)] for kind, text in _KINDS.items()]
    rows += [
        ["jobs", *(str(c.outcome.jobs) for c in columns)],
        ["work of one job (s; median / 95 % / most)", *(_spread(c.outcome.work_s) for c in columns)],
        ["attempts, of these gone on from a checkpoint",
         *(f"{c.outcome.attempts}, {c.outcome.resumed}" for c in columns)],
        ["**lost**", *(str(len(c.outcome.lost)) for c in columns)],
        ["**published twice**", *(str(len(c.outcome.published_twice)) for c in columns)],
        ["**stuck**", *(str(len(c.outcome.stuck)) for c in columns)],
        ["done, but the queue never said so", *(str(len(c.outcome.misreported)) for c in columns)],
        ["worker killed → next attempt runs (s)", *(_spread(c.outcome.recovery_s) for c in columns)],
        ["... of so many workers killed at work", *(str(c.outcome.struck["worker"]) for c in columns)],
        ["engine killed → next attempt runs (s)", *(_spread(c.outcome.engine_recovery_s) for c in columns)],
        ["... of so many engines killed", *(str(c.outcome.struck["engine"]) for c in columns)],
        ["work done again (s)", *(_spread(c.outcome.lost_s) for c in columns)],
        ["... of it, work older than the state kept (s)", *(_spread(c.outcome.beyond_s) for c in columns)],
        ["minutes", *(f"{c.minutes:.0f}" for c in columns)],
    ]  # fmt: skip
    head = f"Faults at random moments, the same for all, seed {seed}, {workers} workers. "
    head += f"SplatCT keeps its state every {CHECKPOINT_S:g} s. A job that has not ended "
    head += f"{columns[0].outcome.end_s:.0f} s after the last fault is stuck.\n\n"
    table = "\n".join(f"| {' | '.join(row)} |" for row in [["", *(c.name for c in columns)], *rows])
    first, _, rest = table.partition("\n")
    table = f"{first}\n|---|{'---:|' * len(columns)}\n{rest}\n"
    return head + table + "".join(_told(column) for column in columns)


def _spread(values: list[float]) -> str:
    if not values:
        return "-"
    ordered = sorted(values)
    return f"{ordered[len(ordered) // 2]:.1f} / {ordered[int(0.95 * (len(ordered) - 1))]:.1f} / {ordered[-1]:.1f}"


def _told(column: Column) -> str:
    out = column.outcome
    bad = {"lost": out.lost, "published twice": out.published_twice, "stuck": out.stuck}
    lines = [f"- {what}: {line}" for what, found in bad.items() for line in found[:_MOST_TOLD]]
    head = [f"{column.name}: {column.settings}"] if column.settings else []
    return "".join(f"\n{line}" for line in (*head, *lines)) + "\n"
