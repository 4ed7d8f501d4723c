"""An effect of one's own: a template that runs as it stands, in the place where a model file looks for it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from verbs import run_verb

from pipeline.models import read_model
from pipeline.models.catalogue import run_effects
from pipeline.models.effect import Effect
from pipeline.simulate import simulate_case

PAGES = sorted((Path(__file__).parents[2] / "docs" / "pages").rglob("*.md"))
PYTHON = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = [(path.name, block) for path in PAGES for block in PYTHON.findall(path.read_text(encoding="utf-8"))]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_template_runs_as_it_stands_by_the_commands_that_it_prints(place: Path) -> None:
    simulate_case("husky_tile", out=place / "run.mcap", duration_s=40.0)
    told = run_verb("model", "new-effect", "side_wind.py")
    assert told.returncode == 0, told.stderr
    tested = subprocess.run([sys.executable, "side_wind.py"], capture_output=True, text=True, check=True)
    assert "are those of the formula" in tested.stdout
    following = [line.split()[2:] for line in told.stdout.splitlines() if line.startswith("next")]
    assert len(following) == 3
    for words in following[:2]:
        assert run_verb(*words).returncode == 0, words
    added = run_verb(*following[2], "--anyway")
    assert added.returncode == 0, added.stderr
    assert "side_wind.k" in added.stdout
    text = (place / "robot.toml").read_text(encoding="utf-8")
    assert text.index('effects = ["side_wind.py"]') < text.index("[vehicle]")
    assert read_model(place / "robot.toml").model.ids == ("side_wind",)


def test_a_model_is_not_made_with_python_that_is_not_beside_it(place: Path) -> None:
    done = run_verb("model", "new", "robot.toml", "--vehicle", "husky_a200", "--own", "wind.py")
    assert done.returncode == 1
    assert "there is no such file of effects" in done.stderr
    assert list(place.iterdir()) == []


@pytest.mark.parametrize(("page", "block"), CODE, ids=[page for page, _ in CODE])
def test_python_of_the_handbook_runs_as_it_stands(page: str, block: str) -> None:
    found = run_effects(block.encode(), Path(page))
    assert all(issubclass(effect, Effect) and effect().columns for effect in found.values())  # type: ignore[attr-defined]
