"""Logs that are unchecked, huge or absurd, through the command line: one clear answer each."""

import json
import struct
from itertools import pairwise
from pathlib import Path

import pytest
import zstandard
from verbs import run_program, run_verb

from pipeline.cli.screen import format_run

DATA_END = 15


@pytest.fixture
def unchecked(samples: Path, tmp_path: Path) -> Path:
    """A log whose chunks and data section carry no checksum."""
    content = bytearray((samples / "husky_tile.mcap").read_bytes())
    starts = [8]
    while starts[-1] < len(content) - 8:
        starts.append(starts[-1] + 9 + struct.unpack_from("<Q", content, starts[-1] + 1)[0])
    for start, _ in pairwise(starts):
        if content[start] == 6:
            content[start + 33 : start + 37] = bytes(4)
        elif content[start] == 15:
            content[start + 9 : start + 13] = bytes(4)
    path = tmp_path / "unchecked.mcap"
    path.write_bytes(content)
    return path


WORDS = "no checksum covers its messages: damage in them cannot be detected"


def test_a_log_without_checksums_is_called_unchecked_wherever_its_health_is_shown(
    unchecked: Path, tmp_path: Path
) -> None:
    seen = run_verb("inspect", unchecked)
    assert seen.returncode == 0
    assert f"complete, unchecked: {WORDS}" in seen.stdout
    assert json.loads(run_verb("inspect", unchecked, "--json").stdout)["unchecked"] == WORDS
    done = run_verb("analyze", unchecked, "--results", tmp_path / "out", "--no-diagnosis", "--json")
    assert done.returncode == 0
    (run,) = json.loads(done.stdout)["runs"]
    assert f"complete (unchecked: {WORDS})" in format_run(run, unchanged=False)
    assert run["log"]["unchecked"] == WORDS
    page = Path(run["report"]).read_text(encoding="utf-8")
    assert "log unchecked" in page
    assert "damage in them cannot be detected" in page


def test_a_log_with_checksums_is_not_called_unchecked(samples: Path) -> None:
    seen = run_verb("inspect", samples / "husky_tile.mcap", "--json")
    assert json.loads(seen.stdout)["unchecked"] is None


def test_a_verb_that_only_reads_results_has_a_memory_limit(tmp_path: Path, samples: Path) -> None:
    out = tmp_path / "out"
    run_verb("analyze", samples / "husky_tile.mcap", "--results", out, "--no-diagnosis", "--no-report")
    hungry = "SELECT a.t FROM slip a CROSS JOIN slip b CROSS JOIN slip c ORDER BY a.t"
    done = run_program("results", "query", hungry, "--results", out, "--memory", "1GB", "--json")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("slip: the command used 1")
    assert [error["code"] for error in json.loads(done.stdout)["errors"]] == ["out_of_memory"]


@pytest.mark.parametrize("verb", ["analyze", "diagnose"])
def test_too_much_memory_ends_with_one_line(samples: Path, tmp_path: Path, verb: str) -> None:
    log = samples / "husky_tile.mcap"
    done = run_program(verb, log, "--results", tmp_path / "out", "--memory", "200MB", "--json", "--quiet")
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"slip: {log}: the command used 0.")
    assert "more than 0.2 GB. Give it more with --memory" in line
    content = json.loads(done.stdout)
    assert content["runs"] == []
    assert [error["code"] for error in content["errors"]] == ["out_of_memory"]
    assert not list(tmp_path.rglob("manifest.json"))
    after = run_verb(
        "analyze", log, "--results", tmp_path / "out", "--no-diagnosis", "--no-report", "--quiet"
    )
    assert (after.returncode, after.stderr) == (0, "")


@pytest.fixture
def bomb(samples: Path, tmp_path: Path) -> Path:
    """A log without summary, and behind it chunks of some kilobytes that inflate to 1.3 GB of zeros."""
    content = (samples / "husky_tile.mcap").read_bytes()
    starts = [8]
    while content[starts[-1]] != DATA_END:
        starts.append(starts[-1] + 9 + struct.unpack_from("<Q", content, starts[-1] + 1)[0])
    size = 255 << 20
    packed = zstandard.ZstdCompressor().compress(bytes(size))
    body = struct.pack("<QQQII", 0, 0, size, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    path = tmp_path / "bomb.mcap"
    path.write_bytes(content[: starts[-1]] + (struct.pack("<BQ", 6, len(body)) + body) * 5)
    return path


def test_a_log_that_inflates_beyond_its_budget_is_read_up_to_it(bomb: Path, tmp_path: Path) -> None:
    whole = json.loads(run_verb("inspect", bomb, "--max-inflated", "2GB", "--json").stdout)
    seen = run_verb("inspect", bomb, "--max-inflated", "300MB", "--json")
    assert seen.returncode == 3
    found = json.loads(seen.stdout)
    assert found["messages"] == whole["messages"] > 1000
    kinds = [loss["kind"] for loss in found["losses"]]
    assert kinds.count("max_inflated") == 1
    assert "max_inflated" not in [loss["kind"] for loss in whole["losses"]]
    plain = run_verb("inspect", bomb)
    assert plain.returncode == 3
    assert "times its size, and at most" in plain.stdout
    assert "chunks were left out; --max-inflated" in plain.stdout
    done = run_verb("analyze", bomb, "--results", tmp_path, "--no-diagnosis", "--no-report", "--json")
    assert done.returncode == 3
    (run,) = json.loads(done.stdout)["runs"]
    assert "max_inflated" in json.dumps(run)


def test_results_of_a_log_that_was_cut_short_are_not_those_of_all_of_it(
    samples: Path, tmp_path: Path
) -> None:
    log = samples / "husky_tile.mcap"

    def extract(*more: str) -> dict[str, object]:
        done = run_verb("results", "stage", "extract", log, "--results", tmp_path, "--json", *more)
        assert done.returncode in (0, 3), done.stderr
        return dict(json.loads(done.stdout))

    some = extract("--max-inflated", "1500kB")
    every = extract()
    assert every["computed"] == ["extract"]
    assert every["rows"] != some["rows"]
    assert extract("--max-inflated", "2GB")["computed"] == []


def test_messages_of_a_damaged_chunk_are_not_counted(samples: Path, tmp_path: Path) -> None:
    content = bytearray((samples / "husky_tile.mcap").read_bytes())
    content[600_000:605_000] = bytes(5000)
    (damaged := tmp_path / "damaged.mcap").write_bytes(content)
    whole = json.loads(run_verb("inspect", samples / "husky_tile.mcap", "--json").stdout)
    found = json.loads(run_verb("inspect", damaged, "--json").stdout)

    assert whole["messages"] == whole["messages_stated"] == found["messages_stated"]
    assert found["messages"] == sum(topic["messages"] for topic in found["topics"]) < whole["messages"]
    plain = run_verb("inspect", damaged, "--all").stdout
    assert f"{found['messages']} of {whole['messages']} messages in" in plain
    assert all(f"  {topic['messages']}  " in plain for topic in found["topics"])
