"""Rings of the game: the same bytes by seed, no truth in a task, generators that know no estimator."""

from __future__ import annotations

import argparse
import ast
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from game import rings as maker
from game.baselines import BASELINES, write_answers
from game.draw import draw_riddle
from game.player import answer_slip, write_claims, write_function
from game.read_task import list_tasks, read_task
from game.recorded import cut_real_windows, cut_stretch, list_listed, write_tables
from game.rings import MIX, list_names, make_truth
from game.score import measure_scores, read_truths, score_ring
from injections import list_injections
from mcap.reader import make_reader
from stored import hash_tree
from test_injections import DRIVE, tables  # noqa: F401 - a fixture

from pipeline.core import SlipError

pytestmark = pytest.mark.long

HERE = Path(maker.__file__).parent
STANDARD = ("geometry_msgs", "ackermann_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "builtin_interfaces")
TASKS = 5


def make(folder: Path, *words: str) -> dict[str, dict[str, Any]]:
    """Make a small open ring; the truths of its tasks."""
    parser = argparse.ArgumentParser()
    maker.add_arguments(parser)
    out = ["--out", str(folder / "rings"), "--truths", str(folder / "truths")]
    maker.run(parser.parse_args([*out, "--rings", "open", "--tasks", str(TASKS), *words]))
    return read_truths(folder / "rings", folder / "truths")["open"]  # type: ignore[return-value]


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first tasks of the open ring."""
    folder = tmp_path_factory.mktemp("game")
    assert len(make(folder)) == TASKS
    return folder


def test_the_same_seed_gives_the_same_bytes_and_one_that_nobody_knows_others(
    ring: Path, tmp_path: Path
) -> None:
    make(tmp_path / "again")
    assert hash_tree(tmp_path / "again") == hash_tree(ring)
    make(tmp_path / "other", "--sealed")
    place = "rings/open/open_001/log.mcap"
    assert hash_tree(tmp_path / "other")[place] != hash_tree(ring)[place]


def test_a_task_says_all_that_is_needed_and_nothing_of_its_truth(ring: Path) -> None:
    truths = read_truths(ring / "rings", ring / "truths")["open"]
    for folder in list_tasks(ring / "rings"):
        assert {path.name for path in folder.iterdir()} == {
            "task.toml", "vehicle.toml", "log.mcap", "held_out_commands.csv", "held_out_windows.csv",
        }  # fmt: skip
        words = "".join(path.read_text("utf-8") for path in folder.iterdir() if path.suffix != ".mcap")
        assert not any(re.search(rf"\b{name}\b", words) for name in list_names())
        task = tomllib.loads((folder / "task.toml").read_text("utf-8"))
        with (folder / "log.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert {channel.topic for channel in summary.channels.values()} == set(task["topics"].values())
        assert all(schema.name.split("/")[0] in STANDARD for schema in summary.schemas.values())
        assert summary.statistics.metadata_count == 0
        read = read_task(folder)
        assert len(read.windows) == len(truths[read.id]["held_out"]["poses"])
        # Of the held-out stretch the log has commands and poses of no window.
        assert read.poses[-1, 0] < read.windows[0, 0]
        # The salt is what nobody can guess; without it a hash could be tried.
        assert len(truths[read.id]["scene"]["salt"]) == 32


def test_the_true_physics_predicts_best(ring: Path) -> None:
    for task in read_truths(ring / "rings", ring / "truths")["open"].values():
        held = task["held_out"]
        assert 0.0 < held["floor"]["position_m"] < 1.1 * held["ideal"]["position_m"]
        assert 0.0 < held["floor"]["yaw_rad"] < 1.1 * held["ideal"]["yaw_rad"]


def test_a_ring_is_drawn_answered_and_scored(ring: Path, tmp_path: Path) -> None:
    truths, lines = read_truths(ring / "rings", ring / "truths")["open"], list[str]()
    for name, solver in BASELINES.items():
        assert write_answers(ring / "rings", tmp_path / name, solver) == TASKS
        measured = measure_scores(score_ring(tmp_path / name, truths, list_names(), lines.append))
        assert -1.0 <= measured["points"][0] <= 1.0
        assert measured["cpu_s"][0] > 0.0
        if name == "nothing":
            # Held commands are put together anew by a reader: the ideal model comes out to a few per cent.
            assert measured["position_over_ideal"][0] == pytest.approx(1.0, abs=0.05)
    assert not lines


def test_a_diagnosis_is_answered_in_the_words_of_the_list(ring: Path, tmp_path: Path) -> None:
    number = {"value": 0.1, "low": 0.05, "high": 0.15, "at_bound": False}
    told = {
        "effects": [
            {"id": "icr_offset", "parameters": {"x_icr": number}, "equivalent_to": ["lever_arm"]},
            {"id": "drive_lag", "parameters": {"tau": number | {"at_bound": True}}},
        ],
        "undecided": [{"candidates": ["icr_offset", "deadband", "term_v_1", "turn_lag"]}],
        "unexplained": {"channels": ["x", "w"], "formula": None, "where": "in turns"},
    }
    said = write_claims(told)
    interval = {"value": 0.1, "low": 0.05, "high": 0.15}
    assert said["effects"] == [
        {"name": "icr_offset", "parameters": {"x_icr": interval}, "same_as": ["lever_arm"]},
        {"name": "drive_lag", "parameters": {"tau": {"value": 0.1}}, "same_as": []},
    ]
    assert said["undecided"] == [["deadband", "turn_lag"]]
    assert said["other"]["channels"] == ["w", "x"]
    assert not said["none"]
    assert write_answers(list_tasks(ring / "rings")[0], tmp_path, answer_slip) == 1
    lines: list[str] = []
    truths = read_truths(ring / "rings", ring / "truths")["open"]
    score_ring(tmp_path, truths, list_names(), lines.append)
    assert lines == [f"{TASKS - 1} of {TASKS} tasks have no answer; they count as abstained"]


def test_a_term_that_cannot_be_exported_is_left_out_of_the_prediction() -> None:
    class Model:
        def __init__(self, *ids: str) -> None:
            self.ids = ids

        def __sub__(self, name: str) -> Model:
            return Model(*(one for one in self.ids if one != name))

        def export(self, to: str) -> str:
            if "rate" in self.ids:
                raise SlipError("not_exportable", "it has a rate", where="rate", hint="Leave it out")
            return f"{to}: {', '.join(self.ids)}"

    assert write_function(Model("drive_lag", "rate")) == "python: drive_lag"  # type: ignore[arg-type]


def test_a_truth_has_every_effect_with_its_size() -> None:
    for category in MIX:
        riddle = draw_riddle(category, 5)
        truth = make_truth(riddle.answer)
        assert [effect["name"] for effect in truth["effects"]] == list(riddle.answer.effects)
        assert (truth["unlisted"] is not None) == (category == "odd")
        for effect in truth["effects"]:
            for number in effect["parameters"].values():
                assert number["scale"] is None or math.isfinite(number["scale"])
        json.dumps(truth, allow_nan=False)


def test_generators_know_no_estimator() -> None:
    for name in ("draw", "sizes", "closed_loop", "odd", "held_out", "rings"):
        tree = ast.parse((HERE / f"{name}.py").read_text("utf-8"))
        found = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        known = {one for one in found if one.startswith("pipeline")}
        assert all(one.startswith("pipeline.simulate") for one in known), name
        own = {"draw", "sizes", "closed_loop", "odd", "held_out", "score", "recorded", "rigid_bodies"}
        assert {one.removeprefix("game.") for one in found if one.startswith("game")} <= own, name


def test_an_effect_put_into_a_recording_becomes_a_task(tables: Any, tmp_path: Path) -> None:  # noqa: F811, ANN401
    several = {
        name: pl.concat([table.with_columns(pl.col("t") + 20.0 * lap) for lap in range(5)])
        for name, table in tables.items()
    }
    several["poses"] = several["poses"].with_columns(outlier=pl.lit(value=False))
    several |= {
        name: several[name].with_columns(active=pl.lit(value=True)) for name in ("wheels", "commands", "imu")
    }
    several["imu"] = several["imu"].with_columns(
        *(
            pl.lit(0.0).alias(name)
            for name in ("rate_x", "rate_y", "acceleration_x", "acceleration_y", "acceleration_z")
        )
    )
    recorded = cut_stretch(several, DRIVE, "circle")
    held = cut_real_windows(recorded)
    assert np.all(held.ends_s - held.starts_s >= 2.0)
    assert held.starts_s[0] >= recorded.log_s
    # The fixture's vehicle does what its wheels do, apart from where its laps are joined.
    good = np.linalg.norm(np.diff(held.starts[:, :2], axis=0), axis=1) > 1.0
    assert good.any()
    assert write_tables(recorded, tmp_path / "log.mcap") == ["encoders", "gyro"]
    assert (tmp_path / "log.mcap").stat().st_size > 10_000
    assert len(list_listed()) < len(list_injections())
