"""Reading a JSON document from a stranger: load it within limits, pick typed values out of it, and
note every problem with its JSON pointer instead of stopping at the first.

jiter reads the text: of long lists of numbers six times as fast as `json`, and it tells a key that is given twice.
"""

from __future__ import annotations

import codecs
import difflib
import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jiter

from splatcore.errors import Problem

MAX_BYTES = 48 * 2**20  # frames of 100,000 views
_MAX_NOT_ASCII = 8 * 2**20  # bytes; one rare character makes Python keep four bytes for each
# What a text of many small values may cost in memory, told before it is parsed; twice what 100,000 views need.
_MAX_MARKS = {b"[": 1_000_000, b"{": 250_000, b":": 500_000, b",": 2_500_000}
_MAX_DEPTH = 64
_MAX_PROBLEMS = 60
_SHOWN = 60  # characters of an offending value that a message repeats
_LONGEST_GUESSED = 255  # characters of a word whose likeness to others is looked for
_TWICE = re.compile(r'Detected duplicate key "(.*)" at (line \d+ column \d+)', re.DOTALL)


def shown(value: object) -> str:
    """A value as a message repeats it: JSON-like and short."""
    if isinstance(value, str):
        value = value[: _SHOWN + 1]  # it may be megabytes
    text = ""
    try:
        for piece in json.JSONEncoder().iterencode(value):  # bit by bit: nobody reads the rest
            text += piece
            if len(text) > _SHOWN:
                break
    except (TypeError, ValueError, RecursionError):
        text = repr(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"


def nearest(given: str, known: Iterable[str]) -> str:
    """A hint that names the closest known word, or all of them."""
    known, given = list(known), given[:_LONGEST_GUESSED]
    close = difflib.get_close_matches(given, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    return "known here: " + ", ".join(known[:12]) + (", …" if len(known) > 12 else "") if known else ""


def token(key: str) -> str:
    """A key as one step of a JSON pointer (RFC 6901), fit for a terminal."""
    text = key if key.isprintable() else ascii(key)[1:-1]
    text = text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
    return text.replace("~", "~0").replace("/", "~1")


def _items(container: Any) -> Iterator[tuple[Any, Any]]:
    return iter(container.items() if isinstance(container, dict) else enumerate(container))


def _plain(container: dict[str, Any] | list[Any]) -> bool:
    """Whether it holds finite numbers alone: the long ones do, and need no step for each."""
    values = container.values() if isinstance(container, dict) else container
    if not set(map(type, values)) <= {int, float}:
        return False
    try:
        return all(map(math.isfinite, values))
    except OverflowError:  # a whole number beyond all floats
        return False


def _unreadable(said: str) -> tuple[str, str]:
    """What the parser found wrong, and a hint."""
    if said.startswith("recursion limit"):
        return f"is nested deeper than {_MAX_DEPTH} levels", ""
    if twice := _TWICE.match(said):
        return f"gives the key {shown(twice[1])} twice in one object, again at {twice[2]}", "keep one of them"
    if said.startswith("number out of range"):  # thousands of digits
        return f"is not usable JSON: {said}", ""
    if "hex escape" in said or "surrogate" in said:
        return (
            f"is not JSON: {said}",
            "characters beyond \\uffff are written as two escapes, \\ud83e\\udeb7 and the like",
        )
    if said.startswith("EOF while parsing"):
        return f"is not JSON: {said}", "it is empty or cut off; write it again"
    return f"is not JSON: {said}", ""


class Document:
    """The problems found so far, and readers of single values. A reader returns None after noting a problem."""

    def __init__(self) -> None:
        self.problems: list[Problem] = []
        self._left_out = 0

    def note(self, where: str, what: str, hint: str = "") -> None:
        if len(self.problems) < _MAX_PROBLEMS:
            self.problems.append(Problem(where, what, hint))
        else:
            self._left_out += 1

    @property
    def full(self) -> bool:
        """Whether more problems are only counted. What costs time to say is then not worth finding out."""
        return len(self.problems) >= _MAX_PROBLEMS

    def pass_over(self, count: int = 1) -> None:
        """More problems of a kind that is noted already."""
        self._left_out += count

    def all_problems(self) -> list[Problem]:
        more = (
            [Problem("", f"and at least {self._left_out} more problems", "mend these first")] if self._left_out else []
        )
        return self.problems + more

    def load(self, path: Path) -> dict[str, Any] | None:
        """The object in a JSON file, with finite numbers only and no key given twice."""
        name = path.name
        try:
            size = path.stat().st_size
            if size > MAX_BYTES:
                self.note(name, f"is {size} bytes long, more than the {MAX_BYTES} allowed")
                return None
            raw = path.read_bytes().removeprefix(codecs.BOM_UTF8)
            if not raw.isascii():
                if size > _MAX_NOT_ASCII:
                    what = f"is {size} bytes long and holds other characters than ASCII"
                    self.note(name, what, f"write them as \\u… or keep the file below {_MAX_NOT_ASCII} bytes")
                    return None
                raw.decode()
            if b"\0" in raw:
                self.note(name, "is not text: it holds bytes of zero", "save it as UTF-8; UTF-16 has them, too")
                return None
        except UnicodeDecodeError as error:
            self.note(name, f"is not UTF-8 text (byte {error.start})", "save it as UTF-8")
            return None
        except OSError as error:
            self.note(name, f"cannot be read: {error.strerror}")
            return None
        for mark, most in _MAX_MARKS.items():
            count = raw.count(mark)
            if count > most:
                what = f"holds {count} times {mark.decode()!r}, more than the {most} allowed"
                self.note(name, what, "leave out what is not used")
                return None
        try:
            data = jiter.from_json(raw, catch_duplicate_keys=True, cache_mode="none")
        except ValueError as error:
            self.note(name, *_unreadable(str(error)))
            return None
        if not isinstance(data, dict):
            self.note(name, f"holds {shown(data)}, expected one object", "it must begin with '{'")
            return None
        self._walk(data, name)
        return data

    def _walk(self, data: Any, name: str) -> None:
        """Notes numbers that are not finite anywhere, and nesting that is too deep."""
        stack: list[Iterator[tuple[Any, Any]]] = [] if _plain(data) else [_items(data)]
        path: list[str] = []  # the keys that lead to each of the stack's containers but the first
        while stack:
            key, value = next(stack[-1], (None, None))
            if key is None:
                stack.pop()
                if path:
                    path.pop()
            elif isinstance(value, float) and not math.isfinite(value):
                if self.full:
                    self.pass_over()
                    return
                pointer = "".join(f"/{token(step)}" for step in [*path, str(key)])
                self.note(
                    pointer,
                    f"got {value}, expected a finite number",
                    "JSON knows neither NaN nor Infinity, and a float nothing above 1.8e308",
                )
            elif isinstance(value, dict | list) and not _plain(value):
                if len(stack) > _MAX_DEPTH:
                    self.note(name, f"is nested deeper than {_MAX_DEPTH} levels")
                    return
                stack.append(_items(value))
                path.append(str(key))

    def object(
        self, value: Any, pointer: str, required: Sequence[str], optional: Sequence[str] = ()
    ) -> dict[str, Any] | None:
        """An object with these keys and no others."""
        if not isinstance(value, dict):
            self.note(pointer, f"got {shown(value)}, expected an object")
            return None
        known = [*required, *optional]
        expected = frozenset(known)
        unknown = [key for key in value if key not in expected]
        told = unknown[: _MAX_PROBLEMS - len(self.problems)]
        for key in told:
            unused = [word for word in known if word not in value]
            self.note(f"{pointer}/{token(key)}", "unknown key", nearest(key, unused))
        self.pass_over(len(unknown) - len(told))
        for key in required:
            if key not in value:
                self.note(f"{pointer}/{key}", "missing")
        return value

    def number(
        self, value: Any, pointer: str, low: float = -math.inf, high: float = math.inf, unit: str = ""
    ) -> float | None:
        """A finite number from low to high."""
        expected = f"a number from {low:g} to {high:g}" + (f" {unit}" if unit else "")
        if isinstance(value, bool) or not isinstance(value, int | float):
            self.note(pointer, f"got {shown(value)}, expected {expected}")
            return None
        if isinstance(value, float) and not math.isfinite(value):
            return None  # noted by `load`
        if not low <= value <= high:
            self.note(pointer, f"got {shown(value)}, expected {expected}")
            return None
        return float(value)

    def integer(self, value: Any, pointer: str, low: int, high: int) -> int | None:
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(value, float) and value.is_integer():
            value, whole = int(value), True
        if not whole or not low <= value <= high:
            self.note(pointer, f"got {shown(value)}, expected a whole number from {low} to {high}")
            return None
        return int(value)

    def array(self, value: Any, pointer: str, length: int | None = None, order: str = "") -> list[Any] | None:
        """A list, of this length where one is given. `order` says what its items are: "[z, y, x]"."""
        expected = f"a list of {length} items {order}".rstrip() if length is not None else "a list"
        if not isinstance(value, list):
            self.note(pointer, f"got {shown(value)}, expected {expected}")
            return None
        if length is not None and len(value) != length:
            self.note(pointer, f"has {len(value)} items, expected {length} {order}".rstrip())
            return None
        return value

    def numbers(
        self,
        value: Any,
        pointer: str,
        length: int | None = None,
        low: float = -math.inf,
        high: float = math.inf,
        order: str = "",
    ) -> list[float] | None:
        """A list of finite numbers from low to high."""
        items = self.array(value, pointer, length, order)
        if items is None:
            return None
        read: list[float] = []
        for i, item in enumerate(items):
            if type(item) in (int, float) and low <= item <= high:
                read.append(float(item))
            elif self.full:
                self.pass_over()
                break
            else:
                self.number(item, f"{pointer}/{i}", low, high)
        return read if len(read) == len(items) else None

    def text(self, value: Any, pointer: str, longest: int = 255) -> str | None:
        """Non-empty text without control characters."""
        if not isinstance(value, str) or not value.strip() or len(value) > longest:
            self.note(pointer, f"got {shown(value)}, expected text of 1 to {longest} characters")
            return None
        if not value.isprintable():
            self.note(pointer, f"got {shown(value)}, expected text without control characters")
            return None
        return value

    def choice(self, value: Any, pointer: str, choices: Sequence[str]) -> str | None:
        if value not in choices:
            hint = nearest(value, choices) if isinstance(value, str) else ""
            self.note(pointer, f"got {shown(value)}, expected one of {', '.join(choices)}", hint)
            return None
        return str(value)
