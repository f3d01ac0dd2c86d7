"""Digests that a client sends along with a chunk: `Content-Digest` (RFC 9530) and tus `Upload-Checksum`."""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from typing import Protocol, Self

TUS_ALGORITHMS = ("sha1", "sha256", "sha512")  # tus asks every server to know sha1
_CONTENT = {"sha-256": "sha256", "sha-512": "sha512"}
_MEMBER = re.compile(r"([a-z0-9*_.-]+)=:([A-Za-z0-9+/]*={0,2}):")


class BadDigest(Exception):
    """The header cannot be understood; the text says which."""


class Hash(Protocol):
    def update(self, data: bytes | memoryview, /) -> None: ...
    def digest(self) -> bytes: ...
    def hexdigest(self) -> str: ...
    def copy(self) -> Self: ...


class Claim:
    """What one chunk should hash to. `status` is the answer if it does not."""

    def __init__(self, header: str, status: int, algorithm: str, expected: bytes) -> None:
        self.header, self.status = header, status
        self._expected = expected
        self._hash: Hash = hashlib.new(algorithm)
        if len(expected) != len(self._hash.digest()):
            raise BadDigest(f"the digest in {header} has another length than {algorithm} gives")

    def update(self, data: bytes) -> None:
        self._hash.update(data)

    def holds(self) -> bool:
        return self._hash.digest() == self._expected


def claims(content_digest: str | None, upload_checksum: str | None) -> list[Claim]:
    """The digests to check. An algorithm that RFC 9530 allows and this server lacks is passed over."""
    found = []
    for member in (content_digest or "").split(",") if content_digest is not None else ():
        match = _MEMBER.fullmatch(member.strip())
        if match is None:
            raise BadDigest("Content-Digest is not of the form sha-256=:base64:")
        if match[1] in _CONTENT:
            found.append(Claim("Content-Digest", 400, _CONTENT[match[1]], _decoded("Content-Digest", match[2])))
    if upload_checksum is not None:
        algorithm, _, value = upload_checksum.strip().partition(" ")
        if algorithm not in TUS_ALGORITHMS:
            raise BadDigest(f"Upload-Checksum takes {', '.join(TUS_ALGORITHMS)}, then a space and the digest in base64")
        found.append(Claim("Upload-Checksum", 460, algorithm, _decoded("Upload-Checksum", value)))
    return found


def content_digest(sha256: str) -> str:
    """A hexadecimal sha256 as RFC 9530 writes it."""
    return f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"


def _decoded(header: str, text: str) -> bytes:
    try:
        return base64.b64decode(text.strip(), validate=True)
    except binascii.Error:
        raise BadDigest(f"the digest in {header} is not base64") from None
