"""Measured figures beside their targets, and how busy the machine was with other things."""

from __future__ import annotations

import contextlib
import math
import os
import resource
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One number, and what it is to be."""

    what: str
    value: float
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def met(self) -> bool | None:
        """None where there is no target."""
        if self.at_least is None and self.at_most is None:
            return None
        return (self.at_least is None or self.value >= self.at_least) and (
            self.at_most is None or self.value <= self.at_most
        )

    @property
    def target(self) -> str:
        least = [] if self.at_least is None else [f"≥ {self.at_least:g}"]
        return ", ".join([*least, *([] if self.at_most is None else [f"≤ {self.at_most:g}"])])

    def row(self) -> str:
        verdict = {True: "met", False: "**missed**", None: ""}[self.met]
        return f"| {self.what} ({self.unit}) | {_told(self.value)} | {self.target} | {verdict} |"

    def to_json(self) -> dict[str, Any]:
        return {**vars(self), "met": self.met}


@dataclass
class Busy:
    """What else the machine did during a measurement. Known after its end."""

    load_before: float  # load average of the last minute
    others_cores: float = 0.0  # processors that were used by others than this bench and what it started


@dataclass(frozen=True)
class Measured:
    """The outcome of one measurement."""

    title: str
    how: str  # what was done, for the reader of the table
    figures: Sequence[Figure]
    raw: dict[str, Any] = field(default_factory=dict)


@contextlib.contextmanager
def watching() -> Iterator[Busy]:
    """All processes that the body starts must have ended when it does: they are counted as ours then."""
    busy, began = Busy(os.getloadavg()[0]), time.monotonic()
    before = _machine_s() - _own_s()
    yield busy
    busy.others_cores = max(0.0, (_machine_s() - _own_s() - before) / (time.monotonic() - began))


def quantile(values: Sequence[float], share: float) -> float:
    """The nearest rank, so that 0.99 of a few hundred is a value that was measured."""
    ordered = sorted(values)
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


def _machine_s() -> float:
    """Processor seconds that were not idle, since the machine started."""
    user, nice, system, _idle, _wait, irq, soft, *_ = map(
        int, Path("/proc/stat").read_text().split("\n")[0].split()[1:]
    )
    return (user + nice + system + irq + soft) / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    mine = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(used.ru_utime + used.ru_stime for used in mine)


def _told(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
