"""Weak entity tags of JSON answers, and the condition that names them."""

from __future__ import annotations

import hashlib

from pydantic import BaseModel


def weak_etag(body: BaseModel) -> str:
    return f'W/"{hashlib.sha256(body.model_dump_json().encode()).hexdigest()[:20]}"'


def matches(if_none_match: str | None, etag: str) -> bool:
    """Whether an If-None-Match header names `etag`, by the weak comparison of RFC 9110."""
    if if_none_match is None:
        return False
    named = [tag.strip() for tag in if_none_match.split(",")]
    return "*" in named or etag.removeprefix("W/") in [tag.removeprefix("W/") for tag in named]
