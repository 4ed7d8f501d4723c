"""Who may ask the server what, and what its answers allow a browser to do."""

import http.client
import json
import secrets

import pytest
from workbench_server import RUN, TOKEN, Workbench

from pipeline.web import Guard, make_token

EVERYTHING = (
    ("GET", "/"), ("GET", "/page.js"), ("GET", "/vega.js"), ("GET", "/api/runs"), ("GET", "/api/jobs"),
    ("GET", f"/report?run={RUN}"), ("GET", f"/model.toml?run={RUN}"), ("GET", "/nowhere"), ("HEAD", "/"),
    ("POST", "/api/session"), ("POST", "/api/upload?name=x.mcap"), ("POST", "/api/diagnose"), ("PUT", "/"),
    ("POST", "/api/plan"), ("GET", f"/plan?run={RUN}&file=plan.mcap"),
)  # fmt: skip
STRANGERS: tuple[dict[str, str], ...] = (
    {},
    {"Cookie": "slip-1=x; slip=y"},
    {"Authorization": "Bearer"},
    {"Authorization": f"Bearer {TOKEN[:-1]}"},
    {"Authorization": f"Basic {TOKEN}"},
    {"Authorization": "Bearer \xe9\xff"},
)


def test_whoever_has_no_token_gets_nothing_but_a_sentence(workbench: Workbench) -> None:
    for method, path in EVERYTHING:
        for headers in (*STRANGERS, {"Cookie": f"slip-{workbench.port}=guess"}):
            status, answered, body = workbench.request(method, path, b"", headers=headers, known=False)
            assert status == 403
            assert method == "HEAD" or b"`slip serve` printed" in body
            assert RUN.encode() not in body
            assert answered["set-cookie"] is None
        assert not (workbench.results / "workbench").exists()


def test_a_wrong_token_in_the_address_is_refused(workbench: Workbench) -> None:
    for token in ("", "guess", TOKEN[:-1], TOKEN + "x", "%E9", "%ff"):
        status, headers, _ = workbench.request("GET", f"/?token={token}", known=False)
        assert status == 403
        assert headers["set-cookie"] is None
    # It is asked for where the page is opened, and nowhere else: it must not end up in logs and links.
    assert workbench.request("GET", f"/api/runs?token={TOKEN}", known=False)[0] == 403


def test_the_printed_address_gives_a_cookie_that_only_the_browser_sees(workbench: Workbench) -> None:
    path = workbench.address.removeprefix(workbench.origin)
    status, headers, body = workbench.request("GET", path, known=False)
    assert status == 200
    assert TOKEN.encode() not in body
    # A browser keeps what stands behind # to itself: only a script can take it along.
    assert b'<script src="/enter.js">' in body
    assert b"location.hash" in workbench.request("GET", "/enter.js")[2]
    kept, *flags = [part.strip().lower() for part in headers["set-cookie"].split(";")]
    assert {"httponly", "samesite=strict", "path=/"} <= set(flags)
    assert not any(flag.startswith(("domain", "expires", "max-age")) for flag in flags)
    for path in ("/", "/api/runs"):
        assert workbench.request("GET", path, headers={"Cookie": kept}, known=False)[0] == 200


def test_a_script_sends_the_token_as_a_header(workbench: Workbench) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", workbench.port)
    bearer = {"Authorization": f"Bearer {TOKEN}"}
    connection.request("POST", "/api/session", json.dumps({"run": RUN}).encode(), headers=bearer)
    assert connection.getresponse().status == 200
    connection.close()
    # Whatever it knows, another origin is another origin.
    for foreign in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
        assert workbench.request("GET", "/api/runs", headers={**bearer, **foreign}, known=False)[0] == 403


def test_tokens_are_compared_in_constant_time_and_made_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    compared = []

    def compare(one: bytes, two: bytes) -> bool:
        compared.append((one, two))
        return False

    monkeypatch.setattr(secrets, "compare_digest", compare)
    asked = {"type": "http", "path": "/", "method": "GET", "query_string": b"token=guess", "server": ("", 80)}
    headers = [(b"host", b"localhost"), (b"cookie", b"slip-80=crumb"), (b"authorization", b"Bearer word")]
    answer = Guard(lambda *_: None, TOKEN)._answer({**asked, "headers": headers})  # type: ignore[arg-type, return-value]
    assert answer is not None
    assert {given for given, _ in compared} == {b"guess", b"crumb", b"word"}
    assert {make_token() for _ in range(20)}.__len__() == 20
    assert len(make_token()) >= 43


def test_answers_carry_a_strict_policy(workbench: Workbench) -> None:
    for path in ("/", "/page.js", "/api/runs", "/nowhere"):
        _, headers, _ = workbench.request("GET", path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["access-control-allow-origin"] is None


def test_a_report_is_shut_off_from_the_page_that_links_to_it(workbench: Workbench) -> None:
    status, headers, body = workbench.request("GET", f"/report?run={RUN}")
    assert status == 200
    assert b"<html" in body[:200]
    policy = headers.get_all("content-security-policy")
    assert policy is not None
    assert len(policy) == 1
    assert "sandbox allow-scripts" in policy[0]
    assert "frame-ancestors 'none'" in policy[0]
    assert "allow-same-origin" not in policy[0]


def test_a_name_that_points_here_from_elsewhere_is_refused(workbench: Workbench) -> None:
    for host in ["evil.example", "127.0.0.1.evil.example", "[::2]:80", "", "localhost.evil:1"]:
        for path in ("/", "/api/runs"):
            status, _, body = workbench.request("GET", path, headers={"Host": host})
            assert status in {400, 403}
            assert b"runs" not in body


@pytest.mark.parametrize(
    ("host", "is_let_in"),
    [
        ("192.168.7.9:8321", True),
        ("[fd00::7]:8321", True),
        ("evil.example", False),
        ("192.168.7.9.evil", False),
    ],
)
def test_on_all_addresses_a_phone_gets_in_by_any_address_and_no_name_does(
    host: str, *, is_let_in: bool
) -> None:
    asked = {"type": "http", "path": "/api/runs", "method": "GET", "query_string": b"", "server": ("", 8321)}
    headers = [(b"host", host.encode()), (b"authorization", f"Bearer {TOKEN}".encode())]
    for hosts, expected in ((("0.0.0.0",), is_let_in), (("127.0.0.1",), False)):  # noqa: S104 - not bound
        answer = Guard(lambda *_: None, TOKEN, hosts)._answer({**asked, "headers": headers})  # type: ignore[arg-type, return-value]
        assert (answer is None) is expected


def test_the_loopback_by_any_of_its_names_is_let_in(workbench: Workbench) -> None:
    for host in ["localhost", "127.0.0.1", "[::1]", "LOCALHOST"]:
        status, _, _ = workbench.request("GET", "/api/runs", headers={"Host": f"{host}:{workbench.port}"})
        assert status == 200


def test_another_origin_is_refused(workbench: Workbench) -> None:
    for origin in [
        "https://evil.example",
        "null",
        "http://[",
        "",
        "http://localhost:1",
        "http://127.0.0.1",
        "http://127.0.0.1:99999",
    ]:
        body = json.dumps({"run": RUN, "action": "add", "effect": "drive_lag"}).encode()
        status, _, _ = workbench.request("POST", "/api/session", body, headers={"Origin": origin})
        assert status == 403
        status, _, _ = workbench.request("GET", "/api/runs", headers={"Origin": origin})
        assert status == 403
        assert not (workbench.results / "workbench").exists()


def test_a_change_without_an_origin_is_refused(workbench: Workbench) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", workbench.port)
    cookie = {"Cookie": f"slip-{workbench.port}={TOKEN}"}
    connection.request("POST", "/api/session", b"{}", headers=cookie)
    assert connection.getresponse().status == 403
    connection.close()


def test_another_site_may_link_here_and_load_nothing(workbench: Workbench) -> None:
    foreign = {"Sec-Fetch-Site": "cross-site"}
    status, _, _ = workbench.request("GET", "/", headers={**foreign, "Sec-Fetch-Mode": "navigate"})
    assert status == 200
    for path, mode in (("/page.js", "no-cors"), ("/api/runs", "no-cors"), (f"/report?run={RUN}", "navigate")):
        status, _, _ = workbench.request("GET", path, headers={**foreign, "Sec-Fetch-Mode": mode})
        assert status == 403


def test_a_body_that_is_too_long_is_not_read_to_its_end(workbench: Workbench) -> None:
    assert workbench.refuse("/api/session", run=RUN, formula="x" * 200_000)["code"] == "bad_request"


def test_the_cookie_that_follows_links_opens_stored_pages_and_nothing_else(workbench: Workbench) -> None:
    path = workbench.address.removeprefix(workbench.origin)
    _, headers, _ = workbench.request("GET", path, known=False)
    (pages,) = [one for one in headers.get_all("Set-Cookie") or [] if f"slip-{workbench.port}-pages=" in one]
    assert "HttpOnly" in pages
    assert TOKEN not in pages
    cookie = {
        "Cookie": pages.partition(";")[0],
        "Sec-Fetch-Site": "cross-site",
        "Sec-Fetch-Mode": "navigate",
    }
    (workbench.results / "index.html").write_text("<p>all runs</p>")
    status, headers, body = workbench.request("GET", "/index.html", known=False, headers=cookie)
    assert (status, body) == (200, b"<p>all runs</p>")
    assert "sandbox" in headers["content-security-policy"]
    report = next(workbench.results.glob("runs/**/report.html")).relative_to(workbench.results)
    assert workbench.request("GET", f"/{report.as_posix()}", known=False, headers=cookie)[0] == 200
    for other in ("/api/runs", "/", "/page.js", f"/report?run={RUN}", "/runs/field/summary.json"):
        assert workbench.request("GET", other, known=False, headers=cookie)[0] == 403
    outside = workbench.results.parent / "report.html"
    outside.write_text("not of the results")
    status, _, body = workbench.request("GET", "/runs/../../report.html", known=False, headers=cookie)
    assert status >= 400
    assert b"not of the results" not in body
