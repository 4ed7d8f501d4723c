"""Audit of the dependencies: licences, known advisories, and a bill of materials from the lock file.

    python benchmarks/audit.py [--lock requirements.txt] [--out build/sbom.cdx.json]

Fails where a locked package has a licence that is not accepted, or a known advisory. Where no advisory
database can be reached, the last line says so. The bill of materials is CycloneDX JSON.
"""

import argparse
import json
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]

ACCEPTED = re.compile(
    r"0BSD|CC0-1\.0|Zlib|MIT( License)?|ISC( License \(ISCL\))?"
    r"|Apache( Software License|-2\.0( WITH LLVM-exception)?)?"
    r"|(3-Clause )?BSD( License|-[23]-Clause)?|PSF-2\.0|Python Software Foundation License"
    r"|MPL-2\.0|Mozilla Public License 2\.0 \(MPL 2\.0\)",
)
"""Permissive licences, and the MPL, which binds only its own files."""

EXCEPTIONS = {
    "apsw": "its metadata says any licence that the OSI approves",
    "dataframely": "BSD-3-Clause by its licence file; its metadata names none",
    "pebble": "LGPL, used as an unmodified dependency",
}
"""Packages that are accepted though their metadata names no accepted licence, with the reason."""

_PIN = re.compile(r"^(?P<name>[A-Za-z0-9._-]+)==(?P<version>[^ ;\\]+)", re.MULTILINE)


@dataclass(frozen=True)
class Package:
    """A locked package: its name, version, and licence as its metadata states it (None if not installed)."""

    name: str
    version: str
    licence: str | None

    @property
    def is_accepted(self) -> bool:
        """Whether each licence of its expression is accepted; a package of another platform is not judged."""
        if self.licence is None or self.name in EXCEPTIONS:
            return True
        return all(ACCEPTED.fullmatch(part) for part in re.split(r" AND | OR |; ", self.licence))


def list_packages(lock: Path) -> list[Package]:
    """The packages of a lock file, each once, with the licences of those that are installed."""
    pins = dict(match.group("name", "version") for match in _PIN.finditer(lock.read_text()))
    return [Package(name, version, find_licence(name)) for name, version in sorted(pins.items())]


def find_licence(name: str) -> str | None:
    """The licence that an installed package's metadata states; None where it is not installed."""
    try:
        about = metadata.metadata(name)
    except metadata.PackageNotFoundError:
        return None
    classifiers = [
        text.split(" :: ")[-1] for text in about.get_all("Classifier") or [] if "License ::" in text
    ]
    return about.get("License-Expression") or "; ".join(classifiers) or about.get("License") or "unknown"


def write_sbom(lock: Path, packages: list[Package], out: Path) -> None:
    """Write the bill of materials of a lock file, with the licences, as CycloneDX JSON."""
    out.parent.mkdir(parents=True, exist_ok=True)
    made = subprocess.run(
        [sys.executable, "-m", "cyclonedx_py", "requirements", str(lock),
         "--pyproject", str(ROOT / "pyproject.toml"), "--output-reproducible"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    sbom: dict[str, Any] = json.loads(made.stdout)
    licences = {package.name: package.licence for package in packages}
    for component in sbom["components"]:
        if licence := licences.get(component["name"]):
            component["licenses"] = [{"license": {"name": licence}}]
    out.write_text(json.dumps(sbom, indent=1) + "\n")


def find_advisories(lock: Path) -> list[str] | None:
    """Known advisories of the locked versions, a line each; None where no database could be reached."""
    done = subprocess.run(
        [sys.executable, "-m", "pip_audit", "--requirement", str(lock), "--disable-pip", "--require-hashes",
         "--timeout", "10", "--progress-spinner", "off", "--format", "json"],
        check=False, capture_output=True, text=True,
    )  # fmt: skip
    try:
        looked_up = json.loads(done.stdout)["dependencies"]
    except (ValueError, KeyError):
        return None
    if all("skip_reason" in one for one in looked_up):
        return None
    return [
        f"{one['name']} {one['version']}: {found['id']}, fixed in {found['fix_versions'] or 'no version'}"
        for one in looked_up
        for found in one.get("vulns", [])
    ]


def main() -> int:
    """Print the audit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--lock", type=Path, default=ROOT / "requirements.txt")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "sbom.cdx.json")
    args = parser.parse_args()

    packages = list_packages(args.lock)
    for package in packages:
        licence = package.licence or "not installed on this platform"
        reason = f" ({EXCEPTIONS[package.name]})" if package.name in EXCEPTIONS else ""
        print(f"{package.name:28} {package.version:18} {licence}{reason}")
    write_sbom(args.lock, packages, args.out)
    print(f"{len(packages)} packages; bill of materials: {args.out}")
    refused = [package.name for package in packages if not package.is_accepted]
    if refused:
        print(f"Licences that are not accepted: {', '.join(refused)}", file=sys.stderr)
    advisories = find_advisories(args.lock)
    if advisories is None:
        print("Advisories were not checked: no advisory database can be reached from here.")
    else:
        print("\n".join(advisories) or "No known advisory.", file=sys.stderr if advisories else sys.stdout)
    return 1 if refused or advisories else 0


if __name__ == "__main__":
    sys.exit(main())
