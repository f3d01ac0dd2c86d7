"""When to ask again, and how long to wait before: exponential, with jitter, honouring Retry-After."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime

RETRIED_STATUS = frozenset({429, 500, 502, 503, 504})
NEVER_DONE_STATUS = frozenset({429, 503})  # safe to repeat even what must not happen twice


def retry_after_s(header: str | None) -> float | None:
    """Seconds from a Retry-After header: a number, or an HTTP date. None if absent or nonsense."""
    if not header:
        return None
    if header.strip().isdecimal():
        return float(header)
    try:
        when = parsedate_to_datetime(header)
    except ValueError:
        return None
    return max(0.0, (when - datetime.now(UTC)).total_seconds()) if when.tzinfo else None


@dataclass(frozen=True)
class Patience:
    """How long a call is repeated before it is given up. Clock and sleep are fields for the tests' sake."""

    total_s: float = 60.0
    first_s: float = 0.5
    longest_s: float = 15.0
    sleep: Callable[[float], None] = field(default=time.sleep, repr=False)
    clock: Callable[[], float] = field(default=time.monotonic, repr=False)

    def start(self) -> Attempts:
        return Attempts(self, deadline=self.clock() + self.total_s)


@dataclass
class Attempts:
    """The tries of one call."""

    patience: Patience
    deadline: float
    made: int = 0

    def pause(self, retry_after: float | None = None) -> bool:
        """Sleep before the next try; False, at once, if there is no time left for it."""
        delay = min(self.patience.first_s * 2**self.made, self.patience.longest_s) * random.uniform(0.75, 1.0)
        self.made += 1
        if retry_after is not None:
            delay = max(delay, retry_after)
        if self.patience.clock() + delay > self.deadline:
            return False
        self.patience.sleep(delay)
        return True
