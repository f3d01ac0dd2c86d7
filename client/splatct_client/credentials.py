"""The key that opens a server: from a file or the environment, never from the command line, which others can read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from splatct_client.errors import InputError

VARIABLE = "SPLATCT_KEY"
LONGEST = 4096


def find_key(key_file: Path | None, environment: Mapping[str, str] = os.environ) -> str | None:
    """The key in `key_file`, else that in SPLATCT_KEY, else None. No error repeats what was read."""
    if key_file is None:
        given = environment.get(VARIABLE, "").strip()
        return checked(given, VARIABLE) if given else None
    try:
        with key_file.open(encoding="utf-8") as file:
            text = file.read(LONGEST + 1)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise InputError(
            f"--key-file: {key_file} cannot be read: {reason}; expected a file with one key in it"
        ) from None
    return checked(text.strip(), f"--key-file: {key_file}")


def checked(key: str, source: str) -> str:
    """The key, if it can stand in a header."""
    if not key or len(key) > LONGEST or not key.isascii() or not key.isprintable() or " " in key:
        raise InputError(f"{source}: holds no key; expected one line as `splatct keys add` printed it")
    return key
