"""`slip fleet map --terrain`: runs find their common places, and what cannot be placed is said."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from simulated_platforms import ORIGIN_DEG, PLATFORMS
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.datasets.terrain_map import Beside, draw_up_terrain, locate_on_earth, read_beside
from pipeline.simulate import Ground, Program, Recording, Scenario, simulate_run, write_log
from pipeline.simulate.path import CompactedGround
from pipeline.stages.satellite import from_local_plane, to_local_plane
from pipeline.store import Store

METRES_PER_DEGREE = 111_132.0


def record(path: Path, *, platform: str | None = None, **changes: object) -> Path:
    """Write the log of a drive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    scene = Scenario(duration_s=60.0, program=Program("smooth"), recording=Recording(terrain="snow"))
    if platform is not None:
        chosen = PLATFORMS[platform]
        layout = replace(scene.recording, layout=chosen.layout)
        scene = replace(scene, vehicle=chosen.vehicle, recording=layout)
    write_log(simulate_run(replace(scene, **changes)), path)  # type: ignore[arg-type]
    return path


def analyze(log: Path, results: Path) -> None:
    analyze_log(log, Options(out=results, diagnosis=False, report=False))


@pytest.fixture(scope="module")
def earth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drives of a robot with a receiver and a battery."""
    place = tmp_path_factory.mktemp("earth")
    starts = {"a": (0.0, 0.0, 0.0), "b": (3.0, -2.0, 2.0)}
    for seed, (name, start) in enumerate(starts.items()):
        log = record(place / f"{name}.mcap", platform="panther", seed=seed, start_pose=start)
        analyze(log, place / "results")
    return place


def test_runs_with_fixes_share_places_on_earth(earth: Path) -> None:
    run_verb("fleet", "map", "--terrain", "--results", earth / "results")
    drawn = draw_up_terrain(Store(earth / "results"))

    assert list(drawn.frames) == ["earth 46.78 -71.27"]
    assert len(drawn.frames["earth 46.78 -71.27"]) == 2
    assert max(drawn.frames["earth 46.78 -71.27"].values()) < 0.1
    assert drawn.cell_table["runs"].to_numpy().max() == 2
    # The truth: where the first drive began is the origin of the simulated site.
    start = drawn.cell_table.filter(pl.col("x").abs() <= 1.0, pl.col("y").abs() <= 1.0)
    assert not start.is_empty()
    away = (start["latitude"].to_numpy() - ORIGIN_DEG[0]) * METRES_PER_DEGREE
    assert np.abs(away).max() < 2.0


def test_cells_on_earth_are_polygons_of_their_size(earth: Path) -> None:
    done = run_verb("fleet", "map", "--terrain", "--cell", 4, "--json", "--results", earth / "results")
    told = json.loads(done.stdout)
    written = {name: Path(path) for name, path in told["written"].items()}
    assert set(written) == {"cells.parquet", "terrain.geojson", "terrain.html"}
    table = pl.read_parquet(written["cells.parquet"])
    assert set(table["cell"]) == {4.0}
    shapes = json.loads(written["terrain.geojson"].read_text(encoding="utf-8"))
    assert len(shapes["features"]) == table.height == len(told["cells"])
    (ring,) = shapes["features"][0]["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    corners = np.array([*ring, ring[0]])
    east, north, _ = to_local_plane(corners[:, 1], corners[:, 0], np.zeros(len(corners))).T
    assert np.hypot(np.diff(east[:5]), np.diff(north[:5])) == pytest.approx(4.0, abs=0.01)
    assert "What to expect by place" in written["terrain.html"].read_text(encoding="utf-8")


def test_a_run_whose_log_has_gone_or_changed_is_not_placed_by_it(earth: Path, tmp_path: Path) -> None:
    log = record(tmp_path / "c.mcap", platform="panther", seed=7)
    analyze(log, tmp_path / "results")
    (manifest,) = Store(tmp_path / "results").survey().manifests
    assert read_beside(manifest).reason == ""
    log.write_bytes((earth / "a.mcap").read_bytes())
    assert "another one" in read_beside(manifest).reason
    log.unlink()
    assert "no longer exists" in read_beside(manifest).reason
    drawn = draw_up_terrain(Store(tmp_path / "results"))
    (note,) = drawn.notes
    assert note.startswith("not placed with other runs, the log of this run no longer exists")
    assert list(drawn.frames) == [f"run {manifest.run}"]
    assert drawn.cell_table["latitude"].null_count() == drawn.cell_table.height


def test_runs_of_one_named_map_share_places(tmp_path: Path) -> None:
    for seed in (1, 2, 3):
        log = record(tmp_path / "logs" / f"{seed}.mcap", seed=seed)
        if seed < 3:
            log.with_suffix(".toml").write_text('[run]\nmap = "yard"\n', encoding="utf-8")
        analyze(log, tmp_path / "results")
    drawn = draw_up_terrain(Store(tmp_path / "results"))
    assert {name: len(runs) for name, runs in drawn.frames.items()} == {"map yard": 2, "run logs/3": 1}
    assert [note for note in drawn.notes if "its log has no fixes" in note and note.endswith(": logs/3")]
    # Who names the map later analyzes again, and it counts.
    (tmp_path / "logs" / "3.toml").write_text('[run]\nmap = "yard"\n', encoding="utf-8")
    analyze(tmp_path / "logs" / "3.mcap", tmp_path / "results")
    assert list(draw_up_terrain(Store(tmp_path / "results")).frames) == ["map yard"]


@pytest.mark.long
def test_ground_that_passes_compact_is_found(tmp_path: Path) -> None:
    program = Program("circle", speed_scale=1.0, turn_scale=0.2)
    scene = {"program": program, "duration_s": 420.0, "extra": CompactedGround(0.3, 0.85, 3.0)}
    analyze(record(tmp_path / "laps.mcap", **scene), tmp_path / "results")
    done = run_verb("fleet", "map", "--terrain", "--results", tmp_path / "results")
    assert "slip falls by 1" in done.stdout
    (effect,) = draw_up_terrain(Store(tmp_path / "results")).effects
    assert effect.change == pytest.approx(-0.15, abs=0.02)
    assert effect.high < -0.1


def test_hills_lean_the_vehicle_and_flat_poses_say_nothing_of_it(tmp_path: Path) -> None:
    analyze(record(tmp_path / "hill.mcap", ground=Ground(pitch_rad=0.1)), tmp_path / "results")
    cells = draw_up_terrain(Store(tmp_path / "results")).cell_table
    assert np.median(cells["lean"].to_numpy()) == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("gone", [slice(0, 3), slice(None)])
def test_poses_that_are_not_known_do_not_place_a_run(gone: slice) -> None:
    times = np.arange(0.0, 60.0, 0.5)
    path = np.stack((times, 3.0 * np.sin(0.2 * times)), axis=1)
    latitude, longitude = from_local_plane(path, (46.78, -71.27))
    fixes = np.column_stack((latitude, longitude, np.zeros(times.size)))
    path[gone] = np.nan
    found = locate_on_earth(times, path, Beside(times, fixes), (46.78, -71.27))
    if gone == slice(None):
        assert found == "its poses and its fixes do not share a time"
    else:
        assert not isinstance(found, str)
        assert found.distance_m < 1e-3
