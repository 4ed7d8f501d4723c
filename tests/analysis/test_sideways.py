"""Logs of vehicles that move sideways, from the file to the named effects."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
from few import few
from simulated_platforms import PLATFORMS, scene_of, simulate_platform

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.logs import open_log
from pipeline.recording.log_choice import choose
from pipeline.simulate import make_scenario, simulate_case, simulate_run, write_log
from pipeline.sources import load_configuration

Hidden = dict[str, float]


def diagnose(log: Path, **options: object) -> dict[str, object]:
    """The summary of a log, with its diagnosis."""
    out = Options(out=log.parent / "out", **{"report": False, "diagnosis": True, **options})  # type: ignore[arg-type]
    return analyze_log(log, out).summary


def list_found(summary: dict[str, object]) -> dict[str, float]:
    """The first number of every named effect."""
    effects = summary["diagnosis"]["effects"]  # type: ignore[index]
    return {item["id"]: next(iter(item["parameters"].values()))["value"] for item in effects}


def simulate(folder: Path, hidden: Hidden, vehicle: str, seed: int, *, bare: bool) -> Path:
    """A log; a bare one has neither encoders nor gyro."""
    scenario = make_scenario(None, hidden, seed=seed, duration_s=120.0, vehicle=vehicle)
    if bare:
        scenario = replace(scenario, encoders=None, imu=None)
    write_log(simulate_run(scenario), folder / "run.mcap")
    return folder / "run.mcap"


@pytest.mark.parametrize(
    ("vehicle", "bare", "hidden"),
    [
        ("youbot", True, {"lateral_scale": 0.85}),
        ("youbot", False, {"roller_slip": 0.3, "effective_track": 1.25, "drive_lag": 0.3}),
        pytest.param("omni", True, {"lateral_scale": 0.9, "drive_lag": 0.3}, marks=pytest.mark.long),
    ],
    ids=["commands only", "four wheels", "omni"],
)
def test_what_is_hidden_in_sideways_driving_is_named(
    vehicle: str, hidden: Hidden, tmp_path: Path, *, bare: bool
) -> None:
    summary = diagnose(simulate(tmp_path, hidden, vehicle, 41, bare=bare))
    found = list_found(summary)
    assert found.keys() == hidden.keys()
    assert found == pytest.approx(hidden, rel=0.05)
    assert summary["diagnosis"]["explained_share"] > 0.9  # type: ignore[index]
    assert summary["diagnosis"]["unexplained"] is None  # type: ignore[index]
    assert set(summary["by_input"]) == ({"command"} if bare else {"command", "measured"})  # type: ignore[call-overload]


@pytest.mark.long
def test_an_effect_that_costs_a_settled_heading_a_thousandth_stands_on_the_ladder(tmp_path: Path) -> None:
    # With the lag taken alone the heading over 2 s is a little better by chance; sideways it is all error.
    hidden = {"lateral_scale": 0.8, "drive_lag": 0.3}
    log = simulate_case(None, hidden, out=tmp_path / "run.mcap", seed=1, duration_s=180.0, vehicle="youbot")
    rungs = diagnose(log)["diagnosis"]["ladder"]  # type: ignore[index]
    assert set(rungs[-1]["effects"]) == hidden.keys()
    assert rungs[-1]["t_mrmse_m"] < 0.03 * rungs[0]["t_mrmse_m"]
    for below, rung in pairwise(rungs):
        assert all(rung[key] <= 1.01 * below[key] for key in ("t_mrmse_m", "r_mrmse_rad"))


@pytest.mark.parametrize("name", few(["panther", "rosbot_xl"], 2))
@pytest.mark.parametrize(("fastest_mps", "wheels"), [(0.0, ""), (0.8, "_mecanum")], ids=["tyres", "mecanum"])
def test_a_platform_with_two_sets_of_wheels_is_told_by_what_it_is_asked(
    name: str, fastest_mps: float, wheels: str, tmp_path: Path
) -> None:
    platform = PLATFORMS["rosbot_xl_mecanum"]
    plain = [one for one in platform.topics if "description" not in one.topic]
    topics = [replace(one, topic=f"/{name}/{one.topic.rsplit('/', 1)[-1]}") for one in plain]
    layout = replace(platform.layout, topics=tuple(topics))
    scenario = scene_of("rosbot_xl_mecanum", {}, seed=3, duration_s=10.0)
    vehicle = replace(platform.vehicle, max_sideways_mps=fastest_mps)
    recording = replace(scenario.recording, layout=layout)
    log = tmp_path / "run.mcap"
    write_log(simulate_run(replace(scenario, vehicle=vehicle, recording=recording)), log)
    chosen = choose(open_log(log), load_configuration(log), {})
    assert (chosen.vehicle.id, chosen.vehicle_source) == (f"{name}{wheels}", "namespace")


@pytest.mark.long
def test_a_log_without_sideways_commands_is_diagnosed_on_a_mecanum_preset_all_the_same(
    tmp_path: Path,
) -> None:
    scenario = make_scenario(
        None, {"effective_track": 1.3, "drive_lag": 0.3}, seed=42, duration_s=120.0, vehicle="youbot"
    )
    straight = replace(scenario, vehicle=replace(scenario.vehicle, max_sideways_mps=0.0))
    write_log(simulate_run(straight), tmp_path / "run.mcap")
    summary = diagnose(tmp_path / "run.mcap")
    assert list_found(summary).keys() == {"effective_track", "drive_lag"}
    assert {"lateral_scale", "roller_slip"} <= set(summary["diagnosis"]["unobservable"])  # type: ignore[index]


@pytest.mark.long
@pytest.mark.parametrize("seed", range(51, 57))
@pytest.mark.parametrize("platform", ["dingo_o", "rosbot_xl_mecanum", "youbot"])
def test_hidden_effects_of_mecanum_platforms_are_named_whatever_the_drive(
    platform: str, seed: int, tmp_path: Path
) -> None:
    hidden = {"lateral_scale": 0.85, "roller_slip": 0.2, "drive_lag": 0.25}
    log = simulate_platform(platform, hidden, out=tmp_path / "run.mcap", seed=seed, duration_s=180.0)
    found = list_found(diagnose(log))
    assert found == pytest.approx(hidden, rel=0.1)
