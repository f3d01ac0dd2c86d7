"""Upload throughput beside that of a bare sink, in turns, so that all meet the same machine."""

from __future__ import annotations

import contextlib
import os
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from bench.load.figures import Figure, Measured
from bench.load.senders import MIB, Send, announce, give_up, patch, put
from bench.service import in_passing

SHARE = 60.0  # percent of the sink's throughput that is asked for
_START_S = 30.0


def uploads(rounds: int, single_mib: int, parallel_mib: int, say: Callable[[str], None]) -> Measured:
    """`rounds` times each: one sender of `single_mib`, then four of `parallel_mib` each."""
    found: dict[str, dict[str, list[float]]] = {}
    with in_passing(workers=0) as service, _sink(service.data.parent, False) as bare, _sink(
        service.data.parent, True
    ) as durable:  # fmt: skip
        ways: dict[str, Callable[[int, int], float]] = {
            "sink": lambda senders, size: _to_sink(bare, service.data.parent, senders, size),
            "PUT": lambda senders, size: _to_service(service.url, put, senders, size),
            "sink + fsync": lambda senders, size: _to_sink(durable, service.data.parent, senders, size),
            "PATCH": lambda senders, size: _to_service(service.url, patch, senders, size),
        }
        for way in ways.values():  # nobody's first call is to count
            way(1, 8 * MIB)
        for number in range(rounds):
            for senders, size in ((1, single_mib * MIB), (4, parallel_mib * MIB)):
                for name, way in ways.items():
                    os.sync()  # what the one before left to be written is not this one's to wait for
                    rate = senders * size / way(senders, size) / MIB
                    found.setdefault(_among(senders), {}).setdefault(name, []).append(rate)
            say(f"uploads: round {number + 1} of {rounds}")
    figures = [figure for among, rates in found.items() for figure in _figures(among, rates)]
    how = (
        f"{rounds} rounds in turns, medians; {single_mib} MiB from one sender, {parallel_mib} MiB from each of four. "
        "The sink writes the body to a file and neither hashes nor syncs; `+ fsync` syncs before it answers. Ours "
        "hashes, and syncs every byte before it is acknowledged. PATCH in chunks of 32 MiB (tus), each acknowledged."
    )
    return Measured("Upload throughput", how, figures, found)


def _figures(among: str, rates: dict[str, list[float]]) -> list[Figure]:
    figures = [Figure(f"{among}: {way}", statistics.median(rates[way]), "MiB/s") for way in rates]
    for way in ("PUT", "PATCH"):
        for sink, least in (("sink", SHARE), ("sink + fsync", None)):
            shares = [100 * ours / theirs for ours, theirs in zip(rates[way], rates[sink], strict=True)]
            figures.append(Figure(f"{among}: {way} of {sink}", statistics.median(shares), "%", at_least=least))
    return figures


def _among(senders: int) -> str:
    return "one sender" if senders == 1 else f"{senders} senders"


def _to_sink(url: str, folder: Path, senders: int, size: int) -> float:
    paths = [f"{url}/{number}.bin" for number in range(senders)]
    seconds = _timed(put, paths, size)
    for number in range(senders):
        (folder / f"{number}.bin").unlink()
    return seconds


def _to_service(url: str, send: Send, senders: int, size: int) -> float:
    opened = [announce(url, size) for _ in range(senders)]
    seconds = _timed(send, [f"{upload}/files/projections.tif" for upload in opened], size)
    for upload in opened:
        give_up(upload)
    return seconds


def _timed(send: Send, paths: list[str], size: int) -> float:
    with ThreadPoolExecutor(len(paths)) as pool:
        began = time.perf_counter()
        for done in [pool.submit(send, path, size) for path in paths]:
            done.result()
        return time.perf_counter() - began


@contextlib.contextmanager
def _sink(folder: Path, fsync: bool) -> Iterator[str]:
    """The address of one that runs meanwhile."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "bench.load.sink", str(port), str(folder), "--tie-to", str(os.getpid())]
    process = subprocess.Popen([*command, *(["--fsync"] if fsync else [])])
    try:
        deadline = time.monotonic() + _START_S
        while not _listens(port):
            if process.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError(f"the sink did not start; its exit code is {process.poll()}")
            time.sleep(0.05)
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


def _listens(port: int) -> bool:
    with contextlib.suppress(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), 1).close()
        return True
    return False
