"""The wheel carries what the program needs, and works where nothing else is."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    build = "from hatchling.build import build_wheel; import sys; print(build_wheel(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", build, str(folder)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return folder / done.stdout.split()[-1]


def test_the_wheel_carries_presets_contracts_and_pages(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())

    for folder, pattern in (
        ("pipeline/vehicles/presets", "*.toml"),
        ("schemas", "*.py"),
        ("pipeline/report", "page.*"),
        ("pipeline/report", "*.js"),
        ("pipeline/report/templates", "**/*.html"),
        ("pipeline/batch", "catalogue.*"),
        ("pipeline/web", "page.*"),
        ("pipeline/web", "*.js"),
    ):
        kept = {str(path.relative_to(ROOT)) for path in (ROOT / folder).glob(pattern)}
        assert kept
        assert kept <= names
    assert not any(name.startswith(("tests/", "data_samples/")) for name in names)


@pytest.mark.long
def test_the_wheel_analyzes_a_log_in_a_bare_environment(wheel: Path, tmp_path: Path) -> None:
    environment = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--require-hashes", "-r", str(ROOT / "requirements.txt")], check=True)
    subprocess.run([*pip, "--no-deps", str(wheel)], check=True)
    log = ROOT / "data_samples" / "husky_tile.mcap"
    done = subprocess.run(
        [str(environment / "bin" / "slip"), "analyze", str(log), "--out", str(tmp_path / "out")],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )

    assert done.returncode == 0, done.stderr
    assert "husky_a200" in done.stdout
    asked = [str(environment / "bin" / "slip"), "--version"]
    said = subprocess.run(asked, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert f"-{said.stdout.strip()}-" in wheel.name
