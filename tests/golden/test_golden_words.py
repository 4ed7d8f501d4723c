"""Sentences about made-up results, whole: verdicts, effects, lines of a diagnosis, pages of a run."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import pytest
from drawn_diagnoses import check_verdict, draw_diagnosis
from golden import read_page
from msgspec.structs import replace
from report_synthesis import make_report

from pipeline.models import Interval, Number, find_effect, list_effects
from pipeline.recording import FAULTS, Finding
from pipeline.report.page import render_report
from pipeline.report.scene import RunReport
from pipeline.results import Delays, Detectable, Errors, Named, RunDiagnosis, Step, Unexplained
from pipeline.sources import list_presets
from pipeline.words.diagnosis import list_lines
from pipeline.words.objects import diagnosis_as_json
from pipeline.words.verdict import format_verdict

if TYPE_CHECKING:
    from collections.abc import Callable

    Check = Callable[[str, str], None]

PRESETS = {vehicle.id: vehicle for vehicle in list_presets()}
SHORT = [
    {
        "id": "little_driving",
        "severity": "warning",
        "where": "diagnosis",
        "values": {"error": "the run has 31 s of driving"},
    }
]
POOR = "run: 9 s of driving. Drive longer."
TRACK, LAG, ASYMMETRY = {"k": 1.5}, {"tau": 0.3}, {"e": 0.02}
CLOSE, FAR = [(0.055, 0.02)], [(0.4, 0.2)]
UNDECIDED = [{"candidates": ["body_inertia", "lateral_skid"], "in_model": "body_inertia"}]
RIVALS = ["icr_lateral", "speed_slip", "turning_resistance", "wheel_radius", "icr_offset"]
DRAWN = {
    "two effects": draw_diagnosis(
        {"effective_track": {"k": 1.79}, "turn_lag": {"tau_mean": 0.4, "tau_diff": 1.08}},
        [(1.06, 0.96), (0.44, 0.14), (0.1, 0.04)],
    ),
    "a third that removes less than a tenth": draw_diagnosis(
        {"effective_track": TRACK, "drive_lag": LAG, "wheel_asymmetry": ASYMMETRY},
        [(1.0, 0.5), (0.5, 0.05), (0.1, 0.04), (0.05, 0.02)],
    ),
    "one that removes little before one that removes much": draw_diagnosis(
        {"drive_lag": LAG, "wheel_asymmetry": ASYMMETRY, "effective_track": TRACK},
        [(1.0, 0.5), (0.5, 0.5), (0.45, 0.48), (0.05, 0.02)],
    ),
    "small ones alone": draw_diagnosis(
        {"deadband": {"d": 0.01}, "lateral_skid": {"c": 0.02}}, [(0.2, 0.1), (0.19, 0.095), (0.2, 0.115)]
    ),
    "sensor, ground and drivetrain": draw_diagnosis(
        {"heading_skew": {"d": 0.1}, "effective_track": TRACK, "drive_lag": LAG},
        [(1.0, 1.0), (0.4, 0.6), (0.2, 0.3), (0.05, 0.02)],
    ),
    "drivetrain, ground and sensor": draw_diagnosis(
        {"acceleration_limit": {"limit": 4.0}, "effective_track": TRACK, "heading_skew": {"d": 0.1}},
        [(1.0, 1.0), (0.6, 0.6), (0.3, 0.2), (0.05, 0.02)],
    ),
    "an alternative": draw_diagnosis({"body_inertia": LAG}, [(1.0, 0.5), (0.3, 0.2)], undecided=UNDECIDED),
    "nothing, close to the floor": draw_diagnosis({}, CLOSE),
    "nothing, far from the floor": draw_diagnosis({}, FAR),
    "nothing, and half a floor": draw_diagnosis({}, FAR, noise_floor={"t_mrmse_m": 0.05, "r_mrmse_rad": 0.0}),
    "nothing, and no floor": draw_diagnosis({}, FAR, noise_floor={}),
    "too short, close to the floor": draw_diagnosis({}, CLOSE, findings=SHORT),
    "too short, far from the floor": draw_diagnosis({}, FAR, findings=SHORT),
    "short with an effect": draw_diagnosis({"drive_lag": LAG}, [(1.0, 0.5), (0.05, 0.02)], findings=SHORT),
    "two rivals": draw_diagnosis({}, FAR, undecided=[{"candidates": RIVALS[2:4], "in_model": None}]),
    "five rivals": draw_diagnosis({}, FAR, undecided=[{"candidates": RIVALS, "in_model": None}]),
    "a clock alone": draw_diagnosis({"clock_offset": {"d": -0.15}}, CLOSE),
    "too poor": RunDiagnosis(
        "run", findings=(Finding("too_short", "warning", "diagnosis", {"error": POOR}),)
    ),
}
UNUSUAL = {"five rivals", "nothing, and no floor", "too poor"}
"""Those with a number that counts something, or without a rung or a floor."""
BESIDE: dict[str, tuple[tuple[str, dict[str, float]], ...]] = {
    "smaller wheels turn less, too": (("effective_track", {"k": 2.0}), ("wheel_radius", {"k": 0.8})),
    "gains turn less, too": (
        ("effective_track", {"k": 2.0}),
        ("drive_gain", {"g": 0.9}),
        ("difference_gain", {"g": 1.1}),
    ),
    "both gains": (("difference_gain", {"g": 1.06}), ("drive_gain", {"g": 0.969})),
    "to the right": (("steering_offset", {"o": -0.02}),),
    "early": (("clock_offset", {"d": -0.12}),),
    "far away": (("lever_arm", {"l_x": 1.804, "l_y": -0.0312}),),
    "without a bound": (("contact_friction", {"k": 1.75}),),
}


def test_verdicts(check_golden: Check) -> None:
    """Not said of a refused run: anything but its reason."""
    told = {
        name: (format_verdict if name in UNUSUAL else check_verdict)(drawn) for name, drawn in DRAWN.items()
    }
    for name in ("not_moving", "pose_from_wheels", *FAULTS):
        finding = Finding(name, "error", values={"error": "the reason in words"})
        told[f"refused: {name}"] = format_verdict(replace(DRAWN["two effects"], findings=(finding,)))
    check_golden("verdicts.txt", "\n\n".join(f"{name}:\n{verdict}" for name, verdict in told.items()))


def test_sentences_of_effects(check_golden: Check) -> None:
    """Each effect at its usual size, with a number that is open, and beside others."""
    lines = []
    for kind in list_effects():
        vehicle = next(
            PRESETS[name]
            for name in ("husky_a200", "ackermann_car", "dingo_o")
            if PRESETS[name].kind in kind.kinds
        )
        usual = {one.name: one.typical for one in kind.parameters if not one.instead_of}
        effect = kind().change(**usual)
        lines += [f"{kind.id}: {effect.describe_motion(vehicle)}", f"    {effect.describe_clause(vehicle)}"]
        lines += [f"    {name} open: {effect.omit_open({name}).describe_clause(vehicle)}" for name in usual]
    for why, told in BESIDE.items():
        effects = [find_effect(name)().change(**values) for name, values in told]
        vehicle = PRESETS["ackermann_car" if why in {"to the right", "far away"} else "husky_a200"]
        lines += [
            f"{why}: {effects[0].describe_motion(vehicle, effects)}",
            f"    {effects[0].describe_clause(vehicle, effects)}",
        ]
    check_golden("effects.txt", "\n".join(lines))


def test_lines_of_a_diagnosis(check_golden: Check) -> None:
    """Numbers at a bound, rises, findings that repeat, and a rest with and without a formula."""
    servo = {
        "tau": Number(0.681, 0.587, 0.775, "s"),
        "reset": Number(0.0, math.nan, math.nan, "1/s", at_bound=True),
        "scrub": Number(1.3312, 1.3300, 1.3324, "m/s", another_run=Interval(0.42, 2.24)),
        "creep": Number(
            0.3601, 0.3597, 0.3605, "s/m", another_run=Interval(0.277, 0.443), is_spread_measured=True
        ),
    }
    stuck = Finding("stuck", "warning", values={"error": "it was stuck"})
    many = [Finding("w", "warning", values={"error": f"warning {number}"}) for number in range(5)]
    grave, note = (
        Finding(one, severity, values={"error": text})  # type: ignore[arg-type]
        for one, severity, text in (("e", "error", "an error"), ("n", "info", "a note"))
    )
    names = ["wheel_servo", "torque_limit", "drive_lag"]
    formula = 'v_y = "k_1 * v0 * v0"\nk_1 = { value = 0.08188, unit = "s/m", bounds = [-50.0, 50.0] }\n'
    run = RunDiagnosis(
        "field/run",
        "command",
        vehicle=PRESETS["warthog"],
        effects=(
            Named("wheel_servo", servo),
            Named("torque_limit", {"limit": Number(14.4, unit="m/s^2")}),
            Named("drive_lag", {"tau": Number(0.3, 0.2, 0.4, "s")}),
        ),
        detectable=(
            Detectable("yaw_drift", "c", "rad/s", 0.016),
            Detectable("difference_gain", "g", "1", 0.16),
        ),
        unexplained=Unexplained(
            "formula",
            0.02,
            "y",
            ("y",),
            "command",
            formula=formula,
            with_formula=Errors(t_mrmse_m=0.25, r_mrmse_rad=0.02),
        ),
        findings=(note, stuck, stuck, *many, grave),
        ladder=tuple(
            Step(effects=tuple(names[:count]), t_mrmse_m=t, r_mrmse_rad=r)
            for count, (t, r) in enumerate([(0.6, 0.5), (0.54, 0.5), (0.54, 0.5), (0.57, 0.4)])
        ),
        noise_floor=Errors(t_mrmse_m=0.05, r_mrmse_rad=0.02),
        explained_share=0.4,
        timing=Delays(wheel_delay_s=0.334),
    )
    left = Unexplained("lasting", 0.98, "w", ("w",), "command", sizes={"w": 0.19})
    bare = replace(run, effects=(), ladder=run.ladder[:1], unexplained=left, findings=(), timing=Delays())
    parts = [
        "\n".join(f"{label:<10}{text}" for label, text in list_lines(one, everything=everything))
        for one in (run, bare)
        for everything in (False, True)
    ]
    check_golden("diagnosis_lines.txt", "\n\n".join(parts))
    assert all(
        number["undetermined"]
        for effect in diagnosis_as_json(run)["effects"]
        if effect["id"] == "torque_limit"
        for number in effect["parameters"].values()
    )


@pytest.mark.parametrize(
    "kind", ["whole", "undiagnosed", "undecided", "refused", "commands_alone", "unknown"]
)
def test_page_of_a_run(kind: str, check_golden: Check) -> None:
    whole = make_report(measured=kind != "commands_alone")
    grave = {"id": "not_moving", "severity": "error", "values": {"error": "the vehicle does not move"}}
    report = {
        "undiagnosed": lambda: RunReport(whole.summary, whole.tables),
        "undecided": lambda: RunReport(whole.summary, {}, replace(whole.diagnosis, effects=())),
        "refused": lambda: RunReport({**whole.summary, "findings": [grave]}, {}),
        "unknown": lambda: RunReport({}, {}),
    }.get(
        kind, lambda: dataclasses.replace(whole, peers={"command": [0.01, 0.02, 99.0], "measured": [1.0]})
    )()
    check_golden(f"page_{kind}.txt", read_page(render_report(report)))
