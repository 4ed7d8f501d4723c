"""Every command that the program prints or advises is one that there is."""

import functools
import inspect
import json
import re
import shlex
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

import pytest
from cyclopts import App
from verbs import run_verb

from pipeline.cli import build_app as build
from pipeline.models import Excitation, find_effect

build_app = functools.cache(build)

ROOT = Path(__file__).parents[2]
SAMPLES = ("husky_tile", "warthog_ice", "ackermann_gravel")
PRINTED = re.compile(r"^(?:next|afterwards)\s+(slip .*)$", re.MULTILINE)
ADVISED = re.compile(r"\bslip((?: [a-z][a-z-]*)+)((?: (?:--[a-z-]+|[A-Z]+(?:\.\.\.)?|\{[^}]*\}))*)")


def require_command(line: str) -> None:
    """The program's own parser takes it."""
    program, *words = shlex.split(line)
    assert program == "slip"
    build_app(words[0]).parse_args(words, exit_on_error=False, print_error=False)


class Codes(HTMLParser):
    """Texts of the `code` elements of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.inside = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        del attrs
        if tag == "code":
            self.texts.append("")
            self.inside = True

    def handle_data(self, data: str) -> None:
        # Names of options are elements of their own in a command.
        if self.inside:
            self.texts[-1] += data

    def handle_endtag(self, tag: str) -> None:
        self.inside &= tag != "code"


@pytest.fixture(scope="module", params=SAMPLES)
def place(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a sample, analyzed and diagnosed."""
    folder = tmp_path_factory.mktemp(request.param)
    (folder / "run.mcap").symlink_to(ROOT / "data_samples" / f"{request.param}.mcap")
    screen = run_verb("analyze", "run.mcap", cwd=folder)
    assert screen.returncode == 0, screen.stderr
    (folder / "screen.txt").write_text(screen.stdout)
    return folder


@pytest.mark.long
def test_what_the_screens_of_a_sample_advise_can_be_typed(place: Path) -> None:
    screens = [(place / "screen.txt").read_text()]
    for words in (
        ("diagnose", "run.mcap"),
        ("diagnose", "run.mcap", "--apply", "model.toml"),
        ("plan", "run.mcap", "--time", "120s", "--area", "40x20m"),
        ("model", "new-effect", "side_wind.py"),
    ):
        done = run_verb(*words, cwd=place)
        assert done.returncode == 0, done.stderr
        screens.append(done.stdout)
    found = [line for screen in screens for line in PRINTED.findall(screen)]
    assert len(found) >= len(screens)
    for line in found:
        require_command(line)
    page = Codes()
    page.feed(next(place.rglob("report.html")).read_text(encoding="utf-8"))
    steps = [text for text in page.texts if text.startswith("slip ")]
    assert any(text.startswith("slip diagnose ") for text in steps)
    for line in steps:
        require_command(line)


@pytest.mark.long
def test_a_plan_speaks_of_all_that_is_not_observable_and_of_what_no_plan_can_show(place: Path) -> None:
    run = json.loads(run_verb("diagnose", "run.mcap", "--json", cwd=place).stdout)["runs"][0]
    hidden = set(run["unobservable"])
    assert hidden
    plan = json.loads(run_verb("plan", "run.mcap", "--force", "--json", cwd=place).stdout)
    asked = {name for one in (*plan["promises"], *plan["impossible"]) for name in one["effects"]}
    assert hidden <= asked
    on_slopes = {name for name in hidden if Excitation.SLOPE in find_effect(name).needs}
    screen = " ".join(run_verb("diagnose", "run.mcap", "--all", cwd=place).stdout.split())
    assert bool(on_slopes) == ("by hand: `slip plan` is for level ground" in screen)
    assert bool(hidden - on_slopes) == ("`slip plan` says whether its room and time are enough" in screen)


def list_texts() -> Iterator[tuple[str, str]]:
    """Place and text of each line that the program, its samples and its make file hold."""
    for folder in ("pipeline", "schemas", "examples", "benchmarks"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in {".py", ".js", ".html", ".toml", ".md", ".in", ".systemd", ".ipynb"}:
                for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
                    yield f"{path.relative_to(ROOT)}:{number}", line


def find_wrong(text: str) -> Iterator[str]:
    """What in a text reads as a command of slip and is none, or has an option that it does not take."""
    app = build_app()
    # A word of a group without the group; others are words of a sentence.
    nested = {name for verb in app for name in app[verb] if name not in app}
    for words, options in ADVISED.findall(text):
        command, chain = app, []
        for word in words.split():
            if word not in command:
                break
            command = command[word]
            chain.append(word)
        given = {word for word in options.split() if word.startswith("--")}
        is_function = inspect.isfunction(command.default_command)
        known = list_options(command) if is_function else set()
        if chain and given - known:
            yield f"slip {' '.join(chain)} {' '.join(sorted(given - known))}"
        elif not chain and words.split()[0] in nested and "slip stage" not in text:
            yield f"slip{words}"


def list_options(command: App) -> set[str]:
    shared = build_app().default_parameter
    return {
        name
        for argument in command.assemble_argument_collection(default_parameter=shared)
        for name in argument.names
    }


@pytest.mark.lint
def test_no_text_of_the_program_names_a_command_or_an_option_that_is_not_there() -> None:
    assert [f"{place}: {wrong}" for place, text in list_texts() for wrong in find_wrong(text)] == []


@pytest.mark.parametrize(
    "text", ["slip trend results", "`slip results verify --seal`", "slip plan RUN --out"]
)
def test_a_planted_command_is_found(text: str) -> None:
    assert list(find_wrong(text))
