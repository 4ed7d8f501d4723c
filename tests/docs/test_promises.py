"""The page of promises holds the program: commands, exit codes, files, JSON keys and names of Python."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from reference import list_verbs
from verbs import ask_verb, run_verb

import slip
from pipeline.simulate import simulate_case

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "pages" / "promises.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
KEYS = [
    (verb, place, re.findall(r"`(\w+)`", keys))
    for verb, place, keys in re.findall(
        r"^\| `slip ([^`]*)` \|\s*`?([^`|]*?)`?\s*\| (.*) \|$", PAGE, re.MULTILINE
    )
]
ASKED = {
    "analyze": ("field/wide.mcap",),
    "diagnose": ("field/wide",),
    "watch": ("field/wide.mcap",),
    "inspect": ("field/wide.mcap",),
    "model fit": ("husky.toml", "--on", "field/wide"),
    "model speed": ("husky.toml", "--on", "field/wide", "--within", "10cm"),
    "compare": ("--by", "run"),
    "check": ("field/wide", "field/other", "--simulated"),
    "plan": ("field/wide", "--time", "60s"),
    "fleet show": (),
    "fleet trend": (),
    "batch": ("field", "--settle", "0"),
    "results status": (),
}


def find_elements(content: Any, place: str) -> Iterator[Any]:  # noqa: ANN401 - JSON
    """The objects at a place such as ``runs[].log``."""
    name, _, rest = place.partition(".")
    if not name:
        yield content
        return
    inner = content[name.removesuffix("[]")]
    for one in inner if name.endswith("[]") else [inner]:
        yield from find_elements(one, rest)


def test_every_command_of_the_program_is_promised_and_there() -> None:
    promised = re.findall(r"`(slip [a-z ]+)`", SECTIONS["Commands"].split("\n\n`--json`")[0])
    there = set(list_verbs())
    assert [one for one in promised if one not in there] == []


def test_the_keys_of_json_are_there(place: Path) -> None:
    simulate_case("ideal_husky", out=place / "field" / "other.mcap", duration_s=40.0, seed=4)
    run_verb("analyze", "field/other.mcap", "--quiet", "--no-report")
    assert {verb for verb, _, _ in KEYS} == set(ASKED)
    for verb, words in ASKED.items():
        allowed = (0, 3, 4) if verb in {"check", "fleet trend"} else (0,)
        done = run_verb(*verb.split(), *words, "--json")
        assert done.returncode in allowed, (verb, done.stderr)
        content = json.loads(done.stdout)
        for name, where, keys in KEYS:
            if name != verb:
                continue
            found = list(find_elements(content, where))
            assert found, f"slip {verb}: nothing at {where}"
            assert [(verb, where, key) for each in found for key in keys if key not in each] == []


def test_the_files_of_a_run_have_their_names(place: Path) -> None:
    names = re.findall(r"^\| `([\w./]+)` \|", SECTIONS["Files"], re.MULTILINE)
    assert len(names) > 10
    missing = [name for name in names if not (place / "results" / name.replace("RUN", "field/wide")).exists()]
    assert missing == []


def test_the_exit_codes_are_those_of_the_page(place: Path) -> None:
    assert set(re.findall(r"^\| (\d) \|", SECTIONS["Exit codes"], re.MULTILINE)) == set("01234")
    log = place / "cut.mcap"
    log.write_bytes((place / "field" / "wide.mcap").read_bytes()[:200_000])
    asked = {
        0: ("effects",),
        1: ("inspect", "gone.mcap"),
        2: ("inspect", "--no-such-option"),
        3: ("inspect", str(log)),
    }
    assert [run_verb(*words).returncode for words in asked.values()] == list(asked)


def test_a_failure_has_its_keys() -> None:
    (error,) = ask_verb("inspect", "gone.mcap", code=1)["errors"]
    sentence = SECTIONS["JSON"].split("`errors` has")[1].split(" of each")[0]
    assert set(re.findall(r"`(\w+)`", sentence)) <= set(error)
    (keys,) = re.findall(r"^\| `slip batch` \| \| (.*) \|$", SECTIONS["JSON"], re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", keys)) <= set(ask_verb("batch", "gone", code=1))


def test_the_names_of_python_are_there() -> None:
    for name in re.findall(r"`slip\.(\w+)`", SECTIONS["Python"]):
        assert getattr(slip, name).__doc__
        assert name in slip.__all__


@pytest.mark.lint
def test_the_version_is_the_same_everywhere() -> None:
    (version,) = re.findall(r'^version = "(.*)"$', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {version} - " in (ROOT / "CHANGELOG.md").read_text()
    assert f"\n{version}\n" in (ROOT / "docs" / "pages" / "install.md").read_text()
