"""The command line as scripts and people use it: output, exit codes, one clear line for every error."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from verbs import run_program, run_verb

from pipeline.cli import main
from pipeline.cli.screen import format_run
from pipeline.logs.writer import LogWriter
from pipeline.simulate import simulate_case

START = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of good and bad logs."""
    folder = tmp_path_factory.mktemp("field")
    simulate_case("husky_tile", out=folder / "good.mcap", duration_s=30.0)
    whole = (folder / "good.mcap").read_bytes()
    (folder / "truncated.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    (folder / "empty.mcap").write_bytes(b"")
    (folder / "text.mcap").write_text("this is no recording\n" * 100)
    stamps = START + np.arange(200, dtype=np.int64) * 50_000_000
    pose = {"pose.pose.position.x": np.arange(200) * 0.02, "pose.pose.orientation.w": np.ones(200)}
    with LogWriter(folder / "no_pose.mcap") as log:
        log.metadata("deployment", {"vehicle": "husky_a200", "terrain": "tile"})
        log.write_columns("/cmd_vel", "geometry_msgs/msg/Twist", stamps, {"linear.x": np.ones(200)})
    with LogWriter(folder / "no_command.mcap") as log:
        log.metadata("deployment", {"vehicle": "husky_a200", "terrain": "tile"})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    with LogWriter(folder / "only_images.mcap") as log:
        log.write_columns("/camera", "std_msgs/msg/String", stamps, {"data": "an image"})
    with LogWriter(folder / "no_vehicle.mcap") as log:
        for side in ("left", "right"):
            log.write_columns(f"/{side}_drive/velocity", "std_msgs/msg/Float64", stamps, {"data": 0.0})
        log.write_columns("/odom", "nav_msgs/msg/Odometry", stamps, pose, header_time=stamps)
    with LogWriter(folder / "no_messages.mcap") as log:
        log.metadata("deployment", {"vehicle": "husky_a200", "terrain": "tile", "note": "one:\n  - two"})
    return folder


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.mcap", ["no such file", "Check the path"]),
        ("empty.mcap", ["is empty"]),
        ("text.mcap", ["MCAP"]),
        ("no_pose.mcap", ["pose", "None of its topics holds any: record", "/cmd_vel"]),
        ("no_command.mcap", ["command", "[command] topic", "/odom"]),
        ("no_vehicle.mcap", ["vehicle", "--vehicle", "husky_a200", "--wheel-radius"]),
        ("only_images.mcap", ["no topic", "pose", "None of its topics holds any: record", "/camera"]),
        ("goof.mcap", ["no such file", "Did you mean good.mcap"]),
        ("no_messages.mcap", ["no message"]),
    ],
)
def test_a_log_that_cannot_be_analyzed_gets_one_line(
    field: Path, tmp_path: Path, name: str, words: list[str]
) -> None:
    done = run_verb("analyze", field / name, "--out", tmp_path / "out", "--quiet", "--no-diagnosis")

    assert done.returncode == 1
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith(f"slip: {field / name}: ")
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in done.stderr
    assert list(tmp_path.rglob("*.parquet")) == []
    assert list(tmp_path.rglob("manifest.json")) == []
    seen = run_verb("inspect", field / name)
    if seen.returncode == 1:
        assert seen.stderr == done.stderr
    else:
        assert seen.returncode == 3
        why = done.stderr.removeprefix(f"slip: {field / name}: ")
        assert seen.stdout.endswith(f"\nproblem   the log cannot be analyzed: {why}")
        assert "it is analyzed" not in seen.stdout


def test_a_truncated_log_is_analyzed_up_to_the_cut(field: Path, tmp_path: Path) -> None:
    done = run_verb(
        "analyze", field / "truncated.mcap", "--out", tmp_path, "--json", "--no-report", "--no-diagnosis"
    )

    assert done.returncode == 3
    log = json.loads(done.stdout)["runs"][0]["log"]
    assert not log["complete"]
    assert {"kind", "bytes", "chunks", "start_s", "end_s"} <= log["losses"][0].keys()
    assert log["losses"][0]["bytes"] > 0


def test_json_is_all_that_stdout_holds_and_has_the_promised_keys(field: Path, tmp_path: Path) -> None:
    done = run_program(
        "analyze", field / "good.mcap", field / "missing.mcap", "--out", tmp_path, "--json", "--no-diagnosis"
    )

    assert done.returncode == 1, "one of two failed"
    content = json.loads(done.stdout)
    (run,) = content["runs"]
    assert {
        "run", "log", "vehicle", "input", "rate_hz", "samples", "segments", "median_modulus",
        "median_window_norm", "length_scale_m", "by_input", "held_poses", "findings", "report",
    } <= run.keys()  # fmt: skip
    assert {"path", "sha256", "duration_s", "complete", "losses"} <= run["log"].keys()
    assert run["input"] == "both"
    assert run["by_input"].keys() == {"command", "measured"}
    assert {"samples", "median_modulus", "median_window_norm", "rms"} <= run["by_input"]["measured"].keys()
    assert run["median_modulus"] == run["by_input"]["command"]["median_modulus"]
    assert Path(run["report"]).is_file()
    (error,) = content["errors"]
    assert error.keys() == {"path", "code", "message", "hint"}
    assert error["code"] == "log_not_found"


def test_the_summary_fits_a_screen_and_says_what_was_used(field: Path, tmp_path: Path) -> None:
    asked = ("analyze", field / "good.mcap", "--out", tmp_path, "--no-diagnosis")
    done = run_verb(*asked, "--all")

    assert done.returncode == 0
    assert len(done.stdout.splitlines()) < 24
    for word in (
        "husky_a200",
        "tile",
        "from commands",
        "from wheel encoders",
        "/mapping/icp_odom",
        "report.html",
    ):
        assert word in done.stdout
    assert "differentiating poses" in done.stderr
    again = run_verb(*asked)
    assert "nothing was computed" in again.stdout
    assert "differentiating" not in again.stderr
    # Without --all only what everybody reads is shown.
    assert "/mapping/icp_odom" not in again.stdout
    assert len(again.stdout.splitlines()) < 6


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (("--vehicle", "huskyA200"), "Did you mean husky_a200?"),
        (("--wheel-radius", "16.5", "--track-width", "0.55"), "If it is in centimetres, write 0.165."),
        (("--wheel-radius", "0.165", "--track-width", "555"), "If it is in centimetres, write 5.55."),
        (("--wheel-radius", "165", "--track-width", "0.55"), "If it is in centimetres, write 1.65."),
        (("--wheel-radius", "330", "--track-width", "0.55"), "If it is in millimetres, write 0.33."),
    ],
)
def test_a_slip_of_the_pen_is_asked_back(
    field: Path, tmp_path: Path, choice: tuple[str, ...], words: str
) -> None:
    done = run_verb("analyze", field / "good.mcap", *choice, "--out", tmp_path, "--quiet")
    assert done.returncode == 1
    assert words in done.stderr


def test_geometry_may_stand_in_for_a_vehicle(field: Path, tmp_path: Path) -> None:
    done = run_verb(
        "analyze", field / "no_vehicle.mcap", "--wheel-radius", 0.1, "--track-width", 0.4,
        "--out", tmp_path, "--json", "--no-report",
    )  # fmt: skip

    (run,) = json.loads(done.stdout)["runs"]
    assert run["vehicle"] == "vehicle"
    # Hardly anything is commanded in this log.
    assert done.returncode == 3
    assert "hardly commanded to move" in run["verdict"]


def test_no_file_of_another_kind_is_proposed_for_a_log(tmp_path: Path) -> None:
    (tmp_path / "husky.png").write_bytes(b"a picture")
    done = run_verb("analyze", "huskyy.mcap", cwd=tmp_path)

    assert done.returncode == 1
    assert "Did you mean" not in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("analyze",),
        ("analyze", "log.mcap", "--wheel-radius", "-1"),
        ("analyze", "log.mcap", "--input", "guess"),
        ("fly",),
        ("results", "stage", "dream", "log.mcap"),
    ],
)
def test_usage_errors_exit_2(arguments: tuple[str, ...], tmp_path: Path) -> None:
    done = run_verb(*arguments, cwd=tmp_path)

    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_what_was_not_given_is_said_to_be_needed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["model", "add", "robot.toml", "drive_lag"])
    assert left.value.code == 2
    assert "needs --on: logs, or runs of the results folder" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["model", "export", "robot.toml"])
    assert "needs --to: ros2_control, nav2," in capsys.readouterr().err


def test_an_argument_too_many_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["fleet", "trend", "results", "other"])
    assert left.value.code == 2
    assert "slip fleet trend takes no further argument: other." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("model", "show", "log.mcap"), "this is not a model file: it is not text"),
        (("model", "show", "folder"), "folder: this is not a model file: it is a folder. Give the TOML file"),
        (("compare", "log.mcap"), "log.mcap: this is not a results folder. Give the folder"),
        (("compare", "folder"), "folder: this is not a results folder. Give the folder"),
        (
            ("diagnose", "no/such"),
            "results: 'no/such' is neither a log nor a run: no run has been analyzed yet (the folder",
        ),
        (("diagnose", "no/such", "--results", "empty"), "no run has been analyzed yet. Analyze logs first"),
        (("export", "run", "--to", "csv"), "(the folder of results does not exist). Analyze"),
        *(
            ((*verb, "--results", "nowhere"), "nowhere: there are no results: there is no such folder. Give")
            for verb in (
                ("compare",),
                ("compare", "--causes"),
                ("results", "status"),
                ("results", "query", "SELECT 1"),
                ("fleet", "fit"),
                ("fleet", "show"),
                ("fleet", "trend"),
                ("fleet", "share"),
                ("fleet", "map"),
                ("fleet", "predict", "--vehicle", "warthog", "--terrain", "ice"),
            )
        ),
        (("diagnose", "no/such", "--apply", "model.toml"), "'no/such' is neither a log nor a run"),
        (("inspect", "missing.mcap"), "missing.mcap: there is no such file. Check the path."),
        (("plan", "--check", "robot.toml", "log.mcap"), "this is not a plan.toml"),
        (("model", "add", "robot.toml", "drive_lag", "--on"), "--on names no run"),
    ],
)
def test_a_file_of_another_kind_is_refused_in_plain_words(
    arguments: tuple[str, ...],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.mcap").write_bytes(b"\x89MCAP0\r\n")
    (tmp_path / "mystery_1.mcap").touch()
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "folder" / "husky.txt").touch()
    with pytest.raises(SystemExit):
        main(["model", "new", "robot.toml", "--vehicle", "husky_a200", "--quiet"])
    with pytest.raises(SystemExit) as left:
        main(list(arguments))
    (line,) = capsys.readouterr().err.splitlines()
    assert left.value.code == 1
    assert words in line


def test_a_loss_is_shown_with_the_time_it_took() -> None:
    summary = {
        "run": "field/a",
        "vehicle": "husky_a200",
        "terrain": "tile",
        "segments": 2,
        "log": {
            "duration_s": 90.0,
            "losses": [
                {"text": "chunk of 9 bytes at 70", "start_s": 72.70, "end_s": 96.94},
                {"text": "the file is truncated", "start_s": None, "end_s": None},
            ],
        },
    }
    lines = format_run(summary, unchanged=False).splitlines()
    assert lines[1].endswith("chunk of 9 bytes at 70 (72.7 to 96.9 s of the log)")
    assert lines[2].endswith("the file is truncated")


def test_an_interval_beside_the_poses_is_named_as_what_is_wrong(field: Path, tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text("[[interval]]\nstart_s = 500\nend_s = 600\n")
    done = run_verb("analyze", field / "good.mcap", "--config", config, "--out", tmp_path / "out", "--quiet")

    assert done.returncode == 1
    assert "[[interval]]" in done.stderr
    assert "[command]" not in done.stderr


def test_an_interrupt_says_what_became_of_the_results(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.models.catalogue.list_effects", interrupt)
    with pytest.raises(SystemExit) as left:
        main(["effects"])

    assert left.value.code == 130
    assert "nothing was left half-written" in capsys.readouterr().err


def test_a_wrong_configuration_names_file_and_key(field: Path, tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text("[velocity]\nrate_hzz = 10\n")
    done = run_verb("analyze", field / "good.mcap", "--config", config, "--out", tmp_path / "out", "--quiet")

    assert done.returncode == 1
    assert str(config) in done.stderr
    assert "rate_hzz" in done.stderr
    assert not (tmp_path / "out").exists()


def test_explain_says_where_numbers_come_from(field: Path, tmp_path: Path) -> None:
    run = json.loads(
        run_verb(
            "analyze", field / "good.mcap", "--out", tmp_path, "--json", "--no-report", "--no-diagnosis"
        ).stdout
    )["runs"][0]
    done = run_program("results", "explain", "good", "slip.g_w", "--out", tmp_path)

    assert done.returncode == 0
    for word in (run["log"]["sha256"], run["key"], "numpy", "rad/s", "slip in yaw rate"):
        assert word in done.stdout
    details = json.loads(run_verb("results", "explain", "good", "--out", tmp_path, "--json").stdout)
    assert details["vehicle"]["track_width_m"] == 0.55
    assert details["stages"].keys() == {"extract", "align", "velocity", "slip", "aggregate"}
    wrong = run_verb("results", "explain", "nobody", "--out", tmp_path)
    assert wrong.returncode == 1
    assert run["run"] in wrong.stderr


def test_inspect_shows_topics_roles_and_damage(field: Path) -> None:
    done = run_program("inspect", field / "good.mcap")
    assert done.returncode == 0
    for word in (
        "complete",
        "/mapping/icp_odom",
        "nav_msgs/msg/Odometry",
        "Clearpath Husky A200",
        "JointState whose name",
    ):
        assert word in done.stdout

    cut = json.loads(run_verb("inspect", field / "truncated.mcap", "--json").stdout)
    assert not cut["complete"]
    assert cut["losses"]
    assert cut["roles"]["pose"]["topic"] == "/mapping/icp_odom"

    assert "note = one: - two\n" in run_verb("inspect", field / "no_messages.mcap").stdout
    unknown = run_verb("inspect", field / "no_vehicle.mcap")
    assert unknown.returncode == 3
    assert "cannot be determined" in unknown.stdout


def test_a_stage_alone(field: Path, tmp_path: Path) -> None:
    done = run_program("results", "stage", "extract", field / "good.mcap", "--out", tmp_path, "--json")
    assert done.returncode == 0
    assert set(json.loads(done.stdout)["rows"]) == {"commands", "wheels", "poses", "imu", "findings"}

    by_run = run_verb("results", "stage", "slip", "good", "--out", tmp_path, "--json")
    assert json.loads(by_run.stdout)["computed"] == ["align", "velocity", "slip"]


def test_simulate_writes_a_log_with_the_effect_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "sim.mcap"
    done = run_program(
        "simulate", "ideal_husky", "--effect", "effective_track=1.8", "--duration", 20, "--out", out
    )
    assert done.returncode == 0, done.stderr
    assert out.is_file()

    twice = ["drive_lag=tau:1,tau:2"], ["drive_lag=0.3", "drive_lag=0.5"]
    for effects in (["effective_track=wide"], ["antigravity=1"], *twice):
        asked = [word for effect in effects for word in ("--effect", effect)]
        wrong = run_verb("simulate", "ideal_husky", *asked, "--out", tmp_path / "x.mcap")
        assert wrong.returncode == 1
        assert len(wrong.stderr.splitlines()) == 1
        assert not (tmp_path / "x.mcap").exists()


def test_the_list_of_cases_keeps_names_and_texts_apart_within_the_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "--cases", "--json"])
    assert ended.value.code == 0
    listed = json.loads(capsys.readouterr().out)
    with pytest.raises(SystemExit):
        main(["simulate", "--cases"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(" ")]
    assert all(len(line) <= 80 or len(line.split()) == 1 for line in lines if line[2] == " ")
    rows: list[list[str]] = []
    for line in lines:
        if line[2] == " ":
            rows[-1] += line.split()
        else:
            rows.append(line.split())
    told = {**listed["cases"], **listed["effects"], **listed["platforms"]}
    assert rows == [[name, *text.split()] for name, text in told.items()]


def test_help_loads_no_heavy_library() -> None:
    code = (
        "import sys\nfrom pipeline.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'polars', 'pyarrow', 'scipy', 'altair', 'dataframely', 'jinja2'}\n"
        "heavy &= set(sys.modules)\n"
        "print('heavy:', sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert "heavy: []" in done.stdout
    for verb in ("analyze", "inspect", "fleet", "results", "simulate", "doctor"):
        assert verb in done.stdout


def test_a_log_that_cannot_show_slip_says_so_first_and_ends_with_3(tmp_path: Path) -> None:
    log = simulate_case("husky_in_the_air", out=tmp_path / "air.mcap", duration_s=60.0)
    done = run_verb("analyze", log, "--results", tmp_path / "out", "--no-report")
    assert done.returncode == 3
    assert done.stdout.startswith("The vehicle does not move")
    done = run_verb("diagnose", log, "--results", tmp_path / "out")
    assert done.returncode == 3
    assert "does not move" in done.stdout
    done = run_verb("diagnose", log, "--results", tmp_path / "out", "--apply", tmp_path / "air.toml")
    assert "no model can be proposed: the vehicle does not move" in done.stderr
    done = run_verb("fleet", "fit", "--results", tmp_path / "out")
    assert "no effect can be estimated: the vehicle does not move" in done.stderr


def test_a_diagnosis_of_a_damaged_log_says_why_it_ends_with_3(tmp_path: Path) -> None:
    log = simulate_case("husky_tile", out=tmp_path / "whole.mcap", duration_s=60.0)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: 3 * log.stat().st_size // 4])
    done = run_verb("diagnose", cut, "--results", tmp_path / "out")
    assert done.returncode == 3
    assert f"logs with losses: {cut} (slip inspect {cut} lists them)" in " ".join(done.stderr.split())
