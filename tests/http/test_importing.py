"""Scans from folders of the server's machine: what is taken, and that nothing else is ever read."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from server.importing import NotHere, Refused, Root, opened, roots
from server.settings import SettingsError

from .stack import Stack, scan_files

FILES = scan_files()
SECRET = b"another tenant's pixels"


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders beside a data folder: `first` and `second`, each its tenant's, and `common`, everybody's."""
    place = tmp_path_factory.mktemp("import")
    for name in ("first", "second", "common"):
        put(place / name / "monday")
    (place / "elsewhere").mkdir()
    (place / "elsewhere" / "secret.tif").write_bytes(SECRET)
    return place


def put(folder: Path, **changes: bytes) -> Path:
    folder.mkdir(parents=True)
    for name, data in {**FILES, **changes}.items():
        (folder / name).write_bytes(data)
    return folder


def naming(*names: str) -> bytes:
    scan = json.loads(FILES["scan.json"])
    scan["projections"]["files"] = list(names)
    return json.dumps(scan).encode()


@pytest.fixture(scope="module")
def served(place: Path) -> Iterator[Stack]:
    stack = Stack(place / "server")
    allowed = (f"first={place / 'first'}", f"second={place / 'second'}", f"*={place / 'common'}")
    stack.environment["SPLATCT_IMPORT_FROM"] = ",".join(allowed)
    with stack:
        yield stack


@pytest.fixture(scope="module")
def http(served: Stack) -> Iterator[httpx.Client]:
    with served.client(served.new_key("first", "admin")[1]) as http:
        yield http


def ask(http: httpx.Client, folder: str) -> httpx.Response:
    return http.post("/v1/imports", json={"folder": folder})


@pytest.mark.parametrize("folder", ["first/monday", "common/monday"])
def test_a_scan_is_copied_and_committed_like_one_that_was_sent(
    http: httpx.Client, served: Stack, place: Path, folder: str
) -> None:
    (place / folder / "notes.txt").write_text("not of the scan")
    made = ask(http, folder)
    assert made.status_code == 201, made.text
    upload = made.json()
    assert upload["name"] == "small" and made.headers["location"] == f"/v1/uploads/{upload['id']}"
    assert {file["name"]: file["complete"] for file in upload["files"]} == {"scan.json": True, "projections.tif": True}
    scan = http.post(f"/v1/uploads/{upload['id']}/commit")
    assert scan.status_code == 201 and scan.json()["facts"]["views"] == 12
    stored = served.data / "scans" / upload["id"] / "projections.tif"
    source = place / folder / "projections.tif"
    assert stored.read_bytes() == source.read_bytes() and stored.stat().st_ino != source.stat().st_ino
    with source.open("r+b") as file:  # what the scanner writes later is no business of the scan's
        file.write(b"changed")
    assert stored.read_bytes() == FILES["projections.tif"]
    source.write_bytes(FILES["projections.tif"])


@pytest.mark.parametrize("folder", ["second/monday", "elsewhere", "nowhere", "first/tuesday", "first", "monday"])
def test_what_is_not_one_s_own_is_not_there(http: httpx.Client, folder: str) -> None:
    answers = [ask(http, folder), ask(http, "nobody-has-this")]
    assert [answer.status_code for answer in answers] == [404, 404] and answers[0].content == answers[1].content


@pytest.mark.parametrize(
    "folder",
    ["first/../second/monday", "first/monday/..", "first//monday", "first/./monday", "first/monday/", "first/a\\b",
     "first/\u0000", "first/\n"],
)  # fmt: skip
def test_path_tricks_are_refused(http: httpx.Client, folder: str) -> None:
    answer = ask(http, folder)
    assert answer.status_code == 422 and answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("folder", ["/etc", "..", ".", "~", "../first/monday"])
def test_a_path_from_elsewhere_leads_to_nothing(http: httpx.Client, place: Path, folder: str) -> None:
    assert ask(http, folder).status_code == 404
    assert ask(http, str(place / "first" / "monday")).status_code == 404


def test_links_are_not_followed_wherever_they_stand(http: httpx.Client, place: Path, served: Stack) -> None:
    first = place / "first"
    (first / "linked").symlink_to(place / "second" / "monday")
    (first / "up").symlink_to("..")
    put(first / "file", **{"projections.tif": b"x"})
    (first / "file" / "projections.tif").unlink()
    (first / "file" / "projections.tif").symlink_to(place / "elsewhere" / "secret.tif")
    put(first / "json")
    (first / "json" / "scan.json").unlink()
    (first / "json" / "scan.json").symlink_to(place / "second" / "monday" / "scan.json")
    for folder in ("linked", "up/second/monday", "file", "json"):
        answer = ask(http, f"first/{folder}")
        assert answer.status_code == 422 and "symbolic link" in answer.text, answer.text
    stored = [file for file in served.data.rglob("*") if file.is_file() and SECRET in file.read_bytes()]
    assert not stored


@pytest.mark.parametrize(
    "name", ["../../elsewhere/secret.tif", "../secret.tif", "/etc/hostname", "sub/projections.tif", "..", ""]
)
def test_scan_json_leads_nowhere_else(http: httpx.Client, place: Path, name: str) -> None:
    folder = f"names-{abs(hash(name))}"
    put(place / "first" / folder, **{"scan.json": naming(name)})
    answer = ask(http, f"first/{folder}")
    assert answer.status_code == 422 and "plain name" in answer.text


def test_every_file_that_cannot_be_taken_is_listed(http: httpx.Client, place: Path, served: Stack) -> None:
    names = ("missing.tif", "folder.tif", "pipe.tif", "empty.tif", ".hidden.tif")
    folder = put(place / "first" / "odd", **{"scan.json": naming(*names), ".hidden.tif": b"x"})
    (folder / "folder.tif").mkdir()
    os.mkfifo(folder / "pipe.tif")
    (folder / "empty.tif").touch()
    answer = ask(http, "first/odd")
    faults = {error["where"]: error["what"] for error in answer.json()["errors"]}
    assert answer.status_code == 422 and set(faults) == set(names[:4])
    assert "not a regular file" in faults["pipe.tif"] and "not in the folder" in faults["missing.tif"]
    (folder / "scan.json").write_bytes(naming(".hidden.tif"))
    assert "dot" in ask(http, "first/odd").text
    for text, words in ((b"{", "not valid JSON"), (b"[1]", "not a JSON object"), (b"[" * 100_000, "not valid JSON")):
        (folder / "scan.json").write_bytes(text)
        assert words in ask(http, "first/odd").text
    assert not list((served.data / "uploads").glob("*/parts/*"))


def test_a_file_that_is_written_to_is_refused(http: httpx.Client, place: Path, served: Stack) -> None:
    """The scanner has not finished: no torn scan, and nothing is left of the attempt."""
    file = put(place / "first" / "growing", **{"projections.tif": bytes(8 << 20)}) / "projections.tif"
    before, stop = http.get("/v1/usage").json(), threading.Event()

    def scanner() -> None:
        with file.open("ab", buffering=0) as growing:
            while not stop.is_set():
                growing.write(b"more")

    thread = threading.Thread(target=scanner)
    thread.start()
    try:
        answer = ask(http, "first/growing")
    finally:
        stop.set()
        thread.join()
    assert answer.status_code == 409 and answer.json()["type"].endswith(":changing"), answer.text
    assert answer.json()["errors"][0]["where"] == "projections.tif"
    assert http.get("/v1/usage").json() == before and not list((served.data / "uploads").glob("*/parts/*"))
    assert ask(http, "first/growing").status_code == 201, "it has finished now"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("/mnt/scanner", "expected TENANT=FOLDER"),
        ("=/mnt/scanner", "expected TENANT=FOLDER"),
        ("lab=scanner", "with an absolute path"),
        ("lab=/", "with an absolute path"),
        ("lab={data}", "lie in each other"),
        ("lab={data}/scans", "lie in each other"),
        ("lab={above}", "lie in each other"),
        ("lab=/mnt/a,lab=/srv/a", "two folders are named 'a'"),
        ("lab=/mnt/a,*=/srv/a", "two folders are named 'a'"),
    ],
)
def test_a_setting_that_cannot_be_is_refused(tmp_path: Path, text: str, words: str) -> None:
    data = tmp_path / "above" / "data"
    with pytest.raises(SettingsError, match=words):
        roots(text.format(data=data, above=data.parent), data)


def test_names_are_a_tenant_s_own(tmp_path: Path) -> None:
    allowed = roots("a=/mnt/in, b=/srv/in,", tmp_path)
    assert allowed == (Root("a", Path("/mnt/in")), Root("b", Path("/srv/in")))
    assert roots("", tmp_path) == ()
    with pytest.raises(NotHere), opened(allowed, "c", "in"):
        pass


def test_a_folder_that_is_swapped_for_a_link_in_between_is_still_the_one_that_was_opened(tmp_path: Path) -> None:
    put(tmp_path / "root" / "scan")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "scan.json").write_bytes(SECRET)
    with opened((Root("a", tmp_path / "root"),), "a", "root/scan") as source:
        (tmp_path / "root" / "scan").rename(tmp_path / "root" / "moved")
        (tmp_path / "root" / "scan").symlink_to(tmp_path / "outside")
        with source.file("scan.json") as descriptor:
            assert os.read(descriptor, 1 << 20) == FILES["scan.json"]
        with pytest.raises(Refused), source.file("../moved/scan.json"):
            pass
