"""Lines of a diagnosis: few by default, each idea once."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_diagnoses import draw_diagnosis
from msgspec.structs import replace

from pipeline.core import format_length
from pipeline.estimation.diagnosis import _parameter_rows
from pipeline.estimation.driving_need import Curve, measure_need
from pipeline.estimation.ladder import Ladder, LadderStep
from pipeline.models import FEW_STRETCHES, Number, name_term
from pipeline.recording import Finding
from pipeline.results import DataNeed, Errors, Named, Region, RunDiagnosis, Unexplained, rank_main
from pipeline.results.reading import rank_effects
from pipeline.words.diagnosis import describe, describe_standing, format_short, list_findings, list_lines
from pipeline.words.effects import describe_clause
from pipeline.words.errors import describe_need, describe_regions, describe_unexplained
from pipeline.words.models import describe_step, format_ladder

MANY = (
    "effective_track",
    "drive_lag",
    "lateral_skid",
    "wheel_asymmetry",
    "icr_offset",
    "deadband",
    "yaw_drift",
)
WARNINGS = [Finding(f"w{number}", "warning", values={"error": f"warning {number}"}) for number in range(5)]


def test_a_screen_has_a_line_an_effect_and_three_findings() -> None:
    errors = [(1.0 - 0.12 * count, 0.5) for count in range(len(MANY) + 1)]
    drawn = draw_diagnosis({name: {} for name in MANY}, errors)
    run = replace(drawn, run="field/run", input="command", findings=tuple(WARNINGS))
    shown = [text for label, text in list_lines(run) if label != "verdict"]
    assert [text.startswith(name_term(name)) for name, text in zip(MANY, shown[:5], strict=False)] == [
        True
    ] * 5
    assert shown[5] == "2 more effects (--all)"
    assert shown[6:] == ["!  warning 0", "!  warning 1", "!  warning 2", "   2 more (--all)"]
    everything = describe([run], everything=True)
    assert all(name in everything for name in (*MANY, "warning 4"))
    assert "(--all)" not in everything


def test_no_effect_is_hidden_that_removes_more_than_one_that_is_shown() -> None:
    names = ("effective_track", "wheel_radius", "lateral_skid", "body_turn_limit", "deadband")
    errors = [(1.0, 1.0), (0.5, 0.5), (0.46, 0.46), (0.2, 0.46), (0.2, 0.38), (0.19, 0.38)]
    values = {"wheel_radius": {"k": 0.8}}
    shares = {"effective_track": 0.4, "body_turn_limit": 0.3, "lateral_skid": 0.2, "deadband": 0.02}
    budget = [
        {"input": "command", "quantity": "slip", "total": 1.0,
         "shares": [{"effect": name, "share": share} for name, share in shares.items()]},
    ]  # fmt: skip
    drawn = draw_diagnosis({name: values.get(name, {}) for name in names}, errors, budget=budget)
    run = replace(drawn, run="field/run", input="command")
    shown = [text for label, text in list_lines(run) if label != "verdict"]
    assert [text.split("  ")[0] for text in shown[:4]] == [name_term(name) for name in names[:4]]
    assert "listed for its large value" in shown[1]
    assert shown[4] == "1 smaller effect (each below a tenth of every error; --all)"
    assert {*rank_main(run)} == {name for name, share in rank_effects(run).items() if share >= 0.1}
    # The verdict names the largest, in the order of the ladder.
    texts = [describe_clause(one, run) for one in run.effects]
    assert [text in list_lines(run)[0][1] for text in texts] == [True, False, True, True, False]


def test_an_effect_that_nothing_distinguishes_from_another_says_what_else_it_may_be() -> None:
    """Late poses and an antenna's place stood behind `--all` only, as ids."""
    values = {"transport_delay": {"d": 0.25}, "icr_offset": {"x_icr": -1.1}, "drive_lag": {"tau": 0.25}}
    drawn = draw_diagnosis(values, [(1.0 - 0.2 * count, 0.5) for count in range(4)])
    others = ("clock_offset",), ("lever_arm",), ("body_inertia",)
    same = [replace(one, equivalent_to=ids) for one, ids in zip(drawn.effects, others, strict=True)]
    run = replace(drawn, effects=tuple(same))
    texts = [text for label, text in list_lines(run) if label != "verdict"]
    assert texts[0].endswith(", or the poses are 0.25 s late")
    assert texts[1].endswith(", or the poses are of a point 1.1 m ahead of base_link")
    assert texts[2].endswith(", or body inertia")
    plain = [text for _, text in list_lines(replace(run, effects=drawn.effects))]
    assert not any(", or " in text for text in plain)


def test_a_difference_of_the_sides_is_on_the_screen_however_little_error_it_makes() -> None:
    """An encoder 6 % off was behind `--all`, as two effects below their typical sizes."""
    many = {name: {} for name in MANY} | {"side_gain": {"e": 0.03}, "speed_track": {"k": 0.011}}
    run = draw_diagnosis(many, [(1.0 - 0.1 * count, 0.5) for count in range(8)] + [(0.3, 0.5), (0.3, 0.5)])
    shown = [text for label, text in list_lines(run) if label != "verdict"]
    assert shown[5].startswith("side gain")
    assert shown[6] == "2 more effects, and 1 smaller effect (each below a tenth of every error; --all)"


def test_the_first_line_says_which_runs_are_simulated() -> None:
    runs = [RunDiagnosis(run=f"field/{number}", input="command") for number in range(5)]
    first = [describe(runs[:1], simulated=names).splitlines()[0] for names in ([], ["field/0"])]
    assert first == ["field/0    from commands", "field/0    simulated    from commands"]
    assert describe(runs[:2], simulated=["field/0"]).splitlines()[:2] == [
        "field/0    simulated",
        "field/1    together, from commands",
    ]
    many = "5 runs, field/0 to field/4"
    for names, text in ((["field/3"], "1 simulated"), ([run.run for run in runs], "all simulated")):
        head = describe(runs, simulated=names).splitlines()[0]
        assert head == f"{many}    {text}    together, from commands"


LAGS = {"mean": "speed", "diff": "turning"}


@pytest.mark.parametrize(
    ("name", "units", "text"),
    [
        ("effective_track", {"k": "1"}, "k = 2.00 [1.90, 2.10], effective over nominal track"),
        ("body_turn_limit", {"limit": "rad/s"}, "limit = 2.00 rad/s [1.90, 2.10]"),
        (
            "turn_lag",
            {"tau_mean": "s", "tau_diff": "s"},
            "; ".join(f"tau_{key} = 2.00 s [1.90, 2.10], time constant of {of}" for key, of in LAGS.items()),
        ),
        ("my_term", {"k_1": "s/m"}, "k_1 = 2.00 s/m [1.90, 2.10]"),
    ],
)
def test_an_effect_on_a_screen_says_what_its_number_is(name: str, units: dict[str, str], text: str) -> None:
    values = {key: Number(2.0, low=1.9, high=2.1, unit=unit) for key, unit in units.items()}
    assert format_short(Named(name, values)) == text


def test_a_finding_of_many_runs_is_said_once_with_its_count() -> None:
    alike = Finding("hold", "warning", values={"error": "no command had arrived"})
    runs = {f"run{number}": [alike] for number in range(48)}
    runs["run3"] = [alike, Finding("stuck", "error", values={"error": "it was stuck"})]
    assert list_findings(runs, "", everything=False) == [
        ("findings", "!! run3: it was stuck"),
        ("", "!  48 runs: no command had arrived"),
    ]


def test_findings_of_a_kind_are_said_once_of_many_runs_where_their_numbers_differ() -> None:
    late = {"run20": 20, "run30": 30, "run31": 30}
    runs = {
        run: [Finding("late", "warning", "pose", {"error": f"poses are late by {ms} ms"})]
        for run, ms in late.items()
    }
    assert list_findings(runs, "", everything=False) == [
        ("findings", "!  3 runs, as in run30: poses are late by 30 ms")
    ]
    # Of one run, each is a finding.
    both = [one for findings in runs.values() for one in findings][:2]
    assert len(list_findings({"run": both}, "", everything=False)) == 2


def test_many_runs_have_one_head() -> None:
    names = [f"day/run{number:02}" for number in range(12)]
    runs = [RunDiagnosis(name, "command", joint=tuple(names)) for name in names]
    assert (
        describe(runs).splitlines()[0].startswith("12 runs, day/run00 to day/run11    together, from command")
    )
    assert set(names[:-1]) < set(describe(runs, everything=True).splitlines())


def test_incidents_of_a_kind_are_one_finding() -> None:
    slides = [
        Finding("slid", "warning", values={"error": "it slid"}, t_start=start, t_end=end)
        for start, end in ((3.0, 4.0), (10.0, 12.5))
    ]
    ((_, text),) = list_findings({"": slides}, "", everything=False)
    assert text == "!  2 incidents, the longest from 10.0 to 12.5 s: it slid"


def test_a_region_of_two_errors_is_said_once() -> None:
    regions = [
        Region(channel, "command", "driving", (1.2,), share, 0.39)
        for channel, share in (("y", 0.68), ("x", 0.65))
    ]
    assert describe_regions(regions) == [
        "above 1.2 m/s (39 % of the time): 68 % of the lateral and 65 % of the forward error"
    ]


@pytest.mark.parametrize(
    ("need", "said"),
    [
        (DataNeed(("a.k", "b.k"), 20.0, 60.0), "2 of 2 parameters are known within 5 %, after 20 s of 60 s"),
        (
            DataNeed(("a.k",) * 4, 286.0, 424.0, vague="b.k", half_width=0.3, others=11, minutes=7),
            "4 of 16 parameters are known within 5 %; 7 more minutes of such driving for 5 % of all",
        ),
        (DataNeed(open=1), "the one parameter is not known within 5 %"),
        (DataNeed(("a.k",), math.nan, 60.0), "a.k is known within 5 %"),
    ],
)
def test_how_much_is_known_is_one_sentence(need: DataNeed, said: str) -> None:
    assert describe_need(RunDiagnosis(need=need)) == said


def test_what_is_in_doubt_is_not_known_and_why_is_said() -> None:
    drawn = draw_diagnosis({"steering_lag": {"tau": 0.45}, "deadband": {"d": 0.2}}, [(1.0, 0.5)] * 3)
    lag, deadband = drawn.effects
    sure, open_ends = Number(0.45, 0.449, 0.451, "s"), Number(0.2, 0.195, 0.205, "m/s")
    few = replace(sure, doubt=FEW_STRETCHES, stretches=4)
    curve = {"steering_lag.tau": Curve(np.array([20.0, 60.0]), np.array([0.002, 0.001]))}
    for tau, d, said in (
        (few, open_ends, f"1 of 2 parameters is known within 5 %; steering_lag.tau: {few.reason}"),
        (sure, open_ends, "2 of 2 parameters are known within 5 %"),
        (sure, replace(open_ends, low=0.1, high=0.3), "1 of 2 parameters is known within 5 %"),
    ):
        effects = (replace(lag, parameters={"tau": tau}), replace(deadband, parameters={"d": d}))
        need = measure_need(effects, curve)
        assert describe_need(replace(drawn, effects=effects, need=need)) == said
        rows = {row["parameter"]: row["doubt"] for row in _parameter_rows(replace(drawn, effects=effects))}
        assert rows == {"tau": tau.doubt, "d": ""}
    alone = replace(drawn, effects=(replace(lag, parameters={"tau": sure}),))
    assert describe_need(replace(alone, need=measure_need(alone.effects, curve))) == (
        "steering_lag.tau is known within 5 %, after 20 s of 60 s"
    )


def test_motion_that_lasts_is_one_short_sentence() -> None:
    lasting = Unexplained("lasting", 0.98, "w", ("w",), "command", sizes={"w": 0.19})
    assert describe_unexplained(lasting) == (
        "the yaw error wanders for seconds at a time (0.19 rad/s); nothing that was tried explains it"
    )


@pytest.mark.parametrize(
    ("metres", "text"), [(1.063, "1.06 m"), (0.057, "5.7 cm"), (0.01, "1 cm"), (0.0018, "1.8 mm")]
)
def test_a_length_has_the_unit_that_people_read(metres: float, text: str) -> None:
    assert format_length(metres) == text


def test_a_number_that_is_hardly_known_is_no_number_of_the_verdict() -> None:
    drawn = draw_diagnosis(
        {"clock_offset": {"d": 0.47}, "contact_friction": {"friction": 0.5}}, [(1.0, 0.5)] * 3
    )
    clock, friction = drawn.effects
    known = replace(clock, parameters={"d": Number(0.47, 0.45, 0.49, "s")})
    wide = replace(clock, parameters={"d": Number(0.47, 0.14, 0.74, "s")})
    assert describe_clause(known, drawn) == "the poses are stamped 0.47 s late"
    assert describe_clause(wide, drawn) == "the poses are stamped 0.14 to 0.74 s late"
    assert format_short(wide) == "d = 0.47 s [0.14, 0.74], not yet known"
    friction = replace(friction, parameters={"friction": Number(0.5, 0.1, 0.9), "k": Number(1.7, 1.6, 1.8)})
    assert "0.5" not in describe_clause(friction, drawn)


def test_what_a_dead_encoder_makes_is_no_fact_beside_it() -> None:
    stretch = {"side": "left", "reads": "zero"}
    values = {"stretches": [stretch], "witnesses": ["pose"], "line": "ignore = [[0, 9]]"}
    dead, stuck = Finding("encoder_dead", "warning", "wheels", values), Finding("stuck", "warning")
    shown = [text for _, text in list_findings({"run": [dead, stuck]}, "", everything=True)]
    assert [text.startswith("!  perhaps by the dead encoder: ") for text in shown] == [False, True]
    (alone,) = list_findings({"run": [stuck]}, "", everything=True)
    assert "dead" not in alone[1]


@pytest.mark.parametrize(
    ("k", "half", "share"), [(1.985, 0.04, "50 %"), (1.985, 0.001, "50 %"), (1.94, 0.4, "52 %")]
)
def test_a_share_is_rounded_once(k: float, half: float, share: str) -> None:
    drawn = draw_diagnosis({"effective_track": {"k": k}}, [(1.0, 1.0), (0.5, 0.3)])
    known = replace(drawn.effects[0], parameters={"k": Number(k, k - half, k + half)})
    assert describe_clause(known, drawn) == f"turns at {share} of the ideal rate"


def test_a_ladder_and_the_sentences_below_it_tell_of_the_same_errors() -> None:
    rows = {
        "ideal": (0.1, 0.5),
        "effective_track": (0.0240, 0.0350),
        "wheel_asymmetry": (0.0246, 0.0333),  # one falls by 5 %, one rises by more than chance
        "difference_gain": (0.0246, 0.0333),
        "side_gain": (0.0252, 0.0333),
    }
    steps, names = [], list(rows)
    for number, (position, heading) in enumerate(rows.values()):
        held_out = SimpleNamespace(pooled=Errors((0.1, 0.1, 0.1), t_mrmse_m=position, r_mrmse_rad=heading))
        fitted = SimpleNamespace(model=SimpleNamespace(ids=tuple(names[1 : number + 1])))
        steps.append(LadderStep(fitted, held_out))  # type: ignore[arg-type]
    lines = format_ladder(Ladder(tuple(steps)))
    assert lines[-1] == "difference_gain, side_gain reduce no held-out error by more than 1 %"
    assert "  ! position error rises by 2.5 %" in lines
    changed, note = describe_step(steps[-2], steps[-1])
    assert changed.split(maxsplit=5)[-1] == "2.46 -> 2.52 cm   heading unchanged"
    assert note.startswith("  ! position error rises by 2.4 %")


def test_an_effect_that_only_raises_errors_is_said_to_do_so() -> None:
    drawn = draw_diagnosis(
        {"effective_track": {"k": 1.8}, "drive_lag": {"tau": 0.3}, "turn_lag": {"tau_diff": 0.3}},
        [(1.0, 1.0), (0.5, 0.3), (0.35, 0.199), (0.362, 0.211)],
    )
    texts = [text for _, text in list_lines(drawn)]
    said = [text for text in texts if " rises by " in text]
    (line,) = said
    assert line == (
        "with turning lag the position error rises by 3.4 %, heading error by 6 %: "
        "it is named because the motion over shorter times is more likely with it"
    )
    better = replace(drawn, ladder=(*drawn.ladder[:3], replace(drawn.ladder[3], t_mrmse_m=0.3)))
    assert not [text for _, text in list_lines(better) if " rises by " in text]
    everything = " ".join(text for _, text in list_lines(better, everything=True))
    assert "35 -> 30 cm; heading error rises by 6 %" in everything
    # Twice the position error for a twentieth of the heading error stood behind `--all`.
    worse = replace(
        drawn, ladder=(*drawn.ladder[:3], replace(drawn.ladder[3], t_mrmse_m=0.7, r_mrmse_rad=0.19))
    )
    (line,) = [text for _, text in list_lines(worse) if " rises by " in text]
    assert line.startswith("with turning lag the position error rises by 100 %: it is named")


def test_it_is_said_where_a_vehicle_stands_for_a_large_part_of_the_time() -> None:
    assert describe_standing(0.672) == "standing 67 % of the time, left out of these numbers"
    assert describe_standing(0.09) == describe_standing(None) == ""
