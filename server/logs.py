"""Log lines: one JSON object each, or plain text. Within a request every line carries the request's id."""

from __future__ import annotations

import json
import logging
from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Any

request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def configure(style: str) -> None:
    """Everything to stderr, in the `style` of the setting `log_format`."""
    handler = logging.StreamHandler()
    handler.setFormatter(Json() if style == "json" else Text())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    for library in ("httpx", "httpcore"):  # they would write down webhooks' addresses, and those hold secrets
        logging.getLogger(library).setLevel(logging.WARNING)


def _fields(record: logging.LogRecord) -> dict[str, Any]:
    """What the caller gave as `extra={"fields": …}`, and the request's id."""
    known: dict[str, Any] = getattr(record, "fields", {})
    current = request_id.get()
    return known if current is None else {"request_id": current, **known}


class Json(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "at": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **_fields(record),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class Text(logging.Formatter):
    def __init__(self) -> None:
        super().__init__("%(asctime)s %(name)s %(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        fields = "".join(f" {name}={value}" for name, value in _fields(record).items() if value is not None)
        return _on_one_line(super().formatMessage(record) + fields)


def _on_one_line(text: str) -> str:
    """Without characters that would end the line, or move the cursor: a path or a name may hold any."""
    return "".join(char if char.isprintable() else ascii(char)[1:-1] for char in text)
