"""Whoever has no token can neither shut the workbench nor make it read or print anything."""

import http.client
import os
import resource
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from test_workbench_upload import wait_for
from test_workbench_workers import read_object
from workbench_server import LIMITS, OPEN_FILES, TOKEN, Workbench

from pipeline.web import server as serving
from pipeline.web.server import serve

CROWD = 1100
ANSWERED_S = 3.0
HUGE = 3_000_000_000
BUFFERS = 20_000_000
"""More than the buffers of a socket on both sides."""
PARTIAL = b"GET /api/runs HTTP/1.1\r\nHost: 127.0.0.1\r\nX-"
SLOW = b"POST /api/session HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 900\r\n\r\n{"


class Served(NamedTuple):
    """A `slip serve` of its own process, which may open no more than 1,024 files."""

    process: subprocess.Popen[str]
    port: int
    token: str
    errors: Path

    def connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=10.0)

    def ask(self, path: str = "/api/jobs") -> float:
        """Ask on a new connection, with the token; gives the time to the answer [s]."""
        started = time.monotonic()
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=20.0)
        line.request("GET", path, headers={"Authorization": f"Bearer {self.token}"})
        answer = line.getresponse()
        assert (answer.status, bool(answer.read())) == (200, True)
        line.close()
        return time.monotonic() - started


@contextmanager
def serve_apart(folder: Path, limit: str) -> Iterator[Served]:
    slip = os.path.dirname(sys.executable) + "/slip"  # noqa: PTH120 - not resolved
    # A program before it sets the limit: it is the soft and the hard one, or the soft one alone.
    command = ["sh", "-c", f'ulimit {limit} {OPEN_FILES} && exec "$@"', "sh"]
    command += [slip, "serve", "results", "--port", "0", "--json"]
    with (folder / "errors").open("w") as errors:
        process = subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=errors)
        try:
            told = read_object(process)
            port = int(told["address"].rstrip("/").rpartition(":")[2])
            served = Served(process, port, told["token"], folder / "errors")
            served.ask()
            yield served
        finally:
            process.kill()
            process.communicate()


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("apart")
    (folder / "results").mkdir()
    (folder / "results" / "index.html").write_bytes(b" " * BUFFERS)
    with serve_apart(folder, "-n") as served:
        yield served


@pytest.fixture
def served(apart: Served) -> Iterator[Served]:
    printed = apart.errors.read_text()
    yield apart
    # Whatever a client does, nothing of it is printed.
    apart.ask()
    assert apart.errors.read_text().removeprefix(printed) == ""


@pytest.fixture(autouse=True)
def enough_files() -> Iterator[None]:
    """Room for the crowd in this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2 * CROWD:
        pytest.skip("the crowd needs more open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2 * CROWD, hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def is_open(line: socket.socket) -> bool:
    line.settimeout(0.0)
    try:
        while line.recv(1 << 16):
            pass
    except BlockingIOError:
        return True
    except OSError:
        pass
    return False


@pytest.mark.parametrize("sent", [PARTIAL, SLOW], ids=["a partial head", "a slow body"])
def test_who_has_the_token_is_answered_whatever_others_hold_open(served: Served, sent: bytes) -> None:
    with ExitStack() as crowd:
        lines = []
        for number in range(CROWD):
            line = crowd.enter_context(served.connect())
            # The server may have hung up already.
            with suppress(OSError):
                line.sendall(sent)
            lines.append(line)
            if number % 100 == 99:
                assert served.ask() < ANSWERED_S
        assert served.ask() < ANSWERED_S
        assert served.ask("/vega.js") < ANSWERED_S
        assert sum(is_open(line) for line in lines) <= serving.MOST_PENDING


def test_who_has_the_token_is_answered_while_others_connect_without_end(served: Served) -> None:
    ends = threading.Event()

    def crowd() -> None:
        held: deque[socket.socket] = deque()
        for _ in range(5 * CROWD):
            if not ends.is_set():
                held.append(served.connect())
            if len(held) > CROWD // 2:
                held.popleft().close()
        for line in held:
            line.close()

    thread = threading.Thread(target=crowd)
    thread.start()
    try:
        times = [served.ask() for _ in range(30)]
    finally:
        ends.set()
        thread.join()
    assert max(times) < ANSWERED_S


LONG = f"Content-Length: {10 * HUGE}"


@pytest.mark.parametrize(
    ("headers", "status", "length"),
    [
        ({"Host": "127.0.0.1"}, 403, "Transfer-Encoding: chunked"),
        ({"Host": "evil.example", "Authorization": "Bearer {token}"}, 403, LONG),
        ({"Host": "127.0.0.1", "Authorization": "Bearer {token}"}, 422, LONG),
    ],
    ids=["no token", "another host", "too large"],
)
def test_the_body_of_a_refused_request_is_not_read(
    served: Served, headers: dict[str, str], status: int, length: str
) -> None:
    said = "\r\n".join(f"{name}: {value.format(token=served.token)}" for name, value in headers.items())
    piece = (b"100000\r\n" if "chunked" in length else b"") + b"x" * 0x100000 + b"\r\n"
    accepted = 0
    with served.connect() as line:
        line.sendall(f"POST /api/upload?name=x.mcap HTTP/1.1\r\n{said}\r\n{length}\r\n\r\n".encode())
        with suppress(OSError):
            while accepted < HUGE // 10:
                accepted += line.send(piece)
        # The answer is there all the same.
        assert line.recv(1 << 16).startswith(b"HTTP/1.1 %d " % status)
        assert served.ask() < ANSWERED_S
    assert accepted < BUFFERS


def test_the_answer_comes_before_the_body_and_ends_the_connection(served: Served) -> None:
    for sent in (SLOW, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n" * 50):
        with served.connect() as line:
            line.sendall(sent)
            answer = b""
            while piece := line.recv(1 << 16):
                answer += piece
        assert answer.startswith(b"HTTP/1.1 403 ")
        assert answer.count(b"HTTP/1.1 ") == 1


HOST = b"Host: 127.0.0.1\r\n"
BROKEN = (
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    b"GET /\r\n\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/9.9\r\n" + HOST + b"\r\n",
    b"GET /\xff HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"Cookie: slip=\xff\xfe; =; ;; a\r\n\r\n",
    b"GET /?token=%ff%00%c3 HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"X-Forwarded-For: ,,[::\r\nX-Forwarded-Proto: \xff\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"Connection: Upgrade\r\nUpgrade: websocket\r\n\r\n",
    b"CONNECT 127.0.0.1:80 HTTP/1.1\r\n" + HOST + b"\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"X: " + b"x" * 300_000,
    b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: " + b"9" * 30 + b"\r\n\r\n",
    b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 1\r\nContent-Length: 2\r\n\r\n",
    b"POST / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: gzip\r\n\r\n",
    b"POST / HTTP/1.1\r\n" + HOST + b"Expect: 100-continue\r\nContent-Length: 9\r\n\r\n",
    # The beginning is a request, and what follows it is none.
    b"POST / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\nzzz\r\n",
    b"GET / HTTP/1.1\r\n" + HOST + b"\r\n\x00\x00\r\n\r\n",
    # Of somebody with the token, before and after the answer has begun.
    b"POST /api/session HTTP/1.1\r\n" + HOST + b"{bearer}Transfer-Encoding: chunked\r\n\r\n1\r\n{\r\nzzz\r\n",
    b"GET /vega.js HTTP/1.1\r\n" + HOST + b"{bearer}Transfer-Encoding: chunked\r\n\r\n|zzz\r\n",
    b"GET /index.html HTTP/1.1\r\n" + HOST + b"{bearer}Transfer-Encoding: chunked\r\n\r\n|zzz\r\n",
    b"GET /nowhere HTTP/1.1\r\n" + HOST + b"{bearer}Transfer-Encoding: chunked\r\n\r\n|zzz\r\n",
    b"GET /api/jobs HTTP/1.1\r\n" + HOST + b"{bearer}\r\n|zzz\r\n\r\n",
)  # fmt: skip


def test_nothing_that_a_client_sends_is_printed(served: Served) -> None:
    bearer = f"Authorization: Bearer {served.token}\r\n".encode()
    for sent in BROKEN:
        for waits in (True, False):
            with served.connect() as line, suppress(OSError):
                for part in sent.replace(b"{bearer}", bearer).split(b"|"):
                    line.sendall(part)
                    if waits:
                        line.settimeout(0.1)
                        line.recv(1000)
        assert served.ask() < ANSWERED_S


@pytest.mark.parametrize(
    "costly",
    [
        b'Cookie: a="' + b'\\"' * 7_000 + b'"\r\n',
        b'Cookie: a="' + b'\\"' * 60_000 + b'"\r\n',
        b"a:b\r\n" * 3_000,
        b"a:b\r\n" * 12_000,
    ],
    ids=["a quoted cookie", "a long one", "many headers", "very many"],
)
def test_no_head_holds_up_who_has_the_token(served: Served, costly: bytes) -> None:
    with ExitStack() as crowd:
        for _ in range(100):
            line = crowd.enter_context(served.connect())
            line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * len(costly))
            line.settimeout(0.0)
            with suppress(OSError):
                line.send(b"GET / HTTP/1.1\r\n" + HOST + costly + b"\r\n")
        assert served.ask() < ANSWERED_S


@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="only Linux changes the limits of others")
def test_when_files_run_out_all_the_same_nothing_is_printed_and_it_goes_on(served: Served) -> None:
    """Somebody with the token may have as many connections as there are files."""
    ask = f"GET /api/jobs HTTP/1.1\r\n{HOST.decode()}Authorization: Bearer {served.token}\r\n\r\n".encode()
    used = len(os.listdir(f"/proc/{served.process.pid}/fd"))  # noqa: PTH208 - numbers only
    limits = resource.prlimit(served.process.pid, resource.RLIMIT_NOFILE)
    resource.prlimit(served.process.pid, resource.RLIMIT_NOFILE, (used + 5, limits[1]))
    with ExitStack() as held:
        lines = [held.enter_context(served.connect()) for _ in range(20)]
        for line in lines:
            line.sendall(ask)
        assert lines[0].recv(1000).startswith(b"HTTP/1.1 200 ")
        lines[-1].settimeout(0.3)
        with pytest.raises(TimeoutError):
            lines[-1].recv(1000)
    resource.prlimit(served.process.pid, resource.RLIMIT_NOFILE, limits)
    assert served.ask() < ANSWERED_S


@pytest.fixture
def hasty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Workbench]:
    """A workbench that soon gives up who does not show the token."""
    monkeypatch.setattr(serving, "PENDING_S", 0.5)
    server = Workbench(tmp_path / "results")
    yield server
    server.close()


def test_a_connection_shows_the_token_soon_or_is_closed(hasty: Workbench) -> None:
    started = time.monotonic()
    with ExitStack() as held:
        lines = [
            held.enter_context(socket.create_connection(("127.0.0.1", hasty.port), timeout=10.0))
            for _ in range(3)
        ]
        for line, sent in zip(lines, (b"", PARTIAL, SLOW), strict=True):
            line.sendall(sent)
        # Bytes that go on coming gain no time.
        while is_open(lines[1]):
            assert time.monotonic() - started < 5.0
            with suppress(OSError):
                lines[1].sendall(b"x")
            time.sleep(0.05)
        wait_for(lambda: not any(is_open(line) for line in lines))
    assert time.monotonic() - started > 0.4


def test_a_connection_that_has_shown_the_token_is_kept_for_the_next_request(hasty: Workbench) -> None:
    line = http.client.HTTPConnection("127.0.0.1", hasty.port, timeout=10.0)
    line.connect()
    held = line.sock
    for _ in range(3):
        line.request("GET", "/api/jobs", headers={"Authorization": f"Bearer {TOKEN}"})
        assert line.getresponse().read()
        time.sleep(0.4)
    assert line.sock is held
    line.close()


def test_the_printed_address_is_the_one_that_is_listened_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another user may listen on the other address that `localhost` has, and would be sent the token."""
    told: list[str] = []
    monkeypatch.setattr(serving.WorkbenchServer, "run", lambda _, sockets: sockets[0].close())
    serve(tmp_path, host="localhost", port=0, notify=lambda address, _: told.append(address), limits=LIMITS)
    assert told[0].startswith("http://127.0.0.1:")
