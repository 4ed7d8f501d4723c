"""Release the version that pyproject.toml declares: wheel, source archive, notes from the CHANGELOG, tag.

python packaging/release.py --check     says what forbids it, and makes nothing
python packaging/release.py             makes dist/ and the tag; nothing is sent anywhere
"""

import argparse
import re
import subprocess
import sys
import tomllib
from pathlib import Path

VERSIONS = {
    "CITATION.cff": r"^version: (\S+)$",
    "packaging/conda.yaml": r"^  version: (\S+)$",
    "packaging/ros2/slip_ros2/package.xml": r"<version>(.+)</version>",
    "packaging/ros2/slip_ros2/setup.py": r'version="(.+)"',
}
"""Files that state the version beside pyproject.toml, and how: their formats cannot refer to another file."""
_BUILD = (
    "import sys; from hatchling import build; build.build_wheel(sys.argv[1]); build.build_sdist(sys.argv[1])"
)


def read_version(root: Path) -> str:
    """The version in pyproject.toml."""
    return str(tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]["version"])


def read_notes(root: Path, version: str) -> tuple[str, str]:
    """Date and text of a version in the CHANGELOG; both empty where it has no section with a date."""
    text = (root / "CHANGELOG.md").read_text("utf-8")
    head = rf"^## {re.escape(version)} - (\d{{4}}-\d{{2}}-\d{{2}})\n(.*?)(?=^## |\Z)"
    found = re.search(head, text, re.MULTILINE | re.DOTALL)
    return (found[1], found[2].strip()) if found else ("", "")


def list_problems(root: Path) -> list[str]:
    """What forbids a release, a line each."""
    version = read_version(root)
    date, notes = read_notes(root, version)
    problems = []
    if _ask_git(root, "status", "--porcelain"):
        problems.append("the tree has changes that are not committed: git status")
    if _ask_git(root, "tag", "--list", f"v{version}"):
        problems.append(f"the tag v{version} exists: raise the version in pyproject.toml")
    if not notes:
        problems.append(f"CHANGELOG.md has no text under `## {version} - YEAR-MONTH-DAY`")
    elif f"date-released: {date}\n" not in (root / "CITATION.cff").read_text("utf-8"):
        problems.append(f"CITATION.cff has another date-released than CHANGELOG.md ({date})")
    for name, pattern in VERSIONS.items():
        found = re.search(pattern, (root / name).read_text("utf-8"), re.MULTILINE)
        if found is None or found[1] != version:
            problems.append(f"{name} does not state the version {version}")
    return problems


def build(root: Path) -> list[Path]:
    """Wheel, source archive and notes of the version, in an empty folder `dist`; it needs no network."""
    dist, version = root / "dist", read_version(root)
    for old in dist.glob("*"):
        old.unlink()
    subprocess.run([sys.executable, "-c", _BUILD, str(dist)], cwd=root, check=True)  # noqa: S603 - our own
    (dist / f"notes-{version}.md").write_text(f"{read_notes(root, version)[1]}\n", "utf-8")
    return sorted(dist.iterdir())


def tag(root: Path) -> str:
    """Name of the tag that was put on the commit."""
    name = f"v{read_version(root)}"
    _ask_git(root, "tag", "--annotate", "--message", f"slip {name[1:]}", name)
    return name


def _ask_git(root: Path, *words: str) -> str:
    command = ["git", *words]
    return subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout.strip()  # noqa: S603


def main() -> int:
    """Exit code 1 where something forbids the release."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only say what forbids it")
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1], help="the checkout")
    args = parser.parse_args()
    problems = list_problems(args.root)
    for problem in problems:
        print(f"release: {problem}", file=sys.stderr)
    if problems or args.check:
        return int(bool(problems))
    for path in build(args.root):
        print(path)
    print(f"tagged {tag(args.root)}; nothing was sent: git push --tags does that")
    return 0


if __name__ == "__main__":
    sys.exit(main())
