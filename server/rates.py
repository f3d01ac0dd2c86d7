"""Token buckets in memory: how often somebody may do something. Each server process counts by itself."""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

_MOST = 10_000  # buckets kept; beyond, those that are full again are dropped


@dataclass(frozen=True)
class Drawn:
    """What came of asking for a token. `wait_s`: until there is one; 0 when one was had."""

    burst: int
    left: int
    full_s: float
    wait_s: float

    def headers(self) -> dict[str, str]:
        return {
            "RateLimit-Limit": str(self.burst),
            "RateLimit-Remaining": str(self.left),
            "RateLimit-Reset": str(math.ceil(self.full_s)),
        }


class Buckets:
    """One bucket a name: `burst` tokens at most, `per_s` more each second. `per_s` 0: no limit."""

    def __init__(self, per_s: float, burst: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._burst = burst
        self._clock = clock
        self._lock = threading.Lock()
        self._level: dict[str, tuple[float, float]] = {}  # tokens, and when there were so many

    def take(self, name: str) -> Drawn | None:
        """None where there is no limit."""
        if not self._per_s:
            return None
        with self._lock:
            now = self._clock()
            tokens = self._tokens(name, now)
            had = tokens >= 1
            if had:
                tokens -= 1
                self._level[name] = tokens, now
                self._forget(now)
        wait_s = 0.0 if had else (1 - tokens) / self._per_s
        return Drawn(self._burst, int(tokens), (self._burst - tokens) / self._per_s, wait_s)

    def wait_s(self, name: str) -> float:
        """Until there is a token, without taking one."""
        if not self._per_s:
            return 0.0
        with self._lock:
            return max(0.0, (1 - self._tokens(name, self._clock())) / self._per_s)

    def _tokens(self, name: str, now: float) -> float:
        tokens, at = self._level.get(name, (float(self._burst), now))
        return min(float(self._burst), tokens + (now - at) * self._per_s)

    def _forget(self, now: float) -> None:
        if len(self._level) > _MOST:
            self._level = {name: kept for name, kept in self._level.items() if self._tokens(name, now) < self._burst}


@dataclass(frozen=True)
class Rates:
    keys: Buckets  # requests, by key
    failures: Buckets  # keys that were none, by address


def neighbourhood(address: str | None) -> str:
    """Whom an address stands for: with IPv6 one subscriber has a whole /64 of them."""
    try:
        known = ipaddress.ip_address(address or "")
    except ValueError:
        return "unknown"
    return str(ipaddress.ip_network((known, 64), strict=False)) if known.version == 6 else str(known)
