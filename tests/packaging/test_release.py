"""`make release`: what forbids it, and what it makes, in a copy of the checkout and without a network."""

import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PARTS = ("pipeline", "schemas", "slip", "packaging", "data_samples/deployments.csv", "pyproject.toml",
         "README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", ".gitignore")  # fmt: skip
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def git(checkout: Path, *words: str) -> str:
    who = ("-c", "user.name=Tester", "-c", "user.email=tester@localhost")
    done = subprocess.run(["git", *who, *words], cwd=checkout, check=True, capture_output=True, text=True)
    return done.stdout


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The parts of this checkout that a release needs, committed."""
    for who in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{who}_NAME", "Tester")
        monkeypatch.setenv(f"GIT_{who}_EMAIL", "tester@localhost")
    root = tmp_path / "checkout"
    for name in PARTS:
        source, target = ROOT / name, root / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, target)
    git(root, "init", "--quiet")
    git(root, "add", "--all")
    git(root, "commit", "--quiet", "--message", "all")
    return root


def release(checkout: Path, *words: str) -> subprocess.CompletedProcess[str]:
    script = [sys.executable, str(ROOT / "packaging" / "release.py"), "--root", str(checkout), *words]
    return subprocess.run(script, capture_output=True, text=True, check=False)


def test_a_release_makes_wheel_archive_notes_and_tag_once(checkout: Path) -> None:
    assert (release(checkout, "--check").returncode, git(checkout, "tag")) == (0, "")
    done = release(checkout)
    assert done.returncode == 0, done.stderr
    made = {path.name: path for path in (checkout / "dist").iterdir()}
    (wheel,) = (path for name, path in made.items() if name.endswith(".whl"))
    assert set(made) == {wheel.name, f"slip_pipeline-{VERSION}.tar.gz", f"notes-{VERSION}.md"}
    notes = made[f"notes-{VERSION}.md"].read_text("utf-8")
    assert "- **Logs**" in notes
    assert not re.search(r"^## ", notes, re.MULTILINE)
    assert git(checkout, "tag").split() == [f"v{VERSION}"]

    with zipfile.ZipFile(wheel) as packed:
        (name,) = (one for one in packed.namelist() if one.endswith(".dist-info/METADATA"))
        metadata = Parser().parsestr(packed.read(name).decode())
    assert metadata["Version"] == VERSION
    assert "Development Status :: 5 - Production/Stable" in (metadata.get_all("Classifier") or [])
    assert not [url for url in metadata.get_all("Project-URL") or [] if "example" in url]

    again = release(checkout)
    assert (again.returncode, again.stdout) == (1, "")
    assert f"the tag v{VERSION} exists" in again.stderr


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("README.md", "# slip", "# slop", "the tree has changes that are not committed"),
        ("CHANGELOG.md", f"## {VERSION} - ", f"## {VERSION}, ", f"no text under `## {VERSION} - "),
        ("CITATION.cff", "date-released: 2", "date-released: 3", "another date-released than CHANGELOG.md"),
        ("packaging/conda.yaml", f"version: {VERSION}", "version: 0.9", "conda.yaml does not state"),
        ("packaging/ros2/slip_ros2/setup.py", f'"{VERSION}"', '"0.9"', "setup.py does not state"),
    ],
)
def test_a_release_is_refused_and_nothing_is_made(
    name: str, old: str, new: str, said: str, checkout: Path
) -> None:
    path = checkout / name
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), "utf-8")
    if "not committed" not in said:
        git(checkout, "commit", "--quiet", "--all", "--message", "a mistake")
    for words in ((), ("--check",)):
        done = release(checkout, *words)
        assert (done.returncode, done.stdout) == (1, "")
        assert said in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (checkout / "dist").exists()
    assert git(checkout, "tag") == ""
