"""The answer to a log does not depend on the process that gives it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LOG = ROOT / ".." / "shared" / "strangers" / "logs" / "odometry_tf_and_commands.mcap"


@pytest.mark.long
@pytest.mark.skipif(not LOG.exists(), reason="../shared/strangers is not here")
def test_the_order_of_names_in_memory_changes_no_answer(tmp_path: Path) -> None:
    """A search of this log can end at two sets of effects."""
    told = []
    for seed in ("0", "1", "2"):
        made = subprocess.run(
            [sys.executable, "-m", "pipeline", "diagnose", LOG, "--results", tmp_path / seed, "--json"],
            env={**os.environ, "PYTHONHASHSEED": seed},
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        effects = json.loads(made.stdout)["runs"][0]["effects"]
        told.append(json.dumps(effects))
    assert len(set(told)) == 1
