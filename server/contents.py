"""Which bytes a tenant already has: files of its committed scans, by SHA-256 and size."""

from __future__ import annotations

from collections.abc import Sequence

import sqlalchemy as sa

from server.store import File, Store, files, uploads

_AT_ONCE = 500  # digests of one query; databases limit what a statement may carry


def find(store: Store, wanted: Sequence[File]) -> dict[str, tuple[str, str]]:
    """Of the files that tell their digest, by name: the scan that has the same bytes, and the name there."""
    assert store.tenant is not None, "what one tenant has is no other's to find"
    asked = sorted({file.expected_sha256 for file in wanted if file.expected_sha256})
    there: dict[tuple[str, int], tuple[str, str]] = {}
    with store.database.reading() as read:
        for start in range(0, len(asked), _AT_ONCE):
            query = (
                sa.select(files.c.sha256, files.c.size, files.c.upload_id, files.c.name)
                .join(uploads, uploads.c.id == files.c.upload_id)
                .where(uploads.c.tenant == store.tenant, uploads.c.committed)
                .where(files.c.sha256.in_(asked[start : start + _AT_ONCE]))
            )
            for sha256, size, scan_id, name in read.execute(query):
                there[sha256, size] = (scan_id, name)
    found = {file.name: there.get((file.expected_sha256 or "", file.size)) for file in wanted}
    return {name: source for name, source in found.items() if source is not None}
