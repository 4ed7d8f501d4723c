"""Every finding has one template, and every template the values that it needs."""

import ast
import inspect
import re
import string
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import pytest

from pipeline.models import Late, find_late_effect
from pipeline.recording import Finding
from pipeline.recording.readings import SIDES
from pipeline.stages import motion_events
from pipeline.words import findings as words
from pipeline.words import format_finding
from pipeline.words.findings import FAULTS, TEMPLATES, Template, fill_template
from schemas.run_tables import EVENT_KINDS

ROOT = Path(__file__).parents[2]
OF_TABLES = {
    ("pipeline.stages.spans", "one.kind"): frozenset(EVENT_KINDS) - {*motion_events._KINDS.values()},
    ("pipeline.stages.motion_events", "kind"): frozenset(motion_events._KINDS.values()),
    ("pipeline.stages.checks", "find_late_effect(Late.HEADING).id"): frozenset(
        {find_late_effect(Late.HEADING).id}
    ),
    ("pipeline.recording.clocks", "name"): frozenset({find_late_effect(Late.POSES).id}),
    ("pipeline.recording.case", "name"): frozenset(
        {"pose_turned", "imu_corrected", "wheels_corrected", "command_corrected"}
    ),
    # A finding of an error has the id of the error, and its text.
    ("pipeline.analysis.summary", "error.code"): frozenset[str](),
    ("pipeline.estimation.together", "error.code"): frozenset[str](),
}
"""Ids that are not written at their site but come out of a table, by module and expression."""
HELPERS = {
    "pipeline.recording.log_choice": {
        "pipeline.recording.log_choice": ("_explain_left_out", "_contradict_radius"),
        "pipeline.recording.geometry": ("describe_vehicle",),
        "pipeline.sources.recognition": ("_compare", "apply_parameters"),
    }
}
"""Functions that make values of findings elsewhere than at their sites, by the module of these."""
OF_FAULTS = (words._corrected, words._configured, words._contradicted)
"""Templates with that of a fault in them, whose values are those of the fault."""


@dataclass(frozen=True)
class Site:
    """A place in the code that makes a finding, and the function around it."""

    module: str
    call: ast.Call
    function: ast.FunctionDef

    @property
    def code(self) -> ast.Module:
        """What makes its values: the function around it, and helpers."""
        helpers = (
            ast.parse(inspect.getsource(getattr(import_module(module), name)))
            for module, names in HELPERS.get(self.module, {}).items()
            for name in names
        )
        return ast.Module([self.function, *helpers], [])

    def __repr__(self) -> str:
        return f"{self.module}:{self.call.lineno}"

    @property
    def ids(self) -> frozenset[str]:
        """The ids that its finding may have."""
        known = OF_TABLES.get((self.module, ast.unparse(self.call.args[0])))
        return frozenset(self._resolve(self.call.args[0])) if known is None else known

    def _resolve(self, node: ast.expr) -> Iterator[str]:
        if isinstance(node, ast.Constant):
            yield str(node.value)
            return
        if isinstance(node, ast.IfExp):
            yield from (*self._resolve(node.body), *self._resolve(node.orelse))
            return
        name = ast.unparse(node)
        assigned = [
            one.value
            for one in ast.walk(self.function)
            if isinstance(one, ast.Assign) and ast.unparse(one.targets[0]) == name
        ]
        for value in assigned:
            yield from self._resolve(value)
        if not assigned:
            yield getattr(import_module(self.module), name)


def list_sites() -> list[Site]:
    """The places that make findings, but for that which reads stored ones."""
    sites = []
    for path in sorted(ROOT.joinpath("pipeline").rglob("*.py")):
        module, tree = ".".join(path.relative_to(ROOT).with_suffix("").parts), ast.parse(path.read_text())
        functions = [one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)]
        calls = (one for one in ast.walk(tree) if isinstance(one, ast.Call))
        for call in (one for one in calls if ast.unparse(one.func) == "Finding"):
            around = [one for one in functions if one.lineno <= call.lineno <= (one.end_lineno or 0)]
            function = max(around, key=lambda one: one.lineno)
            sites.append(Site(module, call, function))
    return [one for one in sites if one.module != "pipeline.results.reading"]


SITES = list_sites()


def list_keys(node: ast.AST) -> set[str]:
    """Keys of the dictionaries of a function: those of the values of its findings are among them."""
    keys: set[object] = set()
    for one in ast.walk(node):
        if isinstance(one, ast.Dict):
            keys |= {key.value for key in one.keys if isinstance(key, ast.Constant)}
        elif isinstance(one, ast.Subscript) and isinstance(one.slice, ast.Constant):
            keys.add(one.slice.value)
    return {key for key in keys if isinstance(key, str)}


def list_texts(node: ast.AST) -> set[str]:
    """Texts of a function: those of the kinds of its findings are among them."""
    return {str(one.value) for one in ast.walk(node) if isinstance(one, ast.Constant)}


def list_templates() -> Iterator[tuple[str, str, Template]]:
    """Id, kind and template of every sentence."""
    for name, template in TEMPLATES.items():
        kinds = template if isinstance(template, Mapping) else {"": template}
        yield from ((name, kind, one) for kind, one in kinds.items())


def list_needed(template: Template) -> set[str]:
    """Names of values without which a template cannot be filled."""
    if isinstance(template, str):
        return {name for _, name, _, _ in string.Formatter().parse(template) if name} - {"where"}
    tree = ast.parse(inspect.getsource(getattr(template, "func", template)))
    needed = set[str]()
    optional = {
        one.left.value
        for one in ast.walk(tree)
        if isinstance(one, ast.Compare) and isinstance(one.left, ast.Constant)
    }
    for one in ast.walk(tree):
        if isinstance(one, ast.Subscript) and ast.unparse(one.value) == "of":
            needed |= {str(one.slice.value)} if isinstance(one.slice, ast.Constant) else set()
        if isinstance(one, ast.Call) and "of" in map(ast.unparse, one.args):
            helper = getattr(words, ast.unparse(one.func), None)
            needed |= list_needed(helper) if inspect.isfunction(helper) and helper != words._fill else set()
    return needed - optional - {"where", "kind"}


def test_every_finding_has_a_template_and_every_template_a_finding() -> None:
    assert {name for site in SITES for name in site.ids} == set(TEMPLATES)


def test_no_finding_is_made_with_a_sentence() -> None:
    allowed = {"where", "values", "t_start", "t_end"}
    assert [site for site in SITES if {one.arg for one in site.call.keywords} - allowed] == []
    assert set(Finding.__struct_fields__) == {"id", "severity", *allowed}


def test_the_sites_of_a_template_have_the_values_that_it_needs() -> None:
    for name, kind, template in list_templates():
        sites = [one for one in SITES if name in one.ids and (not kind or kind in list_texts(one.code))]
        assert sites, (name, kind)
        missing = {site: list_needed(template) - list_keys(site.code) for site in sites}
        assert not any(missing.values()) or getattr(template, "func", template) in OF_FAULTS, (
            name,
            kind,
            missing,
        )


def test_every_kind_has_a_template() -> None:
    known = {kind for _, kind, _ in list_templates()} | {"left out"}
    for site in SITES:
        dicts = [one for one in ast.walk(site.code) if isinstance(one, ast.Dict)]
        pairs = (pair for one in dicts for pair in zip(one.keys, one.values, strict=True))
        kinds = {
            text.value
            for key, value in pairs
            if isinstance(key, ast.Constant) and key.value == "kind"
            for text in ((value.body, value.orelse) if isinstance(value, ast.IfExp) else (value,))
            if isinstance(text, ast.Constant)
        }
        assert kinds <= known, site


def test_every_correction_has_the_values_that_its_template_needs() -> None:
    trees = [ast.parse(path.read_text()) for path in sorted(ROOT.joinpath("pipeline/recording").glob("*.py"))]
    functions = [one for tree in trees for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)]
    corrects = [one for one in functions if re.search(r"case\.(correct|contradict)\(", ast.unparse(one))]
    for name in FAULTS.keys() - words._FAULTS_OF_SIGNS.keys():
        sites = [one for one in corrects if name in list_texts(one)]
        assert sites, name
        missing = {one.name: list_needed(FAULTS[name]) - list_keys(one) - set(SIDES) for one in sites}
        assert not any(missing.values()), (name, missing)


def test_a_finding_of_other_results_is_named_by_its_id() -> None:
    """As of another version, or of a file that somebody wrote."""
    for values in ({}, {"count": "many", "value": None}, {"count": [], "value": {}}):
        assert format_finding(Finding("pose_gap", "info", "/pose", values)) == "pose gap"
        with pytest.raises((LookupError, TypeError, ValueError)):
            fill_template(Finding("pose_gap", "info", "/pose", values))
    assert format_finding(Finding("of_next_year", "info")) == "of next year"


def test_a_finding_of_an_error_says_what_the_error_says() -> None:
    values = {"error": "the run has 9 s of driving"}
    assert format_finding(Finding("too_short", "warning", "diagnosis", values)) == values["error"]
    left_out = Finding("too_short", "warning", "diagnosis", {**values, "kind": "left out"})
    assert format_finding(left_out) == f"left out: {values['error']}"


@pytest.mark.parametrize(
    ("ends", "when"),
    [
        ({"start_s": 40.0, "end_s": 70.0}, "from 40 to 70 s"),
        ({"start_s": 40.0}, "from 40 s on"),
        ({"end_s": 70.0}, "until 70 s"),
        ({}, "throughout"),
    ],
)
def test_an_outage_is_said_with_the_ends_that_it_has(ends: dict[str, float], when: str) -> None:
    stretch = {"side": "left", "reads": "zero", **ends}
    values = {"stretches": [stretch], "witnesses": ["command", "pose"], "line": "ignore = []"}
    text = format_finding(Finding("encoder_dead", "warning", "wheels", values))
    assert f"reads nothing {when} (zero is recorded while the commands and the poses go on)" in text
