"""The least that can take an upload: an ASGI app that writes the body to a file, under the server's uvicorn settings.

python -m bench.load.sink PORT FOLDER [--fsync]
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import uvicorn

from server.wire import uvicorn_config
from worker.lifeline import die_with_parent


def sink(folder: Path, fsync: bool) -> Any:
    async def app(scope: Any, receive: Any, send: Any) -> None:
        assert scope["type"] == "http"
        with (folder / scope["path"].strip("/")).open("wb") as file:
            more = True
            while more:
                message = await receive()
                file.write(message.get("body", b""))
                more = message.get("more_body", False)
            if fsync:
                file.flush()
                os.fsync(file.fileno())
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"0")]})
        await send({"type": "http.response.body"})

    return app


def main() -> None:
    parser = argparse.ArgumentParser("python -m bench.load.sink")
    parser.add_argument("port", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--fsync", action="store_true")
    parser.add_argument("--tie-to", type=int, required=True)
    given = parser.parse_args()
    die_with_parent(given.tie_to)
    uvicorn.Server(uvicorn_config(sink(given.folder, given.fsync), "127.0.0.1", given.port, lifespan="off")).run()


if __name__ == "__main__":
    main()
