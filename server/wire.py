"""How uvicorn listens: its HTTP protocol, with an end to how long a request's head may go on.

httptools keeps a header until it is whole, and has no limit of its own: one that never ends would fill the
memory before any middleware is asked. Heads that do end are judged by `server.guard`, which answers in full.
"""

from __future__ import annotations

from typing import Any

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from server.limits import HEAD_BYTES

_REFUSAL = (
    b"HTTP/1.1 431 Request Header Fields Too Large\r\n"
    b"content-type: application/problem+json\r\ncontent-length: 0\r\nconnection: close\r\n\r\n"
)


class BoundedHead(HttpToolsProtocol):
    """Closes a connection on which more than `HEAD_BYTES` came without a head being whole, or in the trailers of a
    body that came in chunks: headers again, which would be kept, too."""

    _pending = 0  # bytes of a head, or of what follows the last byte of a body
    _in_body = False

    def data_received(self, data: bytes) -> None:
        self._pending += len(data)
        super().data_received(data)
        if self._pending > HEAD_BYTES and not self.transport.is_closing():
            self.transport.write(_REFUSAL)
            self.transport.close()

    def on_body(self, body: bytes) -> None:
        super().on_body(body)
        self._pending = 0

    def on_headers_complete(self) -> None:
        self._in_body, self._pending = True, 0
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        super().on_message_complete()
        self._in_body, self._pending = False, 0


def uvicorn_config(app: Any, host: str, port: int, **more: Any) -> uvicorn.Config:
    """The server's, for any app; `bench.load` puts another one behind it. `more`: what uvicorn.Config takes."""
    return uvicorn.Config(
        app,
        http=BoundedHead,
        host=host,
        port=port,
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=5,
        **more,
    )
