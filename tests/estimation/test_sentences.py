"""Sentences of a diagnosis: the standard term, a number with its unit, one idea each."""

from __future__ import annotations

import math

import pytest

from pipeline.cli.conventions import format_vehicle_source
from pipeline.estimation.ambiguity import Detectable
from pipeline.estimation.diagnosis import Named, RunDiagnosis, Unexplained, Value
from pipeline.estimation.diagnosis_lines import (
    choose_lines,
    format_learned_share,
    format_unexplained,
    list_lines,
)
from pipeline.estimation.error_regions import format_dependence, format_remaining_error
from pipeline.estimation.ladder import ERRORS_OVER_2S, format_rises
from pipeline.models import find_effect
from pipeline.models.formula import parse_expression
from pipeline.models.parameter import parse_unit
from pipeline.report.scene import RunReport
from pipeline.report.sections_why import _list_open, format_row
from pipeline.run import MotionError
from pipeline.sources import find_preset


@pytest.mark.parametrize(
    ("error", "floor", "explained", "sentence"),
    [
        (0.0164, 0.0164, 1.0, "remaining error 1.6 cm, at the noise floor"),
        (0.0029, 0.0034, 1.02, "remaining error 0.29 cm, below the estimated noise floor of 0.34 cm"),
        (
            1.31,
            0.19,
            0.86,
            "remaining error 1.31 m, noise floor 19 cm: the effects remove 86 % of the error above it",
        ),
        (0.3, None, 0.9, ""),
        (0.3, 0.1, None, "remaining error 30 cm, noise floor 10 cm"),
        (0.3, 0.1, math.nan, "remaining error 30 cm, noise floor 10 cm"),
    ],
)
def test_the_remaining_error_is_compared_with_the_noise_floor(
    error: float, floor: float | None, explained: float | None, sentence: str
) -> None:
    assert format_remaining_error(error, floor, explained) == sentence


def test_an_effect_with_several_causes_names_them_and_what_separates_them() -> None:
    husky = find_preset("husky_a200")
    assert husky is not None
    motion = find_effect("effective_track")().change(k=1.8).describe_motion(husky)
    named = Named(
        "effective_track", {"k": Value(1.8, 1.78, 1.82, "1")}, 1.0, (), (), corrected=False, path="command",
        selected=1.0, motion=motion,
    )  # fmt: skip
    assert named.sentence == (
        "Effective track 0.99 m (nominal 0.55): the robot turns at 56 % of the ideal rate. "
        "Cause: skidding or a wrong track width; a run on another surface separates them."
    )
    assert format_row({"sentence": named.sentence}) == (
        motion,
        "skidding or a wrong track width; a run on another surface separates them.",
    )
    assert format_row({"sentence": "Turn acceleration limit: 1.55 rad/s^2"})[0].endswith("1.55 rad/s\u00b2")


def test_causes_that_hold_alternatives_are_joined_by_commas() -> None:
    named = Named(
        "yaw_misalignment", {"psi": Value(-0.03, -0.04, -0.02, "rad")}, 1.0, (), (), corrected=False,
        path="command", selected=1.0, motion="Yaw misalignment",
    )  # fmt: skip
    assert "Cause: a misaligned sensor or a bent axle, or crabbing on this terrain; a run" in named.sentence


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("c * sin(w0)", "sin() needs a dimensionless argument; w0 is in rad/s"),
        ("max(v0, w0)", "max() needs arguments of one unit; v0 is in m/s; w0 is in rad/s"),
        ("v0 + w0", "cannot add values in m/s and in rad/s"),
    ],
)
def test_a_wrong_unit_is_said_of_the_argument_that_has_it(text: str, what: str) -> None:
    written = {"v0": "m/s", "w0": "rad/s", "c": "m/s"}
    units = {name: parse_unit(unit, "signals") for name, unit in written.items()}
    with pytest.raises(MotionError) as caught:
        parse_expression(text, units, "formula")
    assert what in str(caught.value)


def test_the_source_of_a_vehicle_is_that_of_its_geometry() -> None:
    assert format_vehicle_source("fitted") == "geometry: estimated"
    assert format_vehicle_source("robot_description") == "geometry: from robot description"


@pytest.mark.parametrize(
    ("means", "signal", "start"),
    [
        (
            (-0.1, 0.0, 0.2),
            "v_x 0 s ago [m/s]",
            "lateral error grows with forward speed: +0.2 m/s at 1 m/s, -0.1 m/s at -1 m/s",
        ),
        ((0.2, 0.0, -0.1), "v_w 0.5 s ago [rad/s]", "lateral error falls with yaw rate 0.5 s earlier: "),
        (
            (0.0, 0.2, -0.1),
            "roll [rad]",
            "lateral error depends on roll: +0.2 m/s at 0 rad, -0.1 m/s at 1 rad",
        ),
        ((0.2, 0.0, -0.1), "sin yaw", "lateral error falls with sin yaw: +0.2 m/s at -1, -0.1 m/s at 1"),
    ],
)
def test_a_dependence_says_which_way_it_goes(means: tuple[float, ...], signal: str, start: str) -> None:
    table = list(zip((-1.0, 0.0, 1.0), means, strict=True))
    assert format_dependence("lateral error", "m/s", signal, table).startswith(start)


def test_of_a_servo_each_number_has_a_line_of_its_own() -> None:
    numbers = {
        "tau": Value(0.681, 0.587, 0.775, "s"),
        "reset": Value(0.0, math.nan, math.nan, "1/s", at_bound=True),
        "bound": Value(1.03, 0.91, 1.15, "m/s"),
        "scrub": Value(1.3312, 1.3300, 1.3324, "m/s", another_run=(0.42, 2.24)),
        "creep": Value(0.3601, 0.3597, 0.3605, "s/m", another_run=(0.277, 0.443), is_spread_measured=True),
    }
    named = Named(
        "wheel_servo", numbers, 1.0, (), (), corrected=False, path="command", selected=1.0,
        motion="Wheel servo: lag 0.68 s",
    )  # fmt: skip
    ladder = (
        {"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},
        {"effects": ["wheel_servo"], "t_mrmse_m": 0.54, "r_mrmse_rad": 0.5},
    )
    lines = list_lines(RunDiagnosis("run", "command", effects=(named,), ladder=ladder))
    texts = [text for _, text in lines]
    at = texts.index("Wheel servo: lag 0.68 s")
    assert [text.strip() for text in texts[at + 1 : at + 6]] == [
        "wheel_servo         60 -> 54 cm",
        "tau = 0.68 s [0.59, 0.78]",
        "bound = 1.03 m/s [0.91, 1.15]",
        "scrub = 1.3312 m/s [1.3300, 1.3324] this run",
        "creep = 0.3601 s/m [0.3597, 0.3605] this run, [0.28, 0.44] another",
    ]
    # A number at its bound is none: only --all says which.
    assert not any("reset" in text for _, text in choose_lines(lines, everything=False))
    assert ("open", "not determined by this log: wheel_servo reset") in lines


def test_an_effect_without_a_determined_number_has_no_row_and_no_sentence() -> None:
    """Its step of the errors stays, and JSON says `at_bound` and `undetermined`."""
    ladder = (
        {"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},
        {"effects": ["torque_limit"], "t_mrmse_m": 0.3, "r_mrmse_rad": 0.5},
        {"effects": ["torque_limit", "drive_lag"], "t_mrmse_m": 0.2, "r_mrmse_rad": 0.5},
    )
    known = {"tau": Value(0.3, 0.2, 0.4, "s")}
    for unknown in (
        {
            "limit": Value(14.4, 14.4, 14.4, "m/s^2", at_bound=True),
            "no_load": Value(1.0, 0.1, 27.0, "m/s", one_sided=True),
        },
        {"limit": Value(14.4, math.nan, math.nan, "m/s^2")},
        {"no_load": Value(1.0, 0.1, 27.0, "m/s", one_sided=True)},
    ):
        effects = tuple(
            Named(
                name, numbers, 1.0, (), (), corrected=False, path="command", selected=1.0,
                motion=f"{name} in words", clause=f"has a {name}",
            )
            for name, numbers in (("torque_limit", unknown), ("drive_lag", known))
        )  # fmt: skip
        run = RunDiagnosis("run", "command", effects=effects, ladder=ladder)
        lines = list_lines(run)
        shown = " ".join(text for _, text in choose_lines(lines, everything=False))
        assert "torque" not in shown
        assert "The robot has a drive_lag; with two effects in the model" in shown
        words = f"not determined by this log: torque_limit {', '.join(unknown)}"
        assert ("open", "torque_limit in words") in lines
        assert ("", words) in lines
        first, _ = run.to_json()["effects"]
        assert all(number["undetermined"] for number in first["parameters"].values())


@pytest.mark.parametrize(
    ("after", "shown"),
    [
        ({"t_mrmse_m": 0.627, "r_mrmse_rad": 0.4}, "60 -> 63 cm, 29 -> 23 degrees ({rises})"),
        ({"t_mrmse_m": 0.6006, "r_mrmse_rad": 0.5}, "{rises}"),
        ({"t_mrmse_m": 0.6, "r_mrmse_rad": 0.5}, "no visible change of the error over 2 s"),
    ],
)
def test_a_step_with_which_an_error_rises_says_so_as_the_report(after: dict[str, float], shown: str) -> None:
    named = Named(
        "drive_lag", {"tau": Value(0.3, 0.2, 0.4, "s")}, 1.0, (), (), corrected=False, path="command",
        selected=1.0, motion="Drive lag: time constant 0.30 s",
    )  # fmt: skip
    ladder = ({"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5}, {"effects": ["drive_lag"], **after})
    lines = list_lines(RunDiagnosis("run", "command", effects=(named,), ladder=ladder))
    text = shown.format(rises=format_rises(*ladder))
    assert any(line.endswith(f"  {text}") for _, line in lines)


def test_sizes_that_would_be_named_are_detection_limits() -> None:
    seen = (Detectable("yaw_drift", "c", "rad/s", 0.016), Detectable("difference_gain", "g", "1", 0.16))
    ladder = ({"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},)
    lines = list_lines(RunDiagnosis("run", "command", detectable=seen, ladder=ladder))
    assert ("limits", "detection limits (90 %): yaw drift 0.016 rad/s, difference gain 16 %") in lines


def test_what_happened_twice_is_said_once_and_an_open_rest_names_the_way_on() -> None:
    ladder = (
        {"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},
        {"effects": ["drive_lag"], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},
    )
    stuck = {"id": "stuck", "severity": "warning", "text": "it was stuck"}
    floor = {"t_mrmse_m": 0.05, "r_mrmse_rad": 0.02}
    run = RunDiagnosis("run", "command", ladder=ladder, noise_floor=floor, findings=(stuck, stuck))
    lines = list_lines(run)
    assert ("findings", "!  it was stuck (2 times)") in lines
    assert sum("it was stuck" in text for _, text in lines) == 1
    (way_on,) = [text for _, text in lines if text.startswith("next steps: ")]
    assert "another run" in way_on
    assert "slip model new-effect" in way_on


def test_every_finding_is_listed_with_all_and_those_left_out_are_counted_without() -> None:
    """What forbids conclusions comes first; marks are those of `slip analyze`."""
    severe = [{"id": "w", "severity": "warning", "text": f"warning {number}"} for number in range(5)]
    grave = {"id": "e", "severity": "error", "text": "an error"}
    note = {"id": "n", "severity": "info", "text": "a note"}
    lines = list_lines(RunDiagnosis("run", "command", findings=(note, *severe, grave)))
    folded = [text for _, text in choose_lines(lines, everything=False)][1:]
    assert folded == ["!! an error", "!  warning 0", "!  warning 1", "!  warning 2", "   2 more (--all)"]
    whole = [text for _, text in choose_lines(lines, everything=True)][1:]
    assert whole == ["!! an error", *(f"!  {one['text']}" for one in severe), "   a note"]


def test_a_share_of_the_residual_names_what_it_is_a_share_of() -> None:
    rest = Unexplained(0.98, "w", ("w",), "yaw error grows with roll", None, {}, "body")
    ladder = ({"effects": [], "t_mrmse_m": 0.6, "r_mrmse_rad": 0.5},)
    said = "98 % of the residual yaw rate has a structure that the model does not explain: "
    said += "yaw error grows with roll"
    run = RunDiagnosis("run", "command", ladder=ladder, unexplained=rest)
    assert said in [text for _, text in list_lines(run)]
    report = RunReport({"run": "a"}, diagnosis=run.to_json())
    assert said in [sentence for _, sentence, _ in _list_open(report)]
    # A formula is compared with the residual of all channels.
    whole = format_unexplained({**rest.to_json(), "formula": "[[effect]]"})
    assert whole.startswith("98 % of the residual has a structure")


def test_a_late_encoder_and_a_suggested_formula_are_said_with_what_it_would_bring() -> None:
    where = "lateral error grows with forward speed"
    formula = 'v_y = "k_1 * v0 * v0"\nk_1 = { value = 0.08188, unit = "s/m", bounds = [-50.0, 50.0] }\n'
    reached = {"t_mrmse_m": 0.25, "r_mrmse_rad": 0.02}
    rest = Unexplained(0.02, "y", ("y",), where, formula, {}, "command", reached)
    ladder = ({"effects": [], "t_mrmse_m": 1.0}, {"effects": ["drive_lag"], "t_mrmse_m": 0.5})
    timing = {"wheel_delay_s": 0.334}
    run = RunDiagnosis("run", "command", ladder=ladder, unexplained=rest, timing=timing)
    texts = [text for _, text in list_lines(run)]
    assert "suggested term: v_y = k_1 * v0 * v0, k_1 = 0.0819 s/m, v0 the ideal forward speed" in texts
    would = "no model holds it until you add it (`slip serve`): 25 cm and 1.1 degrees would remain over 2 s"
    assert would in texts
    assert "estimated encoder delay 334 ms" in texts
    assert "formula" not in texts[0]
    (shown,) = [
        text
        for label, text, _ in _list_open(RunReport({"run": "a"}, diagnosis=run.to_json()))
        if label == "unexplained"
    ]
    assert shown.endswith(f"{where}; suggested term: {would}")


@pytest.mark.parametrize(
    ("position", "heading", "said"),
    [
        ((0.9, 0.95), (0.8, 0.82), "90 % of the position error and 80 % of the heading error"),
        ((1.84, 1.85), (0.82, 0.84), "above the noise floor the effects remove 82 % of the heading error; "),
        ((1.2, 1.3), (1.1, 1.1), ""),
    ],
)
def test_no_effect_explains_more_than_the_whole_error(
    position: tuple[float, float], heading: tuple[float, float], said: str
) -> None:
    shares = [dict(zip(("physics", "with_learned"), pair, strict=True)) for pair in (position, heading)]
    learned = {"kept": True, "explained_share": dict(zip(ERRORS_OVER_2S, shares, strict=True))}
    text = format_learned_share(learned)
    assert said in text
    assert bool(text) == bool(said)
