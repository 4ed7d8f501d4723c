"""The audit of the dependencies says what it finds."""

import json
from pathlib import Path

import audit
import pytest

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]


def test_all_locked_packages_have_accepted_licences_and_stand_in_the_bill(tmp_path: Path) -> None:
    lock = ROOT / "requirements.txt"
    packages = audit.list_packages(lock)
    audit.write_sbom(lock, packages, tmp_path / "sbom.json")

    assert [one.name for one in packages if not one.is_accepted] == []
    sbom = json.loads((tmp_path / "sbom.json").read_text())
    assert sbom["bomFormat"] == "CycloneDX"
    assert {(one["name"], one["version"]) for one in sbom["components"]} >= {
        (one.name, one.version) for one in packages
    }
    polars = next(one for one in sbom["components"] if one["name"] == "polars")
    assert polars["licenses"] == [{"license": {"name": "MIT License"}}]
    assert polars["externalReferences"][0]["hashes"]


@pytest.mark.parametrize(
    ("licence", "accepted"),
    [
        ("MIT", True),
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", True),
        ("Mozilla Public License 2.0 (MPL 2.0)", True),
        ("GPL-3.0-or-later", False),
        ("MIT AND GPL-2.0-only", False),
        ("GNU Library or Lesser General Public License (LGPL)", False),
        ("unknown", False),
    ],
)
def test_a_licence_that_is_not_permissive_is_refused(licence: str, *, accepted: bool) -> None:
    assert audit.Package("some-package", "1.0", licence).is_accepted is accepted


def test_production_runs_no_code_that_a_log_defines() -> None:
    assert "mcap-ros1-support" not in {one.name for one in audit.list_packages(ROOT / "requirements.txt")}
