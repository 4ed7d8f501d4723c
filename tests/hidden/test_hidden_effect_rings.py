"""HiddenEffect's rings: the same bytes by seed, no truth in a task, a seal that only its key opens."""

from __future__ import annotations

import ast
import hashlib
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import make_rings
import numpy as np
import polars as pl
import pytest
import seal_truth
from answer_simple import BASELINES, write_answers
from answer_slip import answer, translate, write_function
from injections import list_injections
from make_rings import find_seed, main
from mcap.reader import make_reader
from read_task import list_tasks, read_task
from real_tasks import cut_real_windows, cut_stretch, list_listed, write_tables
from score_answers import measure_scores, score_ring
from seal_truth import SealError, open_ring, read_key, unseal
from task_draws import NAMES, SIMULATED, Lengths, draw_task
from test_injections import DRIVE, tables  # noqa: F401 - a fixture

from pipeline.core import SlipError
from pipeline.simulate import list_effects

HERE = Path(make_rings.__file__).parent
SHORT = ["--seconds", "30", "--held-out-seconds", "14"]
STANDARD = ("geometry_msgs", "ackermann_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "builtin_interfaces")


@pytest.fixture(scope="module")
def rings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four tiny tasks of the open ring."""
    out = tmp_path_factory.mktemp("rings")
    assert main(["--out", str(out), "--rings", "open", "--tasks", "4", *SHORT]) == 0
    return out


def hash_tree(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def read_truth(rings: Path) -> dict[str, Any]:
    truth: dict[str, Any] = json.loads((rings / "open" / "truth.json").read_text("utf-8"))
    return truth


@pytest.mark.long
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(rings: Path, tmp_path: Path) -> None:
    for name, seed in (("again", make_rings.SEED), ("other", make_rings.SEED + 1)):
        arguments = ["--out", str(tmp_path / name), "--rings", "open", "--tasks", "4", "--seed", str(seed)]
        assert main([*arguments, *SHORT]) == 0
    assert hash_tree(tmp_path / "again") == hash_tree(rings)
    assert (
        hash_tree(tmp_path / "other")["open/open_001/log.mcap"] != hash_tree(rings)["open/open_001/log.mcap"]
    )


def test_a_task_says_all_that_is_needed_and_nothing_of_its_truth(rings: Path) -> None:
    truth = read_truth(rings)["tasks"]
    assert len(truth) == 4
    for folder in list_tasks(rings):
        assert {path.name for path in folder.iterdir()} == {
            "task.toml", "vehicle.toml", "log.mcap", "held_out_commands.csv", "held_out_windows.csv",
        }  # fmt: skip
        words = "".join(path.read_text("utf-8") for path in folder.iterdir() if path.suffix != ".mcap")
        assert not any(name in words for name in NAMES)
        task = tomllib.loads((folder / "task.toml").read_text("utf-8"))
        with (folder / "log.mcap").open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert {channel.topic for channel in summary.channels.values()} == set(task["topics"].values())
        assert all(schema.name.split("/")[0] in STANDARD for schema in summary.schemas.values())
        assert summary.statistics.metadata_count == 0
        read = read_task(folder)
        assert len(read.windows) == len(truth[read.id]["held_out"]["poses"])
        # Of the held-out stretch the log has commands and poses of no window.
        assert read.poses[-1, 0] < read.windows[0, 0]


def test_the_true_physics_predicts_best(rings: Path) -> None:
    for task in read_truth(rings)["tasks"].values():
        held = task["held_out"]
        assert 0.0 < held["floor"]["position_m"] < 1.1 * held["ideal"]["position_m"]
        assert 0.0 < held["floor"]["yaw_rad"] < 1.1 * held["ideal"]["yaw_rad"]


def test_a_ring_is_drawn_answered_and_scored(rings: Path, tmp_path: Path) -> None:
    truth, lines = read_truth(rings), list[str]()
    for name, solver in BASELINES.items():
        assert write_answers(rings, tmp_path / name, solver) == 4
        measured = measure_scores(score_ring(tmp_path / name, truth, NAMES, lines.append))
        assert -1.0 <= measured["points"][0] <= 1.0
        assert measured["cpu_s"][0] > 0.0
        if name in {"nothing", "bicycle_understeer"}:
            # Held commands are put together anew by a reader: the ideal model comes out to a few per cent.
            assert measured["position_over_ideal"][0] == pytest.approx(1.0, abs=0.05)
    assert not lines


def test_a_diagnosis_is_answered_in_the_words_of_the_list(rings: Path, tmp_path: Path) -> None:
    number = {"value": 0.1, "low": 0.05, "high": 0.15}
    told = {
        "effects": [{"id": "icr_offset", "parameters": {"x_icr": number}}],
        "undecided": [{"candidates": ["icr_offset", "drive_lag", "term_v_1", "turn_lag"]}],
        "unexplained": {"channels": ["x", "w"], "formula": None, "where": "in turns"},
    }
    said = translate(told)
    assert said["effects"] == [{"name": "rotation_centre_forward", "parameters": {"x_icr": number}}]
    assert said["undecided"] == [["drive_lag", "turn_lag"]]
    assert said["other"]["channels"] == ["x", "yaw"]
    assert not said["none"]
    one = list_tasks(rings)[0]
    assert write_answers(one, tmp_path, answer) == 1
    lines: list[str] = []
    score_ring(tmp_path, read_truth(rings), NAMES, lines.append)
    assert lines == ["open: 3 of 4 tasks have no answer; they count as abstained"]


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


def test_the_sealed_ring_opens_with_its_key_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    secret, out = tmp_path / "secret.txt", tmp_path / "rings"
    assert main(["--new-secret", str(secret)]) == 0
    assert secret.stat().st_mode & 0o077 == 0
    arguments = ["--out", str(out), "--rings", "sealed", "--tasks", "1", "--opens", "2030-01-01", *SHORT]
    assert main([*arguments, "--secret-file", str(secret)]) == 0
    ring = out / "sealed"
    assert not (ring / "truth.json").exists()
    published = tomllib.loads((ring / "sealed.toml").read_text("utf-8"))
    sealed = (ring / "truth.sealed").read_bytes()
    assert published["opens"] == "2030-01-01"
    assert b"effects" not in sealed
    # The secret is not the key: who publishes the key does not publish the seeds of rings to come.
    with pytest.raises(SealError, match="does not open"):
        open_ring(ring / "truth.sealed", read_key(secret))
    key = read_key(secret.with_suffix(".key"))
    for place in range(0, len(sealed), 7):
        changed = sealed[:place] + bytes([sealed[place] ^ 1]) + sealed[place + 1 :]
        with pytest.raises(SealError):
            unseal(changed, key)
    text = open_ring(ring / "truth.sealed", key).read_bytes()
    assert hashlib.sha256(text).hexdigest() == published["truth_sha256"]
    assert set(json.loads(text)["tasks"]) == {"sealed_001"}
    (ring / "truth.json").write_bytes(text.replace(b"true", b"false", 1) + b" ")
    command = [sys.executable, str(out / "seal_truth.py"), "check", str(ring)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    capsys.readouterr()


def test_the_sealed_ring_needs_a_secret_and_its_seeds_are_not_the_open_rings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HIDDEN_EFFECT_SECRET", raising=False)
    assert main(["--out", str(tmp_path), "--rings", "sealed", "real"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "sealed: left out; it needs a secret: --secret-file FILE or HIDDEN_EFFECT_SECRET",
        "real: left out; it needs recordings: --recordings FOLDER",
    ]
    monkeypatch.setenv("HIDDEN_EFFECT_SECRET", "not hexadecimal")
    assert main(["--out", str(tmp_path), "--rings", "sealed"]) == 1
    assert "HIDDEN_EFFECT_SECRET: not hexadecimal" in capsys.readouterr().err
    seeds = {find_seed(bytes([root]) * 32, ring, 1) for root in (1, 2) for ring in ("open", "sealed")}
    assert len(seeds) == 4
    assert min(seeds) > 2**64


def test_a_seal_that_unpacks_without_end_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seal_truth, "_MOST_BYTES", 1000)
    with pytest.raises(SealError, match="more than 1000 bytes"):
        unseal(seal_truth.seal(bytes(100_000), bytes(32)), bytes(32))


def test_draws_hold_every_kind_and_at_most_one_effect_of_a_family() -> None:
    tasks = [draw_task("open", number, 1000 + number, Lengths()) for number in range(120)]
    assert {task.kind for task in tasks} == {"differential", "skid_steer", "ackermann", "mecanum"}
    assert {task.driving for task in tasks} == {"designed", "natural", "closed_loop"}
    assert {len(task.hidden) for task in tasks} == {0, 1, 2, 3}
    outside = [task.outside for task in tasks if task.outside is not None]
    assert any(one.name for one in outside)
    assert any(not one.name for one in outside)
    sensors = {(task.scenario.encoders is None, task.scenario.imu is None) for task in tasks}
    assert len(sensors) == 4
    for task in tasks:
        families = [NAMES[hidden.name]["family"] for hidden in task.hidden]
        assert len(set(families)) == len(families)


def test_the_rigid_ring_asks_the_simulator_for_no_effect() -> None:
    tasks = [draw_task("rigid", number, 2000 + number, Lengths()) for number in range(40)]
    assert len({task.cause.split(" of ")[0] for task in tasks}) >= 5
    for task in tasks:
        assert task.machine is not None
        assert not task.scenario.effects
        assert task.scenario.extra is None
        assert task.hidden[0].name == "effective_track"
        assert all(value is None for hidden in task.hidden for value in hidden.parameters.values())


def test_generators_know_no_estimator() -> None:
    for name in ("task_draws", "outside_physics", "held_out", "task_files", "make_rings", "seal_truth"):
        tree = ast.parse((HERE / f"{name}.py").read_text("utf-8"))
        found = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        known = {one for one in found if one.startswith("pipeline")}
        assert known <= {
            "pipeline.simulate", "pipeline.simulate.messages", "pipeline.simulate.programs",
            "pipeline.core",
        }, name  # fmt: skip


def test_the_published_list_is_sound() -> None:
    assert len(NAMES) == 49
    for name, entry in NAMES.items():
        assert set(entry) <= {"family", "slip", "kinds", "same_as", "formula", "parameters"}
        assert entry["parameters"]
        assert all("unit" in parameter for parameter in entry["parameters"].values())
        assert all(name in NAMES[other]["same_as"] for other in entry.get("same_as", ())), name


def test_the_published_list_has_the_parameters_of_every_effect_that_is_simulated() -> None:
    """One was missing of friction in contact: a task with it could not be written."""
    for effect in list_effects():
        if effect.id in SIMULATED:
            # Tasks have changes in time, none over the map.
            simulated = {parameter.name for parameter in effect.parameters} - {"at_x"}
            assert simulated <= set(NAMES[SIMULATED[effect.id]]["parameters"]), effect.id


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
    assert write_tables(recorded, tmp_path / "log.mcap") == ["poses", "encoders", "gyro"]
    assert (tmp_path / "log.mcap").stat().st_size > 10_000
    assert len(list_listed()) < len(list_injections())
