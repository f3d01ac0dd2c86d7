"""The service as one tree of processes: `splatct up` is its root, and nothing outlives it."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from server.children import Child, stop_all
from server.opening import make_ready
from server.redisserver import OwnRedis, RedisUnavailable
from server.settings import Settings, SettingsError

log = logging.getLogger("splatct.up")

TICK_S = 0.2
STOP_S = 15.0


def run_everything(settings: Settings, workers: int, has_redis: bool, ready: Callable[[str], None]) -> int:
    """Run until SIGINT or SIGTERM. `ready` is called once, with the URL, when the server answers."""
    if workers < 1:
        raise SettingsError(f"workers: got {workers}, expected 1 or more")
    settings = settings.model_copy(update={"port": _free_port(settings.host, settings.port)})
    stop = threading.Event()
    for which in (signal.SIGINT, signal.SIGTERM):
        signal.signal(which, lambda *_: stop.set())
    make_ready(settings)
    with _only_one(settings.data), contextlib.ExitStack() as cleanup:
        redis = None
        if not has_redis:
            redis = OwnRedis(settings.data / "redis")
            redis.start()
            cleanup.callback(redis.stop)
            settings = settings.model_copy(update={"redis_url": redis.url})
        environment = settings.to_environment()
        children = [Child("server", "server", [], environment)]
        children += [Child(f"worker {n + 1}", "worker", [], environment) for n in range(workers)]
        cleanup.callback(stop_all, children, STOP_S)
        _tend(settings, children, redis, stop, ready)
    return 0


def _tend(
    settings: Settings,
    children: list[Child],
    redis: OwnRedis | None,
    stop: threading.Event,
    ready: Callable[[str], None],
) -> None:
    announced = False
    while not stop.is_set():
        if redis is not None and not redis.alive():
            log.warning("Redis ended; starting it again")
            try:
                redis.start()
            except RedisUnavailable as error:
                log.error("%s", error)
        for child in children:
            child.tend()
        if not announced and _answers(settings.host, settings.port):
            announced = True
            ready(f"http://{settings.host}:{settings.port}")
        stop.wait(TICK_S)


def _free_port(host: str, port: int) -> int:
    """The port, if it can be had; any free one for 0."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            raise SettingsError(f"port: {port} is taken by another program; choose one with --port") from None
        return int(probe.getsockname()[1])


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), 0.5).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def _only_one(data: Path) -> Iterator[None]:
    """Refuse a second `splatct up` on one data folder."""
    descriptor = os.open(data / ".up.lock", os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise SettingsError(f"data: {data} is in use by another `splatct up`") from None
        yield
    finally:
        os.close(descriptor)
