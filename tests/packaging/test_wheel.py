"""The wheel carries what the program needs, and works where nothing else is."""

import json
import os
import re
import subprocess
import sys
import urllib.request
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
        ("pipeline/sources/presets", "*.toml"),
        ("pipeline/models/literature", "*.toml"),
        ("schemas", "*.py"),
        ("slip", "*.*"),
        ("pipeline/report", "page.*"),
        ("pipeline/report/layouts", "*"),
        ("pipeline/report", "*.js"),
        ("pipeline/report/templates", "**/*.html"),
        ("pipeline/report", "catalogue.*"),
        ("pipeline", "py.typed"),
        ("pipeline/web", "page.*"),
        ("pipeline/web", "*.js"),
    ):
        kept = {str(path.relative_to(ROOT)) for path in (ROOT / folder).glob(pattern)}
        assert kept
        assert kept <= names
    assert not any(name.startswith(("tests/", "data_samples/")) for name in names)


def use_it(program: Path, wheel: Path, tmp_path: Path) -> None:
    """A sample is analyzed, and its results are served to who has the token."""
    log = ROOT / "data_samples" / "husky_tile.mcap"
    done = subprocess.run(
        [str(program), "analyze", str(log), "--results", "out"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "husky_a200" in done.stdout
    said = subprocess.run(
        [str(program), "--version"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert f"-{said.stdout.strip()}-" in wheel.name

    serve = [str(program), "serve", "out", "--port", "0"]
    with subprocess.Popen(serve, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            (address,) = re.findall(r"http://\S+", server.stdout.readline())
            origin, _, token = address.partition("/?token=")
            asked = urllib.request.Request(  # noqa: S310 - the workbench that was just started
                f"{origin}/api/runs", headers={"Authorization": f"Bearer {token}"}
            )
            with urllib.request.urlopen(asked, timeout=60.0) as answer:  # noqa: S310
                runs = json.load(answer)["runs"]
            # The address is exchanged for a cookie, and leads to the page.
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            with browser.open(address, timeout=60.0) as page:
                assert b"workbench" in page.read()
        finally:
            server.terminate()
    assert [run["run"] for run in runs] == ["data_samples/husky_tile"]


@pytest.mark.long
def test_the_wheel_analyzes_and_serves_in_a_bare_environment_and_leaves_it_bare(
    wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    environment = tmp_path / "bare"
    subprocess.run([sys.executable, "-m", "venv", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    subprocess.run([*pip, "--require-hashes", "-r", str(ROOT / "requirements.txt")], check=True)
    subprocess.run([*pip, "--no-deps", str(wheel)], check=True)

    use_it(environment / "bin" / "slip", wheel, tmp_path)
    assert list((tmp_path / "cache" / "slip" / "loops").rglob("*.nbc"))

    subprocess.run([*pip[:3], "uninstall", "--quiet", "--yes", "slip-pipeline"], check=True)
    (packages,) = (environment / "lib").glob("python*/site-packages")
    remains = [name for name in ("pipeline", "schemas", "slip") if (packages / name).exists()]
    assert remains == []
    assert not (environment / "bin" / "slip").exists()


@pytest.mark.long
def test_the_wheel_installs_as_a_tool_as_the_handbook_says(wheel: Path, tmp_path: Path) -> None:
    assert "uv tool install '.[all]'" in (ROOT / "docs/pages/install.md").read_text()
    around = {**os.environ, "UV_TOOL_DIR": str(tmp_path / "tools"), "UV_TOOL_BIN_DIR": str(tmp_path / "bin")}
    uv = Path(sys.executable).parent / "uv"
    subprocess.run([str(uv), "tool", "install", "--quiet", f"{wheel}[serve]"], env=around, check=True)

    use_it(tmp_path / "bin" / "slip", wheel, tmp_path)
