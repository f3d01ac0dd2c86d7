"""Uploads that are cut at random, and whether what is committed in the end is what was sent."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import json
import random
import signal
import socket
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
import tifffile

from bench.service import Service

# How one upload is disturbed, and of how many: killing the server takes the longest.
KINDS = {"client": 40, "server": 10, "overlap": 20, "repeat": 15, "reorder": 15}
_VIEWS = 12
_STACK = "projections.tif"
_AGAIN_S = 60.0  # for a killed server to come back


@dataclass
class UploadOutcome:
    """What was found."""

    uploads: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    corrupt: list[str] = field(default_factory=list)  # committed, and not what was sent
    refused: list[str] = field(default_factory=list)  # could not be brought to an end: why
    bytes: int = 0
    sent_again: list[int] = field(default_factory=list)  # bytes of each upload that the server had been given before
    chunks_sent_again: list[float] = field(default_factory=list)  # the same, in chunks of that upload

    def good(self) -> bool:
        return not (self.corrupt or self.refused) and max(self.chunks_sent_again, default=0.0) < 1

    def to_json(self) -> dict[str, Any]:
        most = round(max(self.chunks_sent_again, default=0.0), 4)
        summary = {"faults": dict(self.faults), "sent_again": sum(self.sent_again), "most_chunks_sent_again": most}
        return {key: value for key, value in vars(self).items() if key != "chunks_sent_again"} | summary

    def table(self) -> str:
        kinds = ", ".join(f"{kind} {self.faults[kind]}" for kind in KINDS)
        again = f"{sum(self.sent_again)}, {max(self.chunks_sent_again, default=0.0):.3f}"
        rows = [
            (f"uploads ({kinds})", str(self.uploads)), ("bytes", str(self.bytes)),
            ("**corrupt commits**", str(len(self.corrupt))), ("**not committed**", str(len(self.refused))),
            ("bytes sent again; most of one upload, in chunks", again),
        ]  # fmt: skip
        bad = "".join(f"\n- {line}" for line in (*self.corrupt, *self.refused))
        return "\n".join(f"| {name} | {value} |" for name, value in rows) + f"\n{bad}\n"


def run_uploads(service: Service, count: int, seed: int, say: Callable[[str], None]) -> UploadOutcome:
    """So many uploads, one after the other, each disturbed once."""
    outcome = UploadOutcome()
    for number in range(count):
        rng = random.Random(f"{seed}/{number}")
        kind = rng.choices(list(KINDS), list(KINDS.values()))[0]
        upload = DisturbedUpload(service, rng)
        try:
            upload.run(kind)
        except (httpx.HTTPError, OSError, TimeoutError, Unexpected) as failure:
            outcome.refused.append(f"upload {number} ({kind}): {type(failure).__name__}: {failure}"[:300])
        else:
            if not upload.is_whole():
                outcome.corrupt.append(f"upload {number} ({kind}): the scan {upload.id} is not what was sent")
        outcome.uploads += 1
        outcome.faults[kind] += 1
        outcome.bytes += len(upload.data)
        outcome.sent_again.append(upload.sent_again)
        outcome.chunks_sent_again.append(upload.sent_again / upload.chunk)
        if (number + 1) % 50 == 0:
            say(f"{number + 1} of {count} uploads")
    return outcome


class Unexpected(Exception):
    """An answer that the protocol does not have here."""


class DisturbedUpload:
    """One scan on its way, in chunks, one of which meets a fault."""

    def __init__(self, service: Service, rng: random.Random) -> None:
        self._service, self._rng = service, rng
        self._http = httpx.Client(base_url=service.url, trust_env=False, timeout=30)
        side = rng.choice((32, 64, 128, 256))
        self._scan, self.data = noise_scan(side, rng.randrange(2**32))
        self.chunk = rng.randrange(len(self.data) // 8, len(self.data))
        self._with_digests = rng.random() < 0.5
        self.id = ""
        self.sent_again = 0

    def run(self, kind: str) -> None:
        with self._http:
            files: list[dict[str, Any]] = [
                {"name": "scan.json", "size": len(self._scan)}, {"name": _STACK, "size": len(self.data)}
            ]  # fmt: skip
            if self._rng.random() < 0.5:
                files[1]["sha256"] = hashlib.sha256(self.data).hexdigest()
            made = self._http.post("/v1/uploads", json={"name": "cut", "files": files}).raise_for_status()
            self.id = made.json()["id"]
            self._http.put(f"/v1/uploads/{self.id}/files/scan.json", content=self._scan).raise_for_status()
            at, when = 0, self._rng.randrange(-(-len(self.data) // self.chunk))
            while at < len(self.data):
                if when == 0:
                    getattr(self, f"_{kind}")(at)
                    at = self._stands_at()
                else:
                    at = self._send(at)
                when -= 1
            self._http.post(f"/v1/uploads/{self.id}/commit").raise_for_status()

    def is_whole(self) -> bool:
        """Whether the scan on the server's disk is, byte for byte, what was sent."""
        folder = self._service.data / "scans" / self.id
        return (folder / _STACK).read_bytes() == self.data and (folder / "scan.json").read_bytes() == self._scan

    # The faults

    def _client(self, at: int) -> None:
        """The client dies in the middle of a chunk."""
        piece = self._piece(at)
        cut = self._rng.randrange(len(piece))
        connection = self._begin(at, piece, cut)
        with contextlib.suppress(TimeoutError):  # some of it may have arrived, or none
            connection.settimeout(self._rng.uniform(0.001, 0.05))
            connection.recv(1)
        if self._rng.random() < 0.5:  # by a reset; else by an end
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
        self.sent_again += at + cut - self._stands_at()

    def _server(self, at: int) -> None:
        """The server dies in the middle of a chunk, or right after it."""
        piece = self._piece(at)
        cut = self._rng.randrange(len(piece) + 1)
        connection = self._begin(at, piece, cut)
        with contextlib.suppress(TimeoutError, ConnectionError):
            connection.settimeout(self._rng.uniform(0.001, 0.2))
            connection.recv(1)
        self._service.server.signal(signal.SIGKILL)
        connection.close()
        self._service.until(self._service.server.has_died, 10, "the server is dead")
        self._service.until(lambda: self._service.jobs() is not None, _AGAIN_S, "the server answers again")
        self.sent_again += at + cut - self._stands_at()

    def _overlap(self, at: int) -> None:
        """Two connections send the same chunk."""
        piece = self._piece(at)
        cut = self._rng.randrange(len(piece))
        connection = self._begin(at, piece, cut)
        answer = self._patch(at, piece)
        if answer.status_code not in (204, 409):
            raise Unexpected(f"an overlapping chunk was answered with {answer.status_code}: {answer.text[:200]}")
        with contextlib.suppress(OSError):  # the newer request has ended this one
            connection.sendall(piece[cut:])
        connection.close()

    def _repeat(self, at: int) -> None:
        """A chunk is sent twice, as if its answer had been lost."""
        after = self._send(at)
        answer = self._patch(at, self._piece(at))
        if answer.status_code != 409 or int(answer.headers["Upload-Offset"]) != after:
            raise Unexpected(f"a repeated chunk was answered with {answer.status_code}: {answer.text[:200]}")

    def _reorder(self, at: int) -> None:
        """A later chunk comes first."""
        later = min(at + self.chunk, len(self.data) - 1)
        answer = self._patch(later, self._piece(later))
        if (later != at and answer.status_code != 409) or answer.status_code not in (204, 409):
            raise Unexpected(f"a later chunk was answered with {answer.status_code}: {answer.text[:200]}")

    # What all of them use

    def _piece(self, at: int) -> bytes:
        return self.data[at : at + self.chunk]

    @property
    def _path(self) -> str:
        return f"/v1/uploads/{self.id}/files/{_STACK}"

    def _headers(self, at: int, piece: bytes) -> dict[str, str]:
        headers = {"Content-Type": "application/offset+octet-stream", "Upload-Offset": str(at)}
        if self._with_digests:
            digest = base64.b64encode(hashlib.sha256(piece).digest()).decode()
            headers["Content-Digest"] = f"sha-256=:{digest}:"
        return headers

    def _patch(self, at: int, piece: bytes) -> httpx.Response:
        return self._http.patch(self._path, content=piece, headers=self._headers(at, piece))

    def _send(self, at: int) -> int:
        answer = self._patch(at, self._piece(at))
        if answer.status_code != 204:
            raise Unexpected(f"a chunk at {at} was answered with {answer.status_code}: {answer.text[:200]}")
        return int(answer.headers["Upload-Offset"])

    def _begin(self, at: int, piece: bytes, cut: int) -> socket.socket:
        """A connection on which a chunk has been sent as far as `cut`."""
        headers = self._headers(at, piece) | {"Host": "localhost", "Content-Length": str(len(piece))}
        head = f"PATCH {self._path} HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in headers.items())
        url = httpx.URL(self._service.url)
        connection = socket.create_connection((url.host, url.port), timeout=30)
        connection.sendall(head.encode() + b"\r\n" + piece[:cut])
        return connection

    def _stands_at(self) -> int:
        return int(self._http.head(self._path).raise_for_status().headers["Upload-Offset"])


def noise_scan(side: int, seed: int) -> tuple[bytes, bytes]:
    """scan.json and a stack of noise, in which no two chunks are alike."""
    pixels = np.random.default_rng(seed).random((_VIEWS, side, side), np.float32)
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, photometric="minisblack")
    scan = {
        "format": "splatct-scan/1", "projections": {"files": [_STACK], "kind": "line_integrals"},
        "geometry": {
            "beam": "cone", "dso_mm": 500.0, "dsd_mm": 700.0, "angles_deg": [30.0 * view for view in range(_VIEWS)],
            "detector": {"rows": side, "cols": side, "pixel_mm": [1.0, 1.0]},
        },
    }  # fmt: skip
    return json.dumps(scan).encode(), out.getvalue()
