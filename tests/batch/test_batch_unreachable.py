"""An object store that does not do what it should: one line, within the time that somebody waits."""

import socket
import time

import pytest
from few import few
from verbs import run_slip

pytest.importorskip("s3fs", reason="the extra s3 is not installed")

from collections.abc import Iterator
from pathlib import Path

import fsspec

from pipeline.logs import remote as bucket_room

LOG = "s3://nobody/logs/a.mcap"
VERBS = {
    "inspect": ("inspect", LOG),
    "analyze": ("analyze", LOG, "--no-report"),
    "batch": ("batch", "s3://nobody/logs"),
    "batch of one": ("batch", LOG),
    "batch of a glob": ("batch", "s3://nobody/logs/*.mcap"),
}


@pytest.fixture(autouse=True)
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Nothing in the environment says who somebody is or where the store is."""
    for name in ("AWS_ENDPOINT_URL", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.chdir(tmp_path)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    yield
    fsspec.get_filesystem_class("s3").clear_instance_cache()


def run(*arguments: str) -> str:
    """What a verb that fails says."""
    code, _, said = run_slip(*arguments)
    assert code == 1, said
    lines = [line for line in said.splitlines() if line.startswith("slip: ")]
    assert len(lines) == 1, said
    assert "Traceback" not in said
    return lines[0]


@pytest.mark.parametrize("verb", few(VERBS, 3))
def test_without_credentials(verb: str) -> None:
    assert "Unable to locate credentials" in run(*VERBS[verb])


@pytest.mark.parametrize("verb", few(["batch", "inspect"], 2))
def test_without_anybody_at_the_address(verb: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as place:
        place.bind(("127.0.0.1", 0))
        port = place.getsockname()[1]
    for name, value in {"ENDPOINT_URL": f"http://127.0.0.1:{port}", "ACCESS_KEY_ID": "a"}.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
    monkeypatch.setattr(bucket_room, "_ATTEMPTS", 1)
    assert f"127.0.0.1:{port}" in run(*VERBS[verb])


def test_a_store_that_is_silent_does_not_hold_anybody(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bucket_room, "_ANSWER_S", 0.2)
    monkeypatch.setattr(bucket_room, "_ATTEMPTS", 1)
    with socket.create_server(("127.0.0.1", 0)) as place:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{place.getsockname()[1]}")
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
        started = time.monotonic()
        said = run(*VERBS["batch"])
    assert time.monotonic() - started < 10.0
    assert "imeout" in said
