"""The key: where it comes from, where it goes, and where it never shows."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest
from splatct_client import Client, InputError, KeyNeeded, ServerProblem, UnexpectedAnswer
from splatct_client.credentials import find_key
from splatct_client.models import ResultFile
from splatct_client.retry import Patience

KEY = "splatct_abcdefghjk_S3cret-S3cret_S3cret"


def test_the_file_comes_before_the_environment(tmp_path: Path) -> None:
    (tmp_path / "key").write_text(f"{KEY}\r\n")
    assert find_key(tmp_path / "key", {"SPLATCT_KEY": "another"}) == KEY
    assert find_key(None, {"SPLATCT_KEY": f" {KEY} "}) == KEY
    assert find_key(None, {"SPLATCT_KEY": ""}) is None and find_key(None, {}) is None


@pytest.mark.parametrize(
    "content", [b"", b"\n", b"two S3cret", b"S3cret\nS3cret", b"S3cr\xff", "S3crét".encode(), b"S" * 5000]
)
def test_a_file_without_a_key_is_refused_and_not_repeated(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "key").write_bytes(content)
    with pytest.raises(InputError, match="key") as refusal:
        find_key(tmp_path / "key", {})
    assert "S3cr" not in str(refusal.value)
    with pytest.raises(InputError, match="cannot be read"):
        find_key(tmp_path / "none", {})


def test_an_address_with_a_secret_in_it_is_refused_and_not_repeated() -> None:
    with pytest.raises(InputError, match="--key-file") as refusal:
        Client("http://user:S3cret@ct.example")
    assert "S3cret" not in str(refusal.value)


class Elsewhere:
    """A server that notes what it is asked; `answer` decides."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, str | None]] = []
        self.answer: tuple[int, dict[str, str], bytes] = (200, {}, b"{}")
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.seen.append((self.path, self.headers.get("Authorization")))
                status, headers, body = outer.answer
                self.send_response(status)
                for name, value in (headers | {"Content-Length": str(len(body))}).items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                """Quiet."""

        self.httpd = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.httpd.server_port}"
        threading.Thread(target=self.httpd.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()


@pytest.fixture
def two() -> Iterator[tuple[Elsewhere, Elsewhere]]:
    made = Elsewhere(), Elsewhere()
    yield made
    for server in made:
        server.httpd.shutdown()
        server.httpd.server_close()


def test_the_key_goes_in_a_header_and_never_in_the_address(two: tuple[Elsewhere, Elsewhere]) -> None:
    server, _ = two
    server.answer = 200, {}, b'{"jobs": []}'
    with Client(server.url, key=KEY) as client:
        assert client.jobs() == []
    assert server.seen == [("/v1/jobs", f"Bearer {KEY}")]


@pytest.mark.parametrize("status", [301, 302, 307, 308])
def test_a_redirect_is_not_followed(two: tuple[Elsewhere, Elsewhere], tmp_path: Path, status: int) -> None:
    server, other = two
    server.answer = status, {"Location": f"{other.url}/v1/jobs"}, b""
    with Client(server.url, key=KEY) as client:
        with pytest.raises(UnexpectedAnswer, match="not followed") as refusal:
            client.jobs()
        with pytest.raises(UnexpectedAnswer, match="not followed"):
            client.download("job", ResultFile("volume.tif", 10, "0" * 64), tmp_path)
    assert other.seen == [] and KEY not in str(refusal.value)


def test_401_says_how_to_give_a_key_and_403_what_it_lacks() -> None:
    def handle(request: httpx.Request) -> httpx.Response:
        problem = {"title": "Forbidden", "status": 403, "detail": "The key may not do this: it lacks the scope submit."}
        return httpx.Response(401 if request.url.path == "/v1/jobs" else 403, json=problem)

    def client(key: str | None) -> Client:
        return Client("http://ct.example", key=key, patience=Patience(0), transport=httpx.MockTransport(handle))

    with client(None) as nobody, pytest.raises(KeyNeeded, match="--key-file FILE, or set SPLATCT_KEY") as needed:
        nobody.jobs()
    assert needed.value.exit_code == 2
    with client(KEY) as somebody:
        with pytest.raises(ServerProblem, match=r"HTTP 401") as refused:
            somebody.jobs()
        with pytest.raises(ServerProblem, match="lacks the scope submit"):
            somebody.options()
    assert KEY not in str(refused.value) and KEY not in repr(somebody)


def test_the_command_line_takes_a_file_or_the_environment_and_prints_neither(  # type: ignore[no-untyped-def]
    splatct, two: tuple[Elsewhere, Elsewhere], tmp_path: Path
) -> None:
    server, _ = two
    server.answer = 200, {}, b'{"jobs": []}'
    (tmp_path / "key").write_text(KEY)
    from_file = splatct("jobs", "--server", server.url, "--key-file", str(tmp_path / "key"), "--json")
    from_environment = splatct("jobs", "--server", server.url, SPLATCT_KEY=KEY)
    assert [key for _, key in server.seen] == [f"Bearer {KEY}"] * 2
    server.answer = 401, {}, b"{}"
    refused = splatct("jobs", "--server", server.url, SPLATCT_KEY=KEY)
    without = splatct("jobs", "--server", server.url)
    for done, code in [(from_file, 0), (from_environment, 0), (refused, 2), (without, 2)]:
        assert done.returncode == code and "S3cret" not in done.stdout + done.stderr
    assert "--key-file" in without.stderr
    assert "--key " not in splatct("jobs", "--help").stdout, "a command line can be read by other users"
