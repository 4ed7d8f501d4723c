"""An effect of one's own: a template that runs as it stands, and no code that a model file could name."""

import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from verbs import run_verb

from pipeline.analysis import Options
from pipeline.analysis.analyze import analyze_log
from pipeline.models import catalogue, find_effect, list_own_effects, load_effects, read_model
from pipeline.models.effect import Effect
from pipeline.run import MotionError
from pipeline.simulate import simulate_case
from pipeline.sources import find_preset
from pipeline.web.cards import list_catalogue

PAGES = sorted((Path(__file__).parents[2] / "docs" / "pages").rglob("*.md"))
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = [
    (path.name, block)
    for path in PAGES
    for block in PYTHON.findall(path.read_text(encoding="utf-8"))
    if "declare(" in block
]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_template_runs_as_it_stands_by_the_commands_that_it_prints(place: Path) -> None:
    simulate_case("husky_tile", out=place / "run.mcap", duration_s=40.0)
    told = run_verb("model", "new-effect", "side_wind.py")
    assert told.returncode == 0, told.stderr
    tested = subprocess.run([sys.executable, "side_wind.py"], capture_output=True, text=True, check=True)
    assert "are those of the formula" in tested.stdout
    make, add = (line.split()[2:] for line in told.stdout.splitlines() if line.startswith("next"))
    assert run_verb(*make).returncode == 0
    added = run_verb(*add, "--anyway")
    assert added.returncode == 0, added.stderr
    assert "side_wind.k" in added.stdout
    assert "side_wind.py" not in (place / "robot.toml").read_text(encoding="utf-8")
    for verb in (("model", "show", "robot.toml"), ("effects", "side_wind")):
        assert "side_wind" in run_verb(*verb, "--effects", "side_wind.py").stdout


def test_a_model_file_never_names_code(place: Path) -> None:
    """Code beside a model file is not run, whatever the file says; its effect is named with what to do."""
    (place / "tilt.py").write_text("import pathlib; pathlib.Path('ran').touch()", encoding="utf-8")
    head = '[vehicle]\npreset = "husky_a200"\n'
    (place / "m.toml").write_text(head + '[[effect]]\nid = "tilt"\nk = 0.2\n', encoding="utf-8")
    (place / "n.toml").write_text('effects = ["tilt.py"]\n' + head, encoding="utf-8")
    for words in ("model show m.toml", "model fit m.toml --on x.mcap", "diagnose x.mcap --model m.toml"):
        done = run_verb(*words.split())
        assert done.returncode == 1
        (line,) = done.stderr.splitlines()
        assert line.startswith("slip: m.toml:4: no effect is called 'tilt'")
        assert "--effects FILE.py" in line
    assert "unknown key 'effects'" in run_verb("model", "show", "n.toml").stderr
    assert not (place / "ran").exists()


def test_the_workbench_offers_an_effect_that_was_loaded(place: Path) -> None:
    assert run_verb("model", "new-effect", "side_wind.py").returncode == 0
    vehicle = find_preset("husky_a200")
    assert "side_wind" not in {one["id"] for one in list_catalogue(vehicle)}
    load_effects([place / "side_wind.py"])
    assert "side_wind" in {one["id"] for one in list_catalogue(vehicle)}


def test_a_file_that_is_not_there_is_named(place: Path) -> None:
    done = run_verb("model", "new", "robot.toml", "--vehicle", "husky_a200", "--effects", "wind.py")
    assert done.returncode == 1
    assert "wind.py: cannot be read" in done.stderr
    assert list(place.iterdir()) == []


def test_an_installed_package_brings_effects_by_its_entry_points(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run_verb("model", "new-effect", str(tmp_path / "side_wind.py")).returncode == 0
    monkeypatch.syspath_prepend(tmp_path)
    made = metadata.EntryPoint("wind", "side_wind", "slip.effects")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [made] if group == "slip.effects" else [])
    catalogue._list_installed.cache_clear()
    assert list(list_own_effects()) == ["side_wind"]
    assert find_effect("side_wind")(k=0.1).values == {"k": 0.1}
    broken = metadata.EntryPoint("wind", "no_such_module", "slip.effects")
    monkeypatch.setattr(metadata, "entry_points", lambda group: [broken] if group == "slip.effects" else [])
    catalogue._list_installed.cache_clear()
    with pytest.raises(MotionError, match=r"slip\.effects: wind: the effects cannot be loaded: Module"):
        find_effect("side_wind")
    assert find_effect("drive_lag")
    catalogue._list_installed.cache_clear()


def test_an_analysis_is_made_again_when_the_code_of_its_model_changed(place: Path) -> None:
    log = simulate_case("husky_tile", out=place / "run.mcap", duration_s=12.0)
    assert run_verb("model", "new-effect", "side_wind.py").returncode == 0
    new = ("model", "new", "m.toml", "side_wind", "--vehicle", "husky_a200", "--effects", "side_wind.py")
    assert run_verb(*new).returncode == 0
    own = place / "side_wind.py"
    load_effects([own])
    assert read_model(place / "m.toml").model.ids == ("side_wind",)
    options = Options(out=place / "results", model=place / "m.toml", report=False, diagnosis=False)
    assert analyze_log(log, options).computed
    assert not analyze_log(log, options).computed
    own.write_text(own.read_text(encoding="utf-8") + "\n# changed\n", encoding="utf-8")
    load_effects([own])
    assert analyze_log(log, options).computed


@pytest.mark.parametrize(("page", "block"), CODE, ids=[page for page, _ in CODE])
def test_python_of_the_handbook_runs_as_it_stands(page: str, block: str, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(block.replace('"lateral_skid"', '"my_skid"'), encoding="utf-8")
    load_effects([tmp_path / "own.py"])
    found = list_own_effects()
    assert found, page
    assert all(issubclass(effect, Effect) and effect().columns for effect in found.values())  # type: ignore[attr-defined]


def test_an_effect_of_the_catalogue_keeps_its_meaning(tmp_path: Path) -> None:
    path = tmp_path / "own.py"
    path.write_text(CODE[0][1], encoding="utf-8")
    with pytest.raises(MotionError, match="of the catalogue is called 'lateral_skid'"):
        load_effects([path])
