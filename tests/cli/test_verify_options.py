"""`slip results verify`: a key, a sample, and what they say."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest

from pipeline.cli import main
from pipeline.simulate import simulate_case
from pipeline.store import Store
from pipeline.store.listing import entry_name
from pipeline.store.seals import KEY_VARIABLE

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def key_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A key, and an environment in which none is named afterwards."""
    monkeypatch.setenv(KEY_VARIABLE, "")
    path = tmp_path / "key"
    path.write_bytes(os.urandom(32))
    path.chmod(0o600)
    return path


def slip(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    os.environ[KEY_VARIABLE] = ""
    return int(ended.value.code or 0), said.out + said.err


def test_results_keep_their_key_from_command_to_command(
    tmp_path: Path, key_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, logs = tmp_path / "out", tmp_path / "logs"
    for number in range(2):
        simulate_case("husky_tile", out=logs / f"{number}.mcap", duration_s=8.0, seed=number)
    with_key = ("--key", key_file)
    batch = ("batch", logs, "--out", out, "--settle", "0")
    # Its workers are processes of their own.
    assert slip(capsys, *batch, *with_key, "--jobs", "2")[0] == 0
    assert slip(capsys, "compare", out, *with_key)[0] == 0
    code, said = slip(capsys, "results", "verify", out, *with_key)
    assert (code, "sealed" in said) == (0, False)
    code, said = slip(capsys, "results", "verify", out)
    assert code == 0
    assert "The results are sealed with a key; --key FILE checks the seal." in said

    for words in (
        (*batch, "--force"),
        ("analyze", logs / "0.mcap", "--out", out, "--force"),
        ("compare", out),
        ("fleet", "trend", out),
    ):
        code, said = slip(capsys, *words)
        assert code == 1, words
        assert "the results are sealed with a key. Name its file: --key FILE, or SLIP_KEY_FILE." in said
    assert slip(capsys, "results", "verify", out, *with_key)[0] == 0

    (out / "sealed.json").unlink()
    code, said = slip(capsys, "results", "verify", out, *with_key)
    assert code == 1
    assert "the results are not sealed with the key" in said


@pytest.mark.parametrize(
    "verb",
    [
        "analyze x.mcap", "results stage extract x.mcap", "diagnose x.mcap", "batch x", "batch run x",
        "compare", "fleet trend", "fleet map", "fleet fit", "plan x.mcap", "serve", "results verify",
        "results seal",
    ],
)  # fmt: skip
def test_every_verb_that_writes_results_takes_the_key(
    verb: str, key_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key_file.write_bytes(b"short")
    code, said = slip(capsys, *verb.split(), "--key", key_file)
    assert (code, said.count("\n")) == (1, 1)
    assert "the key holds 5 bytes and not 32 to 65536" in said


def test_a_sample_says_how_much_was_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, log = tmp_path / "out", tmp_path / "a.mcap"
    simulate_case("husky_tile", out=log, duration_s=8.0, seed=1)
    slip(capsys, "analyze", log, "--out", out, "--no-diagnosis", "--no-report")
    # Which files a seed draws depends on their names, and those on the version of slip.
    looked_at = set()
    for seed in range(10):
        code, said = slip(capsys, "results", "verify", out, "--sample", "20%", "--seed", seed, "--json")
        found = json.loads(said)
        files = found["read"]["files"]
        assert (code, found["runs"]) == (0, 1)
        looked_at.add(files["looked_at"])
    assert len(looked_at) > 1
    assert max(looked_at) < files["all"]
    code, said = slip(capsys, "results", "verify", out, "--sample", "20%", "--seed", seed)
    assert f"sample   {files['looked_at']} of {files['all']} files" in said
    assert "all files that were read are unchanged" in said
    for manifest in Store(out).manifests():
        manifest.path("slip").unlink()
    assert slip(capsys, "results", "verify", out, "--sample", "0.001%")[0] == 1
    for share in ("0%", "101%", "5", "five%"):
        code, said = slip(capsys, "results", "verify", out, "--sample", share)
        assert (code, "is not a share of the files" in said) == (1, True)
    assert slip(capsys, "results", "verify", out, "--seed", "3") == (
        1,
        "slip: --seed does nothing by itself. Add --sample, as 5%.\n",
    )
    assert not (out / "sealed.json").exists()


def test_results_are_sealed_with_a_key_once_and_as_a_whole_only(
    tmp_path: Path, key_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    page = Store(out).write_results_text("page.html", "x")
    code, said = slip(capsys, "results", "seal", out)
    assert (code, "--key" in said) == (1, True)
    page.write_text("another")
    assert slip(capsys, "results", "seal", out, "--key", key_file)[0] == 1
    assert not (out / "sealed.json").exists()
    page.write_text("x")
    assert slip(capsys, "results", "seal", out, "--key", key_file)[0] == 0
    assert slip(capsys, "results", "verify", out, "--key", key_file)[0] == 0
    code, said = slip(capsys, "results", "seal", out, "--key", key_file)
    assert (code, "sealed with a key already" in said) == (1, True)


def test_sealed_results_name_what_the_key_did_not_write(
    tmp_path: Path, key_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    os.environ[KEY_VARIABLE] = str(key_file)
    Store(out).write_results_text("page.html", "x")
    (out / "more.html").write_text("x")
    said = slip(capsys, "results", "verify", out, "--key", key_file, "--repair")[1]
    assert "unlisted more.html: slip did not write it with the key" in said
    assert "--repair" not in said


@pytest.mark.parametrize("name", ["sealed.json", "listed.json"])
def test_a_lost_entry_of_the_seal_or_the_register_is_repaired_with_the_key(
    name: str, tmp_path: Path, key_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    os.environ[KEY_VARIABLE] = str(key_file)
    Store(out).write_results_text("page.html", "x")
    (out / entry_name(name)).unlink()
    assert slip(capsys, "results", "verify", out, "--key", key_file)[0] == 1
    assert slip(capsys, "results", "verify", out, "--key", key_file, "--repair")[0] == 1
    os.environ[KEY_VARIABLE] = str(key_file)
    Store(out).write_results_text("page.html", "y")
    assert slip(capsys, "results", "verify", out, "--key", key_file) == (
        0,
        "0 runs checked\nall files are unchanged\n",
    )
