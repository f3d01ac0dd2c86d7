"""Options of the engine, from the command line."""

from __future__ import annotations

import json
from typing import Any

from splatct_client.errors import InputError, Problem


def parse_options(pairs: list[str], calibrate: str | None) -> dict[str, Any]:
    """`name=value` pairs as JSON would have them: numbers, true, null; anything else is text."""
    options: dict[str, Any] = {} if calibrate is None else {"calibrate": calibrate}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not equals or not name:
            raise InputError(f"--option: got {pair!r}, expected NAME=VALUE")
        try:
            options[name] = json.loads(text)
        except ValueError:
            options[name] = text
    return options


def check_options(options: dict[str, Any], known: list[dict[str, Any]]) -> None:
    """Compare with what the server says it knows. It judges again, more strictly, at submission."""
    described = {str(option.get("name")): option for option in known}
    problems = []
    for name, value in options.items():
        option = described.get(name)
        if option is None:
            problems.append(Problem(name, "unknown option", f"known: {', '.join(described)}"))
            continue
        choices, low, high = (option.get(key) for key in ("choices", "low", "high"))
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if choices and value not in choices:
            problems.append(Problem(name, f"got {value!r}", f"expected one of {', '.join(map(str, choices))}"))
        elif value is not None and low is not None and high is not None and not (number and low <= value <= high):
            problems.append(Problem(name, f"got {value!r}", f"expected {low} to {high}"))
    if problems:
        raise InputError("the options cannot be used:", problems)
