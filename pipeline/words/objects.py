"""The JSON of a diagnosis for people and scripts: its data with the sentences of each part."""

from typing import Any

from pipeline.results import RunDiagnosis, to_json
from pipeline.words.effects import (
    describe_clause,
    describe_effect,
    describe_separation,
    list_readings,
    suggest_drive,
)
from pipeline.words.errors import (
    describe_moments,
    describe_need,
    describe_region,
    describe_rest,
    describe_structure,
    name_region,
    name_span,
)
from pipeline.words.findings import format_finding
from pipeline.words.verdict import format_verdict


def diagnosis_as_json(run: RunDiagnosis) -> dict[str, Any]:
    """The documented keys of `slip diagnose --json` for one run, and more."""
    content: dict[str, Any] = {"run": run.run, "verdict": format_verdict(run), **to_json(run)}
    _describe_effects(run, content)
    content["unobservable"] = list(run.unobservable_why)
    for name, entry in content["unobservable_why"].items():
        entry["manoeuvre"] = suggest_drive(name)
    if run.unexplained is not None:
        content["unexplained"]["where"] = describe_structure(run.unexplained)
    content["findings"] = [
        {"id": one.id, "text": format_finding(one), "where": one.where, "severity": one.severity}
        | {name: entry["values"][name] for name in ("value", "count") if name in one.values}
        | entry
        for one, entry in zip(run.findings, content["findings"], strict=True)
    ]
    for region, entry in zip(run.where, content["where"], strict=True):
        entry["region"], entry["text"] = name_region(region), describe_region(region)
    for moments, entry in zip(run.when, content["when"], strict=True):
        entry["text"] = describe_moments(moments)
        for span, part in zip(moments.spans, entry["spans"], strict=True):
            part["text"] = name_span(span)
    for key in ("noise_floor", "disturbance"):
        content[key] = content[key] or {}
    if run.disturbance is not None:
        content["disturbance"]["text"] = describe_rest(run)
    content["enough"] = describe_need(run) or None
    return content


def _describe_effects(run: RunDiagnosis, content: dict[str, Any]) -> None:
    """Sentences of the effects, and of those that the log does not separate."""
    content["joint_with"] = [name for name in run.joint if name != run.run]
    for effect, entry in zip(run.effects, content["effects"], strict=True):
        entry["sentence"], entry["clause"] = describe_effect(effect, run), describe_clause(effect, run)
        entry["level"] = None
        entry["could_be"] = [
            {"level": one.level.value, "name": one.name, "text": one.text} for one in list_readings(effect)
        ]
        entry["parameters"] = {name: number.to_json() for name, number in effect.parameters.items()}
    for item, entry in zip(run.undecided, content["undecided"], strict=True):
        entry["separate_by"] = describe_separation(item)
        entry["parameters"] = {
            name: {key: number.to_json() for key, number in numbers.items()}
            for name, numbers in item.parameters.items()
        }
