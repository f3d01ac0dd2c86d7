"""The application object, without its lifespan and without a socket."""

from __future__ import annotations

import asyncio
from pathlib import Path

import httpx

from server.app import create_app
from server.settings import Settings


def test_a_bug_is_a_problem_without_a_traceback(tmp_path: Path) -> None:
    app = create_app(Settings(data=tmp_path))  # its lifespan has not begun: every route that needs the store fails

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.get("/v1/scans")

    answer = asyncio.run(ask())
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "urn:splatct:problem:internal-server-error" and "State" not in answer.text


def test_building_an_app_touches_nothing(tmp_path: Path) -> None:
    create_app(Settings(data=tmp_path / "data", redis_url="redis://nowhere.invalid:1/0"))
    assert list(tmp_path.iterdir()) == []
