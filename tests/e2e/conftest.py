"""The real server in a thread of the test's own process, without Redis: see stage.py for who works."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import uvicorn

from server.app import create_app
from server.settings import Settings

from .stage import Stage, wait_until

NO_REDIS = "redis://127.0.0.1:1/0"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path / "data")
    config = uvicorn.Config(
        create_app(Settings(data=made.data, redis_url=NO_REDIS)), port=0, log_level="error", ws="none", lifespan="on"
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    wait_until(lambda: server.started)
    made.url = f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    yield made
    server.should_exit = True
    thread.join(10)
    made.database.close()
