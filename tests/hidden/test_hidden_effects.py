"""The hidden-effect test: logs whose effect is drawn by seed, handed over, and opened only afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest
from draw import Answer, draw_riddle, open_seal, seal, write_riddle
from play import Job, describe, list_jobs, play, play_all
from score import confusion_table, score_run, wilson


def test_a_seal_hides_its_answer_until_it_is_opened(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    riddle = draw_riddle("single", 3, "effective_track")
    write_riddle(riddle, log)
    text = log.with_suffix(".sealed").read_text(encoding="ascii")
    assert "effective_track" not in text
    assert b"effective_track" not in log.read_bytes()
    assert open_seal(text) == riddle.answer


def test_a_seed_draws_the_same_riddle_each_time() -> None:
    one, two = draw_riddle("sets", 11), draw_riddle("sets", 11)
    assert one.answer == two.answer
    assert one.scenario == two.scenario
    assert seal(one.answer) == seal(two.answer)


def test_scores_tell_named_undecided_missed_and_false_apart() -> None:
    run = {
        "effects": [
            {"id": "icr_offset", "equivalent_to": ["lever_arm"]},
            {"id": "speed_slip", "equivalent_to": []},
        ],
        "undecided": [{"candidates": ["drive_lag", "transport_delay"]}],
        "unobservable": ["slope_drift"],
    }
    hidden = {name: {} for name in ("lever_arm", "drive_lag", "slope_drift", "deadband")}
    score = score_run(Answer("sets", hidden), run)
    assert score.found == ("lever_arm",)
    assert score.undecided == ("drive_lag",)
    assert score.unobservable == ("slope_drift",)
    assert score.missed == ("deadband",)
    assert score.false == ("speed_slip",)
    assert not score.is_exact
    assert any("deadband" in line and "missed 1" in line for line in confusion_table([score]))


def test_intervals_of_rates_are_wilson() -> None:
    low, high = wilson(80, 80)
    assert low == pytest.approx(0.954, abs=1e-3)
    assert high == pytest.approx(1.0)


def test_the_command_line_names_a_hidden_effect_as_a_user_would_see_it() -> None:
    played = play(Job("single", 5, "effective_track", by_command_line=True))
    assert played.score.is_exact
    before, after, _ = played.score.errors
    assert after < before


def test_single_effects_of_several_seeds_are_named_and_nothing_else() -> None:
    jobs = [
        *list_jobs("single", [4], "lateral_skid", by_command_line=False),
        *list_jobs("single", [4], "transport_delay", by_command_line=False),
        *list_jobs("single", [5], "clock_offset", by_command_line=False),
    ]
    played = play_all(jobs, workers=1)
    assert [one.score.is_exact for one in played] == [True] * 3, "\n".join(describe("single", played))


def test_in_an_empty_log_nothing_is_named_and_nothing_flagged() -> None:
    played = play_all(list_jobs("empty", [0, 4], None, by_command_line=False), workers=1)
    assert not any(one.score.named or one.score.flagged for one in played)


def test_physics_that_no_catalogue_has_is_flagged_in_its_channel() -> None:
    played = play(Job("odd", 3, "reverse_slip", by_command_line=False))
    assert "x" in played.score.flagged
    assert played.score.formula > 0.1


@pytest.mark.long
@pytest.mark.parametrize(("category", "least"), [("single", 0.93), ("equipped", 0.85), ("sets", 0.85)])
def test_most_hidden_effects_are_exactly_right(category: str, least: float) -> None:
    effect = "each" if category == "single" else None
    seeds = range(20, 22) if effect else range(20, 60)
    played = play_all(list_jobs(category, seeds, effect, by_command_line=False))  # type: ignore[arg-type]
    exact = sum(one.score.is_exact for one in played)
    assert exact >= least * len(played), "\n".join(describe(category, played))


@pytest.mark.long
def test_empty_logs_stay_empty() -> None:
    played = play_all(list_jobs("empty", range(20, 100), None, by_command_line=False))
    clean = sum(not one.score.named and not one.score.flagged for one in played)
    assert clean >= 0.98 * len(played), "\n".join(describe("empty", played))


@pytest.mark.long
def test_poor_driving_gives_no_confident_wrong_name() -> None:
    played = play_all(list_jobs("poor", range(20, 80), None, by_command_line=False))
    wrong = sum(bool(one.score.false) for one in played)
    assert wrong <= 0.05 * len(played), "\n".join(describe("poor", played))


@pytest.mark.long
def test_rigid_bodies_show_what_was_built_into_them() -> None:
    pytest.importorskip("mujoco", reason="needs the extra `sim`")
    played = play_all(list_jobs("rigid", range(20, 23), "each", by_command_line=False))
    named = sum(len(one.score.found) == len(one.score.truth) for one in played)
    assert named >= 0.8 * len(played), "\n".join(describe("rigid", played))
