"""Throws requests at the workbench; anything but an answer or one clear error is a find.

    python tests/fuzz/fuzz_workbench.py --minutes 5 [--seed 1]

A server on the loopback is asked over HTTP: changes of a session with damaged and random fields, formulas,
bodies that are no JSON, uploads with lengths and names that lie, logs with flipped bytes, connections that
break, requests with foreign hosts, origins and tokens, and results files that somebody damaged. No answer may
be a 500 or hold a traceback or a path of the server, none may take longer than 30 s, whoever has no token
gets 403 only, and after each round the session can be opened, changed and undone.
"""

import argparse
import http.client
import json
import os
import random
import shutil
import socket
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote, urlencode

sys.path.insert(0, str(Path(__file__).parents[1] / "fixtures"))

from workbench_server import LIMITS, RUN, TOKEN
from workbench_server import ServedWorkbench as Workbench

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case

SLOWEST_S = 30.0
REQUESTS_A_ROUND = 40
EFFECTS = ("effective_track", "drive_lag", "lateral_skid", "wheel_radius", "own", "magic", "../x", "")
ACTIONS = (
    "open", "add", "drop", "set", "preview", "lock", "fit", "formula", "undo", "redo", "try",
    "burn",
)  # fmt: skip
TEXTS = (
    "", " ", "x", "k", "where", "id", "note", "v_x", "v_w", "self", "c", "\x00", "\n", "'", '"', "\\", "<b>",
    "\u00e9", "../../etc/passwd", "/etc/passwd", "%00", "9" * 350, "-" * 300, "(" * 300, "a" * 5000, "null",
    "1e999",
    "c * w0", "c * v0 * w0", "c ** 0.5 * w0", "c / (w0 - w0)", "exp(exp(9)) * c", "c [1] -0.9 .. 0.5",
    "c [s] 0 .. 1", "c [m^99] 0 .. 1", "c [1] -1e308 .. 1e308", "k [1] 0 .. 1e-300", "c [1] 1 .. 0",
)  # fmt: skip
NUMBERS = (0, 1, -1, 1.6, 1e-300, 1e300, 1e999, -1e999, 10**400, 2**63, 0.1, "1", None, True, [], {})
GETS = (
    "/",
    "/api/runs",
    "/api/jobs",
    "/report",
    "/model.toml",
    "/page.js",
    "/vega.js",
    "/..%2f..%2fetc/passwd",
    "/x",
)
POSTS = (
    "/api/session",
    "/api/figures",
    "/api/rows",
    "/api/save",
    "/api/diagnose",
    "/api/retry",
    "/api/dismiss",
)


class Find(Exception):  # noqa: N818 - what a fuzzer looks for
    """An answer that must not be."""


class Client:
    """Asks, and judges every answer."""

    def __init__(self, server: Workbench, secrets: tuple[str, ...]) -> None:
        self.server = server
        self.secrets = secrets
        self.seen: Counter[int] = Counter()

    def ask(
        self,
        method: str,
        path: str,
        body: bytes = b"",
        headers: dict[str, str] | None = None,
        *,
        known: bool = True,
    ) -> tuple[int, bytes]:
        started = time.monotonic()
        try:
            status, _, answer = self.server.request(method, path, body, headers=headers, known=known)
        except (ConnectionError, http.client.BadStatusLine, ValueError):
            # The client refuses to send it, or the server closes on what is no HTTP.
            self.seen[0] += 1
            return 0, b""
        told = f"{method} {path[:200]} {body[:300]!r} {headers}: {status} {answer[:500]!r}"
        self.seen[status] += 1
        if status >= 500 or b"Traceback" in answer:
            raise Find(told)
        if time.monotonic() - started > SLOWEST_S:
            raise Find(f"{time.monotonic() - started:.0f} s: {told}")
        if any(secret.encode() in answer for secret in self.secrets) and path not in {
            "/api/runs",
            "/api/save",
        }:
            raise Find(f"a path of the server: {told}")
        return status, answer


def make_ask(rng: random.Random) -> bytes:
    """The body of a change: mostly whole, with a few fields that are not."""
    ask: dict[str, object] = {"run": RUN, "action": rng.choice(ACTIONS)}
    fields = {
        "effect": EFFECTS,
        "parameter": ("k", "tau", *TEXTS),
        "value": NUMBERS,
        "slot": ("a", "b", "c", 3),
    }
    fields |= {
        "channel": ("v_x", "v_w", "v_z"),
        "formula": TEXTS,
        "parameters": TEXTS,
        "input": ("command", "x", None),
    }
    for name, values in fields.items():
        if rng.random() < 0.6:
            ask[name] = rng.choice(values)
    if ask["action"] == "formula" and rng.random() < 0.5:
        word = rng.choice(("c", "k", "where", "id", "note", "v_x", "pi", "t"))
        ask |= {"effect": rng.choice(("own", "mine")), "channel": "v_w", "formula": f"{word} * w0"}
        ask["parameters"] = f"{word} [1] -0.9 .. 0.5"
    if rng.random() < 0.15:
        ask[rng.choice((*ask, "more"))] = rng.choice((*TEXTS, *NUMBERS))
    body = bytearray(json.dumps(ask).encode())
    if rng.random() < 0.15:
        for _ in range(rng.randrange(1, 4)):
            body[rng.randrange(len(body))] = rng.randrange(256)
    if rng.random() < 0.05:
        body = bytearray(rng.choice((b"[", b'{"run":', b'{"a":[')) * 100_000)
    return bytes(body)


def change(client: Client, rng: random.Random, log: bytes) -> None:
    """A change of the session, whole or damaged; an upload of a log, likewise."""
    if rng.random() < 0.85:
        client.ask("POST", rng.choice(("/api/session", *POSTS[:4])), make_ask(rng))
        return
    content = bytearray(log if rng.random() < 0.5 else rng.randbytes(rng.randrange(5000)))
    for _ in range(rng.randrange(20) if content else 0):
        content[rng.randrange(len(content))] = rng.randrange(256)
    headers = {"Content-Length": rng.choice(("", "x", "-1", "9" * 5000, "1"))} if rng.random() < 0.1 else None
    client.ask("POST", f"/api/upload?name={quote(rng.choice(TEXTS))}", bytes(content), headers)


def wander(client: Client, rng: random.Random, _: bytes) -> None:
    """Any address in any way."""
    query = urlencode({rng.choice(("run", "slot", "id", "vehicle", "name", "token")): rng.choice(TEXTS)})
    method = rng.choice(("GET", "HEAD", "POST", "PUT", "OPTIONS"))
    client.ask(method, f"{rng.choice((*GETS, *POSTS))}?{query}")


def break_off(client: Client, rng: random.Random, _: bytes) -> None:
    """An upload whose connection breaks."""
    with socket.create_connection(("127.0.0.1", client.server.port)) as line:
        head = f"POST /api/upload?name=x HTTP/1.1\r\nHost: 127.0.0.1:{client.server.port}\r\n"
        head += f"Authorization: Bearer {TOKEN}\r\nContent-Length: {rng.randrange(10**6)}\r\n\r\n"
        line.sendall(head.encode() + rng.randbytes(rng.randrange(3000)))


def intrude(client: Client, rng: random.Random, _: bytes) -> None:
    """A request without the token, or from elsewhere: refused, whatever it is."""
    foreign = {rng.choice(("Origin", "Sec-Fetch-Site")): rng.choice(("http://[", "null", "cross-site"))}
    headers = {
        "Cookie": rng.choice((f"slip-{client.server.port}={TOKEN[:-1]}", "slip=", ";;=;\x80", "a" * 4000)),
        "Authorization": rng.choice(("Bearer", "Bearer x", f"Bearer {TOKEN}x", "\xff")),
        "Host": rng.choice((f"127.0.0.1:{client.server.port}", "evil.example", "", "[", "[::1]:x")),
    }
    known = rng.random() < 0.5
    path = "/api/session" if known else rng.choice((*GETS, *POSTS, f"/?token={quote(rng.choice(TEXTS))}"))
    method = "POST" if known else rng.choice(("GET", "POST"))
    status, _body = client.ask(method, path, make_ask(rng), foreign if known else headers, known=known)
    if status not in {0, 400, 403}:
        raise Find(f"let in: {method} {path} {foreign if known else headers}: {status}")


def damage(client: Client, rng: random.Random, _: bytes) -> None:
    """Flip bytes in a summary, as a stranger's results may hold them."""
    results = client.server.results
    # The server adds and deletes folders meanwhile: `os.walk` passes over those that are gone.
    names = [Path(folder, name) for folder, _, files in os.walk(results) for name in files]
    kept = sorted(path for path in names if path.name == "summary.json")
    if kept:
        path = rng.choice(kept)
        try:
            content = bytearray(path.read_bytes())
        except FileNotFoundError:
            return
        for _ in range(rng.randrange(1, 6) if content else 0):
            content[rng.randrange(len(content))] = rng.randrange(256)
        if rng.random() < 0.2:
            content = bytearray(rng.choice((b"", b"[" * 100_000, b'{"run":"\\ud800"}', b"null")))
        path.write_bytes(bytes(content))


KINDS = (change, change, change, change, change, change, wander, break_off, intrude, damage)


def check_usable(client: Client) -> None:
    """The session can be opened, changed and undone, and the jobs end."""

    def session(action: str, **more: object) -> dict[str, object]:
        body = json.dumps({"run": RUN, "action": action, **more}).encode()
        status, answer = client.ask("POST", "/api/session", body)
        if status != 200:
            raise Find(f"the session is not usable: {action} {more}: {answer!r}")
        return dict(json.loads(answer)["session"])

    for _ in range(300):
        if session("open")["undo"] is None:
            break
        session("undo")
    else:
        raise Find("undo comes to no end")
    if session("open")["effects"] != []:
        raise Find("all undone, and there is an effect")
    session("add", effect="effective_track")
    if session("undo")["effects"] != []:
        raise Find("undo did not take it away")
    for job in client.server.wait_for_jobs():
        client.ask("POST", f"/api/dismiss?id={job['id']}", b"{}")
    left = [
        path for path in (client.server.results / "workbench" / "uploads").rglob("*") if path.name != ".lock"
    ]
    if any(path.is_file() for path in left):
        raise Find(f"left of uploads: {left}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    rng = random.Random(chosen.seed)  # noqa: S311 - repeatable, not secret
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "field").mkdir()
        log = simulate_case(
            None, {"effective_track": 1.6}, out=folder / "field" / "hidden.mcap", seed=3, duration_s=60.0
        )
        results = folder / "results"
        options = Options(out=results, report=True, overrides={"vehicle": {"preset": "husky_a200"}})
        analyze_log(log, options)
        server = Workbench(results, limits=replace(LIMITS, timeout_s=60.0, memory_bytes=2_000_000_000))
        client = Client(
            server,
            (f"{folder}/field", str(results / "workbench" / "uploads"), "site-packages", "pytho" + "n3."),
        )
        content, end, rounds = log.read_bytes(), time.monotonic() + 60.0 * chosen.minutes, 0
        try:
            while time.monotonic() < end:
                for _ in range(REQUESTS_A_ROUND):
                    rng.choice(KINDS)(client, rng, content)
                check_usable(client)
                rounds += 1
        finally:
            answers = ", ".join(
                f"{count} x {status or 'closed'}" for status, count in sorted(client.seen.items())
            )
            sys.stdout.write(
                f"seed {chosen.seed}: {rounds} rounds, {client.seen.total()} requests: {answers}\n"
            )
            server.close()
            shutil.rmtree(results, ignore_errors=True)


if __name__ == "__main__":
    main()
