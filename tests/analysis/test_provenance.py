"""What a result says about the program and the packages that computed it."""

import os
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
BASE = {"rosbags", "python", "slip-pipeline", "mcap", "numpy", "scipy", "polars", "pyarrow"}
DECLARED = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]


@pytest.mark.parametrize("program", [["-m", "pipeline"], [str(Path(sys.executable).with_name("slip"))]])
def test_the_program_says_its_version(program: list[str], tmp_path: Path) -> None:
    asked = [sys.executable, *program, "--version"]
    done = subprocess.run(
        asked, capture_output=True, text=True, check=True, cwd=ROOT if "-m" in program else tmp_path
    )
    assert done.stdout.strip() == DECLARED
    assert DECLARED != "0.0.0"


def test_a_checkout_that_is_not_installed_says_its_version(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "pipeline" / "core", tmp_path / "pipeline" / "core")
    for name in ("__init__.py", "door.py"):
        shutil.copyfile(ROOT / "pipeline" / name, tmp_path / "pipeline" / name)
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "7.8.9"\n', encoding="utf-8")
    code = (
        "import importlib.metadata as m\n"
        "def missing(name): raise m.PackageNotFoundError(name)\n"
        "m.version = missing\n"
        "from pipeline.core import read_version; print(read_version())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert done.stdout.strip() == "7.8.9"


def test_results_list_the_packages_that_took_part(tmp_path: Path) -> None:
    log = simulate_case("ideal_husky", out=tmp_path / "run.mcap", duration_s=30.0)
    plain = analyze_log(log, Options(out=tmp_path / "plain", report=False))
    origin = plain.summary["provenance"]
    assert origin["version"] == DECLARED
    assert origin["versions"] == plain.manifest.details["versions"]
    assert origin["versions"].keys() == BASE | {"zstandard"}
    assert origin["versions"]["scipy"] == version("scipy")

    diagnosed = analyze_log(log, Options(out=tmp_path / "diagnosed", report=False, diagnosis=True))
    assert diagnosed.summary["provenance"]["versions"].keys() == BASE | {"zstandard"}
