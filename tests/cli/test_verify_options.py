"""`slip results verify` of a sample of the files, and what it says."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from pipeline.cli import main
from pipeline.simulate import simulate_case
from pipeline.store import Store

if TYPE_CHECKING:
    from pathlib import Path


def slip(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return int(ended.value.code or 0), said.out + said.err


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
