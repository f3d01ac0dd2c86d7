"""Test mode: drops a share of the uploads midway, as a bad network would, so that clients can be tested against it."""

from __future__ import annotations

import random
import re

from starlette.types import ASGIApp, Message, Receive, Scope, Send

_FILE = re.compile(r"^/v1/uploads/[^/]+/files/[^/]+$")


class DropUploads:
    """Cuts the connection somewhere in the body. What had arrived until then is treated as after any cut."""

    def __init__(self, app: ASGIApp, share: float, seed: int = 0) -> None:
        self._app, self._share, self._rng = app, share, random.Random(seed)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        sends = scope["type"] == "http" and scope["method"] in ("PUT", "PATCH") and _FILE.match(scope["path"])
        if not sends or self._rng.random() >= self._share:
            await self._app(scope, receive, send)
            return
        length = int(dict(scope["headers"]).get(b"content-length", b"65536"))
        left = self._rng.randrange(max(length, 1))

        async def cut() -> Message:
            nonlocal left
            message = await receive()
            if message["type"] == "http.request":
                left -= len(message.get("body", b""))
                if left < 0:
                    return {"type": "http.disconnect"}
            return message

        async def unheard(message: Message) -> None:
            """Whatever is answered does not arrive."""

        await self._app(scope, cut, unheard)
        # An answer that is begun and not ended makes the server close the connection.
        await send({"type": "http.response.start", "status": 500, "headers": []})
