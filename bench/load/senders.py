"""Sends bodies over a bare socket: what a client costs must not be what is measured."""

from __future__ import annotations

import http.client
import json
import os
import socket
from collections.abc import Callable
from typing import Any
from urllib.parse import urlsplit

MIB = 1 << 20
BLOCK = os.urandom(4 * MIB)
CHUNK = 32 * MIB  # of a PATCH, as the batch client has it
PATIENCE_S = 300.0

Send = Callable[[str, int], None]  # to an address, so many bytes; returns when the answer is there


def put(url: str, size: int) -> None:
    """One request with the whole body."""
    with _connection(url) as connection:
        _exchange(connection, "PUT", url, size, "Content-Type: application/octet-stream\r\n", (200,))


def patch(url: str, size: int) -> None:
    """tus: chunk by chunk on one connection."""
    with _connection(url) as connection:
        for at in range(0, size, CHUNK):
            head = f"Tus-Resumable: 1.0.0\r\nContent-Type: application/offset+octet-stream\r\nUpload-Offset: {at}\r\n"
            _exchange(connection, "PATCH", url, min(CHUNK, size - at), head, (204,))


def announce(server: str, size: int) -> str:
    """An upload with one file; the address of that upload."""
    body = {"name": "load", "files": [{"name": "scan.json", "size": 2}, {"name": "projections.tif", "size": size}]}
    return f"{server}/v1/uploads/{ask(server, 'POST', '/v1/uploads', body)['id']}"


def give_up(upload: str) -> None:
    ask(upload, "DELETE", urlsplit(upload).path)


def ask(server: str, method: str, path: str, body: Any = None) -> Any:
    """The JSON of an answer; None if it has no body."""
    data = fetch(server, path, method, body)
    return json.loads(data) if data else None


def fetch(server: str, path: str, method: str = "GET", body: Any = None) -> bytes:
    """The body of an answer, on a connection of its own. Raises RuntimeError on 4xx and 5xx."""
    where = urlsplit(server)
    connection = http.client.HTTPConnection(str(where.hostname), where.port, timeout=PATIENCE_S)
    try:
        text = None if body is None else json.dumps(body)
        connection.request(method, path, text, {"Content-Type": "application/json"} if text else {})
        answer = connection.getresponse()
        data = answer.read()
    finally:
        connection.close()
    if answer.status >= 400:
        raise RuntimeError(f"{method} {path} was answered with {answer.status}: {data[:300]!r}")
    return data


def _connection(url: str) -> socket.socket:
    where = urlsplit(url)
    return socket.create_connection((str(where.hostname), where.port or 80), timeout=PATIENCE_S)


def _exchange(connection: socket.socket, method: str, url: str, size: int, head: str, good: tuple[int, ...]) -> None:
    request = f"{method} {urlsplit(url).path} HTTP/1.1\r\nHost: localhost\r\n{head}Content-Length: {size}\r\n\r\n"
    connection.sendall(request.encode())
    block = memoryview(BLOCK)
    for at in range(0, size, len(block)):
        connection.sendall(block[: min(len(block), size - at)])
    answer = http.client.HTTPResponse(connection, method=method)
    answer.begin()
    said = answer.read()
    if answer.status not in good:
        raise RuntimeError(f"{method} {url} was answered with {answer.status}: {said[:300]!r}")
