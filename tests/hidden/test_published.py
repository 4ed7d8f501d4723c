"""The benchmark `published`: questions with published answers, read from ids and numbers of a diagnosis."""

import argparse
from pathlib import Path

import published
import pytest
from verbs import run_verb

import slip

pytestmark = pytest.mark.long


def make_content(
    *effects: tuple[str, str, float], undecided: tuple[list[str], ...] = ()
) -> dict[str, object]:
    return {
        "effects": [{"id": name, "parameters": {key: {"value": value}}} for name, key, value in effects],
        "undecided": [{"candidates": group} for group in undecided],
    }


def judge(content: dict[str, object]) -> str:
    return published.judge_number("track", published.TRACK, content, "effective_track.k").verdict


def test_a_number_is_right_within_its_margin_and_under_its_own_name() -> None:
    assert judge(make_content(("effective_track", "k", 1.0141))) == "right"
    assert judge(make_content(("effective_track", "k", 1.02))) == "wrong"
    assert judge(make_content(("wheel_radius", "k", 1.0141))) == "wrong"
    assert judge(make_content()) == "wrong"
    assert judge(make_content(undecided=(["effective_track", "yaw_drift"],))) == "undecided"
    assert judge({"code": "too_short"}) == "refused"


def test_an_open_question_needs_all_its_candidates_in_one_group() -> None:
    wanted = {"effective_track", "wheel_asymmetry"}

    def judge_group(content: dict[str, object]) -> str:
        return published.judge_undecided("circles", wanted, content).verdict

    assert judge_group(make_content(undecided=([*wanted, "yaw_drift"],))) == "right"
    assert judge_group(make_content(undecided=(["effective_track"], ["wheel_asymmetry"]))) == "wrong"
    assert judge_group(make_content(("effective_track", "k", 1.01))) == "wrong"


def test_without_the_recordings_it_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    published.add_arguments(parser)
    assert not published.run(parser.parse_args([str(tmp_path / "absent")]))
    assert "not here" in capsys.readouterr().out


def test_models_are_off_by_what_was_published(tmp_path: Path) -> None:
    folder = published.PUBLISHED / "optiodom_differential"
    if not folder.is_dir():
        pytest.skip("the public recordings are not here")
    runs = published.analyze(sorted(folder.glob("diff_circular_*.mcap")), tmp_path)
    position_m, heading_deg = published.find_largest(runs, None)
    assert position_m == pytest.approx(0.162, abs=0.005)
    assert heading_deg == pytest.approx(14.5, abs=0.3)
    assert sum(published.measure_turns(run) > 0.0 for run in runs) == 3
    right_m, left_m = 0.5 * 0.083402, 0.5 * 0.083462
    radius_m = 0.5 * (right_m + left_m)
    calibrated = (
        slip.Model(runs[0].vehicle)
        + slip.effect("wheel_radius", k=radius_m / 0.042)
        + slip.effect("wheel_asymmetry", e=(right_m - left_m) / radius_m)
        + slip.effect("effective_track", k=0.2015 / 0.2)
    )
    position_m, heading_deg = published.find_largest(runs, {"named_model": calibrated})
    assert position_m < 0.035
    assert heading_deg < published.HEADING_DEG


@pytest.mark.skipif(not published.PUBLISHED.is_dir(), reason="../shared/published is not here")
@pytest.mark.parametrize("runs", [slice(3), slice(3, 6)], ids=["right", "left"])
def test_circles_one_way_round_do_not_tell_a_track_from_unequal_wheels(runs: slice, tmp_path: Path) -> None:
    """Wheels as unequal as a data sheet allows turn the robot as a wider track would."""
    circles = sorted((published.PUBLISHED / "optiodom_differential").glob("diff_circular_*.mcap"))
    content = published.ask(published.analyze(circles[runs], tmp_path))
    assert published.judge_undecided("", {"effective_track", "wheel_asymmetry"}, content).verdict == "right"


@pytest.mark.skipif(not published.PUBLISHED.is_dir(), reason="../shared/published is not here")
def test_an_effect_that_undoes_another_is_not_named_and_no_formula_hides_the_offset(tmp_path: Path) -> None:
    logs = sorted((published.PUBLISHED / "optiodom_tricycle").glob("tri_*.mcap"))
    runs = published.analyze(logs, tmp_path)
    numbers = published.read_numbers(published.ask(runs))
    assert numbers["steering_sensor_offset.o"] == pytest.approx(
        published.STEERING_RAD[0], abs=published.STEERING_RAD[1]
    )
    (free,) = (run for run in runs if "140120211508" in str(run))
    assert published.read_numbers(published.ask([free])).keys() == {
        "steering_sensor_offset.o", "effective_wheelbase.k"
    }  # fmt: skip


@pytest.mark.skipif(not published.PUBLISHED.is_dir(), reason="../shared/published is not here")
@pytest.mark.parametrize("run", ["green_06", "green_48"])
def test_wheels_that_slip_on_a_smooth_floor_are_not_said_to_count_backward(run: str) -> None:
    """They turn the body three to five times as far as their odometry says, and the other way."""
    shown = run_verb("inspect", published.PUBLISHED / "robotino_surfaces" / f"{run}.mcap", "--all")
    assert shown.returncode == 0
    assert "backward" not in shown.stdout
