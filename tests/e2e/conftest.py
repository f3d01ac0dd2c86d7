"""The real server in a thread of the test's own process, without Redis: see stage.py for who works."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import uvicorn
from playwright.sync_api import Browser, Page, sync_playwright

from server.app import create_app
from server.settings import Settings

from .chromium import ARGUMENTS, CHROMIUM
from .stage import Stage, wait_until

NO_REDIS = "redis://127.0.0.1:1/0"


class Serving:
    """A server that can be stopped and started again at the same address."""

    def __init__(self, data: Path) -> None:
        self._data = data
        self.port = 0
        self.start()

    def start(self) -> None:
        self._app = create_app(Settings(data=self._data, redis_url=NO_REDIS))
        config = uvicorn.Config(self._app, port=self.port, log_level="error", ws="none", lifespan="on")
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        wait_until(lambda: self._server.started)
        self.port = self._server.servers[0].sockets[0].getsockname()[1]

    def stop(self) -> None:
        self._app.state.service.watch.close()  # as a signal would: streams end
        self._server.should_exit = True
        self._thread.join(10)


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path / "data")
    serving = Serving(made.data)
    made.url, made.stop, made.start_again = f"http://127.0.0.1:{serving.port}", serving.stop, serving.start
    yield made
    serving.stop()
    made.database.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser: Browser, stage: Stage) -> Iterator[Page]:
    """A page that may say nothing on the console and ask nobody but the server."""
    context = browser.new_context(base_url=stage.url, viewport={"width": 1200, "height": 900})
    page = context.new_page()
    complaints: list[str] = []
    asked: set[str] = set()
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("request", lambda request: asked.add(urlsplit(request.url).netloc))
    yield page
    context.close()
    assert complaints == []
    assert asked == {urlsplit(stage.url).netloc}
