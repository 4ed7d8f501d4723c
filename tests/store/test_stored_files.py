"""Files of results that somebody changed, and whose checksums agree: one line names the file."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from store_samples import forge_file
from verbs import run_verb

from pipeline.store import Store

RUN = "field/wide"
VERBS = {
    "summary.json": ["analyze field/wide.mcap --no-report", "analyze field/wide.mcap --no-report --all"],
    "diagnosis.json": [
        f"diagnose {RUN}",
        f"diagnose {RUN} --all",
        f"results status {RUN}",
        f"export {RUN} --to foxglove-layout --file x.json --force",
    ],
}
ODD = st.sampled_from([None, True, 0, -1.5, 1e300, "", "another", [], {}, [[]], {"a": None}, ["x"], [None]])
Path_ = tuple[str | int, ...]


@pytest.fixture
def folder(stored_run: Path, tmp_path: Path) -> Path:
    """Results that a test may change."""
    shutil.copytree(stored_run, tmp_path / "run")
    return tmp_path / "run"


def list_places(value: object, place: Path_ = ()) -> Iterator[Path_]:
    """Every key and entry below a value."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, one in inner:
        yield (*place, key)
        yield from list_places(one, (*place, key))


def change(content: object, place: Path_, odd: object, *, drop: bool) -> object:
    """The content with another value in a place, or without it."""
    whole: object = json.loads(json.dumps(content))
    at = cast("Any", whole)
    for key in place[:-1]:
        at = at[key]
    if drop:
        del at[place[-1]]
    else:
        at[place[-1]] = odd
    return whole


def store(results: Path, name: str, content: object) -> Path:
    """Write a file of the run, bytes as they are, and the manifest that agrees with it."""
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    return forge_file(Store(results).manifests()[0], name, data)


def read(results: Path, name: str) -> dict[str, Any]:
    """The content of a file of the run."""
    content: dict[str, Any] = json.loads(Store(results).manifests()[0].path(name).read_text())
    return content


def judge(folder: Path, verb: str, name: str) -> None:
    """A verb answers, or ends in one line that names the file."""
    done = run_verb(*verb.split(), "--results", "results", cwd=folder)
    assert "Traceback" not in done.stderr
    assert done.returncode in {0, 1, 3}
    if done.returncode == 1:
        line = done.stderr.strip().splitlines()[-1]
        assert re.match(r"slip: .*[.]$", line), done.stderr
        assert len(line) < 1000
        assert name in line or RUN in line, line


@pytest.mark.parametrize("name", ["summary.json", "diagnosis.json"])
@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_file_of_a_run_with_other_words(folder: Path, name: str, data: st.DataObject) -> None:
    original = read(folder / "results", name)
    places = sorted(list_places(original), key=lambda place: (len(place), str(place)))
    place = data.draw(st.sampled_from(places))
    try:
        store(
            folder / "results", name, change(original, place, data.draw(ODD), drop=data.draw(st.booleans()))
        )
        judge(folder, data.draw(st.sampled_from(VERBS[name])), name)
    finally:
        store(folder / "results", name, original)


def test_another_word_for_the_kind_of_vehicle_is_one_line(folder: Path) -> None:
    content = read(folder / "results", "diagnosis.json")
    content["vehicle"]["kind"] = "hovercraft"
    path = store(folder / "results", "diagnosis.json", content)
    done = run_verb("diagnose", RUN, "--results", "results", cwd=folder)
    assert done.returncode == 1
    line = done.stderr.strip().splitlines()[-1]
    assert line.startswith(
        f"slip: {path.relative_to(folder)}: the file is not what this version of slip writes"
    )
    assert "hovercraft" in line
    assert "Analyze the log again with --force" in line


@pytest.mark.parametrize("data", [b"", b"[]", b"\xff", b"{", b"[" * 100_000, b'{"a": NaN}', b"null"])
def test_a_file_that_is_no_object(folder: Path, data: bytes) -> None:
    for name in ("summary.json", "diagnosis.json"):
        store(folder / "results", name, data)
    for verb in (*VERBS["summary.json"], *VERBS["diagnosis.json"]):
        judge(folder, verb, "")


FLEET = {
    "parameters": [
        {"effect": "drive_lag", "parameter": "tau", "vehicle": "husky_a200", "name": "drive_lag",
         "because": "one run", "value": 0.3, "unit": "s", "level": "vehicle", "low": 0.2, "high": 0.4,
         "spread_terrain": None, "spread_run": None, "chi_square": None,
         "terrains": {"ice": {"value": 0.3}, "tile": {"value": 0.3}}},
    ],
    "runs": {"husky_a200": ["a", "b"]},
    "keys": ["k"],
    "notes": ["a note"],
    "summary": "One vehicle.",
}  # fmt: skip


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.sampled_from(list(list_places(FLEET))), odd=ODD, drop=st.booleans())
def test_a_fleet_model_with_other_words(folder: Path, place: Path_, odd: object, *, drop: bool) -> None:
    (folder / "results" / "fleet.json").write_text(json.dumps(change(FLEET, place, odd, drop=drop)))
    for verb in ("fleet show", "fleet show --all"):
        judge(folder, verb, "fleet.json")


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '{"key": 1, "diagnosis": {}}', "[" * 100_000])
def test_a_diagnosis_beside_a_run_that_is_none(folder: Path, text: str) -> None:
    done = run_verb("analyze", "field/wide.mcap", "--no-report", "--no-diagnosis", "--force", cwd=folder)
    assert done.returncode == 0
    path = folder / "results" / "workbench" / "diagnoses" / f"{RUN}.json"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    judge(folder, f"diagnose {RUN}", str(path.relative_to(folder)))
