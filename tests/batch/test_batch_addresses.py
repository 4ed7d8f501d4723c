"""Addresses in the results of a stranger are not asked unless the user says so, whatever verb reads them."""

import json
import threading
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import msgspec
import pytest
from batch_tools import batch
from verbs import slip

pytest.importorskip("s3fs", reason="the extra s3 is not installed")

from collections.abc import Iterator
from pathlib import Path

import fsspec

from pipeline.batch.batch_work import Ledger
from pipeline.logs import LogError, open_store
from pipeline.store import LOG_NOTES, Store
from pipeline.store.manifests import encode_manifest

RUN = "season/a"
VERBS = {
    "verify": ("results", "verify", "OUT"),
    "verify --repair": ("results", "verify", "OUT", "--repair"),
    "verify --sample": ("results", "verify", "OUT", "--sample", "100%"),
    "status": ("results", "status", "--results", "OUT"),
    "status of a run": ("results", "status", RUN, "--results", "OUT"),
    "stage": ("results", "stage", "slip", RUN, "--results", "OUT"),
    "diagnose": ("diagnose", RUN, "--results", "OUT"),
    "diagnose as another vehicle": ("diagnose", RUN, "--results", "OUT", "--vehicle", "warthog"),
    "model fit": ("model", "fit", "MODEL", "--on", RUN, "--results", "OUT"),
    "plan": ("plan", RUN, "--results", "OUT"),
    "export": ("export", RUN, "--to", "mcap", "--results", "OUT"),
    "query": ("results", "query", "SELECT log FROM runs", "--results", "OUT"),
    "compare": ("compare", "OUT"),
    "analyze": ("analyze", "LOG", "--results", "OUT", "--no-report", "--no-diagnosis"),
    "batch": ("batch", "LOG", "--results", "OUT", "--settle", "0", "--jobs", "1", "--executor", "inline"),
    "batch --retry-quarantined": ("batch", "LOG", "--results", "OUT", "--settle", "0", "--retry-quarantined"),
}


@pytest.fixture
def asked() -> Iterator[tuple[str, list[str]]]:
    """Address of a server on loopback, and what it was asked for."""
    requests: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requests.append(self.path)
            self.send_error(404)

        def do_HEAD(self) -> None:
            self.do_GET()

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"127.0.0.1:{server.server_address[1]}", requests
    server.shutdown()
    server.server_close()
    thread.join()


def name_address(out: Path, address: str) -> None:
    """Have the results of a run name another place of its log, as a stranger would write them."""
    store = Store(out)
    for manifest in store.manifests():
        details = json.loads(json.dumps(manifest.details))
        details["log"]["path"] = address
        forged = replace(manifest, details=details)
        home = manifest.folder.parent
        (home / "manifest.json").write_bytes(encode_manifest(forged))
    for entry in Ledger(store).read_all().values():
        forged_entry = replace(entry, state="failed", log=replace(entry.log, path=address))
        store.notes(LOG_NOTES).write(address, msgspec.to_builtins(forged_entry))


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["http", "s3", "ftp"])
def test_no_verb_asks_an_address_that_only_results_name(
    season: Path,
    tmp_path: Path,
    asked: tuple[str, list[str]],
    scheme: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    host, requests = asked
    for name, value in {
        "ENDPOINT_URL": f"http://{host}",
        "ACCESS_KEY_ID": "a",
        "SECRET_ACCESS_KEY": "b",
    }.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    out, log = tmp_path / "out", season / "a.mcap"
    address = "s3://stranger/logs/a.mcap" if scheme == "s3" else f"{scheme}://{host}/logs/a.mcap"
    batch(log, out)
    name_address(out, address)
    slip("model", "new", tmp_path / "model.toml", "--vehicle", "husky_a200")
    monkeypatch.chdir(tmp_path)
    places = {"OUT": out, "LOG": log, "MODEL": tmp_path / "model.toml"}
    for verb, words in VERBS.items():
        code = slip(*(places.get(word, word) for word in words))
        said = capsys.readouterr()
        assert code != 2, f"{verb}: {said.err}"
        assert "Traceback" not in said.err, verb
        assert requests == [], verb
        name_address(out, address)
    if scheme == "s3":
        slip("results", "verify", out, "--follow-remote")
        assert requests
    fsspec.get_filesystem_class("s3").clear_instance_cache()


def test_verify_says_what_was_not_asked_and_finds_nothing_wrong_with_it(
    season: Path, tmp_path: Path, asked: tuple[str, list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    host, requests = asked
    out = tmp_path / "out"
    batch(season / "a.mcap", out)
    name_address(out, "s3://stranger/logs/a.mcap")
    assert slip("results", "verify", out) == 0
    said = capsys.readouterr().out
    assert "remote   s3://stranger/logs/a.mcap (season/a)" in said
    assert "--follow-remote" in said
    assert "all files that were read are unchanged" in said
    for scheme in ("http", "ftp", "sftp", "github", "s3x"):
        name_address(out, f"{scheme}://{host}/a.mcap")
        for option in ("--logs", "--follow-remote"):
            assert slip("results", "verify", out, option) == 1
            said = capsys.readouterr().out
            assert f"{scheme}:// addresses are not read" in said
    assert requests == []


@pytest.mark.parametrize("address", ["ftp://127.0.0.1/a.mcap", "http://127.0.0.1:9/a.mcap", "s3x:/a/b.mcap"])
def test_a_kind_of_store_that_is_not_known_is_one_line(
    address: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(LogError, match="addresses are not read"):
        open_store(address)
    assert slip("inspect", address) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "addresses are not read" in said


def test_an_address_chains_no_other_one(asked: tuple[str, list[str]]) -> None:
    host, requests = asked
    store = open_store(f"memory://x::http://{host}/a.mcap")
    with pytest.raises(OSError, match="x"):
        store.cat_file(f"memory://x::http://{host}/a.mcap")
    assert requests == []
