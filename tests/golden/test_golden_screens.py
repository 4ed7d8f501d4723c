"""Screens of the verbs, whole, as a user reads them: of a stored run, of a made-up season, of refusals."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from comparison_store import Run, make_budget, write_run
from golden import format_shape, read_page
from verbs import run_verb

from pipeline.export import list_targets
from pipeline.simulate import simulate_case
from pipeline.store import Store

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    Check = Callable[[str, str], None]

RUN = "field/wide"
ON = ("--on", RUN)
READING = {
    "analyze.txt": [("analyze", "field/wide.mcap"), ("analyze", "field/wide.mcap", "--all")],
    "diagnose.txt": [
        ("diagnose", RUN),
        ("diagnose", RUN, "--all"),
        ("diagnose", RUN, "--apply", "mine.toml"),
    ],
    "inspect.txt": [("inspect", "field/wide.mcap"), ("inspect", "field/cut.mcap")],
    "results.txt": [
        ("results", "status"),
        ("results", "verify"),
        ("results", "status", RUN),
        ("results", "query", "SELECT run, input, subset, samples FROM aggregates ORDER BY input, subset"),
    ],
    "model.txt": [
        ("model", "show", "husky.toml"),
        ("model", "add", "husky.toml", "effective_track", *ON),
        ("model", "add", "husky.toml", "slope_creep", *ON),
        ("model", "add", "husky.toml", "drive_lag", *ON, "--input", "measured"),
        ("model", "add", "husky.toml", "drive_lag", *ON),
        ("model", "add", "husky.toml", "motor_imbalance", *ON),
        ("model", "fit", "husky.toml", *ON, "--input", "measured"),
        ("model", "show", "husky.toml"),
        ("model", "drop", "husky.toml", "drive_lag", *ON),
        ("model", "new", "plain.toml", "drive_lag", "--vehicle", "husky_a200"),
        ("model", "compare", "husky.toml", "plain.toml", *ON),
        ("model", "new", "jackal.toml", "--vehicle", "jackal"),
        ("model", "fit", "jackal.toml", *ON),
        ("model", "literature"),
        ("model", "literature", "icr_offset"),
    ],
    "fleet_of_one.txt": [("fleet", "fit"), ("fleet", "show", "--all")],
    "effects.txt": [
        ("effects",),
        ("effects", "drive_lag"),
        ("effects", "motor_imbalance"),
        ("effects", "drvie_lag"),
    ],
    "help.txt": [("--help",), ("help", "model", "add"), ("help", "fleet"), ("help", "results")],
    "usage.txt": [
        ("fly",),
        ("analyze",),
        ("analyze", "log.mcap", "--input", "guess"),
        ("model", "add", "robot.toml", "drive_lag"),
        ("model", "export", "robot.toml"),
        ("fleet", "trend", "results", "other"),
    ],
}
"""Commands by the file that holds what they print, in the folder of the stored run, one after the other."""
JSON = {
    "analyze": ("analyze", "field/wide.mcap"),
    "diagnose": ("diagnose", RUN),
    "inspect": ("inspect", "field/cut.mcap"),
    "status_of_a_run": ("results", "status", RUN),
    "status": ("results", "status"),
    "verify": ("results", "verify"),
    "model_show": ("model", "show", "husky.toml"),
    "model_add": ("model", "add", "husky.toml", "effective_track", *ON),
    "effects": ("effects", "drive_lag"),
}
SEASON = {
    "compare.txt": [("compare", "--by", "run"), ("compare",), ("compare", "--causes")],
    "fleet.txt": [
        ("fleet", "fit"),
        ("fleet", "show", "--all"),
        ("fleet", "trend"),
        ("fleet", "map"),
    ],
}
SEASON_JSON = {
    "compare": ("compare",),
    "causes": ("compare", "--causes"),
    "fleet_fit": ("fleet", "fit"),
    "fleet_trend": ("fleet", "trend"),
}
NOT_MOVING = [
    ("analyze", "air.mcap"),
    ("diagnose", "air"),
    ("diagnose", "air", "--apply", "air.toml"),
    ("plan", "air"),
    ("model", "add", "husky.toml", "effective_track", "--on", "air"),
    ("check", RUN, "air"),
    ("fleet", "fit"),
    ("fleet", "trend"),
]
DAY_NS = 86_400 * 10**9


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "110")


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of a Warthog on three grounds, a day each: it slips on ice, and its track is wider at the end."""
    folder = tmp_path_factory.mktemp("season")
    store, rng = Store(folder / "results"), np.random.default_rng(3)
    grounds = [("gravel", 0.3, 1.0)] * 5 + [("ice", 1.2, 0.7)] * 5 + [("asphalt", 0.2, 1.0)] * 4
    for day, (terrain, slip, radius) in enumerate(grounds):
        track = (1.6 if day < 10 else 1.9) + 0.01 * rng.normal()
        causes = {"effective_track": 0.5, "wheel_radius": 4.0 * (1.0 - radius), "disturbance": 0.1}
        squares = {name: square * math.exp(0.1 * rng.normal()) for name, square in causes.items()}
        write_run(
            store,
            Run(
                name=f"{terrain}_{day:02d}",
                dataset=f"warthog_{terrain}",
                terrain=terrain,
                median=slip * math.exp(0.1 * rng.normal()),
                seconds=30.0,
                start_ns=1_700_000_000 * 10**9 + day * DAY_NS,
                estimates=[
                    ("effective_track", "k", track, 0.005),
                    ("wheel_radius", "k", radius + 0.01 * rng.normal(), 0.01),
                ],
                budget=make_budget(
                    {name: one * math.exp(0.1 * rng.normal()) for name, one in squares.items()}
                ),
            ),
            seed=day,
        )
    return folder


def transcribe(commands: Iterable[tuple[str, ...]], folder: Path) -> str:
    """What each command prints, below it, with its exit code where that is not 0; without progress."""
    parts = []
    for words in commands:
        done = run_verb(*words, cwd=folder)
        said = [
            line for line in done.stderr.splitlines() if done.returncode == 2 or line.startswith("slip: ")
        ]
        code = f"\n[{done.returncode}]" if done.returncode else ""
        parts.append("\n".join([f"$ slip {' '.join(words)}", done.stdout.rstrip(), *said]).rstrip() + code)
    return "\n\n".join(parts).replace(str(folder), "FOLDER")


def cut(place: Path) -> None:
    whole = (place / "field" / "wide.mcap").read_bytes()
    (place / "field" / "cut.mcap").write_bytes(whole[: len(whole) * 2 // 3])


@pytest.mark.parametrize("name", READING)
def test_screens_of_a_run(name: str, place: Path, check_golden: Check) -> None:
    cut(place)
    check_golden(f"screen_{name}", transcribe(READING[name], place))


def test_keys_of_json(place: Path, season: Path, check_golden: Check) -> None:
    cut(place)
    parts = []
    for name, words in (*JSON.items(), *SEASON_JSON.items()):
        done = run_verb(*words, "--json", cwd=season if name in SEASON_JSON else place)
        parts.append(f"{name}:\n{format_shape(done.stdout)}")
    check_golden("json_keys.txt", "\n\n".join(parts))


def test_screens_and_pages_of_a_season(season: Path, check_golden: Check) -> None:
    for name, commands in SEASON.items():
        check_golden(f"screen_{name}", transcribe(commands, season))
    pages = [(one.name, one.read_text("utf-8")) for one in sorted((season / "results").glob("*.html"))]
    check_golden("pages_of_a_season.txt", "\n\n".join(f"{name}:\n{read_page(page)}" for name, page in pages))


def test_a_vehicle_that_does_not_move_is_refused_by_every_verb(place: Path, check_golden: Check) -> None:
    simulate_case("husky_in_the_air", out=place / "air.mcap", duration_s=40.0)
    check_golden("screen_not_moving.txt", transcribe(NOT_MOVING, place))


def test_files_for_other_programs(place: Path, check_golden: Check) -> None:
    """Each target gets the fitted model of the stored run."""
    assert run_verb("diagnose", RUN, "--apply", "mine.toml", "--quiet", cwd=place).returncode == 0
    parts = []
    for target in (one.name for one in list_targets()):
        done = run_verb("model", "export", "mine.toml", "--to", target, "--file", f"{target}.out", cwd=place)
        path = place / f"{target}.out"
        parts.append(f"{target}: {done.stdout}{done.stderr}{path.read_text() if path.is_file() else ''}")
    check_golden("exports.txt", "\n\n".join(parts).replace(str(place), "FOLDER"))


def test_a_batch_says_what_became_of_each_log(place: Path, check_golden: Check) -> None:
    cut(place)
    (place / "field" / "text.mcap").write_text("this is no recording\n" * 100)
    words = ("batch", "field", "--settle", "0", "--executor", "inline", "--results", "season")
    told = transcribe([words, words, ("results", "status", "--results", "season")], place)
    keys = format_shape(run_verb(*words, "--json", cwd=place).stdout)
    check_golden("screen_batch.txt", f"{told}\n\n{keys}")
