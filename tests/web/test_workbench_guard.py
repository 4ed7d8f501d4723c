"""Who may ask the server what, and what its answers allow a browser to do."""

import json
from pathlib import Path
from typing import cast

import pytest
from verbs import run_slip
from workbench_server import LIMITS, RUN, TOKEN, Workbench

from pipeline.web import WorkbenchError, server
from pipeline.web.guard import Guard

EVERYTHING = (
    ("GET", "/"), ("GET", "/page.js"), ("GET", "/vega.js"), ("GET", "/api/runs"), ("GET", "/api/jobs"),
    ("GET", f"/report?run={RUN}"), ("GET", f"/model.toml?run={RUN}"), ("GET", "/nowhere"), ("HEAD", "/"),
    ("POST", "/api/session"), ("POST", "/api/upload?name=x.mcap"), ("POST", "/api/diagnose"), ("PUT", "/"),
)  # fmt: skip
STRANGERS: tuple[dict[str, str], ...] = (
    {},
    {"Cookie": "slip-1=x; slip=y"},
    {"Cookie": f"slip-{Workbench.port}=guess"},
    {"Authorization": "Bearer"},
    {"Authorization": TOKEN},
    {"Authorization": f"Bearer {TOKEN[:-1]}"},
    {"Authorization": f"Basic {TOKEN}"},
    {"Authorization": "Bearer \xe9\xff"},
)
LINK = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
BEARER = {"Authorization": f"Bearer {TOKEN}"}


def test_whoever_has_no_token_gets_nothing_but_a_sentence(workbench: Workbench) -> None:
    for method, path in EVERYTHING:
        for headers in STRANGERS:
            status, answered, body = workbench.request(method, path, b"", headers=headers, known=False)
            assert status == 403
            assert b"`slip serve` printed" in body
            assert "set-cookie" not in answered
    # It is asked for where the page is opened, and nowhere else: it must not end up in logs and links.
    wrong = [f"/?token={token}" for token in ("", "guess", TOKEN[:-1], TOKEN + "x", "%E9", "%ff")]
    for path in (*wrong, f"/api/runs?token={TOKEN}"):
        assert workbench.request("GET", path, known=False)[0] == 403


def test_the_printed_address_gives_a_cookie_that_only_the_browser_sees(workbench: Workbench) -> None:
    path = workbench.address.removeprefix(workbench.origin)
    status, headers, _ = workbench.request("GET", path, headers=LINK, known=False)
    # The browser takes along what stands behind #, and leaves the token.
    assert (status, headers["location"]) == (303, "/")
    kept, *flags = [part.strip().lower() for part in headers["set-cookie"].split(";")]
    assert {"httponly", "samesite=lax", "path=/"} <= set(flags)
    assert not any(flag.startswith(("domain", "expires", "max-age")) for flag in flags)
    for path in ("/", "/api/runs"):
        assert workbench.request("GET", path, headers={"Cookie": kept}, known=False)[0] == 200


def test_a_script_sends_the_token_as_a_header_and_another_origin_is_refused(workbench: Workbench) -> None:
    body = json.dumps({"run": "nobody"}).encode()
    asked = {"Host": f"127.0.0.1:{workbench.port}", "Content-Length": str(len(body))}
    assert workbench._send("POST", "/api/session", body, {**asked, **BEARER})[0] == 404
    cookie = {"Cookie": f"slip-{workbench.port}={TOKEN}"}
    assert workbench._send("POST", "/api/session", body, {**asked, **cookie})[0] == 403
    for origin in ("https://evil.example", "null", "http://[", "", "http://localhost:1", "http://127.0.0.1"):
        for method, path in (("POST", "/api/session"), ("GET", "/api/runs")):
            for known in (cookie, BEARER):
                foreign = {**known, "Origin": origin}
                assert workbench.request(method, path, body, headers=foreign, known=False)[0] == 403


def test_another_site_may_link_to_the_page_and_load_nothing(workbench: Workbench) -> None:
    assert workbench.request("GET", "/", headers=LINK)[0] == 200
    for path in ("/api/runs", "/page.js", "/model.toml", f"/report?run={RUN}", "/runs/field/summary.json"):
        assert workbench.request("GET", path, headers=LINK)[0] == 403
    for path in ("/", "/page.js", "/api/runs"):
        assert workbench.request("GET", path, headers={**LINK, "Sec-Fetch-Mode": "no-cors"})[0] == 403
    assert workbench.request("POST", "/", b"", headers=LINK)[0] == 403


@pytest.mark.parametrize(
    ("hosts", "let_in", "refused"),
    [
        (
            ("127.0.0.1", "localhost", "::1"),
            ("localhost", "127.0.0.1:1", "[::1]:8321", "LOCALHOST:8321"),
            (
                "evil.example",
                "127.0.0.1.evil.example",
                "[::2]:80",
                "",
                "[",
                "localhost.evil:1",
                "192.168.7.9",
            ),
        ),
        (
            ("localhost", "0.0.0.0", "robot.local"),  # noqa: S104 - not bound
            ("192.168.7.9:8321", "[fd00::7]:8321", "robot.local"),
            ("evil.example", "192.168.7.9.evil", "", "["),
        ),
    ],
    ids=["this machine", "every address"],
)
def test_a_name_that_points_here_from_elsewhere_is_refused(
    workbench: Workbench, hosts: tuple[str, ...], let_in: tuple[str, ...], refused: tuple[str, ...]
) -> None:
    guard = cast("Guard", workbench.app)
    workbench.app = Guard(guard._app, TOKEN, hosts)
    for status, names in ((200, let_in), (403, refused)):
        for host in names:
            assert workbench.request("GET", "/api/jobs", headers={"Host": host})[0] == status, host


def test_tokens_are_compared_in_constant_time_and_made_anew(
    workbench: Workbench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compared = []

    def compare(one: bytes, _: bytes) -> bool:
        compared.append(one)
        return False

    monkeypatch.setattr("pipeline.web.guard.compare_digest", compare)
    headers = {"Cookie": f"slip-{workbench.port}=crumb", "Authorization": "Bearer word"}
    assert workbench.request("GET", "/?token=guess", headers=headers, known=False)[0] == 403
    assert set(compared) == {b"Bearer word", b"guess", b"crumb"}

    told: list[tuple[str, str]] = []
    monkeypatch.setattr(server.uvicorn.Server, "run", lambda _, sockets: sockets[0].close())
    for host in ("localhost", "127.0.0.1"):
        server.serve(tmp_path, host=host, port=0, notify=lambda *one: told.append(one), limits=LIMITS)
    # Another user may listen on the other address that `localhost` has, and would be sent the token.
    assert all(address.startswith("http://127.0.0.1:") for address, _ in told)
    assert len({token for _, token in told if len(token) >= 43}) == 2
    for port in (70_000, -1):
        with pytest.raises(WorkbenchError, match="nothing can listen there"):
            server.serve(tmp_path, host="127.0.0.1", port=port, notify=lambda *_: None, limits=LIMITS)


def test_answers_carry_a_strict_policy_and_stored_pages_are_shut_off(workbench: Workbench) -> None:
    for path in ("/", "/page.js", "/api/runs", "/nowhere"):
        _, headers, _ = workbench.request("GET", path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in headers

    (workbench.results / "index.html").write_text("<html>all runs")
    report = next(workbench.results.glob("runs/**/report.html")).relative_to(workbench.results).as_posix()
    # Links between stored pages have no origin that the browser knows.
    for path, how in ((f"/report?run={RUN}", {}), ("/index.html", LINK), (f"/{report}", LINK)):
        status, headers, body = workbench.request("GET", path, headers=how)
        assert (status, b"<html" in body[:200]) == (200, True)
        (policy,) = headers.getlist("content-security-policy")
        assert "sandbox allow-scripts" in policy
        assert "frame-ancestors 'none'" in policy
        assert "allow-same-origin" not in policy
    (workbench.results.parent / "report.html").write_text("not of the results")
    for path in ("/runs/../../report.html", "/runs/field/hidden/manifest.json", "/fleet.html"):
        status, _, body = workbench.request("GET", path)
        assert status >= 400
        assert b"not of the results" not in body


def test_a_request_is_read_to_a_limit(workbench: Workbench) -> None:
    for more in ({"formula": "x" * 200_000}, {"formula": "x" * 500}, {"slot": "../a"}, {"action": "burn"}):
        assert workbench.refuse("/api/session", run=RUN, **more)["code"] == "bad_request"
    for body in (b"[" * 99_000, b"\xff", b'{"run": 1}', b""):
        assert workbench.request("POST", "/api/session", body)[0] == 422


def test_an_address_beyond_this_machine_is_warned_of(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Path] = []

    def serve(folder: Path, **more: object) -> None:
        opened.append(folder)
        more["notify"]("http://127.0.0.1:1/", "secret")  # type: ignore[operator]

    monkeypatch.setattr(server, "serve", serve)
    for words in (["hidden"], [RUN], [str(results)], []):
        code, out, said = run_slip("serve", *words, "--results", results)
        where = "#a=field%2Fhidden" if words in (["hidden"], [RUN]) else ""
        assert (code, said) == (0, "")
        assert f"http://127.0.0.1:1/?token=secret{where} " in out
    assert opened == [results] * 4
    _, _, said = run_slip("serve", "--results", results, "--host", "0.0.0.0")  # noqa: S104 - not bound
    assert "can be reached from the network" in said
    code, _, said = run_slip("serve", "hiden", "--results", results)
    assert code == 1
    assert "there is no run 'hiden'" in said
