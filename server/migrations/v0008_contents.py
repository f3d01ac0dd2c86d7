"""Version 8: files can be found by their digest."""

from __future__ import annotations

import sqlalchemy as sa


def upgrade(write: sa.Connection) -> None:
    write.execute(sa.text("CREATE INDEX ix_upload_files_sha256 ON upload_files (sha256)"))
