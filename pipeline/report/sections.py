"""Sections of the page of a run: each has its template, the values that it shows, and its figures."""

import json
import math
import shlex
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from pipeline.core import (
    INPUT_WORDS,
    format_size,
    mapping_in,
    number_in,
    numbers_in,
    objects_in,
    split_interval,
)
from pipeline.models import list_effects, name_term, suggest_manoeuvre
from pipeline.recording import Finding
from pipeline.report import (
    MISSING,
    begin_large,
    count_serious,
    format_known_share,
    format_number,
    format_split,
    set_squares,
)
from pipeline.report.figures import Figure, draw_figure
from pipeline.report.figures.model_figures import BUDGET, ENOUGH, LADDER, SPLIT, VELOCITIES
from pipeline.report.figures.residual_figures import REACH, RESIDUALS, SIGNATURE
from pipeline.report.figures.signal_figures import SIGNALS, view_signals
from pipeline.report.figures.slip_figures import COMMAND_SPACE, MODULUS, STEP_RESPONSE, TRAJECTORY
from pipeline.report.figures.stretch_figures import MOTION, PATHS
from pipeline.report.pages import Section
from pipeline.report.scene import RunReport, Scene
from pipeline.results import (
    Named,
    has_no_pose,
    is_small,
    key_finding,
    read_finding_table,
    read_findings,
    read_model,
    split_main,
)
from pipeline.words import (
    BELOW_MAIN,
    Cell,
    Column,
    Table,
    describe_cause,
    describe_motion,
    describe_regions,
    describe_rest,
    describe_separation,
    describe_standing,
    describe_unexplained,
    format_finding,
    format_short,
    format_suggestion,
    has_dead_encoder,
    list_largest_falls,
    list_remaining_errors,
    list_terms,
    name_group,
    name_span,
    suggest_export,
)

_RANK = {"error": 0, "warning": 1, "info": 2}
_SEVERITY_WORDS = {"error": "do not trust", "warning": "take care", "info": "note"}
_TOPICS = {
    "command": "command",
    "wheels": "measured wheels",
    "pose": "pose",
    "imu": "IMU",
    "interval": "interval",
}
_STEPS_SHOWN = 3
"""Next steps that are shown; the others are folded."""


def view_glance(report: RunReport) -> dict[str, object]:
    """The verdict, and findings that forbid conclusions."""
    doubts = (format_finding(one) for one in list_findings(report) if one.severity == "error")
    return {
        "verdict": report.verdict,
        "doubts": [text for text in doubts if text.casefold() not in report.verdict.casefold()],
        "refusal": report.refusal,
    }


def format_standing(report: RunReport) -> str:
    """Compare the run with comparable ones; empty if there are none."""
    name = report.main_input
    others = list(report.peers.get(name, ()))
    median = number_in(mapping_in(report.part("by_input"), name), "median_modulus")
    if not others or median is None:
        return ""
    dataset = report.text("dataset")
    usual = f"{format_number(statistics.median(others))} m/s"
    if len(others) == 1:
        comparative = "more" if median > others[0] else "less"
        return f"{comparative} slip than the one other run of {dataset}: {usual}"
    below = sum(other < median for other in others)
    return f"more slip than {below} of the {len(others)} other runs of {dataset}; their median is {usual}"


def view_how_bad(report: RunReport) -> dict[str, object]:
    """Cards with the medians, and the table of both inputs."""
    keys = {
        "median": "median_modulus",
        "norm": "median_window_norm",
        "transitory": "transitory_median_modulus",
        "steady": "steady_median_modulus",
    }
    cards = [
        {"input": name, "words": INPUT_WORDS[name]}
        | {key: number_in(_numbers_of(report, name), column) for key, column in keys.items()}
        for name in report.inputs
    ]
    return {
        "refusal": report.refusal,
        "cards": cards,
        "standing": format_standing(report),
        "table": _tabulate(report),
    }


def _numbers_of(report: RunReport, name: str) -> Mapping[str, object]:
    numbers = mapping_in(report.part("by_input"), name)
    if numbers or name != report.main_input:
        return numbers
    return {key: report.summary.get(key) for key in ("samples", "median_modulus", "median_window_norm")}


def _tabulate(report: RunReport) -> Table | None:
    columns = [_list_numbers(_numbers_of(report, name)) for name in report.inputs]
    if not columns:
        return None
    scale = report.number("length_scale_m")
    caption = "Slip g = f(u) \u2212 v of the ideal model"
    caption += "" if scale is None else f"; slip modulus with L = {scale:g} m"
    standing = describe_standing(report.number("standing_share"))
    caption += f"; {standing}" if standing else ""
    if has_no_pose(read_findings(report.summary)):
        caption += "; v is that of the measured wheels: no pose is recorded"
    rows: list[list[str | Cell]] = [[words, *(c[i] for c in columns)] for i, words in enumerate(_QUANTITIES)]
    head = [Column("u"), *(Column(INPUT_WORDS[name], number=True) for name in report.inputs)]
    return Table(caption, head, rows)


_QUANTITIES = (
    Cell("median slip modulus", small="m/s"),
    Cell("median 2 s window norm", small="m/s"),
    Cell("RMS g", sub="x", after=", forward", small="m/s"),
    Cell("RMS g", sub="y", after=", lateral", small="m/s"),
    Cell("RMS g", sub="w", after=", yaw rate", small="rad/s"),
    Cell("time steps"),
)


def _list_numbers(numbers: Mapping[str, object]) -> list[str]:
    """Cells in the order of the quantities."""
    rms = [*numbers_in(numbers, "rms"), None, None, None][:3]
    medians = [number_in(numbers, name) for name in ("median_modulus", "median_window_norm")]
    samples = number_in(numbers, "samples")
    return [
        *(format_number(value) for value in medians + rms),
        MISSING if samples is None else f"{samples:,.0f}",
    ]


def view_where(report: RunReport) -> dict[str, object]:
    """Regions with the largest error, and the times that can be marked."""
    moments = [
        {"of": one, "spans": [(span, name_span(span)) for span in one.spans[:3]]}
        for one in report.diagnosis.when
    ]
    return {"regions": list_regions(report), "moments": moments}


def list_regions(report: RunReport, most: int = 3) -> list[tuple[str, str]]:
    """Regions of the ideal model's error, as on the screen: each with its part of the error."""
    if report.refusal:
        return []
    parted = (text.partition(": ") for text in describe_regions(report.diagnosis.where)[:most])
    return [(region, part) for region, _, part in parted]


def view_what_now(report: RunReport) -> dict[str, object]:
    """Commands for the next steps, and whether a drive could decide anything that is open."""
    diagnosis = report.diagnosis
    is_open = diagnosis.undecided or diagnosis.unobservable_why or diagnosis.unexplained
    steps = list_steps(report) if report.text("run") else []
    return {
        "steps": steps[:_STEPS_SHOWN],
        "more": steps[_STEPS_SHOWN:],
        "settled": bool(steps and diagnosis.effects) and not is_open,
        "planned": report.planned,
    }


def list_steps(report: RunReport) -> list[tuple[str, str]]:
    """Next steps with their commands, in descending order of usefulness."""
    if report.refusal:
        log = shlex.quote(str(report.part("log").get("path") or "run.mcap"))
        return [
            ("List the contents of the log", f"slip inspect {log}"),
            ("Correct what the findings report, then analyze again", f"slip analyze {log}"),
        ]
    run = report.text("run")
    # A run name with a leading dash would be read as an option.
    name = shlex.quote(run) if not run.startswith("-") else shlex.quote(f"./{run}")
    return [
        *_list_model_steps(report, name),
        ("Compare with other vehicles and terrains", "slip compare"),
        ("Look at slip in the viewer that plays the log", f"slip export {name} --to mcap"),
    ]


def _list_model_steps(report: RunReport, name: str) -> list[tuple[str, str]]:
    diagnosis = report.diagnosis
    if not report.is_diagnosed:
        return [("Estimate the effects that the model lacks", f"slip diagnose {name}")]
    steps = []
    if diagnosis.has_suggestion:
        steps.append(("Add the suggested term, and see the error fall", f"slip serve {name}"))
    if diagnosis.effects:
        steps.append(("Save the estimated model", f"slip diagnose {name} --apply model.toml"))
        if (file := read_model(diagnosis)) is not None:
            steps.append(("Export it", suggest_export(file, "model.toml")))
        against = f"slip model compare model.toml --against literature --on {name}"
        steps.append(("Compare it with models of the literature", against))
    if diagnosis.undecided or diagnosis.unobservable_why:
        what = "is undecided" if diagnosis.undecided else "is not observable"
        steps += [
            (f"Plan a drive that determines what {what}, where one can", f"slip plan {name} --folder plan"),
            ("Look at plan/plan.html, lift the wheels, and play it", "ros2 bag play plan/plan.mcap"),
            ("Check the plan against the drive", "slip plan --check plan NEW.mcap"),
        ]
    steps.append(("Try other effects, and plan the next drive, in the browser", f"slip serve {name}"))
    if diagnosis.unexplained:
        steps.append(("Write the effect that explains the rest yourself", "slip model new-effect mine.py"))
    return steps


def view_health(report: RunReport) -> dict[str, object]:
    """Findings, losses and topics."""
    notes = report.part("topics").get("notes")
    return {
        "findings": [_view_finding(finding) for finding in list_findings(report)],
        "losses": _tabulate_losses(report),
        "quarantine": _tabulate_quarantine(report),
        "topics": list(_list_topics(report)),
        "topic_notes": notes if isinstance(notes, list) else [],
    }


def list_findings(report: RunReport) -> list[Finding]:
    """Findings of the summary, or otherwise of the table, the most severe first."""
    findings, table = read_findings(report.summary), report.table("findings")
    if not findings and table is not None:
        findings = read_finding_table(table)
    return sorted(findings, key=lambda finding: _RANK[finding.severity])


def summarise_health(report: RunReport) -> list[tuple[str, str]]:
    """Grade (`good`, `note`, `warning`, `error`) and text for the strip at the head of the page."""
    log = report.part("log")
    losses = objects_in(log, "losses")
    complete = log.get("complete") is not False and not losses
    strip = [("good", "log complete") if complete else ("error", f"log has losses ({max(len(losses), 1)})")]
    findings = list_findings(report)
    if has_dead_encoder(findings):
        strip.append(("error", "a dead encoder"))
    if report.summary.get("simulated"):
        strip.append(("note", "simulated"))
    if log.get("unchecked"):
        strip.append(("note", "log unchecked"))
    segments = report.number("segments")
    if segments is not None:
        gaps = int(segments) - 1
        strip.append(("good", "no gaps") if gaps <= 0 else ("note", f"{int(segments):,} segments"))
    repeated = next((one.value for one in findings if one.id == "held_poses"), None)
    if repeated is not None:
        strip.append(("note", f"{format_known_share(repeated)} of the poses repeated"))
    elif report.number("held_poses") == 0:
        strip.append(("good", "no repeated poses"))
    strip.extend(count_serious(findings).items())
    return strip


def _view_finding(finding: Finding) -> dict[str, object]:
    places = [finding.where] if finding.where else []
    start, end = finding.t_start, finding.t_end
    if start is not None:
        places.append(f"at {format_number(start)} s" if end is None else _format_stretch(start, end))
    return {
        "grade": finding.severity,
        "word": _SEVERITY_WORDS[finding.severity],
        "text": format_finding(finding),
        "places": places,
        "id": finding.id,
    }


def _format_stretch(start: float | None, end: float | None) -> str:
    return MISSING if start is None else f"{format_number(start)}\u2013{format_number(end)} s"


def _tabulate_losses(report: RunReport) -> Table:
    def show(loss: Mapping[str, object], key: str, form: Callable[[float], str]) -> str:
        value = number_in(loss, key)
        return MISSING if value is None else form(value)

    rows = [
        [
            str(loss.get("kind", "")),
            show(loss, "bytes", format_size),
            show(loss, "chunks", "{:.0f}".format),
            _format_stretch(number_in(loss, "start_s"), number_in(loss, "end_s")),
        ]
        for loss in objects_in(report.part("log"), "losses")
    ]
    head = (Column("kind"), Column("size", number=True), Column("chunks", number=True), Column("stretch"))
    return Table("What the log has lost", head, rows)


def _tabulate_quarantine(report: RunReport) -> Table:
    """Rows that violated a contract, counted by table and rule."""
    broken = report.part("quarantined")
    rows = [
        [table, rule, str(count)]
        for table in broken
        for rule, count in mapping_in(mapping_in(broken, table), "rules").items()
    ]
    return Table("Rows set aside", (Column("table"), Column("rule"), Column("rows", number=True)), rows)


def _list_topics(report: RunReport) -> Iterator[tuple[str, object, object]]:
    """Use of a topic, its name, and the reason for its choice."""
    topics = report.part("topics")
    for key, words in _TOPICS.items():
        chosen = mapping_in(topics, key) or {"topic": topics.get(key)}
        topic, reason = chosen.get("topic"), chosen.get("reason")
        if topic or reason:
            yield words, topic, reason


def view_provenance(report: RunReport) -> dict[str, object]:
    """Path and hash of the log, keys and versions, the effective configuration."""
    log, origin = report.part("log"), report.part("provenance")
    rate = report.number("rate_hz")
    facts = [
        ("log", log.get("path")),
        ("SHA-256", log.get("sha256")),
        ("dataset", report.text("dataset")),
        ("rate", f"{rate:g} Hz" if rate is not None else ""),
    ]
    facts += [
        (name, ", ".join(f"{key} {value}" for key, value in mapping_in(origin, name).items()))
        for name in ("versions", "keys")
    ]
    configuration = origin.get("configuration")
    if isinstance(configuration, Mapping):
        configuration = configuration and json.dumps(
            configuration, indent=2, sort_keys=True, ensure_ascii=False, default=str
        )
    return {"facts": [fact for fact in facts if fact[1]], "configuration": configuration}


_MANY_FOLD = 10.0
_PATHS = {"wheels": "from command to wheels", "measured": "from wheels to body"}
"""Paths on which effects are judged where wheels are measured; errors of one are not those of the other."""
_HEAD = (
    Column("effect"),
    Column("value", number=True),
    Column("95 %", number=True),
    Column("95 %, another run", number=True),
    Column("held-out squared error over half a second without it"),
)


def format_remaining(report: RunReport) -> str:
    """The errors of the model relative to their noise floors; empty if unknown."""
    clauses = list_remaining_errors(report.diagnosis)
    return f"remaining error {'; '.join(clauses)}" if clauses else ""


def view_why(report: RunReport) -> dict[str, object]:
    """Effects, open questions, and the split in one sentence."""
    diagnosis = report.diagnosis
    main, minor = split_main(diagnosis.effects, diagnosis)
    rows = [row for entry in (*main, *minor) for row in _list_parameters(entry)]
    split = report.part("split")
    drivetrain, ground, cross = (number_in(split, name) for name in ("drivetrain", "ground", "cross"))
    return {
        "refusal": report.refusal,
        "diagnosed": report.is_diagnosed,
        "named": [_view_effect(report, entry) for entry in main],
        "smaller": [_view_effect(report, entry) for entry in minor],
        "below": BELOW_MAIN,
        # A group that counts as one smaller effect.
        "groups": sum(is_small(group.in_model, diagnosis) for group in diagnosis.undecided),
        "undecided": bool(diagnosis.undecided),
        "remaining": format_remaining(report),
        "table": Table("Effects", _HEAD, rows),
        "open": list(_list_open(report)),
        "split": None
        if drivetrain is None or ground is None or cross is None or report.refusal
        else {"from_drivetrain": drivetrain > ground, "words": format_split(drivetrain, ground, cross)},
    }


def _view_effect(report: RunReport, effect: Named) -> dict[str, object]:
    """One effect: description and possible causes."""
    return {
        "id": effect.id,
        "does": begin_large(set_squares(describe_motion(effect, report.diagnosis))),
        "value": set_squares(format_short(effect)),
        "fall": list_largest_falls(report.diagnosis).get(effect.id, "").replace("->", "\u2192"),
        "may_be": set_squares(describe_cause(effect)),
        "alike": _list_alike(effect),
    }


def _list_alike(effect: Named) -> tuple[str, str] | None:
    """Effects that are easily confused with this one, and the drive that would separate them."""
    known = {kind.id: kind() for kind in list_effects()}
    names = [name for name in effect.confused_with if name in known]
    if not names or effect.id not in known:
        return None
    return ", ".join(map(name_term, names)), suggest_manoeuvre(
        known[effect.id], *(known[name] for name in names)
    )


def _list_parameters(effect: Named) -> list[list[str | Cell]]:
    """One row per parameter: value, interval, and in the first row the gain of the effect."""
    notes = [f"same as {', '.join(effect.equivalent_to)}"] if effect.equivalent_to else []
    form = ",.0f" if effect.gain >= _MANY_FOLD else ".3g"
    is_known = math.isfinite(effect.gain)
    without = Cell(f"x {effect.gain + 1.0:{form}}", small=_PATHS.get(effect.path, "")) if is_known else ""
    rows: list[list[str | Cell]] = []
    for key, value in effect.parameters.items():
        shown = "" if value.unit in {"1", ""} else set_squares(value.unit)
        text, ends = _format_within(value.value, value.low, value.high)
        rows.append(
            [
                Cell(small=key) if rows else Cell(effect.id, small=key, notes=notes),
                Cell(text, small=shown, notes=[value.mark] if value.doubt else []),
                ends,
                _format_within(value.value, value.another_run.low, value.another_run.high)[1],
                "" if rows else without,
            ]
        )
    return rows or [[Cell(effect.id, notes=notes), "", "", "", without]]


def _format_within(value: float, low: float, high: float) -> tuple[str, str]:
    """A value, and an interval about it with the digits that it supports; empty where unknown."""
    if not math.isfinite(value + low + high):
        return format_number(value, digits=4) if math.isfinite(value) else "", ""
    text, *both = split_interval(value, low, high)
    return text, " to ".join(both)


def _list_open(report: RunReport) -> Iterator[tuple[str, str, str]]:
    """What this log does not determine, and what no effect of the catalogue explains, with its formula."""
    diagnosis = report.diagnosis
    for group in diagnosis.undecided:
        yield "undecided", f"{name_group(group.candidates)}: {describe_separation(group)}", ""
    if diagnosis.unexplained is not None:
        rest = diagnosis.unexplained
        terms = list_terms(rest)
        texts = [describe_unexplained(rest), *terms, format_suggestion(rest)]
        # A formula that is too long for a line is nothing that anybody reads.
        yield "unexplained", "; ".join(filter(None, texts)), (rest.formula or "") if terms else ""
    if diagnosis.unobservable_why:
        yield "not observable in this log", ", ".join(map(name_term, diagnosis.unobservable_why)), ""
    known = set(map(key_finding, list_findings(report)))
    for finding in diagnosis.findings:
        if key_finding(finding) not in known:
            yield "finding", format_finding(finding), ""
    if diagnosis.disturbance is not None and diagnosis.unexplained is None:
        yield "residual", describe_rest(diagnosis), ""


def sum_up_where(report: RunReport) -> str:
    """The region that carries most of the ideal model's error."""
    if not report.diagnosis.ladder:
        return ""
    regions = [f"{region}: {part}" for region, part in list_regions(report, 1)]
    return regions[0] if regions else "the error is spread evenly over the run"


def sum_up_slip(report: RunReport) -> str:
    """The median slip from each input."""
    medians = {name: number_in(_numbers_of(report, name), "median_modulus") for name in report.inputs}
    texts = [
        f"{format_number(one, digits=2)} m/s {INPUT_WORDS[name]}"
        for name, one in medians.items()
        if one is not None and not report.refusal
    ]
    return f"median slip modulus {', '.join(texts)}" if texts else ""


def sum_up_rest(report: RunReport) -> str:
    """The error of the model beside the noise floor."""
    ideal = "that of the ideal model: no effect was added"
    return format_remaining(report) or (ideal if report.diagnosis.ladder else "")


_FIGURES: Mapping[str, tuple[Figure, ...]] = {
    "glance": (PATHS, MOTION),
    "signals": (SIGNALS,),
    "why": (LADDER, SIGNATURE),
    "where": (TRAJECTORY, COMMAND_SPACE, REACH),
    "how-bad": (MODULUS, VELOCITIES),
    "rest": (BUDGET, RESIDUALS, STEP_RESPONSE, SPLIT, ENOUGH),
}
"""What is drawn in each section, in order; figures without rows are left out."""


def list_figures() -> list[Figure]:
    """All figures, in the order of the page."""
    return [figure for figures in _FIGURES.values() for figure in figures]


def list_sections(scene: Scene) -> list[Section]:
    """Sections of the page: verdict and first picture, effects, what to do next; others folded.

    Args:
        scene: the run.
    """
    report = scene.report

    def show(name: str, title: str, view: Mapping[str, object], brief: str | None = None) -> Section:
        pictures = [picture for figure in _FIGURES.get(name, ()) for picture in draw_figure(figure, scene)]
        return Section(
            name, title, pictures=pictures, brief=brief, template=name if view else "plain", view=view
        )

    glance = show("glance", "At a glance", {**view_glance(report), "stretch": scene.stretch})
    health = ", ".join(words for _, words in summarise_health(report))
    where = show("where", "Where", view_where(report), sum_up_where(report))
    return [
        glance,
        show(
            "signals", "Signals", view_signals(scene), "any two columns of the tables of this run over time"
        ),
        show("why", "Effects", view_why(report)),
        show("what-now", "What to do next", view_what_now(report)),
        # Without a model to look at, the map is what there is to see.
        replace(where, is_open=not glance.pictures),
        show("how-bad", "How much slip", view_how_bad(report), sum_up_slip(report)),
        show("rest", "Remaining error", {}, sum_up_rest(report)),
        show("health", "Data health", view_health(report), health),
        show("provenance", "Provenance", view_provenance(report), str(report.part("log").get("path") or "")),
    ]
