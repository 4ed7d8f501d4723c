"""What people read is standard English of the field: no phrase of the glossary's left column is shown."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.lint

ROOT = Path(__file__).parents[2]
RENDERED = ("pipeline/cli", "pipeline/models/effects")
"""Folders whose docstrings are shown, too: as help texts, and as pages of the catalogue."""

GLOSSARY = tuple(
    re.compile(pattern)
    for pattern in (
        r"as if (?:its|the) wheels stood",
        r"wheels and wheelbase as they are",
        r"on another ground tells?\b",
        r"follows its (?:steering )?commands \S+ s late",
        r"of what can be explained",
        r"\bcarr(?:y|ies) the slip\b",
        r"\bof slip \(mean square\)",
        r"(?<!to )\btell of\b",
        r"\bto see (?:them|it):",
        r"\bwhat is larger than\b",
        r"\bonly within [\d{]",
        r"\bof such driving (?:is|are) needed",
        r"hardly narrows",
        r"\banother run on this ground:",
        r"what is left (?:is|may|repeat|follow|in)\b",
        r"\bof what is left\b",
        r"(?:what is left|a function) .*of anything recorded",
        r"nothing so far",
        r"\bputting \w+ and \w+ right\b",
        r"\b(?:it was|were|was|is|are|:) put right\b",
        r"\bputs right\b",
        r"\btold by\b",
        r"no rung\b",
        r"no help on unseen",
        r"cannot slip against itself",
        r"of unseen data\b",
        r"times as large\b",
        r"curve under poor driving",
        r"\bnothing at\b",
        r"\busually about\b",
        r"what vehicles show",
        r"\bvehicles show [\d{]",
        r"fair to the order",
        r"are \S+ together\b.* mend|\bgiven to \w+ together",
        r"(?:error|near) .*\d* s ago:",
        r"\bbegins neither\b",
        r"the vehicle's, the ground's",
        r"fleet lets expect",
        r"\bno name is given\b",
        r"\b(?:may have|gets|gives) no name\b",
        r"\bon (?:the )?command\b(?!s? line)(?=[ ,.\])]|$)",
        r"\bon (?:the )?measured wheels\b",
        r"the way from (?:the )?(?:command|wheels)",
        r"\bmay act, too\b",
        r"\bacts, too\b",
        r"^missing [a-z]+_[a-z]+\b",
        r"\bthe way \((?:command to wheels|wheels to (?:the )?body)",
    )
)
"""Phrases of the glossary's table for people, left column: in no string, docstring or changelog."""

PRIVATE = GLOSSARY + tuple(
    re.compile(pattern)
    for pattern in (
        r"evidence is \S+ of what is asked",
        r"\bnamed so far\b",
        r"would mean nothing",
        r"lets us see",
        r"\b(?:is|are|was|were|be|then) told\b(?! apart)",
        r"\bcan (?:then )?not be told (?!apart)",
        r"\bcarr(?:y|ies) how much\b",
        r"\bwho carries\b",
        r"\bis named is asked about\b",
        r"a planner (?:feels|would not feel)",
        r"\bnobody (?:says|knows|can tell)\b",
        r"\bis no (?!longer|such|more\b|slip|lag)(?:[a-z]+ ?)+",
        r"\bslip on (?:command|measured)\b",
        r"\bsegments end\b",
        r"\bmedian modulus\b",
        r"\bcannot tell\b",
        r"\bwould tell\b",
        r"\btoo short to tell\b",
        r"\b(?:told apart|tell \w+ apart) from\b",
        r"\btells? whether\b",
        r"\b(?:a|this|every) rung\b|\brungs\b",
        r"\bto go on:",
        r"\bside would do\b",
        r"; runs differ by\b",
        r"\ba change of \S+ would show\b",
        r"\bpredictions \D*\d* s move\b",
        r"\bno part in it\b",
        r"\bnothing is open\b",
        r"\b(?:answers|of) what is open\b",
        r"\badds certainty\b",
        r"\bspeaks? of (?:this|these) runs?\b",
        r"\bshare no ground\b",
        r"\bhow late (?:this|the encoders|the reported)\b",
        r"\bbrought (?:less|almost nothing)\b",
        r"\bstands? in the log again\b",
        r"\bwhose geometry counts where\b",
        r"\bmodel (?:is|was) fed with\b",
        r"\bmost memory\b",
        r"\bfor so many seconds\b",
        r"\bwherever it lies\b",
        r"\bthough they do not help\b",
        r"\bas it was written\b",
        r"\bmay be given away\b",
        r"\bsomething went wrong that should not\b",
        r"\b(?:Leave|leave) \S+ away\b",
        r"\bsays? its ground\b",
        r"\bas they are, on\b",
    )
)
ALLOWED = (
    # Before a noun that is there or not, "is no" is plain; as a predicate ("'x' is no size") it is not.
    r"\bthere is no\b",
)


def find_private(text: str, patterns: tuple[re.Pattern[str], ...] = PRIVATE) -> list[str]:
    """Phrases of the glossary's left column in a text."""
    plain = " ".join(text.split())
    for allowed in ALLOWED:
        plain = re.sub(allowed, "", plain, flags=re.IGNORECASE)
    return [found[0] for pattern in patterns if (found := pattern.search(plain))]


def list_strings(path: Path, *, docstrings: bool) -> Iterator[tuple[int, str]]:
    """Line and text of every string of a module; places of an f-string read as `{}`."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    hidden = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and not docstrings
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
            hidden.update(map(id, node.values))
            yield node.lineno, "".join(map(str, parts))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in hidden:
            yield node.lineno, node.value


def list_shown() -> Iterator[tuple[str, str]]:
    """Where it stands and text of all that the program, its benchmarks and its handbook show."""
    for path in sorted((*(ROOT / "pipeline").rglob("*"), *(ROOT / "schemas").rglob("*"))):
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".py":
            for line, text in list_strings(path, docstrings=name.startswith(RENDERED)):
                yield f"{name}:{line}", text
        elif path.suffix in {".html", ".js", ".toml"}:
            yield from _list_lines(path)
    for path in sorted((ROOT / "benchmarks").rglob("*.py")):
        for line, text in list_strings(path, docstrings=False):
            yield f"{path.relative_to(ROOT).as_posix()}:{line}", text
    for path in (*sorted((ROOT / "docs" / "pages").rglob("*.md")), ROOT / "README.md", ROOT / "Makefile"):
        yield from _list_lines(path)


def _list_lines(path: Path) -> Iterator[tuple[str, str]]:
    # A phrase may go on in the next line.
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, (line, following) in enumerate(zip(lines, [*lines[1:], ""], strict=True), 1):
        yield f"{path.relative_to(ROOT).as_posix()}:{number}", f"{line} {following}"


def list_written() -> Iterator[tuple[str, str]]:
    """Where it stands and text of docstrings and of the changelog, which only developers read."""
    for path in sorted((*(ROOT / "pipeline").rglob("*.py"), *(ROOT / "schemas").rglob("*.py"))):
        for line, text in list_strings(path, docstrings=True):
            yield f"{path.relative_to(ROOT).as_posix()}:{line}", text
    yield from _list_lines(ROOT / "CHANGELOG.md")


def test_nothing_that_is_shown_has_a_private_phrase() -> None:
    found = [f"{where}: {phrase}" for where, text in list_shown() for phrase in find_private(text)]
    assert found == []


def test_no_docstring_and_no_change_of_the_log_has_a_phrase_of_the_glossary() -> None:
    written = list_written()
    found = [f"{where}: {phrase}" for where, text in written for phrase in find_private(text, GLOSSARY)]
    assert found == []


@pytest.mark.parametrize(
    "text",
    [
        "turns as if its wheels stood 0.99 m apart instead of 0.55",
        "follows its commands 0.30 s late, gradually",
        "explained 100% of what can be explained; now 0.0164 m, floor 0.0164 m",
        "of 0.291 m/s of slip (mean square): effective_track 77%",
        "The budget: who carries the slip",
        "tell of slope_creep from this log",
        "to see them: drive on a slope",
        "what is larger than wheel_radius 1.2%",
        "drive_lag.tau only within 0.031 s, 7 min of such driving are needed",
        "another run on this ground: tau 0 to 0.648 s",
        "what is left is not a function of anything recorded: disturbance",
        "from the wheels to the body: nothing so far (0 s)",
        "putting clocks and scales right",
        "Clearpath Husky A200    told by: fitted",
        "no rung, no help on unseen data: crosswind",
        "the way ahead cannot slip against itself; only what turning shows is the heading's",
        "squared error of unseen data without it",
        "Nearly the same curve under poor driving: wheel_radius.",
        "vehicles show 0 to 3 s",
        "neutral 0, usually about 0.3",
        "fair to the order of its effects",
        "in 'c*sin(w0)' 1/s and 1 are given to sin together",
        "the y error depends on v_x 0 s ago: +0.228 m/s near -1.82",
        "the file begins neither as MCAP does nor as a bag of ROS 1 or ROS 2",
        "Numbers of vehicles by level: the vehicle's, the ground's, a run's own.",
        "be left out: the model is then what the fleet lets expect.",
        "no effect is named: a fit to this run would mean nothing",
        "median modulus 0.241 m/s on command    0.214 m/s on measured wheels",
        "c = 0.2 if body_inertia acts, too",
        "'much' is no size",
        "its stamps were put right by their log times",
        "missing    drive_lag, effective_track",
        "the way (command to wheels, wheels to body)",
        "usually about 0.3",
        "below this size an effect may have no name",
        "0.2 s if body_inertia may act, too",
        "slip on measured     0.0689 m/s as recorded",
        "the pose jumped 2 times: segments end there",
        "median modulus 0.594 m/s from commands",
        "exit code 3: these runs cannot tell",
        "1 more run a side would tell",
        "the run is too short to tell why",
        "the smallest error, not told apart from ideal",
        "a function that tells whether the wheels spin",
        "effects that this rung adds",
        "to go on: diagnose another run",
        "cannot be significant with 2 and 1 runs; 4 a side would do",
        "a change of 0.33 would show; runs differ by 0.034 usually",
        "predictions over 2 s move by 78 cm and 10 degrees",
        "31 % body_turn_limit; no part in it: drive_lag",
        "nothing is open: all effects are decided",
        "no drive answers what is open",
        "the rest of 56 s adds certainty",
        "intervals there speak of this run, not of the terrain",
        "husky_a200 and warthog share no ground: no order to compare",
        "how late the encoders were against the gyro",
        "the wheels brought less and less of their usual motion",
        "4 messages stand in the log again, byte for byte",
        "whose geometry counts where vehicles differ",
        "what the ideal model is fed with",
        "most memory, for example 2GB",
        "end when nothing was written for so many seconds",
        "it is run from now on, wherever it lies",
        "take them though they do not help",
        "all is as it was written",
        "features of every run to a file that may be given away",
        "something went wrong that should not (KeyError)",
        "Leave --current away; it is for vesc",
        "no run says its ground",
        "compare two models, with their values as they are, on runs",
    ],
)
def test_a_planted_sentence_is_found(text: str) -> None:
    assert find_private(text)
    folded = text.replace(" ", "\n          ", 3)
    assert find_private(folded)


def test_a_planted_sentence_is_found_where_it_would_be_shown(tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text(
        '"""What the fleet lets expect."""\n\n\ndef say(value: float) -> str:\n'
        '    return f"another run on this " f"ground: {value}"\n',
        encoding="utf-8",
    )
    shown = list(list_strings(module, docstrings=False))
    assert [line for line, text in shown if find_private(text)] == [5]
    told = list(list_strings(module, docstrings=True))
    assert [line for line, text in told if find_private(text)] in ([1, 5], [5, 1])


@pytest.mark.parametrize(
    "text",
    [
        "Lag of the drive: the wheels follow commands with a time constant of 0.30 s",
        "remaining error 1.6 cm, at the noise floor",
        "not observable in this log: slope_creep",
        "there is no run with a date",
        "the compression is no longer supported",
        "median slip modulus 0.594 m/s from commands",
        "detectable change 0.33; spread between runs 0.034 (default)",
        "the pose jumped 2 times: the run is split there",
    ],
)
def test_standard_wording_passes(text: str) -> None:
    assert find_private(text) == []
