"""The real client against the real server, killed with SIGKILL while it sends: the same command goes on from there."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import re
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from splatct_client.resume import CHUNK

from .stack import PYTHONPATH, SCAN, Stack


class Scanner:
    """A PC with a scan, and the client's own state somewhere else."""

    def __init__(self, stack: Stack, folder: Path) -> None:
        self.stack, self.folder, self.state = stack, folder / "scan", folder / "state"
        self.folder.mkdir(parents=True)

    def describe(self, files: list[str], views: int, edge: int) -> None:
        detector = {"rows": edge, "cols": edge, "pixel_mm": [2.0, 2.0], "offset_mm": [0.0, 0.0]}
        angles = [360 / views * view for view in range(views)]
        scan = SCAN | {
            "projections": {"files": files, "kind": "line_integrals", "scale": 1.0},
            "geometry": SCAN["geometry"] | {"detector": detector, "angles_deg": angles},
        }
        (self.folder / "scan.json").write_text(json.dumps(scan))

    def write(self, name: str, pixels: Any) -> Path:
        path = self.folder / name
        tifffile.imwrite(path.with_suffix(".part"), pixels, photometric="minisblack")
        return path.with_suffix(".part").rename(path)

    def start(self, *arguments: str, server: str = "") -> subprocess.Popen[str]:
        server = server or str(self.stack.http.base_url)
        command = [sys.executable, "-m", "splatct_client", *arguments, "--server", server]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("SPLATCT_")}
        environment |= {"PYTHONPATH": PYTHONPATH, "XDG_STATE_HOME": str(self.state)}
        return subprocess.Popen(
            command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace"
        )

    def killed_again_and_again(self, after_bytes: int, pause_s: Callable[[], float]) -> tuple[int, str]:
        """Submit, and kill the client a moment after so many bytes, until one run comes to its end. How many were,
        and what the last one said."""
        kills = 0
        while True:
            process, goal = self.start("submit", str(self.folder)), self.received() + after_bytes
            while process.poll() is None and self.received() < goal:
                time.sleep(0.02)
            time.sleep(pause_s())
            process.kill()
            _, err = process.communicate()
            assert len(self.uploads()) <= 1, "no second upload is begun"
            if process.returncode != -signal.SIGKILL:
                assert process.returncode == 0, err
                return kills, err
            kills += 1

    def run(self, *arguments: str) -> dict[str, Any]:
        process = self.start(*arguments, "--json")
        out, err = process.communicate(timeout=120)
        assert process.returncode == 0, err
        return dict(json.loads(out))

    def received(self) -> int:
        """Bytes of files that the server got, ever."""
        text = self.stack.http.get("/metrics").text
        found = re.search(r"^splatct_upload_bytes_total ([0-9.e+]+)$", text, re.MULTILINE)
        assert found is not None
        return int(float(found[1]))

    def sent(self, *names: str) -> int:
        return sum((self.folder / name).stat().st_size for name in names)

    def committed(self, scan_id: str) -> dict[str, str]:
        folder = self.stack.data / "scans" / scan_id
        return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.iterdir()}

    def digest(self, name: str) -> str:
        return hashlib.sha256((self.folder / name).read_bytes()).hexdigest()

    def uploads(self) -> list[Path]:
        return list((self.stack.data / "uploads").iterdir())


@pytest.fixture
def scanner(stack: Stack, tmp_path: Path) -> Scanner:
    return Scanner(stack, tmp_path / "pc")


@pytest.mark.slow
def test_many_small_files(scanner: Scanner) -> None:
    """Each is sent whole: of what was sent when the client died, one at most is sent again."""
    names = [f"{view:03}.tif" for view in range(120)]
    for name in names:
        scanner.write(name, np.random.default_rng(int(name[:3])).random((128, 128), dtype="float32"))
    scanner.describe(names, len(names), 128)
    kills, err = scanner.killed_again_and_again(800_000, lambda: 0.0)
    assert kills >= 2 and "files already" in err
    (job,) = scanner.stack.http.get("/v1/jobs").json()["jobs"]
    committed = scanner.committed(job["scan_id"])
    assert all(committed[name] == scanner.digest(name) for name in names)
    size = scanner.sent(*names) // len(names)
    assert scanner.received() <= scanner.sent(*names, "scan.json") + kills * size
    assert not list(scanner.state.rglob("*.json")), "nothing is left to go on with"


@pytest.mark.slow
def test_one_large_file(scanner: Scanner) -> None:
    """Killed at random moments; each death costs a chunk at most."""
    rng, dice = np.random.default_rng(0), random.Random(1)
    scanner.write("projections.tif", rng.random((240, 512, 512), dtype="float32"))
    scanner.describe(["projections.tif"], 240, 512)
    kills, _ = scanner.killed_again_and_again(CHUNK, lambda: dice.uniform(0.0, 0.3))
    assert kills >= 2
    (job,) = scanner.stack.http.get("/v1/jobs").json()["jobs"]
    assert scanner.committed(job["scan_id"])["projections.tif"] == scanner.digest("projections.tif")
    assert scanner.received() <= scanner.sent("projections.tif", "scan.json") + kills * CHUNK


def test_a_client_that_died_after_its_submission_makes_no_second_job(scanner: Scanner) -> None:
    """The state of a run that was killed before it could note that its job was taken."""
    scanner.write("p.tif", np.ones((12, 16, 16), "float32"))
    scanner.describe(["p.tif"], 12, 16)
    first = scanner.run("submit", str(scanner.folder))["job"]
    assert scanner.run("submit", str(scanner.folder))["job"]["id"] != first["id"], "asked again it is another one"

    from splatct_client.journal import Journal

    journal = Journal(str(scanner.stack.http.base_url), scanner.folder, {"XDG_STATE_HOME": str(scanner.state)})
    files = hashlib.sha256(_told(scanner)).hexdigest()
    journal.note(upload=first["scan_id"], files=files, job=first["id"], asked=[first["scan_id"], {}, None, None])
    before = scanner.received()
    assert scanner.run("submit", str(scanner.folder))["job"]["id"] == first["id"]
    assert scanner.received() == before, "nor is a byte sent"


def _told(scanner: Scanner) -> bytes:
    from splatct_client.scanfolder import read_scan_folder

    return json.dumps([spec.to_json() for spec in read_scan_folder(scanner.folder).specs], sort_keys=True).encode()


class Wire:
    """Between client and server; the first answer to a request that begins with `mark` is withheld."""

    def __init__(self, port: int, mark: bytes) -> None:
        self._port, self._mark, self.withheld = port, mark, threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listening.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):  # it was closed
            while True:
                client, _ = self._listening.accept()
                threading.Thread(target=self._carry, args=(client,), daemon=True).start()

    def _carry(self, client: socket.socket) -> None:
        """One request after the other, as a client sends them."""
        with client, socket.create_connection(("127.0.0.1", self._port)) as server, contextlib.suppress(OSError):
            hold = False
            while ready := select.select([client, server], [], [])[0]:
                for end in ready:
                    data = end.recv(1 << 16)
                    if not data:
                        return
                    hold = hold or (end is client and data.startswith(self._mark) and not self.withheld.is_set())
                    if end is server and hold:
                        self.withheld.set()
                        return
                    (server if end is client else client).sendall(data)


@pytest.mark.parametrize("command", ["submit", "send"])
def test_a_client_that_died_before_it_heard_of_its_upload_leaves_none_behind(scanner: Scanner, command: str) -> None:
    scanner.write("p.tif", np.ones((12, 16, 16), "float32"))
    scanner.describe(["p.tif"], 12, 16)
    settle = ["--settle", "0.1"] if command == "send" else []
    wire = Wire(scanner.stack.port, b"PUT /v1/uploads/")
    process = scanner.start(command, str(scanner.folder), *settle, server=wire.url)
    assert wire.withheld.wait(60), "the server has made the upload"
    process.kill()
    process.communicate()
    (left,) = scanner.uploads()
    again = scanner.start(command, str(scanner.folder), *settle, "--json", server=wire.url)
    out, err = again.communicate(timeout=60)
    wire.close()
    assert again.returncode == 0, err
    assert json.loads(out)["job"]["scan_id"] == left.name, "the upload of the run that died was gone on with"
    assert scanner.uploads() == []


def test_a_scan_that_changed_is_sent_anew(scanner: Scanner) -> None:
    scanner.write("p.tif", np.ones((12, 16, 16), "float32"))
    scanner.write("q.tif", np.ones((12, 1024, 1024), "float32"))
    scanner.describe(["p.tif", "q.tif"], 24, 16)
    process = scanner.start("submit", str(scanner.folder))
    scanner.stack.until(lambda: scanner.received() > 0, 60, "something is sent")
    process.kill()
    process.communicate()
    (old,) = scanner.uploads()
    scanner.describe(["p.tif"], 12, 16)
    job = scanner.run("submit", str(scanner.folder))["job"]
    assert set(scanner.committed(job["scan_id"])) == {"scan.json", "p.tif"}
    assert not old.exists(), "what will never be whole holds no room"


def test_where_no_state_can_be_kept_it_is_sent_all_the_same(scanner: Scanner) -> None:
    scanner.write("p.tif", np.ones((12, 16, 16), "float32"))
    scanner.describe(["p.tif"], 12, 16)
    scanner.state.write_text("a file where the folder should be")
    process = scanner.start("submit", str(scanner.folder))
    _, err = process.communicate(timeout=60)
    assert process.returncode == 0 and "cannot be written" in err


def test_views_are_sent_while_the_scanner_writes(scanner: Scanner) -> None:
    """The client is killed in the middle, and scan.json comes last."""
    views, killed = 16, threading.Event()

    def scan() -> None:
        for view in range(views):
            if view == views // 2:
                killed.wait(120)
            scanner.write(f"{view:03}.tif", np.full((16, 16), view, "float32"))
            time.sleep(0.1)
        scanner.describe([f"{view:03}.tif" for view in range(views)], views, 16)

    turning = threading.Thread(target=scan)
    turning.start()
    process = scanner.start("send", str(scanner.folder), "--settle", "0.3")
    one = scanner.stack.data / "uploads"
    scanner.stack.until(lambda: len(list(one.glob("*/scan/*.tif"))) >= 4, 60, "four views have come")
    process.kill()
    process.communicate()
    assert not (scanner.folder / "scan.json").exists()
    killed.set()
    job = scanner.run("send", str(scanner.folder), "--settle", "0.3", "--name", "Prüfling 9")["job"]
    turning.join()
    names = [f"{view:03}.tif" for view in range(views)]
    committed = scanner.committed(job["scan_id"])
    assert {name: committed[name] for name in names} == {name: scanner.digest(name) for name in names}
    assert job["name"] == "Prüfling 9"
    view_bytes = scanner.sent("000.tif")
    assert scanner.received() <= scanner.sent(*names, "scan.json") + view_bytes


@pytest.mark.slow
def test_a_view_that_is_still_written_waits(scanner: Scanner) -> None:
    """It stands still for less than it must, again and again; then the scan is whole."""
    scanner.describe(["slow.tif"], 12, 16)
    pixels = scanner.write("made.tif", np.ones((12, 16, 16), "float32")).read_bytes()
    (scanner.folder / "made.tif").unlink()
    process = scanner.start("send", str(scanner.folder), "--settle", "1.5", "--json")
    with (scanner.folder / "slow.tif").open("wb") as file:
        for start in range(0, len(pixels), len(pixels) // 6):
            file.write(pixels[start : start + len(pixels) // 6])
            file.flush()
            time.sleep(0.7)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    scan_id = json.loads(out)["job"]["scan_id"]
    assert scanner.committed(scan_id)["slow.tif"] == scanner.digest("slow.tif")
    assert scanner.received() == len(pixels) + len(
        (scanner.stack.data / "scans" / scan_id / "scan.json").read_bytes()
    ), "no byte of a file that was not finished"


def test_a_view_that_changes_after_it_was_sent_is_told(scanner: Scanner) -> None:
    """The size is that of before; the digest tells. Another run sends what is there now."""
    scanner.write("000.tif", np.zeros((16, 16), "float32"))
    process = scanner.start("send", str(scanner.folder), "--settle", "0.1")
    uploads = scanner.stack.data / "uploads"
    scanner.stack.until(lambda: bool(list(uploads.glob("*/scan/000.tif"))), 60, "it is sent")
    scanner.write("000.tif", np.ones((16, 16), "float32"))
    scanner.describe(["000.tif"], 1, 16)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "000.tif was written again after it was sent" in err
    assert not scanner.uploads(), "what will never be whole holds no room"
    again = scanner.start("send", str(scanner.folder), "--settle", "0.1")
    again.communicate(timeout=60)
    (folder,) = (scanner.stack.data / "scans").iterdir()
    assert scanner.committed(folder.name)["000.tif"] == scanner.digest("000.tif")


def test_a_folder_where_nothing_comes_is_given_up(scanner: Scanner) -> None:
    scanner.write("000.tif", np.ones((16, 16), "float32"))
    process = scanner.start("send", str(scanner.folder), "--settle", "0.1", "--idle", "1.5")
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2 and "nothing has come for 1.5 s" in err and "1 files are at the server" in err
    assert len(scanner.uploads()) == 1, "another run goes on"
