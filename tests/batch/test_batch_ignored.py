"""Counts and lists of a batch are those of one table on every face; a dead log can be ignored."""

import json
import os
import re
import threading
import time
from html import unescape
from pathlib import Path

import pytest
from verbs import run_verb

from pipeline.report import _date_errors, render_catalogue
from pipeline.sources import ConfigurationError, match_globs
from pipeline.store import LOG_STATES, Store


@pytest.fixture
def folder(place: Path) -> Path:
    """A whole log, its copy, one that is cut, one that is no log, and one that is ignored."""
    whole = (place / "field" / "wide.mcap").read_bytes()
    (place / "field" / "twin.mcap").write_bytes(whole)
    (place / "field" / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])
    (place / "field" / "text.mcap").write_text("this is no recording\n" * 100)
    (place / "field" / "dead.mcap").write_text("nor is this\n" * 100)
    (place / "field" / "fleet.toml").write_text('ignore = ["dead*"]\n')
    return place


def test_every_face_counts_and_lists_the_same_logs(folder: Path) -> None:
    words = ("batch", "field", "--settle", "0", "--executor", "inline", "--results", "season")
    words = (*words, "--notify", "cat > told.json", "--json")
    for number in range(2):
        told = json.loads(run_verb(*words, cwd=folder).stdout)
        status = json.loads(run_verb("results", "status", "--results", "season", "--json", cwd=folder).stdout)
        counts = {state: told[state] for state in LOG_STATES}
        counts["done"] += told["unchanged"]
        assert counts == {state: status[state] for state in LOG_STATES}, number
        expected = {"done": 1, "lossy": 1, "failed": 1, "copy": 1, "ignored": 1}
        assert {state: count for state, count in counts.items() if count} == expected
        assert len(told["logs"]) == sum(counts.values())
        states = [one["state"] for one in told["logs"]]
        assert {state: told[state] for state in states} == {state: states.count(state) for state in states}
    sent = json.loads((folder / "told.json").read_text())
    assert {state: sent[state] for state in LOG_STATES if state != "done"} == {
        state: counts[state] for state in LOG_STATES if state != "done"
    }
    page = unescape((folder / "season" / "index.html").read_text())
    (line,) = re.findall(r"Logs of batches: (.*)\.</p>", page)
    assert line == "1 done, 1 with losses, 1 failed, 1 copy, 1 ignored"
    assert re.search(r'<span class="bad">copy</span>: the same content as field/\w+', page)
    assert all(name in page for name in ("cut.mcap", "text.mcap", "dead.mcap"))
    screen = run_verb(*words[:8], cwd=folder).stdout
    assert re.search(r"^ignored +1$", screen, re.MULTILINE)
    assert 'ignore = "dead*"' in screen


def test_a_dead_mount_does_not_hold_who_asks_for_the_status(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of its logs is left out, with the reason; the others count as before."""
    for name in ("one", "two"):
        (folder / "dead").mkdir(exist_ok=True)
        (folder / "dead" / f"{name}.mcap").write_text(f"no recording {name}\n" * 100)
    words = ("batch", "field", "dead", "--settle", "0", "--executor", "inline", "--results", "season")
    run_verb(*words, cwd=folder)
    never, stat = threading.Event(), os.stat

    def hang(place: str | Path, **options: bool) -> os.stat_result:
        if "dead" in Path(place).parts:
            never.wait()
        return stat(place, **options)

    monkeypatch.setattr("pipeline.report._PATIENCE_S", 0.2)
    monkeypatch.setattr("os.stat", hang)
    started = time.monotonic()
    status = json.loads(run_verb("results", "status", "--results", "season", "--json", cwd=folder).stdout)
    page = render_catalogue(Store(folder / "season"))
    assert time.monotonic() - started < 10.0, "one wait for a mount, not one for each log"
    never.set()
    counts = {state: status[state] for state in LOG_STATES if status[state]}
    assert counts == {"done": 1, "lossy": 1, "failed": 1, "copy": 1, "ignored": 1, "left_out": 2}
    left = [one for one in status["logs"] if one["state"] == "left_out"]
    assert [Path(one["path"]).name for one in left] == ["one.mcap", "two.mcap"]
    assert all("does not answer within 0.2 s" in one["reason"] for one in left)
    assert "2 left out" in page


def test_a_log_that_is_no_longer_ignored_is_read(folder: Path) -> None:
    words = (
        "batch",
        "field/dead.mcap",
        "--settle",
        "0",
        "--executor",
        "inline",
        "--results",
        "season",
        "--json",
    )
    assert json.loads(run_verb(*words, cwd=folder).stdout)["ignored"] == 1
    (folder / "field" / "fleet.toml").unlink()
    told = json.loads(run_verb(*words, cwd=folder).stdout)
    assert (told["ignored"], told["failed"]) == (0, 1)


def test_ignore_is_a_list_of_globs(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text("ignore = 3\n")
    with pytest.raises(ConfigurationError, match="list of globs"):
        match_globs(tmp_path / "a.mcap")


def test_the_index_shows_the_errors_of_each_run_and_over_dates(folder: Path) -> None:
    (manifest,) = Store(folder / "results").manifests()
    steps = manifest.read("ladder").filter(kind="rung").sort("rung")["t_mrmse"].to_list()
    page = unescape(render_catalogue(Store(folder / "results")))
    for head in ("error over 2 s, ideal [m]", "error over 2 s, model [m]"):
        assert f'<button type="button">{head}</button>' in page, "a column that sorts"
    shown = [float(one) for one in re.findall(r'data-value="([\d.]+)"', page)]
    assert pytest.approx(steps[0]) in shown
    assert pytest.approx(steps[-1]) in shown
    assert "<figure>" not in page, "one date has no course"
    rows = [
        {"run": f"r{day}", "day": f"2026-05-0{day}", "vehicle": name, "ideal": 0.5 * day, "model": 0.1}
        for day, name in ((1, "husky"), (2, "jackal"), (4, "jackal"))
    ]
    dated = _date_errors(rows)
    assert dated is not None
    assert list(dated["dates"].values()) == ["2026-05-01", "2026-05-02", "2026-05-04"]
    assert dated["heights"] == {0.0: "0", 0.25: "0.5", 0.5: "1", 0.75: "1.5", 1.0: "2"}
    assert dated["vehicles"] == ["jackal", "husky"]
    assert [one["vehicle"] for one in dated["points"]] == [1, 0, 0]
    many = [{**row, "vehicle": f"robot {number}"} for number in range(8) for row in rows]
    assert _date_errors(many)["vehicles"] == [*(f"robot {number}" for number in range(6)), "2 other vehicles"]
    assert [one["x"] for one in dated["points"]] == pytest.approx([0.0, 1 / 3, 1.0])
    assert [one["ideal"] for one in dated["points"]] == pytest.approx([0.25, 0.5, 1.0])


def test_a_glob_that_matches_no_log_is_told(folder: Path) -> None:
    """Of a folder that was searched; of one log nobody knows what else there is."""
    fleet = folder / "field" / "fleet.toml"
    fleet.write_text('ignore = ["dead*", "deed*", "*.mcap.part"]\n')
    words = ("--settle", "0", "--executor", "inline", "--results", "season")
    told = [f'{fleet}: ignore = "{glob}" matched no log' for glob in ("deed*", "*.mcap.part")]
    for _ in range(2):
        answer = json.loads(run_verb("batch", "field", *words, "--json", cwd=folder).stdout)
        assert answer["notes"] == told
    assert 'ignore = "deed*" matched no log' in " ".join(
        run_verb("batch", "field", *words, cwd=folder).stdout.split()
    )
    one = json.loads(run_verb("batch", "field/text.mcap", *words, "--json", cwd=folder).stdout)
    assert one["notes"] == []


def test_a_match_that_fits_no_log_is_told(folder: Path) -> None:
    fleet = folder / "field" / "fleet.toml"
    fleet.write_text("""ignore = ["*.mcap"]
[[match]]
glob = "wide*"
run.terrain = "clay"
[[match]]
glob = "wild*"
run.terrain = "mud"
""")
    words = ("batch", "field", "--settle", "0", "--executor", "inline", "--results", "season", "--json")
    notes = json.loads(run_verb(*words, cwd=folder).stdout)["notes"]
    assert notes == [f'{fleet}: [[match]] glob = "wild*" matched no log']


def test_links_are_ignored_as_they_are_listed(folder: Path) -> None:
    """A linked folder, a dead link and a pipe that a glob matches are not left out."""
    (folder / "other" / "inside").mkdir(parents=True)
    (folder / "other" / "inside" / "x.mcap").write_text("no recording\n" * 100)
    (folder / "field" / "robot").symlink_to(folder / "other")
    (folder / "field" / "lost.mcap").symlink_to("nothing")
    os.mkfifo(folder / "field" / "pipe.mcap")
    (folder / "field" / "fleet.toml").write_text('ignore = ["dead*", "robot/*", "lost*", "pipe*"]\n')
    words = ("batch", "field", "--settle", "0", "--executor", "inline", "--results", "season", "--json")
    told = json.loads(run_verb(*words, cwd=folder).stdout)
    assert (told["ignored"], told["left_out"]) == (4, 0)


def test_logs_of_another_vehicle_than_the_stated_one_are_named(season: Path, tmp_path: Path) -> None:
    """By the batch, every night, and by the index; the results stand."""
    (season / "fleet.toml").write_text('[vehicle]\npreset = "husky_a200"\n')
    words = ("batch", season, "--settle", "0", "--executor", "inline", "--results", "out")
    for _ in range(2):
        (note,) = json.loads(run_verb(*words, "--json", cwd=tmp_path).stdout)["notes"]
        assert note.startswith(
            "1 log indicates a Clearpath Warthog, and not the Clearpath Husky A200 that is"
        )
        assert "season/d; check [vehicle]" in note
    assert note in unescape((tmp_path / "out" / "index.html").read_text())
    (season / "fleet.toml").unlink()
    assert json.loads(run_verb(*words, "--json", cwd=tmp_path).stdout)["notes"] == []
    assert "indicates a" not in (tmp_path / "out" / "index.html").read_text()


def test_robots_of_one_type_are_not_pooled_without_a_word(season: Path, tmp_path: Path) -> None:
    """By the batch that brings the second robot, though it is asked for that one alone, and by the index."""
    words = ("--settle", "0", "--executor", "inline", "--results", "out", "--json")
    notes = []
    for name, robot in (("a", "husky_7"), ("b", "husky_9")):
        (season / robot).mkdir()
        (season / f"{name}.mcap").rename(season / robot / "run.mcap")
        notes.append(json.loads(run_verb("batch", season / robot, *words, cwd=tmp_path).stdout)["notes"])
    assert notes[0] == []
    (note,) = notes[1]
    assert "husky_7 in husky_7/run; husky_9 in husky_9/run" in note
    assert note in unescape((tmp_path / "out" / "index.html").read_text())
    lines = re.findall(r'\[\[match\]\] glob = ("[^"]*"), vehicle.name = ("[^"]*")', note)
    (fleet,) = re.findall(r"In (\S+fleet.toml)", note)
    Path(fleet).write_text(
        "".join(f"[[match]]\nglob = {glob}\nvehicle.name = {one}\n" for glob, one in lines)
    )
    told = json.loads(run_verb("batch", season / "husky_7", season / "husky_9", *words, cwd=tmp_path).stdout)
    assert (told["done"], told["notes"]) == (2, [])
    assert sorted(one.part("vehicle")["id"] for one in Store(tmp_path / "out").manifests()) == [
        "husky_7",
        "husky_9",
    ]
    assert "count as those of one robot" not in (tmp_path / "out" / "index.html").read_text()


def test_a_fleet_file_reaches_the_logs_behind_a_link(season: Path, tmp_path: Path) -> None:
    """As they are listed: by its plain keys and by the globs of its matches."""
    logs = tmp_path / "logs"
    logs.mkdir()
    (logs / "husky_7").symlink_to(season)
    (season / "b.mcap").rename(tmp_path / "b.mcap")
    (logs / "one.mcap").symlink_to(tmp_path / "b.mcap")
    match = '[[match]]\nglob = "husky_7/*"\n[match.run]\nterrain = "clay"\n'
    (logs / "fleet.toml").write_text(f'[run]\nterrain = "mud"\n{match}')
    words = ("batch", "logs", "--settle", "0", "--executor", "inline", "--results", "out")
    for _ in range(2):
        run_verb(*words, cwd=tmp_path)
        runs = Store(tmp_path / "out").query("SELECT run, terrain FROM runs ORDER BY run")
        assert {run[-1]: terrain for run, terrain in runs.rows()} == {"b": "mud"} | dict.fromkeys(
            "acd", "clay"
        )
    (logs / "fleet.toml").write_text('[run]\nterrain = "mud"\n')
    (season / "fleet.toml").write_text('[run]\ndataset = "near"\n')
    run_verb(*words, cwd=tmp_path)
    runs = Store(tmp_path / "out").query("SELECT terrain, dataset FROM runs")
    assert sorted(runs.rows())[1:] == [("mud", "near")] * 3
    run_verb("analyze", "logs/husky_7/a.mcap", "--results", "other", "--no-report", cwd=tmp_path)
    assert Store(tmp_path / "other").query("SELECT terrain FROM runs")["terrain"].to_list() == ["mud"]
