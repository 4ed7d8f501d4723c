"""The handbook: whole, offline, and true to the code it speaks of."""

import re
import shlex
from collections.abc import Mapping
from pathlib import Path

import msgspec
import pytest
from barriers import find_barriers
from blocks import find_difference, list_pages, read_commands
from chrome import Chrome
from cyclopts import App
from effects_pages import list_settings
from reference import list_verbs, write_reference

from pipeline.cli import build_app
from pipeline.models import find_effect, list_effects
from pipeline.sources import Configuration, list_presets
from schemas import list_contracts

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
SYMPTOMS = sorted((ROOT / "docs" / "pages" / "symptoms").glob("[!i]*.md"))
PROGRAMS = {"slip", "make", "python", "printf", "mkdir", "cat"}
INLINE = re.compile(r"`(slip [a-z][^`]*)`")
ROW = re.compile(r"^\| `([^|]*)` \|(.*)\|$", re.MULTILINE)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_every_effect_verb_key_column_and_vehicle_has_its_place(handbook: Path) -> None:
    assert {path.stem for path in (handbook / "effects").glob("*.html")} == {
        "index",
        *(kind.id for kind in list_effects()),
    }
    pages = write_reference()
    keys = [key.name for each in msgspec.structs.fields(Configuration) for key in _keys_of(each.default)]
    for page, names in (
        ("configuration-keys.md", keys),
        ("tables.md", [name for each in list_contracts() for name in each.schema.columns()]),
        ("vehicles.md", [vehicle.id for vehicle in list_presets()]),
    ):
        rows = dict(ROW.findall(pages[page]))
        assert set(names) <= set(rows)
        assert not [name for name in names if not rows[name].strip(" |")], "a row without words"
    verbs = pages["verbs.md"]
    assert {f"## {words}" for words in list_verbs()} == set(re.findall(r"^## .*", verbs, re.MULTILINE))
    undescribed = [row for row in ROW.findall(verbs) if not row[1].split("|")[0].strip()]
    assert undescribed == []


def _keys_of(section: object) -> tuple[msgspec.structs.FieldInfo, ...]:
    return msgspec.structs.fields(section) if isinstance(section, msgspec.Struct) else ()


def test_an_effects_page_has_formula_parameters_sentence_source_and_settings() -> None:
    page = write_reference()["effects/effective_track.md"]

    assert "\n    w0 = w0 / k" in page
    assert "| `k` | effective over nominal track | 1 | 0.1 to 20 | 1 | 1.8 |" in page
    assert "Effective track 0.99 m (nominal 0.55): the robot turns at 56 % of the ideal rate" in page
    assert "Source: Mandow et al." in page
    assert dict(list_settings(find_effect("effective_track")))["ros2_control"] == [
        "wheel_separation_multiplier"
    ]


def test_a_source_that_an_effect_names_by_author_and_year_has_its_title_in_the_list() -> None:
    page = (ROOT / "docs" / "pages" / "methods.md").read_text("utf-8")
    listed = page.partition("\n## Sources\n")[2].splitlines()
    pages = [" ".join(effect.find_page().split()) for effect in list_effects()]
    cited = {found for text in pages for found in re.findall(r"(\w+ et al\.) (\d{4})", text)}
    assert {author for author, _ in cited} >= {"Becker et al.", "Samson et al."}
    for author, year in cited:
        entries = [line for line in listed if line.startswith(f'- {author}, "') and year in line]
        assert len(entries) == 1, (author, year)


@pytest.mark.long
def test_the_search_works_from_the_disk_and_nothing_is_asked_of_a_network(
    handbook: Path, chrome: Chrome
) -> None:
    chrome.size(1280, 900)
    chrome.open((handbook / "index.html").as_uri())
    chrome.wait("document.readyState === 'complete' && document.querySelector('.md-search__input')")
    assert find_barriers(chrome) == []
    chrome.click(".md-search__input")
    chrome.run("document.querySelector('.md-search__input').value = 'understeer'")
    typed = "new KeyboardEvent('keyup', { bubbles: true })"
    chrome.run(f"document.querySelector('.md-search__input').dispatchEvent({typed})")
    chrome.wait("document.querySelector('.md-search-result__link[href*=understeer]')")
    assert chrome.errors == []
    assert {address.split(":")[0] for address in chrome.requests} <= {"file", "data", "about", "blob"}


@pytest.mark.parametrize("page", list_pages(), ids=named)
def test_what_is_typed_can_be_run_and_what_is_mentioned_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    fences = re.findall(r"^```(\w*)$", text, re.MULTILINE)
    assert set(fences[::2]) <= {"console", "pycon", "text", "toml", "python"}
    commands = read_commands(text)
    typed = [command for command in commands if not command.is_python]
    assert {shlex.split(command.text)[0] for command in typed} <= PROGRAMS
    assert not [command.text for command in commands if "?" in command.shown], (
        "run docs/tools/blocks.py --write"
    )
    assert str(ROOT) not in text
    assert "/tmp/" not in text  # noqa: S108 - where outputs of this machine would show
    verbs = list_verbs()
    for mentioned in [*INLINE.findall(text), *(command.text for command in typed)]:
        _require_verb(mentioned, verbs)


def _require_verb(text: str, verbs: Mapping[str, App]) -> None:
    """A command of slip in a text names a verb that there is, with options that it has."""
    words = re.split(r" [|&]", text, maxsplit=1)[0].split()
    if words[0] != "slip" or words[1] in {"VERB", "--version", "--help"}:
        return
    found = next((verbs[" ".join(words[:n])] for n in (4, 3, 2) if " ".join(words[:n]) in verbs), None)
    if found is None:
        # Verbs of `model` in one word, and the other spelling of `model drop`.
        assert words[1:] == ["model"] or words[1:3] == ["model", "remove"], text
        return
    known = _list_options(found)
    assert {word.split("=")[0] for word in words if word.startswith("--")} <= known | {"--help"}, text


def _list_options(verb: App) -> set[str]:
    arguments = verb.assemble_argument_collection(default_parameter=build_app().default_parameter)
    return {name for argument in arguments for name in argument.names}


def test_a_symptom_has_its_looks_a_log_an_answer_and_a_remedy() -> None:
    assert len(SYMPTOMS) >= 15
    for page in SYMPTOMS:
        text = page.read_text(encoding="utf-8")
        for part in ("**How it looks.**", "**What the tool says.**", "**What to do.**"):
            assert part in text, page.name
        assert re.search(r"\*\*(A log|Logs) that shows? it", text), page.name
        assert any("?" not in command.shown and command.shown for command in read_commands(text)), page.name


def test_the_readme_answers_first_and_is_short() -> None:
    text = README.read_text(encoding="utf-8")

    assert not [line for line in text.splitlines() if len(line) > 100]  # as many as outputs are folded at
    answers = [
        text.index(each)
        for each in ("For teams", ".png)", "## Install", "make test", "## Run it on", "## Where to read on")
    ]
    assert answers == sorted(answers)
    assert text[: answers[-2]].count("\n") < 40
    assert text.count("\n") <= 100


@pytest.mark.parametrize(
    ("shown", "printed", "differs"),
    [
        ("k = 1.80 [1.78, 1.82]", "k = 1.81 [1.78, 1.82]", False),
        ("k = 1.80 [1.78, 1.82]", "k = 2.30 [1.78, 1.82]", True),
        ("tau = 0.301 [0.272, 0.329]", "tau = 0.3003 [0.2982, 0.3023]", True),
        ("64 runs, 3 of 20", "65 runs, 3 of 20", False),
        ("64 runs, 3 of 20", "66 runs, 3 of 20", True),
        ("missing   drive_lag", "missing   turn_lag", True),
        ("runs/8864e66ce2fee5d7/report.html", "runs/0064e66ce2fee5d7/report.html", False),
        ("one line", "one line\nand another", True),
    ],
)
def test_other_words_and_other_numbers_are_noticed(shown: str, printed: str, *, differs: bool) -> None:
    assert bool(find_difference(tuple(shown.splitlines()), printed)) == differs


def test_a_block_that_begins_with_no_command_is_refused() -> None:
    with pytest.raises(ValueError, match="not with a command"):
        read_commands("```console\nmissing\n```\n")
