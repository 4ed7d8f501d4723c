"""Tables of the handbook from what was measured: rendered, and held against the pages.

What a command measured stands in a file of
benchmarks/measured: its rows, the command, the commit, the date, and the versions of the program that its
numbers depend on. A page has the place of a table between two comments, `<!-- measured: NAME -->` and
`<!-- /measured -->`; without --check what stands between them is written again.
`make bench NAME=measure` measures.
"""

import argparse
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "benchmarks" / "measured"
PAGES_FOLDER = ROOT / "docs" / "pages"
PAGES = [*sorted(PAGES_FOLDER.rglob("*.md")), ROOT / "benchmarks" / "rivals.md"]
BLOCK = re.compile(r"(<!-- measured: (?P<name>[^>]*?) -->\n)(?P<text>.*?)(<!-- /measured -->)", re.DOTALL)
ALLOWED_VERSIONS = 1
"""Versions by which a table may be older than the program: a mend does not ask for hours of measurement."""

WIDTH = 100
"""Columns of a line of a page."""

INPUTS = {"command": "commands", "measured": "wheels"}
PLACES = {
    "in the run": "the run itself, held out",
    "same ground": "another run of the same ground",
    "other ground": "a run on another ground",
}
METRICS = {"position": "Error of position over 2 s [m]", "heading": "Error of heading over 2 s [degrees]"}
GROUPS = {
    "literature": "the best model of the literature",
    "learned": "the best learned model",
    "named + trees": "named + trees",
}
Data = Mapping[str, Any]


def read_measured(name: str) -> Data:
    """What was measured, by the name of its file."""
    content: dict[str, Any] = json.loads((MEASURED / f"{name}.json").read_text(encoding="utf-8"))
    return content


def list_versions() -> dict[str, int]:
    """Versions of the program that measured numbers depend on."""
    from pipeline.analysis.work import VERSIONS  # noqa: PLC0415 - heavy
    from pipeline.estimation.stored_diagnosis import VERSION  # noqa: PLC0415 - heavy

    return {"diagnosis": VERSION, **VERSIONS}


def find_outdated(data: Data, present: Mapping[str, int]) -> list[str]:
    """What a table is too old in, in words; empty where it may stay."""
    return [
        f"{name}: measured at version {version}, the program has {present[name]}"
        for name, version in data["versions"].items()
        if name in present and present[name] - version > ALLOWED_VERSIONS
    ]


def name_origin(data: Data) -> list[str]:
    """The sentences below a table: command, commit, date and versions, and whether they are outdated."""
    versions = ", ".join(f"{name} version {version}" for name, version in data["versions"].items())
    outdated = find_outdated(data, list_versions())
    older = f" **Outdated** ({'; '.join(outdated)}): today's figures may differ." if outdated else ""
    return fold(f"Measured by `{data['command']}` at {data['commit']} ({data['date']}; {versions}).{older}")


def fold(text: str) -> list[str]:
    """Text in lines of a page."""
    return textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False)


def make_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """A table in Markdown."""
    return [
        f"| {' | '.join(head)} |",
        "| --- " * len(head) + "|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


KINDS = (
    ("one hidden effect", ("single", "small")),
    ("two to four hidden effects", ("sets", "equipped")),
    ("cars", ("cars",)),
    ("people's driving on rough ground, one or two minutes", ("natural",)),
    ("late and held poses", ("late",)),
    ("two runs judged together", ("joint",)),
    ("nothing hidden", ("empty",)),
)


def render_accuracy(data: Data) -> list[str]:
    """How often the diagnosis names exactly what is hidden."""
    rows = {row["category"]: row for row in data["rows"]}
    table = []
    for words, names in KINDS:
        there = [rows[name] for name in names if name in rows]
        if there:
            counted, exact, narrowed = (
                sum(row[key] for row in there) for key in ("counted", "exact", "narrowed")
            )
            more = f", in {narrowed - exact} more undecided" if narrowed > exact else ""
            table.append((words, f"{exact} of {counted}{more}"))
    held, whole = (sum(one[key] for one in data["intervals"]) for key in ("held", "of"))
    odd = rows["odd"]
    flagged, alike, missed = odd["exact"], odd["narrowed"] - odd["exact"], odd["counted"] - odd["narrowed"]
    return [
        *make_table(("test logs", "exactly the hidden effects named"), table),
        "",
        *fold(
            f"A wrong effect is named in {data['wrong']} of {data['logs']} simulated logs; the 95 % "
            f"intervals contain the true value in {held} of {whole} cases. Physics outside the catalogue has "
            f"no name: it is flagged as unexplained in the right channel in {flagged} of {odd['counted']} "
            f"logs, called by names of known effects that are like it in {alike}, and not noticed or "
            f"misnamed in {missed}."
        ),
    ]


def find_section(data: Data, place: str, metric: str) -> Data:
    """One table of the rivals."""
    (found,) = [one for one in data["sections"] if (one["place"], one["metric"]) == (place, metric)]
    return found


def render_wins(*inputs: Data) -> list[str]:
    """How often the best model of the literature is better or worse than the named physics."""
    rows = []
    for place, words in PLACES.items():
        for source, data in zip(INPUTS.values(), inputs, strict=True):
            there = [find_section(data, place, metric)["wins"]["literature"] for metric in METRICS]
            rows.append((words, source, *map(count_wins, there)))
    return make_table(("fitted to", "fed", *METRICS), rows)


def count_wins(wins: Sequence[int]) -> str:
    """How often a model is better and worse, and of how many."""
    better, worse, count = wins
    return f"{better} better, {worse} worse of {count}"


def render_learned(data: Data) -> list[str]:
    """The same of learned models, held out in the run and from commands."""
    rows = []
    for group in list(GROUPS)[1:]:
        counts = [find_section(data, "in the run", metric)["wins"][group] for metric in METRICS]
        rows.append((GROUPS[group], *map(count_wins, counts)))
    return make_table(("from commands, held out in the run", *METRICS), rows)


def render_errors(data: Data) -> list[str]:
    """Errors of the named physics over those of the ideal model, from commands, held out in the run."""
    parts = []
    for metric in METRICS:
        section = find_section(data, "in the run", metric)
        ideal, named = (section["head"].index(name) for name in ("ideal", "named physics"))
        shares = sorted(float(row[named]) / float(row[ideal]) for row in section["rows"])
        middle = 0.5 * (shares[(len(shares) - 1) // 2] + shares[len(shares) // 2])
        low, high, median = (f"{100.0 * share:.0f}" for share in (shares[0], shares[-1], middle))
        parts.append(f"{metric} error falls to {low} to {high} % (median {median} %)")
    count = len(section["rows"])
    return fold(
        f"Over 2 s, held out in {count} recordings of Husky and Warthog and fed with commands, the "
        f"{parts[0]} of that of the ideal model, the {parts[1]}, but rarely to the noise floor, which the "
        "verdict states."
    )


def render_section(section: Data) -> list[str]:
    """One table of the rivals in Markdown, and how often who won."""
    title = section["metric"].capitalize()
    lines = [f"{METRICS[section['metric']]}:", ""]
    lines += [*make_table(section["head"], section["rows"]), ""] if section["rows"] else []
    for group, (better, worse, count) in section["wins"].items():
        lines.append(
            f"- {title}: {GROUPS[group]} is better than the named physics on {better} of {count}, "
            f"worse on {worse}, not significantly different on {count - better - worse}."
        )
    gone = ", ".join(f"{format_percent(share)} with {name}" for name, share in section["gone"].items())
    lines.append(f"- {title}: of the ideal model's error are gone, in the median, {gone}.")
    for name, shares in section["bands"].items():
        held = ", ".join(map(format_percent, shares))
        lines.append(f"- The bands of 95 % of {name} hold {held} of the errors.")
    return lines


def format_percent(share: float) -> str:
    """A share as a whole number of percent."""
    return f"{100.0 * share:.0f} %"


def render_place(place: str, data: Data) -> list[str]:
    """Both tables of a place."""
    there = [find_section(data, place, metric) for metric in METRICS]
    return [line for section in there for line in (*render_section(section), "")][:-1]


def render_paper(data: Data) -> list[str]:
    """Medians and ratios of the paper beside those of this program."""
    medians = [
        (row["name"], f"{'about ' if row['derived'] else ''}{row['paper']:g}", *describe_row(row))
        for row in data["rows"]
    ]
    ratios = [(row["name"], f"{row['paper']:g}", *describe_row(row)) for row in data["ratios"]]
    return [
        *make_table(("median", "paper", "this program, 95 % interval of the run", "reproduced"), medians),
        "",
        *make_table(("ratio", "paper", "this program", "reproduced"), ratios),
    ]


def describe_row(row: Data) -> tuple[str, str]:
    """A value with its interval, and whether the paper's is in it."""
    value, low, high = (row[key] for key in ("value", "low", "high"))
    return f"{value:#.3g} [{low:#.3g}, {high:#.3g}]", judge(row["paper"], value, low, high)


def judge(paper: float, value: float, low: float, high: float) -> str:
    """Whether a number of the paper lies in an interval of this program."""
    off = f"{100.0 * abs(value / paper - 1.0):.0f} % {'above' if value > paper else 'below'}"
    return f"yes, {off}" if low <= paper <= high else f"**no**, {off}"


VERDICTS = {"wrong": "**wrong**", "refused": "**refused**"}
"""Verdicts in bold: what is missed is to be seen."""


def render_published(name: str, data: Data) -> list[str]:
    """What was said of the questions of one set of public recordings."""
    rows = [
        (row["question"], escape(row["published"]), escape(row["said"]), VERDICTS.get(verdict, verdict))
        for row in data["rows"]
        if row["set"] == name
        for verdict in (row["verdict"],)
    ]
    return make_table(("question", "published", "this program", ""), rows)


def escape(text: str) -> str:
    """Text in a cell of a table, alternatives as `or`."""
    return text.replace(" | ", " or ").replace("|", "or")


RIVALS = {source: f"rivals_{source}" for source in INPUTS}
RENDERERS: dict[str, tuple[tuple[str, ...], Callable[..., list[str]]]] = {
    "accuracy": (("accuracy",), render_accuracy),
    "wins": (tuple(RIVALS.values()), render_wins),
    "learned": ((RIVALS["command"],), render_learned),
    "errors": ((RIVALS["command"],), render_errors),
    "paper": (("paper",), render_paper),
    **{
        f"published {name}": (("published",), partial(render_published, name))
        for name in ("optiodom_differential", "optiodom_tricycle", "robotino_surfaces", "f1tenth_mocap")
    },
    **{
        f"{RIVALS[source]} {place}": ((RIVALS[source],), partial(render_place, place))
        for source in INPUTS
        for place in PLACES
    },
}
"""By the name in a page: the files that a table is made of, and what makes it."""


def fill_page(text: str) -> str:
    """A page with what was measured in the places of its tables."""

    def fill(found: re.Match[str]) -> str:
        names, render = RENDERERS[found["name"]]
        sources = [read_measured(name) for name in names]
        lines = [*render(*sources), "", *(line for source in sources for line in name_origin(source))]
        return "".join((found[1], "\n", "\n".join(lines), "\n\n", found[4]))

    return BLOCK.sub(fill, text)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--check", action="store_true", help="write nothing, say what differs or is outdated")


def run(asked: argparse.Namespace) -> int:
    """Write the tables, or say which pages differ from what was measured."""
    differ = [page for page in PAGES if fill_page(page.read_text("utf-8")) != page.read_text("utf-8")]
    for page in differ:
        sys.stdout.write(f"{page.relative_to(ROOT)}{' differs' if asked.check else ''}\n")
        if not asked.check:
            page.write_text(fill_page(page.read_text("utf-8")), encoding="utf-8")
    outdated = [
        f"{path.name}, {what}"
        for path in sorted(MEASURED.glob("*.json"))
        for what in find_outdated(read_measured(path.stem), list_versions())
    ]
    sys.stdout.write("".join(f"{one}: make bench NAME=measure\n" for one in outdated))
    return int(asked.check and bool(differ or outdated))
