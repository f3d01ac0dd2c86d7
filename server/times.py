"""Points in time as the command line says them: a date, or how far away from now."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime

from server.settings import SettingsError

_UNITS_S = {"m": 60.0, "h": 3600.0, "d": 24 * 3600.0}


def text(seconds: float | None) -> str | None:
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def expiry(given: str | None) -> float | None:
    """When something ends; it must lie ahead. None, never, for nothing given."""
    if given is None:
        return None
    at = _moment(given, +1)
    if at <= time.time():
        raise SettingsError(f"--expires: got {given!r}, which is over; expected a time to come, such as 90d")
    return at


def since(given: str | None) -> float | None:
    """When something began: a date, or that long ago."""
    return None if given is None else _moment(given, -1)


def _moment(given: str, sign: int) -> float:
    match = re.fullmatch(r"([0-9]{1,6})([mhd])", given)
    if match:
        return time.time() + sign * int(match[1]) * _UNITS_S[match[2]]
    try:
        at = datetime.fromisoformat(given)
    except ValueError:
        raise SettingsError(
            f"a time: got {given!r}, expected a date such as 2027-01-31 or 2027-01-31T12:00Z, or 90d, 12h, 30m"
        ) from None
    return (at if at.tzinfo else at.replace(tzinfo=UTC)).timestamp()
