"""A plan for a vehicle on a terrain starts from what the fleet's runs let expect there."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from comparison_store import Run, write_run
from plan_game import record

from pipeline.cli import main
from pipeline.estimation import load_recording
from pipeline.models import find_effect
from pipeline.plan import choose_limits
from pipeline.plan.next_drive import ask, expect
from pipeline.plan.rehearsal import learn
from pipeline.simulate import Program, make_scenario
from pipeline.sources import Vehicle, find_preset, list_configuration_files
from pipeline.store import Store

# Track factors of three runs a ground: known well on ice, badly on gravel.
FLEET = {"ice": (1.50, 1.51, 1.49), "gravel": (1.6, 2.0, 1.8)}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = Store(tmp_path_factory.mktemp("results"))
    for terrain, values in FLEET.items():
        for number, value in enumerate(values):
            track = [("effective_track", "k", value, 0.005)]
            name = f"{terrain}_{number}"
            write_run(store, Run(name=name, dataset=name, terrain=terrain, seconds=6.0, estimates=track))
    return store.root


def _find() -> Vehicle:
    vehicle = find_preset("warthog")
    assert vehicle is not None
    return vehicle


def test_what_is_known_is_what_the_fleet_lets_expect(results: Path) -> None:
    vehicle = _find()
    spread = {}
    for terrain in ("ice", "gravel", "mud"):
        studied = expect(vehicle, terrain, results)
        knowledge, expected = studied.knowledge, studied.expected
        assert expected is not None
        (mean, deviation) = expected.prior["effective_track.k"]
        assert knowledge.base.names == {"effective_track"}
        assert knowledge.base.values.tolist() == [mean]
        assert np.linalg.inv(knowledge.base.information)[0, 0] ** 0.5 == pytest.approx(deviation)
        spread[terrain] = deviation
        questions = ask(knowledge, ["effective_track"], choose_limits(vehicle), 60.0, None)
        assert [one.effects for one in questions] == [("effective_track",)]
    assert max(spread["ice"], spread["gravel"]) < spread["mud"]
    # Whether an effect acts that the fleet names is no question any more.
    questions = ask(knowledge, [], choose_limits(vehicle), 60.0, None)
    assert "whether effective_track acts" not in {one.text for one in questions}
    assert expect(vehicle, None, results).knowledge.base.names == set()


def test_a_plan_for_a_terrain_needs_no_run(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = ["plan", "--vehicle", "warthog", "--terrain", "gravel", "--results", str(results), "--json"]
    with pytest.raises(SystemExit, match="0"):
        main([*told, "--for", "effective_track", "--folder", str(tmp_path / "plan")])
    made = json.loads(capsys.readouterr().out)
    assert made["known"] == {"terrain": "gravel", "runs_on_terrain": 3, "runs_elsewhere": 3}
    (answer,) = made["promises"]
    assert answer["question"].startswith("effective_track.k within")
    assert (tmp_path / "plan" / "plan.mcap").is_file()
    # The plan beside it is none of its configuration.
    assert list_configuration_files(tmp_path / "plan" / "plan.mcap") == ()


def test_what_the_fleet_knows_adds_to_what_a_run_says(tmp_path: Path) -> None:
    """Half a minute straight ahead shows nothing of the track."""
    scenario = make_scenario(None, {"effective_track": {"k": 1.5}}, seed=3, duration_s=30.0, vehicle="husky")
    straight = replace(scenario, program=Program("straight", speed_scale=0.4, turn_scale=0.4))
    vehicle, recording = record(straight, tmp_path / "straight.mcap")
    runs = [load_recording(recording, vehicle)]
    effects = [find_effect("effective_track")()]
    alone = learn(runs, vehicle, effects).base
    tied = learn(runs, vehicle, effects, {"effective_track.k": (1.5, 0.02)}).base
    assert np.linalg.inv(alone.information)[0, 0] ** 0.5 > 0.02
    assert np.linalg.inv(tied.information)[0, 0] ** 0.5 < 0.02
    assert tied.values[0] == pytest.approx(1.5, abs=0.04)
