"""Who may ask the server what, and what its answers allow a browser to do."""

from __future__ import annotations

import json
import socket
from typing import TYPE_CHECKING

import pytest
from workbench_server import RUN

from pipeline.workbench import WorkbenchError, serve
from pipeline.workbench.guard import strip_port

if TYPE_CHECKING:
    from pathlib import Path

    from workbench_server import Workbench


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
    assert "allow-same-origin" not in policy[0]


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "[::2]:80", "", "localhost.evil:1"]
)
def test_a_name_that_points_here_from_elsewhere_is_refused(workbench: Workbench, host: str) -> None:
    for path in ("/", "/api/runs"):
        status, _, body = workbench.request("GET", path, headers={"Host": host})
        assert status in {400, 403}
        assert b"runs" not in body


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1", "[::1]", "LOCALHOST"])
def test_the_loopback_by_any_of_its_names_is_let_in(workbench: Workbench, host: str) -> None:
    status, _, _ = workbench.request("GET", "/api/runs", headers={"Host": f"{host}:{workbench.port}"})
    assert status == 200


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://localhost:1", "http://127.0.0.1", "http://127.0.0.1:99999"],
)
def test_another_origin_is_refused(workbench: Workbench, origin: str) -> None:
    body = json.dumps({"run": RUN, "action": "add", "effect": "drive_lag"}).encode()
    status, _, _ = workbench.request("POST", "/api/desk", body, headers={"Origin": origin})
    assert status == 403
    status, _, _ = workbench.request("GET", "/api/runs", headers={"Origin": origin})
    assert status == 403
    assert not (workbench.results / "workbench").exists()


def test_a_change_without_an_origin_is_refused(workbench: Workbench) -> None:
    import http.client  # noqa: PLC0415 - this one request must not say its origin

    connection = http.client.HTTPConnection("127.0.0.1", workbench.port)
    connection.request("POST", "/api/desk", b"{}")
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
    assert workbench.refuse("/api/desk", run=RUN, formula="x" * 200_000)["code"] == "bad_request"


def test_ports_are_stripped_from_hosts() -> None:
    assert strip_port("LocalHost:80") == "localhost"
    assert strip_port("[::1]:8321") == "[::1]"
    assert strip_port("127.0.0.1") == "127.0.0.1"


def test_a_taken_port_is_named(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(WorkbenchError, match="--port") as caught:
            serve(tmp_path, host="127.0.0.1", port=port, tell=lambda _: None)
    assert caught.value.code == "port_taken"
